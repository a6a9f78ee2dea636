"""The networks whose details differ from segmentation_models_pytorch's, in torch: TensorFlow's and torchvision's.

`TfDeepLab` is DeepLabv3+ as its authors built it, on aligned Xception-65 (Chollet 2017; Qi et al. 2017, COCO
challenge; Chen et al. 2018), ResNet-101 and MobileNetV2; modules are named after the scopes of its checkpoints.
`TorchvisionDeepLab` is DeepLabv3 (Chen et al. 2017) under the names of torchvision's state dicts. Written from
the papers and the published names and shapes, for golden logits; the package itself never imports torch.
"""

from __future__ import annotations

import torch
from torch import nn
from torch.nn import functional
from torch_deeplab import MOBILENET, RESNETS, InvertedResidual, ResidualUnit, conv, conv_norm

XCEPTION = (
    *(("entry_flow", block, (depth,) * 3, 2, "conv") for block, depth in enumerate((128, 256, 728), start=1)),
    *(("middle_flow", unit, (728,) * 3, 1, "sum") for unit in range(1, 17)),
    ("exit_flow", 1, (728, 1024, 1024), 2, "conv"),
    ("exit_flow", 2, (1536, 1536, 2048), 1, "none"),
)
"""Flow, number, depths, stride and shortcut of each module."""


class Placement:
    """Turns strides into dilations once the output stride is reached: for the units that follow, not at once."""

    def __init__(self, reached, output_stride):
        self.reached, self.output_stride, self.rate = reached, output_stride, 1

    def __call__(self, stride):
        if self.reached < self.output_stride:
            self.reached *= stride
            return stride, 1
        rate = self.rate
        self.rate *= stride
        return 1, rate


class Convolution(nn.Module):
    """A convolution that pads both sides alike, and its norm."""

    def __init__(self, inputs, outputs, size=1, stride=1, rate=1, groups=1):
        super().__init__()
        self.conv, self.norm = conv(inputs, outputs, size, stride, rate, groups), nn.BatchNorm2d(outputs)

    def forward(self, x):
        return self.norm(self.conv(x))


class XceptionModule(nn.Module):
    """Three separable convolutions, the last one strided, beside a shortcut."""

    def __init__(self, inputs, depths, stride, rate, shortcut):
        super().__init__()
        self.kind = shortcut
        if shortcut == "conv":
            self.shortcut = Convolution(inputs, depths[2], 1, stride)
        for index, (before, after) in enumerate(zip((inputs, *depths), depths, strict=False), start=1):
            step = stride if index == 3 else 1
            setattr(self, f"separable_conv{index}_depthwise", Convolution(before, before, 3, step, rate, before))
            setattr(self, f"separable_conv{index}_pointwise", Convolution(before, after))

    def forward(self, x):
        inside = self.kind == "none"
        result = x
        for index in (1, 2, 3):
            depthwise = getattr(self, f"separable_conv{index}_depthwise")
            pointwise = getattr(self, f"separable_conv{index}_pointwise")
            if inside:
                result = torch.relu(pointwise(torch.relu(depthwise(result))))
            else:
                result = pointwise(depthwise(torch.relu(result)))
            if index == 2:
                self.second = result
        if self.kind == "conv":
            return result + self.shortcut(x)
        return result + x if self.kind == "sum" else result


class Xception65(nn.Module):
    channels = (256, 2048)

    def __init__(self, output_stride):
        super().__init__()
        self.conv1_1, self.conv1_2 = Convolution(3, 32, 3, 2), Convolution(32, 64, 3)
        inputs, place = 64, Placement(2, output_stride)
        for flow, number, depths, stride, shortcut in XCEPTION:
            self.add_module(f"{flow}_{number}", XceptionModule(inputs, depths, *place(stride), shortcut))
            inputs = depths[2]

    def forward(self, x):
        x = torch.relu(self.conv1_2(torch.relu(self.conv1_1(x))))
        for flow, number, *_ in XCEPTION:
            x = getattr(self, f"{flow}_{number}")(x)
        return self.entry_flow_2.second, x


class ResNet(nn.Module):
    """Of bottlenecks, under torchvision's names."""

    channels = (256, 2048)

    def __init__(self, name, output_stride):
        super().__init__()
        self.conv1, self.bn1 = conv(3, 64, 7, 2), nn.BatchNorm2d(64)
        inputs, place = 64, Placement(4, output_stride)
        for stage, count in enumerate(RESNETS[name]):
            units, width = [], 64 * 2**stage
            for unit in range(count):
                stride, rate = place(2 if stage and not unit else 1)
                units.append(ResidualUnit(inputs, width, stride, rate, True))
                if not unit:
                    units[0].downsample = nn.Sequential(conv(inputs, 4 * width, 1, stride), nn.BatchNorm2d(4 * width))
                inputs = 4 * width
            setattr(self, f"layer{stage + 1}", nn.Sequential(*units))

    def forward(self, x):
        x = functional.max_pool2d(torch.relu(self.bn1(self.conv1(x))), 3, 2, 1)
        low = self.layer1(x)
        return low, self.layer4(self.layer3(self.layer2(low)))


class MobileNetV2(nn.Module):
    """Without its last convolution, under torchvision's names."""

    channels = (24, 320)

    def __init__(self, output_stride):
        super().__init__()
        units, inputs, place = [conv_norm(3, 32, 3, nn.ReLU6, 2)], 32, Placement(2, output_stride)
        for expansion, outputs, count, first in MOBILENET:
            for unit in range(count):
                units.append(InvertedResidual(inputs, outputs, expansion, *place(1 if unit else first)))
                inputs = outputs
        self.features = nn.Sequential(*units)

    def forward(self, x):
        low = self.features[:4](x)
        return low, self.features[4:](low)


def resized(x, like):
    return functional.interpolate(x, like.shape[2:], mode="bilinear", align_corners=True)


class TfDeepLab(nn.Module):
    """Images on a scale of -1 to 1 (B, 3, H, W) -> logits; sides of a multiple of the output stride and 1."""

    def __init__(self, backbone, output_stride=16, classes=3):
        super().__init__()
        backbones = {"xception65": Xception65, "mobilenet_v2": MobileNetV2}
        self.backbone = backbones[backbone](output_stride) if backbone in backbones else ResNet(backbone, output_stride)
        if not backbone.startswith("resnet"):
            for module in self.backbone.modules():
                if isinstance(module, nn.BatchNorm2d):
                    module.eps = 1e-3
        low, high = self.backbone.channels
        rates = () if backbone == "mobilenet_v2" else (6, 12, 18) if output_stride == 16 else (12, 24, 36)
        self.image_pooling, self.aspp0 = Convolution(high, 256), Convolution(high, 256)
        self.branches = range(1, len(rates) + 1)
        for index, rate in zip(self.branches, rates, strict=True):
            self.add_separable(f"aspp{index}", high, rate)
        self.concat_projection = Convolution(256 * (2 + len(rates)), 256)
        self.feature_projection0 = Convolution(low, 48)
        self.add_separable("decoder_conv0", 304)
        self.add_separable("decoder_conv1", 256)
        self.segmentation_head = nn.Conv2d(256, classes, 1)

    def add_separable(self, name, inputs, rate=1):
        setattr(self, f"{name}_depthwise", Convolution(inputs, inputs, 3, 1, rate, inputs))
        setattr(self, f"{name}_pointwise", Convolution(inputs, 256))

    def separable(self, name, x):
        x = torch.relu(getattr(self, f"{name}_depthwise")(x))
        return torch.relu(getattr(self, f"{name}_pointwise")(x))

    def forward(self, x):
        low, high = self.backbone(x)
        pooled = resized(torch.relu(self.image_pooling(high.mean((2, 3), keepdim=True))), high)
        branches = [pooled, torch.relu(self.aspp0(high))]
        branches += [self.separable(f"aspp{index}", high) for index in self.branches]
        features = torch.relu(self.concat_projection(torch.cat(branches, dim=1)))
        features = torch.cat([resized(features, low), torch.relu(self.feature_projection0(low))], dim=1)
        features = self.separable("decoder_conv1", self.separable("decoder_conv0", features))
        return resized(self.segmentation_head(features), x)


class DenseAspp(nn.Module):
    def __init__(self, inputs, rates):
        super().__init__()
        branches = [conv_norm(inputs, 256, 1, nn.ReLU)]
        branches += [conv_norm(inputs, 256, 3, nn.ReLU, 1, rate) for rate in rates]
        pool = nn.Sequential(nn.AdaptiveAvgPool2d(1), conv(inputs, 256, 1), nn.BatchNorm2d(256), nn.ReLU())
        self.convs = nn.ModuleList([*branches, pool])
        self.project = conv_norm(256 * (2 + len(rates)), 256, 1, nn.ReLU)

    def forward(self, x):
        branches = [branch(x) for branch in self.convs]
        branches[-1] = branches[-1].expand(-1, -1, *x.shape[2:])
        return self.project(torch.cat(branches, dim=1))


class TorchvisionDeepLab(nn.Module):
    """Normalised images (B, 3, H, W) -> logits; the auxiliary classifier serves training alone and is left out."""

    def __init__(self, backbone, output_stride=8, classes=3):
        super().__init__()
        self.backbone = ResNet(backbone, output_stride)
        aspp = DenseAspp(2048, (12, 24, 36) if output_stride == 8 else (6, 12, 18))
        self.classifier = nn.Sequential(
            aspp, conv(256, 256, 3), nn.BatchNorm2d(256), nn.ReLU(), nn.Conv2d(256, classes, 1)
        )

    def forward(self, x):
        logits = self.classifier(self.backbone(x)[1])
        return functional.interpolate(logits, x.shape[2:], mode="bilinear", align_corners=False)

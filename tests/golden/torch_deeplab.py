"""DeepLabv3+ in torch, as segmentation_models_pytorch 0.6.0 builds it: same names, shapes and sums.

Written from the published names and shapes of its state dicts and from the layout of torchvision's
backbones, for golden logits and for timing; the package itself never imports torch.
"""

from __future__ import annotations

import torch
from torch import nn

RATES = (12, 24, 36)
MOBILENET = ((1, 16, 1, 1), (6, 24, 2, 2), (6, 32, 3, 2), (6, 64, 4, 2), (6, 96, 3, 1), (6, 160, 3, 2), (6, 320, 1, 1))
RESNETS = {"resnet18": (2, 2, 2, 2), "resnet50": (3, 4, 6, 3), "resnet101": (3, 4, 23, 3)}


def conv(inputs, outputs, size, stride=1, dilation=1, groups=1):
    reach = dilation * (size - 1) // 2
    return nn.Conv2d(inputs, outputs, size, stride, reach, dilation, groups, bias=False)


def conv_norm(inputs, outputs, size, activation, stride=1, dilation=1, groups=1):
    return nn.Sequential(
        conv(inputs, outputs, size, stride, dilation, groups), nn.BatchNorm2d(outputs), activation(inplace=True)
    )


class InvertedResidual(nn.Module):
    def __init__(self, inputs, outputs, expansion, stride, dilation):
        super().__init__()
        hidden = inputs * expansion
        expand = [conv_norm(inputs, hidden, 1, nn.ReLU6)] if expansion > 1 else []
        depthwise = conv_norm(hidden, hidden, 3, nn.ReLU6, stride, dilation, hidden)
        self.conv = nn.Sequential(*expand, depthwise, conv(hidden, outputs, 1), nn.BatchNorm2d(outputs))
        self.shortcut = stride == 1 and inputs == outputs

    def forward(self, x):
        return x + self.conv(x) if self.shortcut else self.conv(x)


class MobileNetV2(nn.Module):
    def __init__(self, output_stride):
        super().__init__()
        units, inputs, reached, dilation = [conv_norm(3, 32, 3, nn.ReLU6, 2)], 32, 2, 1
        for expansion, outputs, count, first in MOBILENET:
            for unit in range(count):
                stride = first if unit == 0 else 1
                if reached * stride > output_stride:
                    dilation, stride = dilation * stride, 1
                reached *= stride
                units.append(InvertedResidual(inputs, outputs, expansion, stride, dilation))
                inputs = outputs
        self.features = nn.Sequential(*units, conv_norm(inputs, 1280, 1, nn.ReLU6))
        self.channels = (24, 1280)

    def forward(self, x):
        low = self.features[:4](x)
        return low, self.features[4:](low)


class ResidualUnit(nn.Module):
    def __init__(self, inputs, width, stride, dilation, bottleneck):
        super().__init__()
        outputs = width * 4 if bottleneck else width
        if bottleneck:
            plan = [(inputs, width, 1, 1, 1), (width, width, 3, stride, dilation), (width, outputs, 1, 1, 1)]
        else:
            plan = [(inputs, width, 3, stride, dilation), (width, width, 3, 1, dilation)]
        for index, step in enumerate(plan, start=1):
            setattr(self, f"conv{index}", conv(*step))
            setattr(self, f"bn{index}", nn.BatchNorm2d(step[1]))
        self.count = len(plan)
        self.downsample = None

    def forward(self, x):
        y = x
        for index in range(1, self.count + 1):
            y = getattr(self, f"bn{index}")(getattr(self, f"conv{index}")(y))
            if index < self.count:
                y = torch.relu(y)
        return torch.relu(y + (x if self.downsample is None else self.downsample(x)))


class ResNet(nn.Module):
    def __init__(self, name, output_stride):
        super().__init__()
        bottleneck = name != "resnet18"
        self.conv1, self.bn1 = conv(3, 64, 7, 2), nn.BatchNorm2d(64)
        inputs, reached, dilation = 64, 4, 1
        for stage, (width, count) in enumerate(zip((64, 128, 256, 512), RESNETS[name], strict=True)):
            stride = 2 if stage else 1
            if reached * stride > output_stride:
                dilation, stride = dilation * stride, 1
            reached *= stride
            units = []
            for unit in range(count):
                units.append(ResidualUnit(inputs, width, stride if unit == 0 else 1, dilation, bottleneck))
                outputs = width * 4 if bottleneck else width
                if unit == 0 and (stage or bottleneck):
                    units[0].downsample = nn.Sequential(conv(inputs, outputs, 1, stride), nn.BatchNorm2d(outputs))
                inputs = outputs
            setattr(self, f"layer{stage + 1}", nn.Sequential(*units))
        self.channels = (256, 2048) if bottleneck else (64, 512)

    def forward(self, x):
        x = nn.functional.max_pool2d(torch.relu(self.bn1(self.conv1(x))), 3, 2, 1)
        low = self.layer1(x)
        return low, self.layer4(self.layer3(self.layer2(low)))


def separable(inputs, outputs, dilation=1):
    return nn.Sequential(conv(inputs, inputs, 3, 1, dilation, inputs), conv(inputs, outputs, 1))


class Aspp(nn.Module):
    def __init__(self, inputs):
        super().__init__()
        branches = [conv_norm(inputs, 256, 1, nn.ReLU)]
        branches += [nn.Sequential(separable(inputs, 256, rate), nn.BatchNorm2d(256), nn.ReLU()) for rate in RATES]
        pool = nn.Sequential(nn.AdaptiveAvgPool2d(1), conv(inputs, 256, 1), nn.BatchNorm2d(256), nn.ReLU())
        self.convs = nn.ModuleList([*branches, pool])
        self.project = conv_norm(5 * 256, 256, 1, nn.ReLU)

    def forward(self, x):
        branches = [branch(x) for branch in self.convs]
        branches[-1] = branches[-1].expand(-1, -1, *x.shape[2:])
        return self.project(torch.cat(branches, dim=1))


class Decoder(nn.Module):
    def __init__(self, low, high, output_stride):
        super().__init__()
        self.aspp = nn.Sequential(Aspp(high), separable(256, 256), nn.BatchNorm2d(256), nn.ReLU())
        self.up = nn.UpsamplingBilinear2d(scale_factor=output_stride // 4)
        self.block1 = conv_norm(low, 48, 1, nn.ReLU)
        self.block2 = nn.Sequential(separable(304, 256), nn.BatchNorm2d(256), nn.ReLU())

    def forward(self, low, high):
        return self.block2(torch.cat([self.up(self.aspp(high)), self.block1(low)], dim=1))


class DeepLabV3Plus(nn.Module):
    """Normalised images (B, 3, H, W) -> logits (B, classes, H, W); sides that 32 divides."""

    def __init__(self, backbone, output_stride=16, classes=3):
        super().__init__()
        self.encoder = MobileNetV2(output_stride) if backbone == "mobilenet_v2" else ResNet(backbone, output_stride)
        self.decoder = Decoder(*self.encoder.channels, output_stride)
        self.segmentation_head = nn.Sequential(nn.Conv2d(256, classes, 1), nn.UpsamplingBilinear2d(scale_factor=4))

    def forward(self, x):
        return self.segmentation_head(self.decoder(*self.encoder(x)))

"""Writes networks_golden.npz: what torchvision's FCN, segmentation_models_pytorch's Unet and a SegNet of torch's say.

Needs torch (CPU), torchvision and segmentation_models_pytorch, whose own networks are run on a seeded image with seeded
weights; the SegNet is torchvision's VGG-16 and torch's own unpooling.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import segmentation_models_pytorch
import torch
import torchvision
from seeded_weights import seeded_image, seeded_state

CLASSES, SIZE, STEP = 3, (64, 96), 3
"""Of the logits every third row and column is kept; of the labels all."""
MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


def unet(backbone: str) -> torch.nn.Module:
    return segmentation_models_pytorch.Unet(backbone, encoder_weights=None, classes=CLASSES)


def fcn(backbone: str) -> torch.nn.Module:
    make = getattr(torchvision.models.segmentation, f"fcn_{backbone}")
    return make(weights=None, weights_backbone=None, num_classes=CLASSES, aux_loss=False)


class SegNet(torch.nn.Module):
    """Pooling that tells its indices, and its mirror."""

    def __init__(self) -> None:
        super().__init__()
        self.features = torchvision.models.vgg16_bn(weights=None).features
        for layer in self.features:
            if isinstance(layer, torch.nn.MaxPool2d):
                layer.return_indices = True
        widths = (512, 512, 256, 128, 64)
        steps = [
            [self.block(width, width), *([self.block(width, after)] if after else [])]
            for width, after in zip(widths, (*widths[1:], 0), strict=True)
        ]
        self.decoder = torch.nn.ModuleList(torch.nn.Sequential(*step) for step in steps)
        self.classifier = torch.nn.Conv2d(64, CLASSES, 3, padding=1)

    @staticmethod
    def block(inputs: int, outputs: int) -> torch.nn.Module:
        conv = torch.nn.Conv2d(inputs, outputs, 3, padding=1, bias=False)
        return torch.nn.Sequential(conv, torch.nn.BatchNorm2d(outputs), torch.nn.ReLU())

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        indices = []
        for layer in self.features:
            x = layer(x)
            if isinstance(layer, torch.nn.MaxPool2d):
                x, places = x
                indices.append(places)
        for step in self.decoder:
            x = step(torch.nn.functional.max_unpool2d(x, indices.pop(), 2))
        return self.classifier(x)


def segnet(backbone: str) -> torch.nn.Module:
    return SegNet()


CASES = (
    ("segnet", segnet, "vgg16"),
    ("unet", unet, "mobilenet_v2"),
    ("unet", unet, "resnet18"),
    ("unet", unet, "resnet50"),
    ("fcn", fcn, "resnet50"),
)


def main() -> None:
    image, content = seeded_image(*SIZE), {}
    scaled = (image.astype(np.float32) / 255 - np.float32(MEAN)) / np.float32(STD)
    for kind, make, backbone in CASES:
        network = make(backbone).eval()
        shapes = {name: tuple(value.shape) for name, value in network.state_dict().items()}
        network.load_state_dict({name: torch.from_numpy(value) for name, value in seeded_state(shapes).items()})
        with torch.no_grad():
            result = network(torch.from_numpy(scaled.transpose(2, 0, 1)[None]))
        logits = (result["out"] if kind == "fcn" else result)[0].numpy().transpose(1, 2, 0)
        labels = (logits - logits.mean(axis=(0, 1))).argmax(axis=-1).astype(np.uint8)
        spread = [round(float(value), 2) for value in (logits.std(), np.abs(logits).max())]
        print(kind, backbone, "std, max:", spread, "classes:", np.bincount(labels.ravel(), minlength=CLASSES))
        key = f"{kind}_{backbone}"
        content[f"names/{key}"] = np.array("\n".join(f"{name} {list(shape)}" for name, shape in shapes.items()))
        content[f"logits/{key}"], content[f"labels/{key}"] = logits[::STEP, ::STEP], labels
    np.savez_compressed(Path(__file__).with_name("networks_golden.npz"), **content)


if __name__ == "__main__":
    main()

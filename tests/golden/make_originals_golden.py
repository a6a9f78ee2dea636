"""Writes originals_golden.npz: what the torch networks of torch_originals.py say of seeded images.

Needs torch (CPU). `--names DIR` compares names and shapes with the list of torchvision's own network
(`torchvision_deeplabv3_resnet50.txt`, one `name<TAB>shape<TAB>type` a line).
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from seeded_weights import seeded_image, seeded_state
from torch_deeplab import DeepLabV3Plus
from torch_originals import TfDeepLab, TorchvisionDeepLab

TF_SCALE = ((0.5, 0.5, 0.5), (0.5, 0.5, 0.5))
IMAGENET_SCALE = ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))
FAMILIES = {
    "tf": (TfDeepLab, TF_SCALE),
    "torchvision": (TorchvisionDeepLab, IMAGENET_SCALE),
    "smp": (DeepLabV3Plus, IMAGENET_SCALE),
}
CASES = (
    ("tf", "xception65", 16, (65, 97)),
    ("tf", "xception65", 8, (65, 97)),
    ("tf", "resnet101", 16, (65, 97)),
    ("tf", "mobilenet_v2", 16, (65, 97)),
    ("torchvision", "resnet50", 8, (64, 96)),
    ("torchvision", "resnet101", 8, (64, 96)),
    ("smp", "resnet101", 16, (64, 96)),
)
STEP = 3
"""Of the logits every third row and column is kept; of the labels all."""


def labels_of(logits: np.ndarray) -> np.ndarray:
    """The best class of each pixel once every class is as good on average: with random weights one may win all."""
    return (logits - logits.mean(axis=(0, 1))).argmax(axis=-1).astype(np.uint8)


def seeded_network(family: str, backbone: str, output_stride: int) -> torch.nn.Module:
    network = FAMILIES[family][0](backbone, output_stride).eval()
    shapes = {name: tuple(value.shape) for name, value in network.state_dict().items()}
    network.load_state_dict({name: torch.from_numpy(value) for name, value in seeded_state(shapes).items()})
    return network


def logits(network: torch.nn.Module, image: np.ndarray, family: str) -> np.ndarray:
    mean, std = FAMILIES[family][1]
    scaled = (image.astype(np.float32) / 255 - np.float32(mean)) / np.float32(std)
    with torch.no_grad():
        return network(torch.from_numpy(scaled.transpose(2, 0, 1)[None]))[0].numpy().transpose(1, 2, 0)


def check_names(folder: Path) -> None:
    state = TorchvisionDeepLab("resnet50", classes=21).state_dict()
    ours = {f"{name}\t{tuple(value.shape)}" for name, value in state.items()}
    lines = (folder / "torchvision_deeplabv3_resnet50.txt").read_text().splitlines()
    theirs = {line.rpartition("\t")[0] for line in lines if not line.startswith("aux_classifier.")}
    assert ours == theirs, sorted(ours ^ theirs)[:10]
    print(f"all {len(ours)} names and shapes agree")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--names", type=Path)
    arguments = parser.parse_args()
    if arguments.names:
        check_names(arguments.names)
        return
    content = {}
    for family, backbone, stride, (height, width) in CASES:
        network = seeded_network(family, backbone, stride)
        shapes = [f"{name} {list(value.shape)}" for name, value in network.state_dict().items()]
        key = f"{family}_{backbone}_{stride}_{height}x{width}"
        result = logits(network, seeded_image(height, width), family)
        spread = [round(float(value), 2) for value in (result.std(), np.abs(result).max())]
        print(key, "std, max:", spread, "classes:", np.bincount(labels_of(result).ravel(), minlength=3))
        content[f"names/{family}_{backbone}"] = np.array("\n".join(shapes))
        content[f"logits/{key}"] = result[::STEP, ::STEP]
        content[f"labels/{key}"] = labels_of(result)
    np.savez_compressed(Path(__file__).with_name("originals_golden.npz"), **content)


if __name__ == "__main__":
    main()

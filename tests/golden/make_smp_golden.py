"""Writes smp_golden.npz: what a torch DeepLabv3+ of segmentation_models_pytorch's design says of seeded images.

Needs torch (CPU). `python make_smp_golden.py` writes the golden file; with `--large DIR` it writes whole logits
at full sizes there instead, which are too large to keep. `--names DIR` compares names and shapes with lists of
the original's (`smp060_DeepLabV3Plus_BACKBONE.txt`, one `name<TAB>shape<TAB>type` a line).
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from seeded_weights import seeded_image, seeded_state
from torch_deeplab import DeepLabV3Plus

BACKBONES = ("mobilenet_v2", "resnet18", "resnet50")
STRIDES = (16, 8)
SIZES = ((64, 96), (96, 128))
LARGE_SIZES = ((384, 512), (512, 512), (352, 1216))
MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
STEP = 3
"""Of the logits every third row and column is kept; of the labels all."""


def seeded_network(backbone: str, output_stride: int) -> DeepLabV3Plus:
    network = DeepLabV3Plus(backbone, output_stride).eval()
    shapes = {name: tuple(value.shape) for name, value in network.state_dict().items()}
    network.load_state_dict({name: torch.from_numpy(value) for name, value in seeded_state(shapes).items()})
    return network


def logits(network: DeepLabV3Plus, image: np.ndarray) -> np.ndarray:
    scaled = (image.astype(np.float32) / 255 - np.float32(MEAN)) / np.float32(STD)
    with torch.no_grad():
        return network(torch.from_numpy(scaled.transpose(2, 0, 1)[None]))[0].numpy().transpose(1, 2, 0)


def check_names(folder: Path) -> None:
    for backbone in BACKBONES:
        ours = {f"{name}\t{tuple(value.shape)}" for name, value in DeepLabV3Plus(backbone).state_dict().items()}
        lines = (folder / f"smp060_DeepLabV3Plus_{backbone}.txt").read_text().splitlines()
        theirs = {line.rpartition("\t")[0] for line in lines}
        assert ours == theirs, (backbone, sorted(ours ^ theirs)[:10])
        print(f"{backbone}: all {len(ours)} names and shapes agree")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--large", type=Path)
    parser.add_argument("--names", type=Path)
    arguments = parser.parse_args()
    if arguments.names:
        check_names(arguments.names)
        return
    content = {}
    for backbone in BACKBONES:
        for stride in STRIDES:
            network = seeded_network(backbone, stride)
            shapes = [f"{name} {list(value.shape)}" for name, value in network.state_dict().items()]
            content[f"names/{backbone}"] = np.array("\n".join(shapes))
            for height, width in LARGE_SIZES if arguments.large else SIZES:
                key = f"{backbone}_{stride}_{height}x{width}"
                result = logits(network, seeded_image(height, width))
                spread = [round(float(value), 2) for value in (result.std(), np.abs(result).max())]
                print(key, "std, max:", spread, "classes:", np.bincount(result.argmax(-1).ravel(), minlength=3))
                if arguments.large:
                    arguments.large.mkdir(parents=True, exist_ok=True)
                    np.save(arguments.large / f"{key}.npy", result)
                    continue
                content[f"logits/{key}"] = result[::STEP, ::STEP]
                content[f"labels/{key}"] = result.argmax(-1).astype(np.uint8)
    if not arguments.large:
        np.savez_compressed(Path(__file__).with_name("smp_golden.npz"), **content)


if __name__ == "__main__":
    main()

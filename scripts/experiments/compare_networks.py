"""DeepLabv3+, FCN-8s, SegNet and U-Net under one budget: the same images, encoder, crops, steps and recipe.

    python scripts/experiments/compare_networks.py BACKBONE --data mars_rocks=DIR simulated=DIR --out DIR

repeats the paper's preliminary comparison. BACKBONE is a model file that holds the encoder (`jaxmap weights import`);
DIR a folder of images and masks with train.txt and val.txt: MarsData's rocks, or what `jaxmap simulate --training N`
writes. Every network starts from the encoder and a random rest, and is drawn the same crops in the same order;
`--crops` sets how many, `--seeds` how often all is repeated. Finished runs are kept and interrupted ones resumed.
Prints one table: the IoU of rock and the mean IoU of the last epoch's weights on the validation images, averaged over
the seeds, with the least and the greatest; parameters; minutes of training; and the least time in which the folded
network labels one image of 480 x 640.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Mapping
from pathlib import Path

import jax
import numpy as np
from common import Table, command_line, jaxmap, parse

from jaxmap.models.checkpoint import load_network
from jaxmap.models.network import inference_network

KINDS = ("deeplab", "fcn", "segnet", "unet")
DATA = {
    "mars_rocks": ("--classes", "ground", "rock", "--data.remap", "0", "ground", "255", "rock"),
    "simulated": (
        *("--classes", "background", "sand", "rock"),
        *("--data.remap", "0", "background", "1", "sand", "2", "rock", "255", "ignore"),
    ),
}
RECIPE = {
    "--network.top-conv": False,
    "--loss.soft-iou": 1.0,
    "--loss.class-weights": "balanced",
    # SegNet's encoder pools where it was trained with strides: all may adapt.
    "--norm.backbone": "batch",
    "--optimiser.backbone-rate": 0.3,
    "--optimiser.weight-decay": 1e-2,
    "--optimiser.warmup-steps": 20,
    "--optimiser.average": 0.95,
    "--augmentation.class-share": 0.5,
    "--keep": "last",
    # Only the last epoch.
    "--validate-every": 1_000_000,
}
SIZE_PX, ROUNDS = (480, 640), 9


def main() -> None:
    """Trains what is not trained yet and prints the table."""
    parser = command_line(__doc__)
    parser.add_argument("backbone", type=Path)
    parser.add_argument("--data", nargs="+", required=True, metavar="NAME=DIR", help=f"of {', '.join(DATA)}")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--crops", type=int, default=6000, help="that each network is trained on, of each data set")
    parser.add_argument("--crop-px", type=int, default=256)
    parser.add_argument("--batch-size", type=int, default=4)
    parser.add_argument("--seeds", type=int, default=1)
    given = parse(parser)
    folders = {name: Path(folder) for name, _, folder in (pair.partition("=") for pair in given.data)}
    if unknown := set(folders) - set(DATA):
        parser.error(f"no data {', '.join(sorted(unknown))}; known are {', '.join(DATA)}")
    for name, folder in folders.items():
        images = len((folder / "train.txt").read_text().split())
        words = {
            **RECIPE,
            "--init": given.backbone,
            "--epochs": math.ceil(given.crops / images),
            "--batch-size": given.batch_size,
        }
        for seed in range(given.seeds):
            for kind in KINDS:
                out = run_folder(given.out, name, kind, seed)
                train(folder, out, words | {"--network.kind": kind, "--seed": seed}, DATA[name], given.crop_px)
    scores = {"rock IoU": "10.3f", "least": "7.3f", "most": "7.3f", "mean IoU": "10.3f"}
    costs = {"parameters": "12,d", "train min": "11.1f", "label ms": "10.0f"}
    table = Table({"data": "<12", "network": "<12", **scores, **costs})
    for name in folders:
        times_ms = label_times_ms({kind: run_folder(given.out, name, kind, 0) for kind in KINDS})
        for kind in KINDS:
            runs = [run_folder(given.out, name, kind, seed) for seed in range(given.seeds)]
            found = [json.loads((run / "metrics.json").read_text()) for run in runs]
            rock = [metrics["last"]["classes"]["rock"]["iou"] for metrics in found]
            mean = np.mean([metrics["last"]["mean_iou"] for metrics in found])
            minutes = np.mean([metrics["seconds"] for metrics in found]) / 60
            saved = load_network(runs[0] / "model.safetensors")
            size = sum(weight.size for weight in saved.weights.values())
            ious = float(np.mean(rock)), min(rock), max(rock), float(mean)
            table.row(name, saved.architecture.name, *ious, size, float(minutes), times_ms[kind])


def run_folder(out: Path, name: str, kind: str, seed: int) -> Path:
    """Where a network is trained."""
    return out / f"{name}_{kind}_{seed}"


def train(data: Path, out: Path, words: Mapping[str, object], classes: tuple[str, ...], crop_px: int) -> None:
    """Trains a network, or goes on where it was interrupted."""
    metrics = out / "metrics.json"
    if metrics.exists() and json.loads(metrics.read_text())["complete"]:
        return
    resume = ["--resume"] if out.exists() else []
    options = [word for pair in words.items() for word in pair]
    jaxmap("train", data, "--out", out, *options, *classes, "--augmentation.crop-px", crop_px, crop_px, *resume)


def label_times_ms(runs: Mapping[str, Path]) -> dict[str, float]:
    """The least time of each network for one image, timed in turn."""
    image = np.random.default_rng(0).integers(0, 256, (1, *SIZE_PX, 3)).astype(np.uint8)
    calls = {}
    for kind, run in runs.items():
        saved = load_network(run / "model.safetensors")
        network = inference_network(saved.architecture, saved.weights)
        calls[kind] = (jax.jit(network.apply), network.weights)
    least = dict.fromkeys(runs, math.inf)
    for _ in range(ROUNDS):
        for kind, (label, weights) in calls.items():
            start = time.perf_counter()
            jax.block_until_ready(label(weights, image))
            least[kind] = min(least[kind], 1e3 * (time.perf_counter() - start))
    return least


if __name__ == "__main__":
    main()

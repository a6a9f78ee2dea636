"""Trains on real images of Mars, from a pretrained backbone and from scratch, and prints both scores.

    python scripts/train_mars_rocks.py DATA BACKBONE --out DIR

DATA is a folder of images and masks with train.txt and val.txt (MarsData's rocks), BACKBONE a checkpoint that
`jaxmap weights import` reads. Both runs see the same crops in the same order, some twenty minutes each on two cores;
interrupted ones go on where they stopped.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from jaxmap.commands.main import main as jaxmap
from jaxmap.host.memory import restart_with_lasting_memory

RUNS = {
    "pretrained": [],
    # What was never trained before has nothing to lose by moving fast.
    "from scratch": ["--optimiser.backbone-rate", "1"],
}


def main() -> None:
    """Runs both trainings and prints a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("backbone", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--only", choices=list(RUNS))
    arguments = parser.parse_args()

    restart_with_lasting_memory()
    arguments.out.mkdir(parents=True, exist_ok=True)
    model = arguments.out / "backbone.safetensors"
    run("weights", "import", str(arguments.backbone), "--out", str(model))
    for name, options in RUNS.items():
        if arguments.only in (None, name):
            start = ["--init", str(model)] if name == "pretrained" else []
            out = arguments.out / name.replace(" ", "_")
            train = ["train", str(arguments.data), "--out", str(out), "--config", "mars_rocks", *start, *options]
            run(*train, *(["--resume"] if out.exists() else []))
    print(f"\n{'start':<14}{'crops':>8}{'minutes':>9}{'crops/s':>9}{'rock IoU, last':>16}{'best':>8}{'at epoch':>10}")
    for name in RUNS:
        metrics = arguments.out / name.replace(" ", "_") / "metrics.json"
        if metrics.exists():
            print(row(name, json.loads(metrics.read_text())))


def run(*words: str) -> None:
    """Runs a command of jaxmap's; stops where it fails."""
    if status := jaxmap(words):
        raise SystemExit(status)


def row(name: str, metrics: dict) -> str:
    """One line of the table."""
    crops, seconds, best = metrics["examples_seen"], metrics["seconds"], metrics["best"]
    last, most = (scores["classes"]["rock"]["iou"] for scores in (metrics["last"], best))
    return (
        f"{name:<14}{crops:>8,}{seconds / 60:>9.1f}{crops / seconds:>9.2f}{last:>16.3f}{most:>8.3f}{best['epoch']:>10}"
    )


if __name__ == "__main__":
    main()

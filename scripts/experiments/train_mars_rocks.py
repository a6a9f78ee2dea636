"""Trains on recorded images of Mars, from a pretrained backbone and from scratch, and compares the scores.

    python scripts/experiments/train_mars_rocks.py DATA BACKBONE --out DIR

DATA is a folder of images and masks with train.txt and val.txt (MarsData's rocks), BACKBONE a checkpoint that
`jaxmap weights import` reads. Both runs see the same crops in the same order, some twenty minutes each on two cores;
interrupted ones are resumed. Prints one table: crops, time, and the IoU of rock of the last and of the best epoch.
"""

from __future__ import annotations

import json
from pathlib import Path

from common import Table, command_line, jaxmap, parse

RUNS = {
    "pretrained": [],
    # Fresh weights may move fast.
    "from scratch": ["--optimiser.backbone-rate", "1"],
}


def main() -> None:
    """Runs both trainings and prints the table."""
    parser = command_line(__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("backbone", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--only", choices=list(RUNS))
    given = parse(parser)
    given.out.mkdir(parents=True, exist_ok=True)
    model = given.out / "backbone.safetensors"
    jaxmap("weights", "import", given.backbone, "--out", model)
    for name, options in RUNS.items():
        if given.only in (None, name):
            start = ["--init", model] if name == "pretrained" else []
            out = given.out / name.replace(" ", "_")
            resume = ["--resume"] if out.exists() else []
            jaxmap("train", given.data, "--out", out, "--config", "mars_rocks", *start, *options, *resume)
    columns = {"start": "<14", "crops": "8d", "minutes": "9.1f", "crops/s": "9.2f"}
    table = Table({**columns, "rock IoU, last": "16.3f", "best": "8.3f", "at epoch": "10d"})
    for name in RUNS:
        path = given.out / name.replace(" ", "_") / "metrics.json"
        if path.exists():
            metrics = json.loads(path.read_text())
            crops, seconds, best = metrics["examples_seen"], metrics["seconds"], metrics["best"]
            ious = [scores["classes"]["rock"]["iou"] for scores in (metrics["last"], best)]
            table.row(name, crops, seconds / 60, crops / seconds, *ious, best["epoch"])


if __name__ == "__main__":
    main()

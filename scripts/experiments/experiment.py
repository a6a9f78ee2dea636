"""The paper's experiment on simulated traverses: three drives, three sources of labels, four rules of fusion.

    python scripts/experiments/experiment.py --work DIR     # simulates the three first (extra `sim`), half an hour
    python scripts/experiments/experiment.py TRAVERSE... [--poses true]

A TRAVERSE is a folder in the simulator's layout. The three are analogues of the paper's Data 01 (few big, near rocks),
02 (many small and flat ones) and 03 (medium ones, with the rover's shadow in view), of seeds that the bundled network
never saw. Prints one table: every map is scored in cells of 0.2 m within 8 m of the camera, a cell being rock where
half its area is, and by the IoU on 16 lattices of cells; then the paper's own figures.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from common import LABELS, Frames, Table, Traverse, command_line, jaxmap, parse, rules

SCENES = {"few": 201, "small": 202, "medium": 203}
PAPER = {"deeplab": ((0.96, 0.58), (0.90, 0.21), (0.95, 0.36)), "plane": ((0.95, 0.37), (0.97, 0.58), (0.96, 0.47))}
"""Accuracy and IoU of the paper's Data 01, 02 and 03."""
SCORES = ("accuracy", "iou", "precision", "recall", "coverage")


def simulated(work: Path, scene: str, frames: int) -> Path:
    """The traverse of a scene, rendered where it is not there yet."""
    jaxmap("simulate", "--out", work / scene, "--scene", scene, "--seed", SCENES[scene], "--frames", frames)
    return work / scene


def main() -> None:
    """Simulates where asked, maps, scores, prints."""
    parser = command_line(__doc__)
    parser.add_argument("traverses", nargs="*", type=Path, help="folders that hold a part and gt")
    parser.add_argument("--work", type=Path, help="where to simulate the three traverses")
    parser.add_argument("--frames", type=int, default=14)
    parser.add_argument("--poses", choices=("own", "true"), default="own", help="estimated by the reader, or true")
    parser.add_argument("--model", type=Path, help="a network other than the bundled one")
    parser.add_argument("--json", type=Path, help="file for the table")
    given = parse(parser)
    if bool(given.traverses) == bool(given.work):
        parser.error("give traverses or --work")
    columns = {"traverse": "<16", "labels": "<9", "rule": "<10", **dict.fromkeys(SCORES, "10.3f")}
    columns |= {"mean IoU": "10.3f", "least": "7.3f", "greatest": "10.3f"}
    table = Table({**columns, "cells": "7d", "rock": "6d", "rocks": "7d", "frames": "8d"})
    for path in given.traverses or [simulated(given.work, scene, given.frames) for scene in SCENES]:
        traverse = Traverse(path)
        for labels in LABELS:
            base = traverse.config(labels, true_poses=given.poses == "true", model=given.model)
            frames = Frames(traverse.sequence, traverse.truth)
            for rule, config in rules(base).items():
                result = frames.scored(config)
                ious, scores = result.lattice_ious(), result.scores
                counts = (scores["cells"], scores["rock_cells"], scores["rocks"]["count"], len(frames.prepared))
                numbers = [scores[name] or 0.0 for name in SCORES]
                spread = (float(np.mean(ious)), min(ious), max(ious))
                confusion = {name: scores[name] for name in ("tp", "fp", "fn", "tn")}
                table.row(traverse.name, labels, rule, *numbers, *spread, *counts, **confusion)
    print("\nthe paper, on the real beach: accuracy and IoU of Data 01, 02, 03")
    for labels, figures in PAPER.items():
        print(f"{labels:9s}" + "   ".join(f"{accuracy:.2f}, {iou:.2f}" for accuracy, iou in figures))
    table.write(given.json)


if __name__ == "__main__":
    main()

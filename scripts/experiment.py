"""The paper's experiment on simulated traverses: three drives, three sources of labels, three rules of fusion.

    python scripts/experiment.py --work DIR                  # simulates the three first (extra `sim`), half an hour
    python scripts/experiment.py TRAVERSE... [--poses true]  # on traverses that are there, in the simulator's layout

The three are analogues of the paper's Data 01 (few big, near rocks), 02 (many small and flat ones) and 03 (medium ones,
with the rover's shadow in view), of seeds that the bundled network never saw. Every map is scored in cells of 0.2 m
within 8 m of the camera, a cell being rock where half its area is. Prints the table beside the paper's own figures.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from ladder import COARSE, POINTS, confusions, fused

from jaxmap.evaluation.evaluate import evaluate_map
from jaxmap.evaluation.map_scores import confusion_scores
from jaxmap.evaluation.options import ScoringOptions
from jaxmap.host.cache import keep_compiled_programs
from jaxmap.mapping.sequence import PreparedFrame, prepare_frames
from jaxmap.runs.config import DepthConfig, MapConfig, load_config
from jaxmap.runs.evaluation import TruthOptions, read_truth
from jaxmap.runs.mapping_plan import plan_run

SCENES = {"few": 201, "small": 202, "medium": 203}
PAPER = {"deeplab": ((0.96, 0.58), (0.90, 0.21), (0.95, 0.36)), "plane": ((0.95, 0.37), (0.97, 0.58), (0.96, 0.47))}
"""Accuracy and IoU of the paper's Data 01, 02 and 03."""

LABELS = {"true": "files", "deeplab": "deeplab", "plane": "plane"}
CELL_M, RANGE_M = 0.2, 8.0


def main() -> None:
    """Simulates where asked, maps, scores, prints."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("traverses", nargs="*", type=Path, help="folders that hold Part1 and gt")
    parser.add_argument("--work", type=Path, help="where to simulate the three traverses")
    parser.add_argument("--frames", type=int, default=14)
    parser.add_argument("--poses", choices=("own", "true"), default="own", help="estimated by the reader, or true")
    parser.add_argument("--model", type=Path, help="a network other than the bundled one")
    parser.add_argument("--json", type=Path, help="file for the table")
    given = parser.parse_args()
    if bool(given.traverses) == bool(given.work):
        parser.error("give traverses or --work")
    keep_compiled_programs()
    traverses = given.traverses or [simulated(given.work, scene, given.frames) for scene in SCENES]
    rows = [row for path in traverses for row in rows_of(path, given.poses == "true", given.model)]
    print_paper()
    print_summary(rows, [path.name for path in traverses])
    if given.json:
        given.json.write_text(json.dumps(rows, indent=1) + "\n")


def simulated(work: Path, scene: str, frames: int) -> Path:
    """The traverse of a scene, rendered where it is not there yet."""
    out = work / scene
    command = ["simulate", "--out", out, "--scene", scene, "--seed", SCENES[scene], "--frames", frames]
    if status := subprocess.run([sys.executable, "-m", "jaxmap", *map(str, command)]).returncode:
        raise SystemExit(status)
    return out


def rules(base: MapConfig) -> dict[str, MapConfig]:
    """The paper's rule, the majority of points in voxels of 0.2 m, and the default."""
    paper = load_config("chiodini2020")
    return {
        "paper": replace(base, grid=paper.grid, fusion=paper.fusion),
        "majority": replace(base, grid=COARSE, fusion=POINTS),
        "default": base,
    }


def rows_of(traverse: Path, true_poses: bool, model: Path | None) -> list[dict[str, Any]]:
    """Scores of one traverse, printed as they come."""
    gt, rows = traverse / "gt", []
    print(f"\n{traverse.name}, poses {'true' if true_poses else 'estimated'}")
    print(
        f"{'labels':9s}{'rule':10s}{'accuracy':>9s}{'IoU':>7s}{'precision':>10s}{'recall':>8s}{'coverage':>9s}", end=""
    )
    print(f"{'IoU of 16 lattices':>26s}{'cells':>8s}{'rock':>6s}{'rocks':>7s}{'frames':>8s}")
    for labels, labeller in LABELS.items():
        base = MapConfig(
            labeller=labeller,
            labels=gt / "labels" if labeller == "files" else None,
            labels_are="raw" if labeller == "files" else "auto",
            model=model if labeller == "deeplab" else None,
            poses=gt / "poses_utm.tum" if true_poses else None,
            depth=DepthConfig(max_m=RANGE_M),
        )
        frames: list[PreparedFrame] = []
        for rule, config in rules(base).items():
            plan = plan_run(str(traverse / "Part1"), config, lambda line: None)
            needs = plan.labeller.needs
            frames = frames or list(prepare_frames(plan.sequence, plan.front_end, plan.label_folder, needs=needs))
            row = {"traverse": traverse.name, "labels": labels, "rule": rule, "frames": len(frames)}
            rows.append(row | scored(plan, frames, gt / "orthomosaic_labels.tif"))
            print_row(rows[-1])
    return rows


def scored(plan: Any, frames: list[PreparedFrame], truth: Path) -> dict[str, Any]:
    """Scores of the frames fused by a plan."""
    class_map = fused(plan, frames, "rock")
    raster = read_truth([truth], class_map.place, TruthOptions())
    scores = evaluate_map(class_map, raster, None, ScoringOptions(cell_size_m=CELL_M)).scores
    spread = [confusion_scores(one)["iou"] or 0.0 for one in confusions(class_map, raster, CELL_M)]
    kept = (
        "accuracy",
        "iou",
        "precision",
        "recall",
        "coverage",
        "tp",
        "fp",
        "fn",
        "tn",
        "cells",
        "rock_cells",
        "rocks",
    )
    lattices = {"mean": float(np.mean(spread)), "least": min(spread), "greatest": max(spread)}
    return {name: scores[name] for name in kept} | {"iou_of_lattices": lattices}


def print_row(row: dict[str, Any]) -> None:
    """One line of a traverse's table."""
    numbers = [row[name] or 0.0 for name in ("accuracy", "iou", "precision", "recall", "coverage")]
    widths = (9, 7, 10, 8, 9)
    spread = row["iou_of_lattices"]
    around = f"{spread['mean']:.3f}, {spread['least']:.3f} to {spread['greatest']:.3f}"
    text = "".join(f"{number:{width}.3f}" for number, width in zip(numbers, widths, strict=True))
    counts = f"{row['cells']:8d}{row['rock_cells']:6d}{row['rocks']['count']:7d}{row['frames']:8d}"
    print(f"{row['labels']:9s}{row['rule']:10s}{text}{around:>26s}{counts}", flush=True)


def print_paper() -> None:
    """The paper's own figures, on the real beach."""
    print("\nthe paper, on the real beach (accuracy / IoU of Data 01, 02, 03)")
    for labels, figures in PAPER.items():
        print(f"{labels:9s}" + "   ".join(f"{accuracy:.2f} / {iou:.2f}" for accuracy, iou in figures))


def print_summary(rows: list[dict[str, Any]], traverses: list[str]) -> None:
    """The ratios that tell where the errors come from."""

    def iou(traverse: str, labels: str, rule: str) -> float:
        found = (row for row in rows if (row["traverse"], row["labels"], row["rule"]) == (traverse, labels, rule))
        return next(found)["iou_of_lattices"]["mean"]

    print(
        "\nmean IoU of the lattices        network / true labels    true labels, default / majority    network - plane"
    )
    for name in traverses:
        true, network = iou(name, "true", "default"), iou(name, "deeplab", "default")
        majority, plane = iou(name, "true", "majority"), iou(name, "plane", "default")
        print(f"{name:32s}{network / max(true, 1e-9):20.2f}{true / max(majority, 1e-9):35.2f}{network - plane:19.3f}")


if __name__ == "__main__":
    main()

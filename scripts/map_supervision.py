"""What map supervision is worth: a network fine-tuned by an orthomosaic alone, beside one fine-tuned by true masks.

    python scripts/map_supervision.py TRAVERSE --work DIR [--epochs 30] [--held-out 0.3] [--poses true]

TRAVERSE is a folder in the simulator's layout (Part1, gt/labels, gt/orthomosaic_labels.tif). The bundled network is
fine-tuned twice on the same frames, with the same recipe and as many steps: by the masks of these frames (pixels), and
by the orthomosaic (map). Every network then maps the frames that it learnt from and those that were held out, at the
end of the traverse; both maps are scored in cells of 0.2 m within 8 m. Goes on where it was interrupted.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections import deque
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from ladder import confusions
from PIL import Image

from jaxmap.datasets.images import as_rgb, read_index_image
from jaxmap.evaluation.map_scores import confusion_scores
from jaxmap.host.cache import keep_compiled_programs
from jaxmap.mapping.sequence import PreparedFrame, prepare_frames, run_sequence
from jaxmap.runs.config import DeeplabConfig, DepthConfig, MapConfig
from jaxmap.runs.evaluation import TruthOptions, class_layer_of, read_truth
from jaxmap.runs.mapping_plan import Plan, plan_run

CELL_M, RANGE_M = 0.2, 8.0
SIZE_PX = (384, 512)
"""What the networks run at, for all of them; crops are drawn around that scale."""

RECIPE = {
    "--batch-size": "4",
    "--keep": "last",
    "--augmentation.crop-px": "288 384",
    "--augmentation.scale": "0.4 0.8",
    "--optimiser.learning-rate": "5e-4",
    "--optimiser.warmup-steps": "10",
    "--loss.soft-iou": "1",
    "--loss.class-weights": "balanced",
}
"""Shared by both."""


def main() -> None:
    """Trains where that is not done yet, maps, scores, prints."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("traverse", type=Path)
    parser.add_argument("--work", type=Path, required=True, help="folder for what is made on the way")
    parser.add_argument("--epochs", type=int, default=30)
    parser.add_argument("--held-out", type=float, default=0.3, help="share of the frames, at the end")
    parser.add_argument("--poses", choices=("own", "true"), default="true", help="estimated by the reader, or true")
    given = parser.parse_args()
    keep_compiled_programs()
    gt = given.traverse / "gt"
    base = MapConfig(
        labeller="deeplab",
        poses=gt / "poses_utm.tum" if given.poses == "true" else None,
        depth=DepthConfig(max_m=RANGE_M),
        deeplab=DeeplabConfig(size_px=SIZE_PX),
    )
    plan = plan_run(str(given.traverse / "Part1"), base, print)
    frames = list(prepare_frames(plan.sequence, plan.front_end, needs="image"))
    held_out = round(len(frames) * given.held_out)
    parts = {"learnt from": frames[: len(frames) - held_out], "held out": frames[len(frames) - held_out :]}
    networks = {"bundled": None} | train_both(given, plan, parts)
    print(f"\n{given.traverse.name}: rock of the map (cells of {CELL_M} m within {RANGE_M:g} m, mean of 16 lattices)")
    print(f"{'frames':14s}{'network':10s}{'accuracy':>9s}{'IoU':>7s}{'precision':>10s}{'recall':>8s}")
    for part, chosen in parts.items():
        ious = {}
        for name, model in networks.items():
            scores = scored(plan_run(str(given.traverse / "Part1"), replace(base, model=model), str), chosen, gt)
            numbers = "".join(f"{scores[key]:{width}.3f}" for key, width in COLUMNS.items())
            print(f"{part:14s}{name:10s}{numbers}", flush=True)
            ious[name] = scores["iou"]
        print(f"{'':14s}map / pixels: {ious['map'] / max(ious['pixels'], 1e-9):.2f}")


COLUMNS = {"accuracy": 9, "iou": 7, "precision": 10, "recall": 8}


def train_both(given: Any, plan: Plan, parts: dict[str, list[PreparedFrame]]) -> dict[str, Path]:
    """The two networks, by what taught them."""
    gt, work = given.traverse / "gt", given.work
    masks = write_masks(work / "masks", plan, parts, gt / "labels")
    by_map = {
        "--supervision": "map",
        "--ground-truth": str(gt / "orthomosaic_labels.tif"),
        "--data.validation-share": str(given.held_out),
        "--mapping.depth.max-m": f"{RANGE_M:g}",
        "--mapping.deeplab.size-px": f"{SIZE_PX[0]} {SIZE_PX[1]}",
    }
    if given.poses == "true":
        by_map["--mapping.poses"] = str(gt / "poses_utm.tum")
    bundled = {"--init": str(plan.model.path)} if plan.model is not None else {}
    sources = {"pixels": (masks, bundled), "map": (given.traverse / "Part1", by_map)}
    models = {}
    for name, (source, own) in sources.items():
        run = work / name
        options = RECIPE | own | {"--epochs": str(given.epochs), "--validate-every": str(given.epochs)}
        words = [word for option, values in options.items() for word in (option, *values.split())]
        resume = ["--resume"] if run.exists() else []
        command = [sys.executable, "-m", "jaxmap", "train", source, "--out", run, *words, *resume]
        if status := subprocess.run([str(word) for word in command]).returncode:
            raise SystemExit(status)
        models[name] = run / "model.safetensors"
    return models


def write_masks(folder: Path, plan: Plan, parts: dict[str, list[PreparedFrame]], labels: Path) -> Path:
    """The same frames as images with their true masks, rectified."""
    for kind in ("images", "masks"):
        (folder / kind).mkdir(parents=True, exist_ok=True)
    for part, listed in (("learnt from", "train.txt"), ("held out", "val.txt")):
        names = []
        for prepared in parts[part]:
            assert prepared.rectified is not None
            name = prepared.ref.name
            mask = plan.front_end.rectify_labels(read_index_image(labels / f"{name}.png"))
            Image.fromarray(as_rgb(prepared.rectified.left)).save(folder / "images" / f"{name}.png")
            Image.fromarray(mask).save(folder / "masks" / f"{name}.png")
            names.append(name)
        (folder / listed).write_text("".join(f"{name}\n" for name in names))
    return folder


def scored(plan: Plan, frames: list[PreparedFrame], gt: Path) -> dict[str, float]:
    """Rock in the map of some frames, over lattices of cells."""
    steps = run_sequence(plan.mapper, plan.mapper.init(), frames, plan.params, plan.key)
    voxel_map, _ = deque(steps, maxlen=1).pop()
    sequence = plan.sequence
    class_map = class_layer_of(
        voxel_map, plan.params.fusion, plan.rule, "rock", site_origin=sequence.site_origin, crs=sequence.crs
    )
    raster = read_truth([gt / "orthomosaic_labels.tif"], class_map.place, TruthOptions())
    every = [confusion_scores(one) for one in confusions(class_map, raster, CELL_M)]
    return {key: float(np.mean([scores[key] or 0.0 for scores in every])) for key in COLUMNS}


if __name__ == "__main__":
    main()

"""What map supervision is worth: a network fine-tuned by an orthomosaic alone, beside one fine-tuned by true masks.

    python scripts/experiments/map_supervision.py TRAVERSE --work DIR [--epochs 30] [--held-out 0.3] [--poses true]

TRAVERSE is a folder in the simulator's layout. The bundled network is fine-tuned twice on the same frames, with the
same recipe and as many steps: by the masks of these frames (pixels), and by the orthomosaic (map). Every network then
maps the frames that it learnt from and those that were held out, at the end of the traverse. Prints one table: scores
of rock in both maps, in cells of 0.2 m within 8 m, means over 16 lattices. An interrupted training is resumed.
"""

from __future__ import annotations

from argparse import Namespace
from dataclasses import replace
from pathlib import Path

import numpy as np
from common import CELL_M, RANGE_M, Frames, Table, Traverse, command_line, jaxmap, parse
from PIL import Image

from jaxmap.datasets.images import as_rgb
from jaxmap.datasets.masks import read_values
from jaxmap.labellers.options import DeeplabOptions
from jaxmap.mapping.sequence import PreparedFrame
from jaxmap.runs.mapping_plan import Plan

SIZE_PX = (384, 512)
"""Height and width at which all networks run; crops are drawn around that scale."""
SCORES = ("accuracy", "iou", "precision", "recall")

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


def train_both(given: Namespace, plan: Plan, parts: dict[str, list[PreparedFrame]]) -> dict[str, Path | None]:
    """The bundled network (None) and the two fine-tuned ones, by what supervised them."""
    traverse, work = Traverse(given.traverse), given.work
    by_map = {
        "--supervision": "map",
        "--ground-truth": str(traverse.truth),
        "--data.validation-share": str(given.held_out),
        "--mapping.depth.max-m": f"{RANGE_M:g}",
        "--mapping.deeplab.size-px": f"{SIZE_PX[0]} {SIZE_PX[1]}",
    }
    if given.poses == "true":
        by_map["--mapping.poses"] = str(traverse.gt / "poses_utm.tum")
    bundled = {"--init": str(plan.model.path)} if plan.model is not None else {}
    masks = write_masks(work / "masks", plan, parts, traverse.gt / "labels")
    models: dict[str, Path | None] = {"bundled": None}
    for name, source, own in (("pixels", masks, bundled), ("map", traverse.sequence, by_map)):
        options = RECIPE | own | {"--epochs": str(given.epochs), "--validate-every": str(given.epochs)}
        words = [word for option, values in options.items() for word in (option, *values.split())]
        resume = ["--resume"] if (work / name).exists() else []
        jaxmap("train", source, "--out", work / name, *words, *resume)
        models[name] = work / name / "model.safetensors"
    return models


def write_masks(folder: Path, plan: Plan, parts: dict[str, list[PreparedFrame]], labels: Path) -> Path:
    """The same frames as images with their true masks, rectified."""
    for kind in ("images", "masks"):
        (folder / kind).mkdir(parents=True, exist_ok=True)
    for part, listed in (("learnt from", "train.txt"), ("held out", "val.txt")):
        for prepared in parts[part]:
            assert prepared.rectified is not None
            mask = plan.front_end.rectify_labels(read_values(labels / f"{prepared.ref.name}.png").astype(np.uint8))
            Image.fromarray(as_rgb(prepared.rectified.left)).save(folder / "images" / f"{prepared.ref.name}.png")
            Image.fromarray(mask).save(folder / "masks" / f"{prepared.ref.name}.png")
        (folder / listed).write_text("".join(f"{prepared.ref.name}\n" for prepared in parts[part]))
    return folder


def main() -> None:
    """Trains where that is not done yet, maps, scores, prints."""
    parser = command_line(__doc__)
    parser.add_argument("traverse", type=Path)
    parser.add_argument("--work", type=Path, required=True, help="folder for what is made on the way")
    parser.add_argument("--epochs", type=int, default=30)
    parser.add_argument("--held-out", type=float, default=0.3, help="share of the frames, at the end")
    parser.add_argument("--poses", choices=("own", "true"), default="true", help="estimated by the reader, or true")
    given = parse(parser)
    traverse = Traverse(given.traverse)
    base = traverse.config("deeplab", true_poses=given.poses == "true")
    base = replace(base, deeplab=DeeplabOptions(size_px=SIZE_PX))
    frames = Frames(traverse.sequence, traverse.truth)
    plan = frames.plan(base)
    learnt = len(frames.prepared) - round(len(frames.prepared) * given.held_out)
    parts = {"learnt from": frames.prepared[:learnt], "held out": frames.prepared[learnt:]}
    networks = train_both(given, plan, parts)
    print(f"\n{traverse.name}: rock in the map, cells of {CELL_M} m within {RANGE_M:g} m")
    table = Table({"frames": "<14", "network": "<10", **dict.fromkeys(SCORES, "10.3f")})
    for part, chosen in parts.items():
        for name, model in networks.items():
            lattices = frames.scored(replace(base, model=model), chosen).lattices
            table.row(part, name, *(float(np.mean([one[key] or 0.0 for one in lattices])) for key in SCORES))


if __name__ == "__main__":
    main()

"""What the bundled network and relief make of real images: a rover pair with two boulders, and photographs of Mars.

    python scripts/experiments/real_images.py [--model F] [--json F]

On the K10 pair (asphalt with a dark strip and shadows, two boulders): the share of each boulder's pixels that is called
rock, of those that are labelled, and the share of the ground within 8 m that is; both areas were outlined by hand on
the rectified left image. On the validation images of MarsData's rocks: IoU, precision and recall of rock, by the image
alone. Data that is not beside the repository is left out.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import jax
import numpy as np
from common import SHARED, Table, command_line, parse

from jaxmap.datasets.images import as_rgb, read_image
from jaxmap.datasets.masks import read_values
from jaxmap.geometry.options import DepthOptions
from jaxmap.host.files import bundled
from jaxmap.labellers.options import ReliefOptions
from jaxmap.mapping.sequence import prepare_frames
from jaxmap.models.checkpoint import load_network
from jaxmap.models.network import inference_network
from jaxmap.runs.config import MapConfig
from jaxmap.runs.mapping_plan import plan_run

K10, MARS = SHARED / "realdata" / "k10", SHARED / "realdata" / "mars_rocks"
ROCK, RANGE_M, GROUND_RANGE_M = 2, 12.0, 8.0
BOULDERS = {
    "near": [(431, 569), (454, 431), (470, 334), (635, 332), (658, 418), (679, 509), (671, 575)],
    "far": [(517, 264), (533, 172), (543, 136), (577, 136), (601, 188), (603, 264)],
}
"""Outlines (column, row), on the rectified left image."""
ROVER = ([(509, 771), (535, 601), (692, 614), (888, 684), (1024, 666), (1024, 771)], [(0, 705), (104, 684), (157, 771)])
HORIZON_PX, RIM_PX = 144, 45
LABELLERS = {
    "MLESAC plane": {"labeller": "plane"},
    "relief": {"labeller": "relief"},
    "network sees relief": {"labeller": "deeplab", "relief": ReliefOptions(combine=False)},
    "... and relief (ours)": {"labeller": "deeplab"},
}


def area(shape: tuple[int, ...], *outlines: list[tuple[int, int]]) -> np.ndarray:
    """The pixels within outlines."""
    mask = np.zeros(shape, np.uint8)
    cv2.fillPoly(mask, [np.array(outline, np.int32) for outline in outlines], 1)
    return mask > 0


def rover_pair(table: Table, model: Path | None) -> None:
    """Prints the shares of the K10 pair."""
    for name, chosen in LABELLERS.items():
        config = replace(MapConfig(), depth=DepthOptions(max_m=RANGE_M), **chosen)
        config = replace(config, model=model) if config.labeller == "deeplab" else config
        plan = plan_run(str(K10), config, lambda line: None)
        frame = next(iter(prepare_frames(plan.sequence, plan.front_end, None, needs=plan.labeller.needs))).frame
        assert frame is not None
        labels = np.asarray(plan.mapper.label_image(frame, plan.params, plan.key, 0))
        shape, known = labels.shape, labels < len(plan.labeller.classes)
        bf_px_m = float(plan.params.camera.baseline_m * plan.params.camera.fx_px)
        ground = known & (np.asarray(frame.matched_px) > bf_px_m / GROUND_RANGE_M) & ~area(shape, *ROVER)
        ground &= ~cv2.dilate(area(shape, *BOULDERS.values()).astype(np.uint8), np.ones((RIM_PX, RIM_PX))).astype(bool)
        ground[:HORIZON_PX] = False
        inside = [area(shape, outline) & known for outline in BOULDERS.values()]
        table.row(name, *(float((labels[where] == ROCK).mean()) for where in (*inside, ground)))


def photographs(model: Path) -> None:
    """Prints the scores of the photographs of Mars."""
    network = inference_network(*load_network(model)[:2])
    apply = jax.jit(network.apply)
    found, false, missed = 0, 0, 0
    for name in (MARS / "val.txt").read_text().split():
        image = as_rgb(read_image(next((MARS / "images").glob(f"{Path(name).stem}.*"))))
        truth = read_values(MARS / "masks" / f"{Path(name).stem}.png") > 127
        called = np.asarray(apply(network.weights, image[None]))[0].argmax(axis=-1) == ROCK
        found, false = found + (called & truth).sum(), false + (called & ~truth).sum()
        missed += (~called & truth).sum()
    iou, precision, recall = found / (found + false + missed), found / (found + false), found / (found + missed)
    print(f"\nphotographs of Mars, image alone: IoU {iou:.3f}, precision {precision:.3f}, recall {recall:.3f}")


def main() -> None:
    """Labels and prints."""
    parser = command_line(__doc__)
    parser.add_argument("--model", type=Path, help="a network other than the bundled one")
    parser.add_argument("--json", type=Path, help="file for the table")
    given = parse(parser)
    if K10.exists():
        table = Table({"K10": "<24", "near boulder": "14.3f", "far boulder": "13.3f", "ground called rock": "20.3f"})
        rover_pair(table, given.model)
        table.write(given.json)
    if MARS.exists():
        photographs(given.model or bundled("rover.safetensors"))


if __name__ == "__main__":
    main()

"""What keeps a map with true labels from being perfect: one idea at a time against the default.

    python scripts/experiments/ceiling.py [TRAVERSE...] [--json F]

A TRAVERSE is `sample:traverse` or a folder in the simulator's layout; by default the sample and the two of another
renderer beside the repository. The labels are the true ones, so what is lost is lost to stereo and fusion. Scores are
of cells of 0.2 m within 8 m of the camera; differences within the spread of the 16 lattices say nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from common import SHARED, Frames, Table, Traverse, command_line, parse

from jaxmap.mapping.sequence import PreparedFrame
from jaxmap.runs.config import MapConfig

DEFAULT = ("sample:traverse", SHARED / "simdata" / "traverse_a", SHARED / "simdata" / "traverse_b")
SUBPIXEL_PX = 0.05
"""Amplitude of a sub-pixel bias towards whole pixels, or away from them."""

SETTINGS: dict[str, dict[str, dict[str, object]]] = {
    "the default": {},
    "edges of depth kept": {"stereo": {"edge_step_px": 0.0}},
    "frames agree: occupied above 0.8": {"fusion": {"occupancy_threshold": 0.8}},
    "confidence: none by range": {"fusion": {"range_weighting": False}},
    "confidence: noise of 1 px": {"fusion": {"disparity_sigma_px": 1.0}},
    "confidence: full from 2 points on": {"fusion": {"full_evidence_points": 2.0}},
}


def median(disparity_px: np.ndarray) -> np.ndarray:
    """The median of 5 x 5 pixels, where it is within a pixel."""
    smooth = cv2.medianBlur(np.nan_to_num(disparity_px), 5)
    return np.where(np.abs(smooth - disparity_px) < 1, smooth, disparity_px)


def sharpened(disparity_px: np.ndarray) -> np.ndarray:
    """Smoothed by a bilateral filter, which keeps edges."""
    smooth = cv2.bilateralFilter(np.nan_to_num(disparity_px, nan=-100.0), -1, 1.0, 3.0)
    return np.where(np.isfinite(disparity_px), smooth, np.nan).astype(np.float32)


def shifted(sign: int) -> Callable[[np.ndarray], np.ndarray]:
    """Moved towards whole pixels (-1) or away from them (+1)."""
    return lambda px: (px + sign * SUBPIXEL_PX * np.sin(2 * np.pi * px)).astype(np.float32)


FILTERS = {
    "noise: median of 5 x 5": median,
    "noise: bilateral filter": sharpened,
    "sub-pixel bias, + 0.05 px": shifted(1),
    "sub-pixel bias, - 0.05 px": shifted(-1),
}
"""Of the disparity, before fusion."""


def changed(config: MapConfig, sections: dict[str, dict[str, object]]) -> MapConfig:
    """The settings with some options changed."""
    return replace(config, **{name: replace(getattr(config, name), **more) for name, more in sections.items()})


def filtered(prepared: PreparedFrame, change: Callable[[np.ndarray], np.ndarray]) -> PreparedFrame:
    """A frame with another disparity."""
    disparity_px = change(np.array(prepared.frame.matched_px))
    return replace(prepared, frame=replace(prepared.frame, disparity_px=disparity_px))


def main() -> None:
    """Maps, scores, prints."""
    parser = command_line(__doc__)
    parser.add_argument("traverses", nargs="*", help="sample:traverse, or folders that hold a part and gt")
    parser.add_argument("--json", type=Path, help="file for the table")
    given = parse(parser)
    columns = {"traverse": "<16", "idea": "<36", **dict.fromkeys(("iou", "precision", "recall"), "10.3f")}
    table = Table({**columns, "mean IoU": "10.3f", "least": "7.3f", "greatest": "10.3f"})
    for path in given.traverses or [path for path in DEFAULT if str(path) == DEFAULT[0] or Path(path).exists()]:
        traverse = Traverse(path)
        config = traverse.config("true")
        matched: dict[str, Frames] = {}
        for name in (*SETTINGS, *FILTERS):
            settings = changed(config, SETTINGS.get(name, {}))
            frames = matched.setdefault(str(settings.stereo), Frames(traverse.sequence, traverse.truth))
            frames.plan(settings)
            seen = [filtered(one, FILTERS[name]) for one in frames.prepared] if name in FILTERS else frames.prepared
            result = frames.scored(settings, seen)
            ious = result.lattice_ious()
            numbers = [result.scores[one] or 0.0 for one in ("iou", "precision", "recall")]
            table.row(traverse.name, name, *numbers, float(np.mean(ious)), min(ious), max(ious))
    table.write(given.json)


if __name__ == "__main__":
    main()

"""Semi-global matching by its options: what it sees, where it errs, what maps come of it, and its cost.

    python scripts/experiments/stereo_table.py [--mode 3way hh4 sgm --penalties 1 2 4 --block 5 7 --speckle 100 1000]
                                               [--maps true plane] [--traverses FOLDER...] [--stop 10]

Every combination of the options given is a row of each data set; what is missing is left out. With truth (the
Motorcycle pair; frames of traverses with `gt/depth`): pixels off by more than 1 and 2 px among those that are matched
and truly within 12 m, and the latter among rocks alone. In traverses: background (sky, ridges) matched within 12 m, of
all its pixels: what floats in a map that trusts geometry alone. With --maps: the mean IoU of rock over 16 lattices of
cells, with true labels and with those of the plane, which are geometry alone, under the default rule and the reader's
own poses. In KITTI: points within 5 % of the depth measured five frames later. Modes sgm, sgm4 (four paths), bt, bt4
and mccnn are the matcher of the compiled step, under the penalties of its defaults. Times are of processors, of all
threads together.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import NamedTuple

import cv2
import jax.numpy as jnp
import jaxlie
import numpy as np
from common import SHARED, Frames, Scored, Table, Traverse, command_line, fuse, parse

from jaxmap.datasets import ReadOptions, open_sequence
from jaxmap.datasets.masks import read_values
from jaxmap.datasets.samples import motorcycle_disparity
from jaxmap.evaluation.geometry_scores import depth_consistency
from jaxmap.mapping.sequence import PreparedFrame
from jaxmap.stereo.front_end import StereoFrontEnd
from jaxmap.stereo.jax_matcher import make_matcher
from jaxmap.stereo.match import StereoOptions
from jaxmap.types import to_device

RANGE_M, DRIVE_FRAMES, FRAMES_APART, BACKGROUND, ROCK = 12.0, 15, 5, 0, 2
IN_JAX = {
    "sgm": {"matcher": "sgm"},
    "sgm4": {"matcher": "sgm", "paths": 4},
    "bt": {"matcher": "sgm", "cost": "bt"},
    "bt4": {"matcher": "sgm", "cost": "bt", "paths": 4},
    "mccnn": {"matcher": "mccnn"},
}
"""The matcher of the step, by modes of this table."""
SCORES = ("valid", "off_1px", "off_2px", "rock_off_2px", "rock_valid", "floating", "agreeing", "iou_true", "iou_plane")


class Truth(NamedTuple):
    """What is known of a frame's rectified pixels: disparity, NaN where unknown, and labels."""

    disparity_px: np.ndarray | None = None
    labels: np.ndarray | None = None


class Site:
    """Rectified pairs of a data set, which are matched by one setting after the other."""

    def __init__(self, name: str, source: str, frames: int | None = None) -> None:
        self.name = name
        self.sequence = open_sequence(source, ReadOptions(stop=frames))
        self.front_end = StereoFrontEnd(self.sequence.camera, StereoOptions())
        self.pairs = [self.front_end(*self.sequence.read_pair(frame)) for frame in self.sequence.frames]
        self.chosen = list(range(len(self.pairs)))

    def truths(self) -> dict[int, Truth]:
        """By the index of the frame."""
        return {}

    def scored(self, disparities: dict[int, np.ndarray]) -> dict[str, float]:
        """The scores of the whole sequence."""
        return {}

    def row(self, options: StereoOptions) -> dict[str, float | None]:
        """All scores of a setting."""
        matcher, spent_ms = make_matcher(options, self.front_end.camera.width_px), []
        disparities = {}
        if options.matcher != "opencv":
            # Compiled by the first pair.
            matcher(self.pairs[0].left, self.pairs[0].right)
        for index in self.chosen:
            pair, started_s = self.pairs[index], time.process_time()
            disparities[index] = matcher(pair.left, pair.right)
            spent_ms.append(1e3 * (time.process_time() - started_s))
            if self.front_end.rectifier is not None:
                disparities[index][~self.front_end.rectifier.seen] = np.nan
        valid = float(np.mean([np.isfinite(one).mean() for one in disparities.values()]))
        compared = pixel_scores([(disparities[index], truth) for index, truth in self.truths().items()], self.near_px)
        return {"valid": valid, **compared, **self.scored(disparities), "ms": float(np.median(spent_ms))}

    @property
    def near_px(self) -> float:
        """The disparity at the end of the range."""
        camera = self.front_end.camera
        return float(camera.fx_px * camera.baseline_m / RANGE_M - camera.doffs_px)


def pixel_scores(compared: list[tuple[np.ndarray, Truth]], near_px: float) -> dict[str, float]:
    """The scores of matched pixels nearer than the range, over all frames with a truth."""
    off, rock_off, rock_seen, floating = [], [], [], []
    for disparity_px, truth in compared:
        near = disparity_px > near_px
        if truth.labels is not None:
            floating.append(near[truth.labels == BACKGROUND])
        if truth.disparity_px is None:
            continue
        known = truth.disparity_px > near_px
        off.append(np.abs(disparity_px - truth.disparity_px)[known & np.isfinite(disparity_px)])
        if truth.labels is not None:
            rock = known & (truth.labels == ROCK)
            rock_seen.append(np.isfinite(disparity_px[rock]))
            rock_off.append(np.abs(disparity_px - truth.disparity_px)[rock & np.isfinite(disparity_px)] > 2)
    parts = {"off_1px": [one > 1 for one in off], "off_2px": [one > 2 for one in off]}
    parts |= {"rock_off_2px": rock_off, "rock_valid": rock_seen, "floating": floating}
    return {name: float(np.concatenate(part).mean()) for name, part in parts.items() if part}


class Motorcycle(Site):
    """The Middlebury pair, with its true disparity."""

    def __init__(self) -> None:
        super().__init__("Motorcycle", "sample:motorcycle")

    def truths(self) -> dict[int, Truth]:
        """Of its one frame."""
        return {0: Truth(motorcycle_disparity())}

    @property
    def near_px(self) -> float:
        """The whole image counts: it is a room."""
        return -np.inf


class Drive(Site):
    """Frames with poses, and no truth."""

    def scored(self, disparities: dict[int, np.ndarray]) -> dict[str, float]:
        """How frames agree with those five later."""
        agreeing = []
        for a in range(len(self.pairs) - FRAMES_APART):
            T_b_a = np.linalg.inv(self.sequence.T_world_camera[a + FRAMES_APART]) @ self.sequence.T_world_camera[a]
            pose = jaxlie.SE3.from_matrix(jnp.asarray(T_b_a, jnp.float32))
            error = depth_consistency(self.front_end.camera, disparities[a], disparities[a + FRAMES_APART], pose)
            agreeing.append(np.abs(error) < 0.05)
        return {"agreeing": float(np.concatenate(agreeing).mean())} if agreeing else {}


class Simulated(Site):
    """A simulated traverse, with true labels and, of some frames, true depth."""

    def __init__(self, traverse: Traverse, maps: Sequence[str], stop: int | None) -> None:
        super().__init__(traverse.name, traverse.sequence, stop)
        self.traverse, self.maps, self.stop = traverse, maps, stop
        if not maps and any(truth.disparity_px is not None for truth in self._truths.values()):
            self.chosen = [index for index, truth in self._truths.items() if truth.disparity_px is not None]

    def truths(self) -> dict[int, Truth]:
        """Of the frames that are matched."""
        return {index: self._truths[index] for index in self.chosen}

    @cached_property
    def _truths(self) -> dict[int, Truth]:
        found = {}
        for index, frame in enumerate(self.sequence.frames):
            labels = read_values(self.traverse.gt / "labels" / f"{frame.name}.png").astype(np.uint8)
            depth = self.traverse.gt / "depth" / f"{frame.name}.npy"
            true_px = self._disparity_px(np.load(depth)) if depth.exists() else None
            found[index] = Truth(true_px, self.front_end.rectify_labels(labels))
        return found

    def _disparity_px(self, depth_m: np.ndarray) -> np.ndarray:
        """True disparity on rectified pixels, from the depth along the raw camera's axis on raw pixels, 0 for none."""
        camera, rectifier = self.front_end.camera, self.front_end.rectifier
        assert rectifier is not None
        # Nearest pixels: between a rock and the sand behind it no depth is true.
        near_m = cv2.remap(depth_m.astype(np.float32), *rectifier.left_maps, cv2.INTER_NEAREST)
        v, u = np.indices(near_m.shape)
        ray = np.stack([(u - camera.cx_px) / camera.fx_px, (v - camera.cy_px) / camera.fy_px, np.ones(u.shape)], -1)
        # Along a ray of unit depth in the rectified camera, the raw one's depth is its third row.
        depth_m = near_m / (ray @ rectifier.R_rectified_left[:, 2])
        with np.errstate(divide="ignore"):
            return np.where(near_m > 0, camera.fx_px * camera.baseline_m / depth_m - camera.doffs_px, np.nan)

    @cached_property
    def _frames(self) -> dict[str, Frames]:
        return {labels: Frames(self.traverse.sequence, self.traverse.truth) for labels in self.maps}

    def scored(self, disparities: dict[int, np.ndarray]) -> dict[str, float]:
        """The maps, by their labels."""
        scores = {}
        for labels, frames in self._frames.items():
            plan = frames.plan(replace(self.traverse.config(labels), stop=self.stop))
            matched = [self._with(prepared, disparities[prepared.index]) for prepared in frames.prepared]
            result = Scored(plan, fuse(plan, matched), self.traverse.truth)
            scores[f"iou_{labels}"] = float(np.mean(result.lattice_ious()))
        return scores

    def _with(self, prepared: PreparedFrame, disparity_px: np.ndarray) -> PreparedFrame:
        assert prepared.frame is not None
        return replace(prepared, frame=replace(prepared.frame, disparity_px=to_device(disparity_px, np.float32)))


def sites(data: Path, traverses: list[str] | None, maps: Sequence[str], stop: int | None) -> Iterator[Site]:
    """The data sets that are there; with maps, those that can be mapped against a truth."""
    simulated = data / "simdata"
    for name in traverses or [simulated / "traverse_a", simulated / "traverse_b", "sample:traverse"]:
        traverse = Traverse(name)
        if traverse.gt.is_dir():
            yield Simulated(traverse, maps, stop)
        else:
            print(f"left out: there is no {name}")
    if maps:
        return
    yield Motorcycle()
    for name, folder in (("KITTI 01", "kitti_odometry/sequences/01"), ("K10", "k10")):
        if (data / "realdata" / folder).is_dir():
            yield Drive(name, str(data / "realdata" / folder), DRIVE_FRAMES)
        else:
            print(f"left out: there is no {folder}")


def main() -> None:
    """Prints one table."""
    parser = command_line(__doc__)
    parser.add_argument("--data", type=Path, default=SHARED)
    parser.add_argument("--traverses", nargs="+", help="others than simdata's two and the sample")
    parser.add_argument("--mode", nargs="+", default=["3way", "sgbm", "hh4", "hh"])
    parser.add_argument("--penalties", nargs="+", type=int, default=[1, 2, 4], help="times those of OpenCV's examples")
    parser.add_argument("--block", nargs="+", type=int, default=[5])
    parser.add_argument("--speckle", nargs="+", type=int, default=[100])
    parser.add_argument("--maps", nargs="+", choices=("true", "plane"), default=(), help="labels of maps")
    parser.add_argument("--stop", type=int, help="of traverses, so many frames alone")
    parser.add_argument("--json", type=Path, help="file for the table")
    given = parse(parser)
    cv2.setNumThreads(1)
    columns = {"data": "<16", "mode": "<5", "P": "3d", "block": "6d", "speckle": "8d"}
    table = Table({**columns, **{name: f"{max(len(name) + 1, 7)}.4f" for name in SCORES}, "ms": "6.0f"})
    for site in sites(given.data, given.traverses, given.maps, given.stop):
        for mode, options in combinations(given.mode, given.penalties, given.block, given.speckle):
            row = site.row(options)
            of_opencv = (None if options.p1 is None else options.p1 // (8 * options.block_size**2), options.block_size)
            table.row(site.name, mode, *of_opencv, options.speckle_window, *(row.get(name) for name in (*SCORES, "ms")))
    table.write(given.json)


def combinations(
    modes: Sequence[str], penalties: Sequence[int], blocks: Sequence[int], speckles: Sequence[int]
) -> Iterator[tuple[str, StereoOptions]]:
    """The options of the rows."""
    for mode in modes:
        if mode in IN_JAX:
            yield from ((mode, StereoOptions(speckle_window=speckle, **IN_JAX[mode])) for speckle in speckles)
            continue
        for times, block, speckle in product(penalties, blocks, speckles):
            numbers = {"p1": 8 * times * block**2, "p2": 32 * times * block**2}
            yield mode, StereoOptions(mode=mode, block_size=block, speckle_window=speckle, **numbers)


if __name__ == "__main__":
    main()

"""Compares our projective carving with OctoMap's ray casting: the same clouds, poses, hits and misses into both.

    python scripts/experiments/octomap_agreement.py SEQUENCE... [--config katwijk] [--voxel-size-m 0.2 0.1] [--json F]

Needs `octomap-python` (extra `bench`). Every frame counts once in a voxel, as in OctoMap; evidence is a plain sum in
both; voxels are cubes; what lies outside the mapped depths is left out of the clouds. Prints for each sequence and
voxel size one table: the classes (unknown, free, occupied) of both maps against each other, and the cause of each
difference. Where the sequence is a simulated traverse (true poses and heights in `gt` beside it), voxels are also
compared with the true ground. Exit status 1 where the maps agree on fewer than 97 % of the voxels that both observed.
"""

from __future__ import annotations

import importlib.util
import json
import sys
from argparse import Namespace
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from common import command_line, parse
from jaxtyping import Bool, Float, Int, Int8

from jaxmap.datasets.crs import Extent, transform_between
from jaxmap.datasets.rasters import read_heights
from jaxmap.errors import JaxmapError
from jaxmap.fusion.query import observed, occupied
from jaxmap.geometry.camera import depth_sigma, disparity_to_points, points_to_pixels, transform_points
from jaxmap.geometry.grid import exact_corner
from jaxmap.mapping.sequence import prepare_frames
from jaxmap.runs.config import MapConfig, load_config
from jaxmap.runs.mapping_plan import Plan, plan_run
from jaxmap.types import Frame, GridSpec

LEAST_AGREEMENT = 0.97
CLASS_NAMES = ("unknown", "free", "occupied")
UNKNOWN, FREE, OCCUPIED = range(3)
MISS, NOTHING, HIT = -1, 0, 1
"""What one frame adds to a voxel."""
ABOVE, SURFACE, BELOW, NO_TRUTH = 0, 1, 2, -1
TRUTH_NAMES = ("above the ground", "holds its surface", "below it")

NEVER_CLAMPED = 1e-15
"""Probability 34 units of log-odds from even: farther than the frames of any comparison add up to."""
MARGIN_SIGMAS = 2.0
"""Of depth noise, that `carve` keeps before a surface."""
STRAY_SHARE = 0.25
"""Where fewer of the pixels that a voxel covers have a disparity, those are islands: mismatches, mostly."""
SAMPLES = 5
"""True heights looked up along each side of a voxel."""

CAUSES = {
    "no_ray": "between the rays: no ray crosses it",
    "rounding": "a point on its face falls to the neighbour",
    "range": "its centre lies outside the mapped depths",
    "view": "its centre lies outside the image",
    "stray": "stray points: most of the pixels it covers have no disparity",
    "hole": "its centre's pixel has no disparity, others around it have",
    "far": "its centre's pixel sees beyond the mapped depths",
    "behind": "edge or thin object: seen past, its centre is hidden",
    "grazing": "grazing ray: the surface is less than half a diagonal away",
    "noise": "depth noise: nearer to the surface than two sigmas",
}
"""Why a frame changed the two maps differently in a voxel, in the order in which they are tested. All but the first two
are voxels that a ray crosses, which ray casting frees, and that the projective test leaves alone."""

Classes = Int8[np.ndarray, "X Y Z"]


class Comparison(NamedTuple):
    """Two maps as classes of voxels; of those that differ indices, cause, and whether both maps observed them."""

    ours: Classes
    theirs: Classes
    voxels: Int[np.ndarray, "N 3"]
    cause: Int[np.ndarray, "N"]
    both: Bool[np.ndarray, "N"]
    frames: int

    def confusion(self) -> Int[np.ndarray, "3 3"]:
        """Counts of voxels by our class (rows) and OctoMap's."""
        return np.bincount(3 * self.ours.ravel().astype(int) + self.theirs.ravel(), minlength=9).reshape(3, 3)


def planned(source: str, voxel_size_m: float, given: Namespace) -> Plan:
    """The run of `jaxmap map` with the rule that OctoMap has."""
    config = load_config(given.config) if given.config else MapConfig()
    poses = truth_folder(source) / "poses_utm.tum"
    speckle = {} if given.speckle_window is None else {"speckle_window": given.speckle_window}
    config = replace(
        config,
        labeller="none",
        stereo=replace(config.stereo, **speckle),
        stop=given.stop if given.stop is not None else config.stop,
        grid=replace(config.grid, voxel_size_m=voxel_size_m),
        fusion=replace(config.fusion, per_frame="once", carve=True, range_weighting=False),
        **({"poses": poses, "max_pose_gap_s": 10.0} if poses.is_file() else {}),
    )
    return plan_run(source, config, lambda line: None)


def truth_folder(source: str) -> Path:
    """Where a simulated traverse keeps the truth."""
    return Path(source).resolve().parent / "gt"


def frames_of(plan: Plan, count: int) -> Iterator[Frame]:
    """So many frames, evenly spread over the sequence; those that cannot be used are left out."""
    every = len(plan.sequence.frames)
    chosen = sorted({round(index) for index in np.linspace(0, every - 1, min(count, every))})
    frames = tuple(plan.sequence.frames[index] for index in chosen)
    sequence = replace(plan.sequence, frames=frames, T_world_camera=plan.sequence.T_world_camera[chosen])
    return (ready.frame for ready in prepare_frames(sequence, plan.front_end) if ready.frame is not None)


def compare(plan: Plan, count: int) -> Comparison:
    """Maps frames twice and finds, for each voxel that differs, the cause that most frames have.

    Raises:
        JaxmapError: the voxels are not cubes, or do not lie on whole multiples of their edge.
    """
    mapper, params, grid, camera = plan.mapper, plan.params, plan.grid, plan.params.camera
    whole, key = make_octree(plan), jax.random.key(0)
    voxel_map, seen = mapper.init(), []
    for frame in frames_of(plan, count):
        # Without the disparities that are not mapped: ours would also see through what lies before farther points, but
        # OctoMap has a greatest range, no depth.
        points, valid = disparity_to_points(camera, frame.matched_px)
        kept = valid & (points[..., 2] >= plan.depth_range_m[0]) & (points[..., 2] <= plan.depth_range_m[1])
        near = replace(frame, disparity_px=jnp.where(kept, frame.matched_px, jnp.nan))
        cloud = np.asarray(transform_points(frame.T_world_camera, points), np.float64)[np.asarray(kept)]
        origin = np.asarray(frame.T_world_camera.translation(), np.float64)
        voxel_map, _ = mapper.step(voxel_map, near, params, key)
        # Evidence adds up, so a frame's share of a map is the map of that frame alone.
        mine, _ = mapper.step(mapper.init(), near, params, key)
        alone = make_octree(plan)
        for tree in (whole, alone):
            tree.insertPointCloud(cloud, origin, discretize=False)
        theirs = np.array([NOTHING, MISS, HIT], np.int8)[octree_classes(alone, grid)]
        seen.append((frame, np.sign(np.asarray(mine.log_odds[0])).astype(np.int8), theirs))
    solid, known = (np.asarray(which) for which in (occupied(voxel_map, params.fusion), observed(voxel_map)))
    ours = np.where(solid, OCCUPIED, np.where(known, FREE, UNKNOWN)).astype(np.int8)
    theirs = octree_classes(whole, grid)
    voxels = np.argwhere(ours != theirs)
    where, votes = tuple(voxels.T), np.zeros((len(voxels), len(CAUSES)), int)
    for frame, mine, other in seen:
        cause = frame_cause(plan, frame, mine[where], other[where], voxels)
        differs = cause >= 0
        votes[np.flatnonzero(differs), cause[differs]] += 1
    both = (ours[where] != UNKNOWN) & (theirs[where] != UNKNOWN)
    return Comparison(ours, theirs, voxels, votes.argmax(axis=1), both, len(seen))


def make_octree(plan: Plan) -> Any:
    """An empty OctoMap whose hits and misses add the same log-odds as ours, without bounds."""
    import octomap

    origin_m, size_m = exact_corner(plan.grid)
    offset = origin_m / size_m
    if np.ptp(size_m) > 0 or np.abs(offset - np.rint(offset)).max() > 1e-3:
        raise JaxmapError(
            f"voxels of {size_m.tolist()} m from {origin_m.tolist()}",
            where="grid",
            fix="OctoMap's voxels are cubes on whole multiples of their edge",
        )
    fusion, tree = plan.params.fusion, octomap.OcTree(float(size_m[0]))
    hit, miss = (
        1 / (1 + np.exp(float(fusion.occupancy_prior) - float(value)))
        for value in (fusion.occupancy_hit, fusion.occupancy_miss)
    )
    tree.setProbHit(float(hit))
    tree.setProbMiss(float(miss))
    tree.setOccupancyThres(0.5)
    tree.setClampingThresMin(NEVER_CLAMPED)
    tree.setClampingThresMax(1 - NEVER_CLAMPED)
    return tree


def octree_classes(tree: Any, grid: GridSpec) -> Classes:
    """The class of each voxel of an OctoMap, on our grid."""
    classes = np.full(grid.shape, UNKNOWN, np.int8)
    origin_m, size_m = exact_corner(grid)
    # Centres of all leaves; those that pruning has merged are taken apart again.
    for centres, name in zip(tree.extractPointCloud(), (OCCUPIED, FREE), strict=True):
        index = np.floor((np.asarray(centres, np.float64).reshape(-1, 3) - origin_m) / size_m).astype(int)
        inside = ((index >= 0) & (index < grid.shape)).all(axis=1)
        classes[tuple(index[inside].T)] = name
    return classes


def frame_cause(
    plan: Plan, frame: Frame, ours: np.ndarray, theirs: np.ndarray, voxels: Int[np.ndarray, "N 3"]
) -> Int[np.ndarray, "N"]:
    """Why one frame changed the maps differently in these voxels; -1 where it did not."""
    camera, grid, (low_m, high_m) = plan.params.camera, plan.grid, plan.depth_range_m
    size_m = np.asarray(grid.voxel_size_m)
    centres = (np.asarray(grid.origin_m) + (voxels + 0.5) * size_m).astype(np.float32)
    centres_camera = transform_points(frame.T_world_camera.inverse(), jnp.asarray(centres))
    u_px, v_px, _, in_front = (np.asarray(values) for values in points_to_pixels(camera, centres_camera))
    depth_m = np.asarray(centres_camera[:, 2])
    column, row = np.rint(u_px), np.rint(v_px)
    in_view = in_front & (column >= 0) & (column < camera.width_px) & (row >= 0) & (row < camera.height_px)
    pixel = (np.where(in_view, row, 0).astype(int), np.where(in_view, column, 0).astype(int))
    points, valid = (np.asarray(values) for values in disparity_to_points(camera, frame.matched_px))
    measured_m, known = points[..., 2][pixel], valid[pixel]
    half_width_px = 0.5 * float(np.mean(size_m)) * float(camera.fx_px) / np.maximum(depth_m, 1e-3)
    half_diagonal_m, gap_m = 0.5 * float(np.linalg.norm(size_m)), measured_m - depth_m
    sigma_m = np.asarray(depth_sigma(camera, jnp.asarray(measured_m), plan.params.fusion.disparity_sigma_px))
    crossed = (theirs == MISS) & (ours == NOTHING)
    tests = {
        "no_ray": (ours == MISS) & (theirs == NOTHING),
        "rounding": (ours != theirs) & ~crossed,
        "range": (depth_m < low_m) | (depth_m > high_m),
        "view": ~in_view,
        "stray": ~known & (share_known(valid, pixel, half_width_px) < STRAY_SHARE),
        "hole": ~known,
        "far": (measured_m < low_m) | (measured_m > high_m),
        "behind": gap_m < -half_diagonal_m,
        "grazing": gap_m <= half_diagonal_m,
        "noise": gap_m <= half_diagonal_m + MARGIN_SIGMAS * sigma_m,
    }
    names = list(CAUSES)
    found = np.select([tests[name] for name in names], list(range(len(names))), names.index("rounding"))
    return np.where(ours == theirs, -1, found)


def share_known(
    valid: Bool[np.ndarray, "H W"], pixel: tuple[np.ndarray, np.ndarray], half_width_px: Float[np.ndarray, "N"]
) -> Float[np.ndarray, "N"]:
    """Share of the pixels in squares about some pixels that have a disparity, from a summed-area table."""
    table = np.pad(valid.astype(np.int64).cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    reach = np.rint(half_width_px).clip(0, max(valid.shape)).astype(int)
    (top, left), (bottom, right) = (
        tuple((at + way).clip(0, size) for at, size in zip(pixel, valid.shape, strict=True))
        for way in (-reach, reach + 1)
    )
    known = table[bottom, right] - table[top, right] - table[bottom, left] + table[top, left]
    return known / ((bottom - top) * (right - left))


def true_voxels(path: Path, plan: Plan) -> Classes:
    """Whether each voxel lies above the true ground (rocks included), holds its surface, or lies below."""
    grid, site = plan.grid, plan.sequence.site_origin
    origin_m, size_m = exact_corner(grid)
    low = origin_m[:2] + site[:2]
    high = low + size_m[:2] * grid.shape[:2]
    raster = read_heights(path, Extent(low[0], low[1], high[0], high[1], plan.sequence.crs))
    axes_m = (low[i] + (np.arange(grid.shape[i] * SAMPLES) + 0.5) * size_m[i] / SAMPLES for i in (0, 1))
    x, y = transform_between(plan.sequence.crs, raster.crs, "the heights")(*np.meshgrid(*axes_m, indexing="ij"))
    column, row, _ = np.einsum("ij,jxy->ixy", np.linalg.inv(raster.T_crs_pixel), np.stack([x, y, np.ones_like(x)]))
    column, row = np.floor(column).astype(int), np.floor(row).astype(int)
    rows, columns = raster.height_m.shape
    inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    height_m = np.where(inside, raster.height_m[row.clip(0, rows - 1), column.clip(0, columns - 1)], np.nan)
    cells = height_m.reshape(grid.shape[0], SAMPLES, grid.shape[1], SAMPLES) - site[2]
    lowest_m, highest_m = cells.min(axis=(1, 3))[..., None], cells.max(axis=(1, 3))[..., None]
    bottom_m = origin_m[2] + np.arange(grid.shape[2]) * size_m[2]
    place = np.where(bottom_m > highest_m, ABOVE, np.where(bottom_m + size_m[2] < lowest_m, BELOW, SURFACE))
    return np.where(np.isfinite(lowest_m), place, NO_TRUTH).astype(np.int8)


def print_comparison(name: str, found: Comparison, truth: Classes | None) -> dict[str, Any]:
    """Prints the tables of a comparison, and returns them as plain values."""
    confusion = found.confusion()
    agreed = np.trace(confusion[1:, 1:])
    both, either = agreed / max(confusion[1:, 1:].sum(), 1), agreed / max(confusion.sum() - confusion[0, 0], 1)
    print(f"\n{name}\n  {'ours / OctoMap':16s}" + "".join(f"{one:>12s}" for one in CLASS_NAMES))
    for one, counts in zip(CLASS_NAMES, confusion, strict=True):
        print(f"  {one:16s}" + "".join(f"{count:12,d}" for count in counts))
    print(f"  one class: {both:.2%} of the voxels that both observed, {either:.2%} of those that either did")
    result = {"name": name, "confusion": confusion.tolist(), "agreement_both": both, "agreement_either": either}
    header = "".join(f"{one:>20s}" for one in TRUTH_NAMES) if truth is not None else ""
    print(f"  {'':80s}{'voxels':>9s}{header}")

    def line(title: str, voxels: np.ndarray) -> None:
        counts = [len(voxels)]
        if truth is not None:
            places = truth[tuple(voxels.T)]
            counts += np.bincount(places[places != NO_TRUTH], minlength=len(TRUTH_NAMES)).tolist()
        if len(voxels):
            result[title] = counts
            print(f"  {title:80s}{counts[0]:9,d}" + "".join(f"{count:20,d}" for count in counts[1:]))

    for seen, kind in ((True, "observed by both"), (False, "observed by one")):
        of_kind = found.both == seen
        for index in np.argsort(-np.bincount(found.cause[of_kind], minlength=len(CAUSES)), kind="stable"):
            cause = list(CAUSES.values())[index]
            line(f"{kind}; {cause}", found.voxels[of_kind & (found.cause == index)])
    for who, classes in (("ours", found.ours), ("OctoMap", found.theirs)):
        for index in (FREE, OCCUPIED):
            line(f"{who}, {CLASS_NAMES[index]}", np.argwhere(classes == index))
    sys.stdout.flush()
    return result


def main() -> int:
    """Prints the comparisons; 1 where the maps agree on too few voxels, or cannot be made."""
    parser = command_line(__doc__)
    parser.add_argument("sequences", nargs="+", metavar="SEQUENCE", help="as for jaxmap map")
    parser.add_argument("--config", help="configuration of jaxmap map")
    parser.add_argument("--voxel-size-m", type=float, nargs="+", default=[0.2, 0.1])
    parser.add_argument("--frames", type=int, default=8, help="how many, spread over the sequence")
    parser.add_argument("--stop", type=int, help="frame to stop before, as for jaxmap map")
    parser.add_argument("--speckle-window", type=int, help="drop matches in islands of at most so many pixels")
    parser.add_argument("--json", type=Path, help="file for the tables")
    given = parse(parser)
    if importlib.util.find_spec("octomap") is None:
        parser.error("needs octomap: pip install octomap-python")
    rows = []
    try:
        for source in given.sequences:
            for voxel_size_m in given.voxel_size_m:
                plan = planned(source, voxel_size_m, given)
                found = compare(plan, given.frames)
                dem = truth_folder(source) / "dem.tif"
                truth = true_voxels(dem, plan) if dem.is_file() else None
                name = f"{Path(source).resolve().parent.name} {plan.sequence.name}" if dem.is_file() else source
                rows.append(
                    print_comparison(f"{name}, voxels of {voxel_size_m:g} m, frames: {found.frames}", found, truth)
                )
    except JaxmapError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    if given.json:
        given.json.write_text(json.dumps(rows, indent=1) + "\n")
    return 0 if all(row["agreement_both"] >= LEAST_AGREEMENT for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())

"""Where two maps differ, and what each difference comes from, measured voxel by voxel and frame by frame."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from agreement.maps import MISS, NOTHING, UNKNOWN, Seen, TwoMaps
from jaxtyping import Bool, Float, Int

from jaxmap.fusion.params import FusionParams
from jaxmap.geometry.camera import depth_sigma, disparity_to_points, points_to_pixels, transform_points
from jaxmap.types import GridSpec, StereoCamera

MARGIN_SIGMAS = 2.0
"""Of depth noise, that `carve` keeps before a surface."""

STRAY_SHARE = 0.25
"""Where fewer of the pixels that a voxel covers have a disparity, those are islands: mismatches, mostly."""

CAUSES = {
    "grazing": "grazing ray: the surface is less than half a diagonal away",
    "noise": "depth noise: nearer to the surface than two sigmas",
    "behind": "edge or thin object: seen past, its centre is hidden",
    "stray": "stray points: most of the pixels it covers have no disparity",
    "hole": "its centre's pixel has no disparity, others around it have",
    "far": "its centre's pixel sees beyond the mapped depths",
    "view": "its centre lies outside the image",
    "range": "its centre lies outside the mapped depths",
    "no_ray": "between the rays: no ray crosses it",
    "rounding": "a point on its face falls to the neighbour",
}
"""Why a frame told the two maps different things of a voxel. All but the last two are voxels that a ray crosses, which
ray casting frees, and that the projective test leaves alone."""

_NAMES = list(CAUSES)


class Agreement(NamedTuple):
    """How far two maps agree.

    `confusion[i, j]` counts voxels of our class i and their class j (unknown, free, occupied).
    """

    confusion: Int[np.ndarray, "3 3"]

    @property
    def both(self) -> float:
        """Share of the voxels observed in both maps that have one class."""
        seen = self.confusion[1:, 1:]
        return float(np.trace(seen) / max(seen.sum(), 1))

    @property
    def either(self) -> float:
        """Share of the voxels observed in either map that have one class."""
        return float(np.trace(self.confusion[1:, 1:]) / max(self.confusion.sum() - self.confusion[0, 0], 1))


def agreement_of(maps: TwoMaps) -> Agreement:
    """Counts the classes of two maps against each other."""
    pairs = np.bincount(3 * maps.ours.ravel().astype(int) + maps.theirs.ravel(), minlength=9)
    return Agreement(pairs.reshape(3, 3))


class Differences(NamedTuple):
    """The voxels whose classes differ: their indices, their cause, and whether both maps had observed them."""

    voxels: Int[np.ndarray, "N 3"]
    cause: Int[np.ndarray, "N"]
    both: Bool[np.ndarray, "N"]

    def counts(self, both: bool) -> dict[str, int]:
        """How many voxels each cause explains."""
        found = np.bincount(self.cause[self.both == both], minlength=len(_NAMES))
        return dict(zip(_NAMES, found.tolist(), strict=True))


def explain(
    maps: TwoMaps, camera: StereoCamera, grid: GridSpec, params: FusionParams, depth_range_m: tuple[float, float]
) -> Differences:
    """Finds for each voxel that differs the cause that most of the frames which tell the two maps apart have."""
    voxels = np.argwhere(maps.ours != maps.theirs)
    votes = np.zeros((len(voxels), len(_NAMES)), int)
    where = tuple(voxels.T)
    centres = np.asarray(grid.origin_m) + (voxels + 0.5) * np.asarray(grid.voxel_size_m)
    for seen in maps.frames:
        cause = _frame_cause(seen, where, centres.astype(np.float32), camera, grid, params, depth_range_m)
        told_apart = cause >= 0
        votes[np.flatnonzero(told_apart), cause[told_apart]] += 1
    both = (maps.ours[where] != UNKNOWN) & (maps.theirs[where] != UNKNOWN)
    return Differences(voxels, votes.argmax(axis=1), both)


def _frame_cause(
    seen: Seen,
    where: tuple[np.ndarray, ...],
    centres: Float[np.ndarray, "N 3"],
    camera: StereoCamera,
    grid: GridSpec,
    params: FusionParams,
    depth_range_m: tuple[float, float],
) -> Int[np.ndarray, "N"]:
    """Why one frame told the maps different things of these voxels; -1 where it did not."""
    centres_camera = transform_points(seen.frame.T_world_camera.inverse(), jnp.asarray(centres))
    u_px, v_px, _, in_front = (np.asarray(values) for values in points_to_pixels(camera, centres_camera))
    depth_m = np.asarray(centres_camera[:, 2])
    column, row = np.rint(u_px), np.rint(v_px)
    in_view = in_front & (column >= 0) & (column < camera.width_px) & (row >= 0) & (row < camera.height_px)
    points, valid = disparity_to_points(camera, seen.frame.disparity_px)
    pixel = (np.where(in_view, row, 0).astype(int), np.where(in_view, column, 0).astype(int))
    measured_m, known = np.asarray(points[..., 2])[pixel], np.asarray(valid)[pixel]
    low_m, high_m = depth_range_m
    half_width_px = 0.5 * float(np.mean(grid.voxel_size_m)) * float(camera.fx_px) / np.maximum(depth_m, 1e-3)
    gap_m = measured_m - depth_m
    half_diagonal_m = 0.5 * float(np.linalg.norm(np.asarray(grid.voxel_size_m)))
    sigma_m = depth_sigma(camera, jnp.asarray(measured_m), params.disparity_sigma_px)
    noise_m = MARGIN_SIGMAS * np.asarray(sigma_m)
    ours, theirs = seen.ours[where], seen.theirs[where]
    crossed = (theirs == MISS) & (ours == NOTHING)
    # In this order: what is found first is the cause.
    causes = {
        "no_ray": (ours == MISS) & (theirs == NOTHING),
        "rounding": (ours != theirs) & ~crossed,
        "range": (depth_m < low_m) | (depth_m > high_m),
        "view": ~in_view,
        "stray": ~known & (_share_known(np.asarray(valid), pixel, half_width_px) < STRAY_SHARE),
        "hole": ~known,
        "far": (measured_m < low_m) | (measured_m > high_m),
        "behind": gap_m < -half_diagonal_m,
        "grazing": gap_m <= half_diagonal_m,
        "noise": gap_m <= half_diagonal_m + noise_m,
    }
    found = np.select(list(causes.values()), [_NAMES.index(name) for name in causes], _NAMES.index("rounding"))
    return np.where(ours == theirs, -1, found)


def _share_known(
    valid: Bool[np.ndarray, "H W"], pixel: tuple[np.ndarray, np.ndarray], half_width_px: Float[np.ndarray, "N"]
) -> Float[np.ndarray, "N"]:
    """Share of the pixels in squares about some pixels that have a disparity, from a summed-area table."""
    table = np.pad(valid.astype(np.int64).cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    reach = np.rint(half_width_px).clip(0, max(valid.shape)).astype(int)
    (top, left), (bottom, right) = (
        tuple((at + way).clip(0, size) for at, way, size in zip(pixel, ways, valid.shape, strict=True))
        for ways in ((-reach, -reach), (reach + 1, reach + 1))
    )
    known = table[bottom, right] - table[top, right] - table[bottom, left] + table[top, left]
    return known / ((bottom - top) * (right - left))

"""Errors of a trajectory against a true one: absolute (ATE) and relative (RPE), as the program evo counts them.

Sturm et al. 2012, "A benchmark for the evaluation of RGB-D SLAM systems", section IV; alignment by Umeyama 1991,
"Least-squares estimation of transformation parameters between two point patterns", equations 38 to 43.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64, Int
from scipy.spatial.transform import Rotation

from jaxmap.errors import JaxmapError

LEAST_POSES = 3
"""Any two poses can be aligned exactly, given a scale."""


class Similarity(NamedTuple):
    """`p_true = scale * R @ p + t_m`."""

    R: Float64[np.ndarray, "3 3"]
    t_m: Float64[np.ndarray, "3"]
    scale: float


def associate(
    times_s: Float64[np.ndarray, "N"], true_times_s: Float64[np.ndarray, "M"], max_diff_s: float
) -> tuple[Int[np.ndarray, "K"], Int[np.ndarray, "K"]]:
    """Which poses belong together: each of the fewer with the nearest in time of the others.

    Args:
        times_s: increasing.
        true_times_s: increasing.
        max_diff_s: those farther apart than this have no partner.

    Returns:
        Indices into both. Of two equally near, the earlier one is taken.
    """
    if len(times_s) > len(true_times_s):
        true_index, index = associate(true_times_s, times_s, max_diff_s)
        return index, true_index
    after = np.searchsorted(true_times_s, times_s, side="right").clip(1, len(true_times_s) - 1)
    if len(true_times_s) == 1:
        after = np.zeros(len(times_s), int)
    before = np.maximum(after - 1, 0)
    ahead_s, behind_s = np.abs(true_times_s[after] - times_s), np.abs(times_s - true_times_s[before])
    nearest = np.where(ahead_s < behind_s, after, before)
    found = np.minimum(ahead_s, behind_s) <= max_diff_s
    return np.flatnonzero(found), nearest[found]


def align(
    positions: Float64[np.ndarray, "N 3"], true_positions: Float64[np.ndarray, "N 3"], *, with_scale: bool
) -> Similarity:
    """The motion, with a scale where asked for, that takes positions nearest to the true ones in the mean square.

    Where all lie on a line, the turn about it is arbitrary; what is left between the two is not.
    """
    mean, true_mean = positions.mean(axis=0), true_positions.mean(axis=0)
    off, true_off = positions - mean, true_positions - true_mean
    U, strength, Vt = np.linalg.svd(true_off.T @ off / len(off))
    mirror = np.array([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))])
    R = (U * mirror) @ Vt
    variance = float((off**2).sum(axis=1).mean())
    scale = float(strength @ mirror) / variance if with_scale and variance > 0 else 1.0
    return Similarity(R, true_mean - scale * R @ mean, scale)


def absolute_errors_m(
    T: Float64[np.ndarray, "N 4 4"], T_true: Float64[np.ndarray, "N 4 4"], alignment: Similarity | None = None
) -> Float64[np.ndarray, "N"]:
    """Distances between the positions of poses and true ones, after an alignment where one is given."""
    moved = T[:, :3, 3]
    if alignment is not None:
        moved = alignment.scale * moved @ alignment.R.T + alignment.t_m
    return np.linalg.norm(moved - T_true[:, :3, 3], axis=1)


def relative_errors(
    T: Float64[np.ndarray, "N 4 4"], T_true: Float64[np.ndarray, "N 4 4"], pairs: Int[np.ndarray, "P 2"]
) -> tuple[Float64[np.ndarray, "P"], Float64[np.ndarray, "P"]]:
    """How far the motion between two poses is from the true one, for each pair: metres, and degrees."""
    moved, truly = (np.linalg.inv(poses[pairs[:, 0]]) @ poses[pairs[:, 1]] for poses in (T, T_true))
    off = np.linalg.inv(truly) @ moved
    turned = Rotation.from_matrix(off[:, :3, :3].reshape(-1, 3, 3)).magnitude()
    return np.linalg.norm(off[:, :3, 3], axis=1), np.degrees(turned)


def pairs_by_way(positions: Float64[np.ndarray, "N 3"], way_m: float) -> Int[np.ndarray, "P 2"]:
    """Poses that follow each other with at least this way between them along the path; none for a shorter path."""
    kept, since_m = [0], 0.0
    for index, step_m in enumerate(np.linalg.norm(np.diff(positions, axis=0), axis=1).tolist(), start=1):
        since_m += step_m
        if since_m >= way_m:
            kept.append(index)
            since_m = 0.0
    return np.column_stack([kept[:-1], kept[1:]]).astype(int)


def pose_scores(
    T: Float64[np.ndarray, "N 4 4"], T_true: Float64[np.ndarray, "N 4 4"], way_m: float = 1.0
) -> dict[str, Any]:
    """ATE and RPE of poses that belong together.

    Args:
        T: T_world_camera.
        T_true: the same, true.
        way_m: of the RPE along the path.

    Returns:
        `ate_m` as they are, `ate_aligned_m` after a motion, `ate_scaled_m` after one with a scale, which is `scale`;
        `rpe_frame_m` and `rpe_frame_deg` from each pose to the next; `rpe_way_m` and `rpe_way_deg` over pieces of at
        least `way_m` of the path. Each holds rmse, mean, median, std, min, max and count, or is None without pairs.

    Raises:
        JaxmapError: fewer than `LEAST_POSES`.
    """
    if len(T) < LEAST_POSES:
        raise JaxmapError(f"{len(T)} poses to compare, fewer than {LEAST_POSES}", where="poses", fix="give more")
    positions, true_positions = T[:, :3, 3], T_true[:, :3, 3]
    rigid, similar = (align(positions, true_positions, with_scale=scaled) for scaled in (False, True))
    following = np.column_stack([np.arange(len(T) - 1), np.arange(1, len(T))])
    frame_m, frame_deg = relative_errors(T, T_true, following)
    piece_m, piece_deg = relative_errors(T, T_true, pairs_by_way(positions, way_m))
    return {
        "poses": len(T),
        "path_length_m": float(np.linalg.norm(np.diff(true_positions, axis=0), axis=1).sum()),
        "scale": similar.scale,
        "way_m": way_m,
        "ate_m": _statistics(absolute_errors_m(T, T_true)),
        "ate_aligned_m": _statistics(absolute_errors_m(T, T_true, rigid)),
        "ate_scaled_m": _statistics(absolute_errors_m(T, T_true, similar)),
        "rpe_frame_m": _statistics(frame_m),
        "rpe_frame_deg": _statistics(frame_deg),
        "rpe_way_m": _statistics(piece_m),
        "rpe_way_deg": _statistics(piece_deg),
    }


def _statistics(errors: np.ndarray) -> dict[str, float | int] | None:
    if not len(errors):
        return None
    numbers = {
        "rmse": np.sqrt(np.mean(errors**2)),
        **{name: getattr(np, name)(errors) for name in ("mean", "median", "std", "min", "max")},
    }
    return {**{name: float(value) for name, value in numbers.items()}, "count": len(errors)}

"""The values that flow through jaxmap: immutable pytrees, checked once on the host by `make_*`.

Frames and units are in the names. The camera frame is x right, y down, z forward with integer pixel
centres; the world is x east, y north, z up, in metres, float32 relative to a float64 `site_origin`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8

from jaxmap.errors import JaxmapError

MAX_TENSOR_ELEMENTS = 2**31 - 1
"""Flat indices are int32, so a map tensor holds at most this many numbers."""


def _static() -> dict[str, bool]:
    return {"static": True}


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class StereoCamera:
    """A rectified pinhole stereo pair, seen from its left camera.

    `Z = baseline_m * fx_px / (disparity_px + doffs_px)`, where `doffs_px` is the difference of the
    principal points `cx_right - cx_left` (zero for most rectified pairs, not for Middlebury's).
    """

    fx_px: Float[Array, ""]
    fy_px: Float[Array, ""]
    cx_px: Float[Array, ""]
    cy_px: Float[Array, ""]
    baseline_m: Float[Array, ""]
    doffs_px: Float[Array, ""]
    width_px: int = field(metadata=_static())
    height_px: int = field(metadata=_static())


def make_stereo_camera(
    *,
    fx_px: float,
    cx_px: float,
    cy_px: float,
    baseline_m: float,
    width_px: int,
    height_px: int,
    fy_px: float | None = None,
    doffs_px: float = 0.0,
    where: object = "stereo camera",
) -> StereoCamera:
    """Checks and builds a `StereoCamera`; `fy_px` is `fx_px` where it is not given.

    Raises:
        JaxmapError: a number is not finite, or the focal length, baseline or size is not positive.
    """
    fy_px = fx_px if fy_px is None else fy_px
    numbers = dict(fx_px=fx_px, fy_px=fy_px, cx_px=cx_px, cy_px=cy_px, baseline_m=baseline_m, doffs_px=doffs_px)
    for name, value in numbers.items():
        if not np.isfinite(value):
            raise JaxmapError(f"{name} is {value}", where=where, fix="give a finite number")
    for name in ("fx_px", "fy_px", "baseline_m"):
        if numbers[name] <= 0:
            raise JaxmapError(
                f"{name} is {numbers[name]:g}, it must be positive",
                where=where,
                fix="check the calibration: the right camera sits at +x of the left one",
            )
    if width_px < 1 or height_px < 1:
        raise JaxmapError(f"image size {width_px}x{height_px}", where=where, fix="give a positive size")
    leaves = {name: jnp.asarray(value, jnp.float32) for name, value in numbers.items()}
    return StereoCamera(**leaves, width_px=int(width_px), height_px=int(height_px))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Frame:
    """One stereo frame, ready for the compiled step.

    `disparity_px` is NaN where the matcher found nothing. The last three are present only where
    the labeller asks for them, so that every frame of a sequence has the same structure.
    """

    disparity_px: Float[Array, "H W"]
    T_world_camera: jaxlie.SE3
    image: UInt8[Array, "H W 3"] | None = None
    labels: UInt8[Array, "H W"] | None = None
    class_probabilities: Float[Array, "H W C"] | None = None


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class GridSpec:
    """A bounded voxel grid: voxel `i` spans `[origin_m + i * size, origin_m + (i + 1) * size)`."""

    origin_m: Float[Array, "3"]
    voxel_size_m: Float[Array, "3"]
    shape: tuple[int, int, int] = field(metadata=_static())


def make_grid(lower_m: Sequence[float], upper_m: Sequence[float], voxel_size_m: float | Sequence[float]) -> GridSpec:
    """The grid that spans from `lower_m` to at least `upper_m` (world, metres).

    Raises:
        JaxmapError: bounds not finite or not ordered, or a voxel size that is not positive.
    """
    lower, upper = np.asarray(lower_m, np.float64), np.asarray(upper_m, np.float64)
    size = np.broadcast_to(np.asarray(voxel_size_m, np.float64), (3,))
    if lower.shape != (3,) or upper.shape != (3,):
        raise JaxmapError("a grid takes three lower and three upper bounds", where="grid bounds")
    if not (np.isfinite(lower).all() and np.isfinite(upper).all() and (upper > lower).all()):
        raise JaxmapError(
            f"lower {lower.tolist()} and upper {upper.tolist()} do not span a box",
            where="grid bounds",
            fix="each upper bound must be finite and above the lower one",
        )
    if not (np.isfinite(size).all() and (size > 0).all()):
        raise JaxmapError(f"voxel size {size.tolist()} m", where="grid", fix="give a positive size")
    # A span of 40 m in voxels of 0.2 m is 200 voxels, not 201, in spite of rounding.
    counts = np.ceil((upper - lower) / size - 1e-6).astype(int).clip(min=1)
    return GridSpec(
        origin_m=jnp.asarray(lower, jnp.float32),
        voxel_size_m=jnp.asarray(size, jnp.float32),
        shape=(int(counts[0]), int(counts[1]), int(counts[2])),
    )


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class VoxelMap:
    """Evidence gathered so far, as sums of log-odds increments.

    Channel 0 is occupancy, channel `1 + c` is class `c`. A voxel that nothing has touched holds
    exact zeros; priors are added when the map is read (`fusion.query`), so that maps can be summed.
    """

    log_odds: Float[Array, "K X Y Z"]
    frames_fused: Int[Array, ""]
    grid: GridSpec
    classes: tuple[str, ...] = field(metadata=_static())


def make_voxel_map(grid: GridSpec, classes: Sequence[str]) -> VoxelMap:
    """An empty map.

    Raises:
        JaxmapError: the tensor would have more elements than a 32-bit index can reach.
    """
    shape = (1 + len(classes), *grid.shape)
    if np.prod(shape, dtype=np.int64) > MAX_TENSOR_ELEMENTS:
        raise JaxmapError(
            f"a map of {shape[0]} channels x {' x '.join(map(str, grid.shape))} voxels passes 2^31 numbers",
            where="grid",
            fix="take larger voxels or a smaller box",
        )
    return VoxelMap(
        log_odds=jnp.zeros(shape, jnp.float32),
        frames_fused=jnp.zeros((), jnp.int32),
        grid=grid,
        classes=tuple(classes),
    )


class Plane(NamedTuple):
    """The plane `normal . p + offset_m = 0`, its normal on the side of the up hint.

    `found` is false where no hypothesis was acceptable (too few points, or all planes too steep).
    """

    normal: Float[Array, "3"]
    offset_m: Float[Array, ""]
    inlier_fraction: Float[Array, ""]
    found: Bool[Array, ""]


class PointLabels(NamedTuple):
    """What a labeller says of the points of a frame.

    Exactly one of `labels` (`IGNORE` where unknown) and `probabilities` is given. Points whose
    `keep` is false are not fused at all; ignored points still say that something is there.
    """

    keep: Bool[Array, "N"]
    labels: Int[Array, "N"] | None = None
    probabilities: Float[Array, "N C"] | None = None


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class FusionParams:
    """The numbers of the sensor model and of the decision; every leaf is differentiable.

    Log-odds are natural. `class_increments[i, j]` is what one observation of label `i` adds to
    class `j`. `disparity_sigma_px` drives the range weight and the margin of free-space carving.
    """

    occupancy_hit: Float[Array, ""]
    occupancy_miss: Float[Array, ""]
    occupancy_prior: Float[Array, ""]
    class_increments: Float[Array, "C C"]
    class_prior: Float[Array, "C"]
    disparity_sigma_px: Float[Array, ""]
    full_evidence_points: Float[Array, ""]
    occupancy_threshold: Float[Array, ""]
    class_threshold: Float[Array, ""]


@dataclass(frozen=True)
class FusionRule:
    """The discrete choices of fusion, fixed when the step is compiled.

    Attributes:
        per_frame: how the points of one frame in one voxel count. `sum`: each adds its increment;
            `once`: each label present adds its increment once (the paper); `mean`: the frame adds
            one increment, shared by the labels' fractions, in full from `full_evidence_points` on.
        carve: whether voxels seen through are marked free.
        range_weighting: whether a point counts less as its depth noise outgrows the voxel.
        priority_classes: classes that win a voxel as soon as their probability passes the
            threshold, in this order; the others compete by probability.
        column: how voxels of a column make the top-down map: the `max` probability over them, or
            the `sum` of their evidence.
    """

    per_frame: Literal["sum", "once", "mean"] = "mean"
    carve: bool = True
    range_weighting: bool = True
    priority_classes: tuple[str, ...] = ("rock",)
    column: Literal["max", "sum"] = "sum"


def logit(probability: float) -> float:
    """Natural log-odds of a probability in (0, 1)."""
    return float(np.log(probability / (1.0 - probability)))


def make_fusion_params(
    classes: Sequence[str],
    *,
    occupancy_hit: float = 0.85,
    occupancy_miss: float = -0.4,
    occupancy_prior: float = 0.5,
    class_hit: float = 0.9,
    class_miss: float = -0.9,
    class_increments: Sequence[Sequence[float]] | None = None,
    class_prior: float | Sequence[float] = 0.5,
    disparity_sigma_px: float = 0.5,
    full_evidence_points: float = 8.0,
    occupancy_threshold: float = 0.5,
    class_threshold: float = 0.5,
) -> FusionParams:
    """Checks and builds `FusionParams`; priors and thresholds are probabilities here.

    Without `class_increments`, an observation adds `class_hit` to its own class and `class_miss` to
    every other (the label confusion of a sensor that treats all classes alike).

    Raises:
        JaxmapError: a probability outside (0, 1), a matrix of another size, or a wrong sign.
    """
    count = len(classes)
    for name, value in dict(
        occupancy_prior=occupancy_prior, occupancy_threshold=occupancy_threshold, class_threshold=class_threshold
    ).items():
        if not 0.0 < value < 1.0:
            raise JaxmapError(f"{name} is {value}", where="fusion", fix="give a probability between 0 and 1")
    if occupancy_hit < 0 or occupancy_miss > 0:
        raise JaxmapError(
            f"occupancy_hit {occupancy_hit} and occupancy_miss {occupancy_miss}",
            where="fusion",
            fix="a hit adds (>= 0) and a miss takes away (<= 0)",
        )
    if disparity_sigma_px <= 0 or full_evidence_points <= 0:
        raise JaxmapError(
            "disparity_sigma_px and full_evidence_points must be positive", where="fusion", fix="give numbers above 0"
        )
    if class_increments is None:
        matrix = np.full((count, count), class_miss) + np.eye(count) * (class_hit - class_miss)
    else:
        matrix = np.asarray(class_increments, np.float64).reshape(-1, count) if count else np.zeros((0, 0))
    if matrix.shape != (count, count) or not np.isfinite(matrix).all():
        raise JaxmapError(
            f"class_increments is not a finite {count}x{count} matrix",
            where="fusion",
            fix=f"one row per class of {list(classes)}",
        )
    priors = np.broadcast_to(np.asarray(class_prior, np.float64), (count,))
    if not ((priors > 0) & (priors < 1)).all():
        raise JaxmapError(f"class_prior is {class_prior}", where="fusion", fix="give probabilities between 0 and 1")

    def leaf(value: object) -> Array:
        return jnp.asarray(value, jnp.float32)

    return FusionParams(
        occupancy_hit=leaf(occupancy_hit),
        occupancy_miss=leaf(occupancy_miss),
        occupancy_prior=leaf(logit(occupancy_prior)),
        class_increments=leaf(matrix),
        class_prior=leaf(np.log(priors / (1 - priors))),
        disparity_sigma_px=leaf(disparity_sigma_px),
        full_evidence_points=leaf(full_evidence_points),
        occupancy_threshold=leaf(occupancy_threshold),
        class_threshold=leaf(class_threshold),
    )

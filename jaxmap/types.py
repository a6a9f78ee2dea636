"""The values that flow through jaxmap: immutable pytrees, checked once on the host by `make_*`.

Frames and units are in the names. The camera frame is x right, y down, z forward with integer pixel
centres; the world is x east, y north, z up, in metres, float32 relative to a float64 `site_origin`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import numpy.typing as npt
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int, Shaped, UInt8

from jaxmap.errors import JaxmapError

MAX_TENSOR_ELEMENTS = 2**31 - 1
"""Flat indices are int32, so a map tensor holds at most this many numbers."""

MOST_VOXELS_ALONG = 2**23
"""Indices of voxels along an axis, and halves of them, are exact in float32 up to here: 419 km of 0.05 m."""

MOST_CAMERA_PX, MOST_BASELINE_M = 1e6, 1e4
"""Focal lengths and principal points, and baselines, beyond these are mistakes; float32 must hold their products."""
_LEAST = 1e-6


DistortionModel = Literal["opencv", "equidistant"]
"""How a lens bends rays: OpenCV's usual model, or that of a fisheye."""


def _static() -> dict[str, bool]:
    return {"static": True}


def to_device(value: npt.ArrayLike, dtype: DTypeLike | None = None) -> Array:
    """Copies numbers to the device.

    `jnp.asarray` does the same, but compiles a program for each new shape; this compiles nothing. Not to be called
    within a traced function.
    """
    return jax.device_put(np.asarray(value, dtype))


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
        JaxmapError: a number is not finite, or beyond what a camera can have; or the focal length, baseline or size
            is not positive.
    """
    fy_px = fx_px if fy_px is None else fy_px
    numbers = dict(fx_px=fx_px, fy_px=fy_px, cx_px=cx_px, cy_px=cy_px, baseline_m=baseline_m, doffs_px=doffs_px)
    for name, value in numbers.items():
        if not np.isfinite(value):
            raise JaxmapError(f"{name} is {value}", where=where, fix="give a finite number")
        most = MOST_BASELINE_M if name == "baseline_m" else MOST_CAMERA_PX
        if abs(value) > most:
            raise JaxmapError(f"{name} is {value:g}, no camera has more than {most:g}", where=where, fix="correct it")
    for name in ("fx_px", "fy_px", "baseline_m"):
        if numbers[name] < _LEAST:
            raise JaxmapError(
                f"{name} is {numbers[name]:g}, it must be positive",
                where=where,
                fix="check the calibration: the right camera sits at +x of the left one",
            )
    if width_px < 1 or height_px < 1:
        raise JaxmapError(f"image size {width_px}x{height_px}", where=where, fix="give a positive size")
    leaves = {name: to_device(value, np.float32) for name, value in numbers.items()}
    return StereoCamera(**leaves, width_px=int(width_px), height_px=int(height_px))


class Pinhole(NamedTuple):
    """The numbers of a rectified stereo camera in float64, for the host."""

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    baseline_m: float
    doffs_px: float


def pinhole(camera: StereoCamera) -> Pinhole:
    """The numbers of a camera."""
    return Pinhole(*(float(getattr(camera, name)) for name in Pinhole._fields))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Frame:
    """One stereo frame, ready for the compiled step.

    `disparity_px` is NaN where the matcher found nothing; it is None where the step itself matches `image` with
    `right_image`, but for the pixels that are `blind`: those have no disparity, whatever the images show. `image` is
    the rectified left one, grey or RGB; `logits` are what a network has made of it, at its own resolution. One of
    `image`, `labels`, `class_probabilities` and `logits` is present where the labeller asks for it, so that every frame
    of a sequence has the same structure; `pose_errors` are those of the members of an ensemble, where there is one
    (`ensemble.draws.draw_pose_errors`). `show` asks the step for the labels of the pixels (`StepReport.labels`); it is
    None where no frame of a sequence does.
    """

    disparity_px: Float[Array, "H W"] | None
    T_world_camera: jaxlie.SE3
    image: Shaped[Array, "H W *rgb"] | None = None
    labels: UInt8[Array, "H W"] | None = None
    class_probabilities: Float[Array, "H W C"] | None = None
    logits: Float[Array, "h w C"] | None = None
    pose_errors: Float[Array, "M 6"] | None = None
    right_image: Shaped[Array, "H W *rgb"] | None = None
    blind: Bool[Array, "H W"] | None = None
    show: Bool[Array, ""] | None = None

    @property
    def matched_px(self) -> Float[Array, "H W"]:
        """The disparity that the frame brings.

        Raises:
            JaxmapError: it brings none; its images were to be matched within the step.
        """
        if self.disparity_px is None:
            raise JaxmapError("the frame has no disparity", where="Frame", fix="match its images first")
        return self.disparity_px


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class GridSpec:
    """A box of voxels on an endless lattice.

    Voxel `i` of the lattice spans `[lattice_m + i * size, lattice_m + (i + 1) * size)`; the box begins at voxel
    `first`. Where a point lies on the lattice does not depend on the box, to the last bit: a map may be cut into boxes
    in any way.
    """

    lattice_m: Float[Array, "3"]
    voxel_size_m: Float[Array, "3"]
    shape: tuple[int, int, int] = field(metadata=_static())
    first: Int[Array, "3"] = field(default_factory=lambda: np.zeros(3, np.int32))  # pyright: ignore[reportAssignmentType]

    @property
    def origin_m(self) -> Float[Array, "3"]:
        """The lower corner of the box, world."""
        return self.lattice_m + self.first * self.voxel_size_m


def make_grid(
    lower_m: Sequence[float],
    upper_m: Sequence[float],
    voxel_size_m: float | Sequence[float],
    lattice_m: Float[np.ndarray, "3"] | None = None,
) -> GridSpec:
    """The grid that spans from `lower_m`, or a little below it, to at least `upper_m` (world, metres).

    Args:
        lower_m: lower corner.
        upper_m: upper corner.
        voxel_size_m: edge of a voxel, or three edges.
        lattice_m: float64, where a voxel of the lattice begins; without it the lattice begins at `lower_m`.

    Raises:
        JaxmapError: bounds not finite or not ordered, or a voxel size that is not positive.
    """
    lower, upper = np.asarray(lower_m, np.float64), np.asarray(upper_m, np.float64)
    size = np.asarray(voxel_size_m, np.float64)
    if lower.shape != (3,) or upper.shape != (3,):
        raise JaxmapError("a grid takes three lower and three upper bounds", where="grid bounds")
    if size.shape not in ((), (3,)):
        raise JaxmapError(f"voxel size {size.tolist()}", where="grid", fix="give one edge in metres, or three")
    size = np.broadcast_to(size, (3,))
    if not (np.isfinite(lower).all() and np.isfinite(upper).all() and (upper > lower).all()):
        raise JaxmapError(
            f"lower {lower.tolist()} and upper {upper.tolist()} do not span a box",
            where="grid bounds",
            fix="each upper bound must be finite and above the lower one",
        )
    if not (np.isfinite(size).all() and (size > 0).all()):
        raise JaxmapError(f"voxel size {size.tolist()} m", where="grid", fix="give a positive size")
    lattice = lower if lattice_m is None else np.asarray(lattice_m, np.float64)
    # A span of 40 m in voxels of 0.2 m is 200 voxels, not 201, in spite of rounding.
    first = np.floor((lower - lattice) / size + 1e-6)
    counts = (np.ceil((upper - lattice) / size - 1e-6) - first).clip(min=1)
    farthest = max(np.abs(first).max(), np.abs(first + counts).max())
    if farthest > MOST_VOXELS_ALONG:
        raise JaxmapError(
            f"{farthest:.3g} voxels along one axis, at most {MOST_VOXELS_ALONG:,} can be told apart",
            where="grid",
            fix="take larger voxels",
        )
    return GridSpec(
        lattice_m=to_device(lattice, np.float32),
        voxel_size_m=to_device(size, np.float32),
        shape=(int(counts[0]), int(counts[1]), int(counts[2])),
        first=to_device(first, np.int32),
    )


LAYER = 16
"""Voxels of the lattice, in height, whose points share the statistics of a column: those of a tile."""


def layer_count(height: int) -> int:
    """How many layers so many voxels of height touch at most, wherever on the lattice they begin."""
    return (height + LAYER - 2) // LAYER + 1


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class VoxelMap:
    """Evidence gathered so far, as sums of log-odds increments.

    Channel 0 is occupancy, channel `1 + c` is class `c`. A voxel that nothing has touched holds
    exact zeros; priors are added when the map is read (`fusion.query`), so that maps can be summed.
    `members` are those of an ensemble (`ensemble.members`), two channels each, where there is one; `surface` are the
    heights of each column, in layers of `LAYER` voxels of the lattice (`fusion.surface`), where they are kept.
    """

    log_odds: Float[Array, "K X Y Z"]
    frames_fused: Int[Array, ""]
    grid: GridSpec
    classes: tuple[str, ...] = field(metadata=_static())
    members: Float[Array, "M 2 X Y Z"] | None = None
    surface: Float[Array, "4 X Y L"] | None = None


def make_voxel_map(grid: GridSpec, classes: Sequence[str], members: int = 0, *, surface: bool = False) -> VoxelMap:
    """An empty map, with as many members of an ensemble, and statistics of heights where asked for.

    Raises:
        JaxmapError: the tensor would have more elements than a 32-bit index can reach.
    """
    shape = (1 + len(classes), *grid.shape)
    if math.prod(shape) > MAX_TENSOR_ELEMENTS:
        raise JaxmapError(
            f"a map of {shape[0]} channels x {' x '.join(map(str, grid.shape))} voxels passes 2^31 numbers",
            where="grid",
            fix="take larger voxels or a smaller box",
        )
    return VoxelMap(
        log_odds=jnp.zeros(shape, jnp.float32),
        frames_fused=to_device(0, np.int32),
        grid=grid,
        classes=tuple(classes),
        members=jnp.zeros((members, 2, *grid.shape), jnp.float32) if members else None,
        surface=jnp.zeros((4, *grid.shape[:2], layer_count(grid.shape[2])), jnp.float32) if surface else None,
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
    """The labels of the points of a frame.

    Exactly one of `labels` (`IGNORE` where unknown) and `probabilities` is given. Points whose
    `keep` is false are not fused at all; ignored points still say that something is there.
    """

    keep: Bool[Array, "N"]
    labels: Int[Array, "N"] | None = None
    probabilities: Float[Array, "N C"] | None = None

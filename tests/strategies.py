"""Hypothesis strategies and small factories shared by the law tests.

Array shapes are fixed, so that a jitted kernel is compiled once whatever is drawn.
"""

from __future__ import annotations

import jax.numpy as jnp
import jaxlie
import numpy as np
from hypothesis import strategies as st

from jaxmap.ensemble.options import EnsembleOptions
from jaxmap.geometry.cloud import PointCloud
from jaxmap.labels import IGNORE, ROVER_CLASSES
from jaxmap.types import GridSpec, PointLabels, StereoCamera, VoxelMap, make_stereo_camera, make_voxel_map

HEIGHT_PX, WIDTH_PX = 24, 32
GRID_SHAPE = (8, 7, 5)
POINTS = 64
CLASSES = ROVER_CLASSES
VOXEL_SIZES_M = st.sampled_from([0.25, 0.5, 1.0])
"""Powers of two: positions on such grids are exact in float32."""

NO_SPREAD = EnsembleOptions(
    members=3,
    position_sigma_m=0.0,
    heading_sigma_rad=0.0,
    tilt_sigma_rad=0.0,
    disparity_sigma_px=0.0,
    increment_sigma=0.0,
    temperature_sigma=0.0,
    label_bias_sigma=0.0,
)
"""Members that doubt nothing."""

BAD_NUMBERS = (np.nan, np.inf, -np.inf, 1e30, -1e30, 3e9, -3e9)


def rngs() -> st.SearchStrategy[np.random.Generator]:
    """Generators of the arrays of an example: one number to shrink instead of thousands."""
    return st.integers(0, 2**31).map(np.random.default_rng)


@st.composite
def cameras(draw: st.DrawFn, doffs: bool = True) -> StereoCamera:
    return make_stereo_camera(
        fx_px=draw(st.floats(15, 60)),
        fy_px=draw(st.floats(15, 60)),
        cx_px=draw(st.floats(5, 25)),
        cy_px=draw(st.floats(5, 20)),
        baseline_m=draw(st.floats(0.05, 0.5)),
        doffs_px=draw(st.integers(-32, 80)) / 16 if doffs else 0.0,
        width_px=WIDTH_PX,
        height_px=HEIGHT_PX,
    )


@st.composite
def poses(draw: st.DrawFn, reach_m: float = 3.0) -> jaxlie.SE3:
    # To micrometres and microradians: below, float32 has subnormal numbers, which XLA takes for zero.
    angles = [round(draw(st.floats(-3.1, 3.1)), 6) for _ in range(3)]
    position = [round(draw(st.floats(-reach_m, reach_m)), 6) for _ in range(3)]
    return jaxlie.SE3.from_rotation_and_translation(
        jaxlie.SO3.from_rpy_radians(*angles), jnp.asarray(position, jnp.float32)
    )


@st.composite
def grids(draw: st.DrawFn) -> GridSpec:
    """Grids on which voxel faces are exact; voxels may be flat or tall."""
    size = [draw(VOXEL_SIZES_M) for _ in range(3)]
    origin = [draw(st.integers(-20, 20)) * s for s in size]
    return GridSpec(jnp.asarray(origin, jnp.float32), jnp.asarray(size, jnp.float32), GRID_SHAPE)


def points_in(grid: GridSpec, rng: np.random.Generator, *, spill: int = 2) -> np.ndarray:
    """Points in and around a grid, clear of voxel faces and exact in float32."""
    shape = np.array(GRID_SHAPE)
    index = rng.integers(-spill, shape + spill, (POINTS, 3))
    within = rng.integers(1, 16, (POINTS, 3)) / 16
    return (np.asarray(grid.origin_m) + (index + within) * np.asarray(grid.voxel_size_m)).astype(np.float32)


def hard_labels(rng: np.random.Generator, classes: int = len(CLASSES)) -> PointLabels:
    """Random labels, some ignored, most points kept."""
    labels = rng.choice(np.array([*range(classes), IGNORE]), POINTS)
    return PointLabels(keep=jnp.asarray(rng.random(POINTS) < 0.9), labels=jnp.asarray(labels, jnp.int32))


def soft_labels(rng: np.random.Generator, classes: int = len(CLASSES)) -> PointLabels:
    """Random class probabilities, most points kept."""
    shares = rng.dirichlet(np.ones(classes + 1), POINTS)[:, :classes]
    return PointLabels(keep=jnp.asarray(rng.random(POINTS) < 0.9), probabilities=jnp.asarray(shares, jnp.float32))


def integer_weights(rng: np.random.Generator) -> np.ndarray:
    """Weights whose sums are exact in float32, in whatever order."""
    return rng.integers(1, 5, POINTS).astype(np.float32)


def random_map(grid: GridSpec, rng: np.random.Generator, classes: tuple[str, ...] = CLASSES) -> VoxelMap:
    """A map with a third of its voxels untouched."""
    empty = make_voxel_map(grid, classes)
    touched = rng.random(grid.shape) < 0.66
    log_odds = np.where(touched, rng.normal(0, 1.5, empty.log_odds.shape), 0.0)
    return VoxelMap(jnp.asarray(log_odds, jnp.float32), jnp.asarray(3, jnp.int32), grid, classes)


def disparities(rng: np.random.Generator, low_px: float = 1.0, high_px: float = 12.0) -> np.ndarray:
    """A disparity image with holes: NaN, zero, negative and infinite."""
    disparity = rng.uniform(low_px, high_px, (HEIGHT_PX, WIDTH_PX)).astype(np.float32)
    hole = rng.random(disparity.shape)
    for limit, value in ((0.1, np.nan), (0.04, 0.0), (0.03, -3.0), (0.02, np.inf), (0.01, -np.inf)):
        disparity[hole < limit] = value
    return disparity


def cloud_of(points, valid) -> PointCloud:
    """A point cloud of points that are given, one for each pixel, all at a depth of 1 m."""
    flat = jnp.asarray(valid).reshape(HEIGHT_PX, WIDTH_PX)
    ones = jnp.ones((HEIGHT_PX, WIDTH_PX))
    return PointCloud(jnp.asarray(points), ones, ones, flat, flat)

"""Ties to the ground, and the consistency of a map."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refinement.synthetic import match_term, matches_of, track
from scipy.spatial.transform import Rotation

from jaxmap.refinement.consistency import between_frames, consistency_of
from jaxmap.refinement.ground import (
    GroundRaster,
    ground_contact,
    placement_term,
    register_labels,
    rock_relief,
    sample_raster,
)
from jaxmap.refinement.rig import make_rig
from jaxmap.refinement.solver import Prior, solve
from jaxmap.types import make_grid

ROCKS_M = np.array([[1.0, 1.0, 0.4], [2.6, -0.4, 0.3], [3.9, 1.7, 0.35], [0.8, -1.4, 0.3], [4.4, -1.3, 0.4]])
"""x, y and radius."""


def on_rock(x, y):
    return (np.hypot(x[..., None] - ROCKS_M[:, 0], y[..., None] - ROCKS_M[:, 1]) < ROCKS_M[:, 2]).any(axis=-1)


def relief_points(rng: np.random.Generator) -> np.ndarray:
    """Sloping ground with flat-topped rocks on it."""
    x, y = rng.uniform(-0.5, 5.5, 40_000), rng.uniform(-2.5, 2.5, 40_000)
    return np.stack([x, y, 0.1 * x + np.where(on_rock(x, y), 0.25, 0.0)], axis=-1)


def labels(shift_m=(0.0, 0.0), cell_m: float = 0.05) -> GroundRaster:
    lower = np.array([-2.0, -4.0])
    x, y = np.meshgrid(*(lower[axis] + (np.arange(180) + 0.5) * cell_m for axis in (0, 1)), indexing="ij")
    return GroundRaster(on_rock(x - shift_m[0], y - shift_m[1]).astype(float), lower, cell_m)


@pytest.mark.slow
def test_labels_are_found_where_the_relief_is():
    relief = rock_relief(relief_points(np.random.default_rng(0)))
    placed = register_labels(relief, labels((0.15, -0.1)), (2.5, 0.0))
    assert placed is not None
    alignment, sigma = placed
    # The labels must be moved back.
    np.testing.assert_allclose(alignment.shift_m, [-0.15, 0.1], atol=0.04)
    assert abs(np.degrees(alignment.heading_rad)) < 0.7
    assert (sigma[:2] >= 0.08).all()


def test_where_no_rock_is_in_view_nothing_is_said():
    relief = rock_relief(relief_points(np.random.default_rng(0)))
    bare = labels()
    assert register_labels(relief, bare._replace(values=np.zeros_like(bare.values)), (2.5, 0.0)) is None
    assert register_labels(relief, bare._replace(values=np.full_like(bare.values, np.nan)), (2.5, 0.0)) is None


def test_a_placed_map_moves_as_a_whole():
    from jaxmap.evaluation.truth_cells import Alignment

    rng, T = np.random.default_rng(1), track()
    given = make_rig(T)
    alignment = Alignment((0.1, -0.2), np.radians(0.8), (1.0, 0.5))
    matches = match_term(matches_of(T, rng))
    term = placement_term(given, alignment, np.array([0.001, 0.001, np.radians(0.01)]))
    found = solve(given, given, [matches, term], Prior(0.2, np.radians(1))).rig.T_world_camera
    x, y = alignment.undone(T[:, 0, 3], T[:, 1, 3])
    np.testing.assert_allclose(found[:, :2, 3], np.stack([x, y], axis=-1), atol=5e-3)
    turn = Rotation.from_matrix(found[:, :3, :3] @ T[:, :3, :3].transpose(0, 2, 1)).as_rotvec(degrees=True)
    np.testing.assert_allclose(turn, np.tile([0, 0, -0.8], (len(T), 1)), atol=0.05)


def test_ground_is_known_only_around_the_cameras():
    contact = ground_contact(np.array([[0.0, 0.0, 5.0], [3.0, 0.0, 6.0]]), 1.1)
    found = sample_raster(contact, np.array([0.1, 2.9, 1.5]), np.array([0.1, -0.1, 0.0]))
    np.testing.assert_allclose(found[:2], [3.9, 4.9])
    assert np.isnan(found[2])


def frames_of(rng: np.random.Generator, offsets_m, per_frame: int = 4000):
    """Frames of one rolling surface, each lifted by an offset."""
    xy = rng.uniform(0, 3, (len(offsets_m), per_frame, 2))
    z = 0.1 * np.sin(xy[..., 0]) + np.array(offsets_m)[:, None]
    return np.concatenate([xy, z[..., None]], axis=-1)


def test_the_spread_between_frames_is_that_of_their_offsets():
    points = frames_of(np.random.default_rng(2), (0.0, 0.1, 0.2))
    frames = np.repeat(np.arange(3), points.shape[1])
    brightness = np.repeat([100.0, 110.0, 120.0], points.shape[1])
    found = consistency_of(points.reshape(-1, 3) + np.array([0, 0, 40.0]), brightness, frames)
    assert found.height_m == pytest.approx(0.1, rel=0.02)
    assert found.brightness == pytest.approx(10.0, rel=1e-3)
    alike = consistency_of(points.reshape(-1, 3) - np.repeat([0, 0.1, 0.2], points.shape[1])[:, None] * [0, 0, 1],
                           brightness, frames)  # fmt: skip
    assert alike.height_m < 0.01


@pytest.mark.slow
def test_the_gradient_of_the_spread_brings_frames_together():
    points = jnp.asarray(frames_of(np.random.default_rng(3), (0.0, 0.1), per_frame=2000), jnp.float32)
    grid = make_grid([0, 0, -1], [3, 3, 1], [0.25, 0.25, 2.0])

    @jax.jit
    @jax.value_and_grad
    def spread(lift):
        lifted = points.at[..., 2].add(lift[:, None])
        variance, count = between_frames(grid, lifted, lifted[None, ..., 2])
        return variance.sum() / (count > 1).sum()

    _, slope = spread(jnp.zeros(2))
    assert slope[0] < 0 < slope[1]
    ahead, behind = (spread(jnp.array([step, 0.0]))[0] for step in (1e-2, -1e-2))
    assert float(slope[0]) == pytest.approx(float(ahead - behind) / 2e-2, rel=0.02)

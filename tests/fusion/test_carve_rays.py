"""Projective carving against ray casting by a twin in NumPy."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
import reference
import scenes
from hypothesis import given
from hypothesis import strategies as st
from reference_rays import cast_rays, walk
from strategies import HEIGHT_PX, WIDTH_PX, cameras, rngs
from test_carve import SHARP, see_through, views

from jaxmap.fusion.params import FusionRule, make_fusion_params
from jaxmap.geometry.camera import disparity_to_points, transform_points
from jaxmap.labellers.base import make_no_labeller
from jaxmap.mapping.step import Mapper, MapperParams, make_mapper
from jaxmap.types import Frame, GridSpec, make_grid, make_stereo_camera

DEPTH_RANGE_M = (0.3, 5.0)
FRAMES = 5
NOISE_PX = 0.1
KEY = jax.random.key(0)


@given(cameras(doffs=False), views())
def test_every_freed_voxel_lies_on_the_ray_of_its_pixel_and_before_its_end(camera, view):
    grid, pose, depth_m, valid = view
    free = np.asarray(see_through(camera, pose, depth_m, valid, grid, SHARP))
    disparity_px = np.where(valid, float(camera.baseline_m) * float(camera.fx_px) / depth_m, np.nan)
    points_camera, known = reference.disparity_to_points(camera, disparity_px)
    rays_at = np.flatnonzero(known)
    points = reference.transform_points(pose, points_camera.reshape(-1, 3)[rays_at])
    centres = reference.transform_points(pose.inverse(), reference.voxel_centres(grid))
    u_px, v_px, _, _ = reference.points_to_pixels(camera, centres)
    pixel = np.rint(v_px).clip(0, HEIGHT_PX - 1) * WIDTH_PX + np.rint(u_px).clip(0, WIDTH_PX - 1)
    crossed = np.zeros(grid.shape, bool)
    for rays, index in walk(grid, pose.translation(), points):
        inside = ((index >= 0) & (index < np.array(grid.shape))).all(axis=1)
        rays, index = rays[inside], index[inside]
        own = pixel[tuple(index.T)] == rays_at[rays]
        crossed[tuple(index[own].T)] = True
    # Where a voxel is wider than a pixel there: its pixel's ray passes its centre by half a pixel at most.
    off_m = centres[..., 2] * np.hypot(0.501 / float(camera.fx_px), 0.501 / float(camera.fy_px))
    wide = off_m < 0.499 * reference.f64(grid.voxel_size_m).min()
    assert crossed[free & wide].all()


@given(rngs(), st.sampled_from([0.25, 0.5]))
def test_rays_of_the_twin_go_where_fine_steps_along_them_go(rng, size_m):
    grid = GridSpec(jnp.asarray([-2.0, -2.0, -2.0]), jnp.full(3, size_m), (12, 12, 12))
    origin, points = rng.uniform(-1, 1, 3), rng.uniform(-2.5, 2.5, (20, 3))
    cast = cast_rays(grid, origin, points)
    sampled, hit = np.zeros(grid.shape, bool), np.zeros(grid.shape, bool)
    for share in np.linspace(0, 1, 2001):
        index, inside = reference.world_to_voxel(grid, origin + share * (points - origin))
        sampled[tuple(index[inside].T)] = True
    index, inside = reference.world_to_voxel(grid, points)
    hit[tuple(index[inside].T)] = True
    np.testing.assert_array_equal(cast.hit, hit)
    # Steps may miss a corner that a ray cuts, but find nothing that it does not.
    assert not (sampled & ~(cast.free | cast.hit)).any()
    assert (cast.free & ~sampled).sum() <= 0.05 * sampled.sum() + 2


class Setting:
    """The scene at voxels of 0.1 m, its ground in the middle of a layer of them; disparities true but for noise."""

    ground_m = 0.05

    def __init__(self) -> None:
        image = {name: value for name, value in scenes.CAMERA.items() if name != "image_size_px"}
        camera = make_stereo_camera(**image, width_px=scenes.WIDTH_PX, height_px=scenes.HEIGHT_PX)
        self.grid = make_grid([-2, 0, -0.5], [2, 6, 1], 0.1)
        rule = FusionRule(per_frame="once", range_weighting=False)
        labeller = make_no_labeller()
        self.mapper: Mapper = make_mapper(camera, self.grid, labeller, rule, DEPTH_RANGE_M)
        self.params = MapperParams(camera, make_fusion_params((), disparity_sigma_px=NOISE_PX), labeller.params)

    def frames(self) -> list[Frame]:
        """Some views of the scene."""
        rng = np.random.default_rng(7)
        return [self._frame(scenes.scene_frame(index), rng) for index in range(FRAMES)]

    def _frame(self, view: scenes.SceneFrame, rng: np.random.Generator) -> Frame:
        disparity_px = np.where(np.isfinite(view.depth_m), view.disparity_px, np.nan)
        disparity_px = disparity_px + rng.normal(0, NOISE_PX, disparity_px.shape)
        T = view.T_world_camera.copy()
        T[2, 3] += self.ground_m
        return Frame(jnp.asarray(disparity_px, jnp.float32), jaxlie.SE3.from_matrix(jnp.asarray(T, jnp.float32)))

    def solid(self) -> np.ndarray:
        """Voxels that the ground or a box reaches into, for certain."""
        centres = reference.voxel_centres(self.grid)
        reaches = centres[..., 2] < self.ground_m + 0.049
        for lower, upper in scenes.BOXES_M + np.array([0, 0, self.ground_m]):
            reaches |= ((centres > lower - 0.049) & (centres < upper + 0.049)).all(axis=-1)
        return reaches


@pytest.fixture(scope="module")
def mapped() -> tuple[np.ndarray, np.ndarray, Setting]:
    """Evidence of occupancy of every voxel of the scene: by the compiled step, and by rays of the twin."""
    setting = Setting()
    camera, fusion = setting.params.camera, setting.params.fusion
    voxel_map, by_rays = setting.mapper.init(), np.zeros(setting.grid.shape)
    for frame in setting.frames():
        # Both get one cloud: carving would also see through what lies before points beyond the mapped depths.
        points, valid = disparity_to_points(camera, frame.disparity_px)
        kept = valid & (points[..., 2] >= DEPTH_RANGE_M[0]) & (points[..., 2] <= DEPTH_RANGE_M[1])
        near = replace(frame, disparity_px=jnp.where(kept, frame.disparity_px, jnp.nan))
        voxel_map, _ = setting.mapper.step(voxel_map, near, setting.params, KEY)
        cloud = np.asarray(transform_points(frame.T_world_camera, points), np.float64)[np.asarray(kept)]
        cast = cast_rays(setting.grid, np.asarray(frame.T_world_camera.translation(), np.float64), cloud)
        by_rays += cast.hit * float(fusion.occupancy_hit) + cast.free * float(fusion.occupancy_miss)
    return np.asarray(voxel_map.log_odds[0]), by_rays, setting


def test_carving_and_casting_rays_agree_on_what_both_observed(mapped):
    ours, by_rays, _ = mapped
    both = (ours != 0) & (by_rays != 0)
    assert (both & (ours < 0)).sum() > 3000 and (both & (ours > 0)).sum() > 1000
    assert (np.sign(ours[both]) == np.sign(by_rays[both])).mean() >= 0.97
    # What is seen through was crossed: carving frees nothing that rays do not.
    assert not ((ours < 0) & (by_rays >= 0)).any()


def test_what_is_carved_is_truly_free_more_often_than_what_rays_cross(mapped):
    ours, by_rays, setting = mapped
    wrong_ours, wrong_rays = (setting.solid()[evidence < 0].mean() for evidence in (ours, by_rays))
    assert wrong_ours < 0.005
    assert wrong_ours < wrong_rays

"""Projective carving against ray casting: by a twin in NumPy, and by OctoMap where it is installed."""

from __future__ import annotations

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
import reference
import scenes
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from reference_rays import cast_rays, walk
from strategies import HEIGHT_PX, WIDTH_PX, cameras, rngs
from test_carve import SHARP, see_through, views
from truth_files import CRS, SITE, write_raster

from jaxmap.fusion.options import FusionRule
from jaxmap.fusion.params import make_fusion_params
from jaxmap.labellers.base import make_no_labeller
from jaxmap.mapping.step import Mapper, MapperParams, make_mapper
from jaxmap.types import Frame, GridSpec, make_grid, make_stereo_camera

sys.path.append(str(Path(__file__).resolve().parents[2] / "scripts"))

from agreement.causes import CAUSES, agreement_of, explain
from agreement.heights import ABOVE, BELOW, NO_TRUTH, SURFACE, true_voxels
from agreement.maps import (
    FREE,
    OCCUPIED,
    UNKNOWN,
    Seen,
    TwoMaps,
    cloud_of,
    in_range_only,
    insert,
    make_octree,
    map_both,
    map_classes,
    octree_classes,
)
from agreement.picture import draw_agreement, from_above, kinds_of_voxels

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
def mapped() -> tuple[TwoMaps, Setting]:
    """The scene by the compiled step, and by rays of the twin."""
    setting = Setting()
    ours, seen = setting.mapper.init(), []
    evidence = np.zeros(setting.grid.shape)
    fusion = setting.params.fusion
    for frame in setting.frames():
        near = in_range_only(frame, setting.params.camera, DEPTH_RANGE_M)
        ours, _ = setting.mapper.step(ours, near, setting.params, KEY)
        alone, _ = setting.mapper.step(setting.mapper.init(), near, setting.params, KEY)
        cloud = cloud_of(near, setting.params.camera)
        cast = cast_rays(setting.grid, cloud.origin_world, cloud.points_world)
        evidence += cast.hit * float(fusion.occupancy_hit) + cast.free * float(fusion.occupancy_miss)
        theirs = cast.hit.astype(np.int8) - cast.free
        seen.append(Seen(frame, np.sign(np.asarray(alone.log_odds[0])).astype(np.int8), theirs))
    classes = np.where(evidence > 0, OCCUPIED, np.where(evidence < 0, FREE, UNKNOWN)).astype(np.int8)
    return TwoMaps(map_classes(ours, fusion), classes, seen), setting


def test_carving_and_casting_rays_agree_on_what_both_observed(mapped):
    maps, _ = mapped
    agreement = agreement_of(maps)
    assert agreement.confusion[1, 1] > 3000 and agreement.confusion[2, 2] > 1000
    assert agreement.both >= 0.97
    # What is seen through was crossed: carving frees nothing that rays do not.
    assert not ((maps.ours == FREE) & (maps.theirs != FREE)).any()


def test_what_is_carved_is_truly_free_more_often_than_what_rays_cross(mapped):
    maps, setting = mapped
    wrong_ours, wrong_rays = (setting.solid()[classes == FREE].mean() for classes in (maps.ours, maps.theirs))
    assert wrong_ours < 0.005
    assert wrong_ours < wrong_rays


def test_every_difference_has_one_cause(mapped):
    maps, setting = mapped
    camera, fusion = setting.params.camera, setting.params.fusion
    found = explain(maps, camera, setting.grid, fusion, DEPTH_RANGE_M)
    conflicts, alone = found.counts(both=True), found.counts(both=False)
    assert sum(conflicts.values()) + sum(alone.values()) == (maps.ours != maps.theirs).sum()
    assert set(conflicts) == set(CAUSES)
    # Rays are dense here, and only a point on a voxel's face may fall to either side.
    assert conflicts["no_ray"] == alone["no_ray"] == 0
    assert conflicts["rounding"] + alone["rounding"] <= 0.001 * (maps.theirs != 0).sum()
    assert alone["behind"] > 0 and alone["noise"] > 0


def test_the_picture_shows_each_class_and_each_cause_that_occurs(mapped, tmp_path):
    maps, setting = mapped
    found = explain(maps, setting.params.camera, setting.grid, setting.params.fusion, DEPTH_RANGE_M)
    kinds = kinds_of_voxels(maps, found)
    assert ((kinds == 0) == ((maps.ours == UNKNOWN) & (maps.theirs == UNKNOWN))).all()
    assert (
        (kinds == 3).sum()
        == found.both.sum()
        == agreement_of(maps).confusion[1:, 1:].sum() - (((kinds == 1) | (kinds == 2)).sum())
    )
    colours = from_above(kinds)
    conflict = (kinds == 3).any(axis=2)
    assert conflict.any() and len(np.unique(colours[conflict], axis=0)) == 1
    assert not (colours[~conflict] == colours[conflict][0]).all(axis=-1).any()
    draw_agreement(maps, found, setting.grid, "scene", tmp_path / "scene.png")
    picture = np.asarray(Image.open(tmp_path / "scene.png").convert("RGB"))
    assert picture.shape[0] > 900 and (picture == colours[conflict][0]).all(axis=-1).any()


def test_voxels_are_told_apart_by_the_lowest_and_the_highest_ground_in_them(tmp_path):
    # A step from 46.05 to 46.65 m in the middle of the second column from the west; the north-east is not known.
    heights = np.full((4, 8), 46.05, np.float32)
    heights[:, 3:] = 46.65
    heights[:2, 6:] = np.nan
    path = write_raster(tmp_path / "dem.tif", heights, SITE[0], SITE[1] + 0.4, 0.1)
    grid = make_grid([0, 0, 0.8], [0.8, 0.4, 2.0], 0.2)
    truth = true_voxels(path, grid, SITE, CRS)
    assert truth.shape == (4, 2, 6)
    low = [BELOW, SURFACE, ABOVE, ABOVE, ABOVE, ABOVE]
    step = [BELOW, SURFACE, SURFACE, SURFACE, SURFACE, ABOVE]
    high = [BELOW, BELOW, BELOW, BELOW, SURFACE, ABOVE]
    for y in (0, 1):
        np.testing.assert_array_equal(truth[:3, y], [low, step, high])
    np.testing.assert_array_equal(truth[3], [high, [NO_TRUTH] * 6])


def test_octomap_is_the_twin_and_agrees(mapped):
    pytest.importorskip("octomap", reason="octomap-python is not installed (extra bench)")
    twin, setting = mapped
    maps = map_both(setting.frames(), setting.mapper, setting.params, setting.grid, DEPTH_RANGE_M)
    np.testing.assert_array_equal(maps.ours, twin.ours)
    # But for rays along a face and points on one.
    assert (maps.theirs == twin.theirs).mean() > 0.999
    assert agreement_of(maps).both >= 0.97


def test_classes_of_an_octree_are_those_that_it_tells_of_each_voxel():
    pytest.importorskip("octomap", reason="octomap-python is not installed (extra bench)")
    setting = Setting()
    tree = make_octree(setting.grid, setting.params.fusion)
    frame = in_range_only(setting.frames()[0], setting.params.camera, DEPTH_RANGE_M)
    insert(tree, cloud_of(frame, setting.params.camera))
    told = tree.getLabels(reference.voxel_centres(setting.grid).reshape(-1, 3)).reshape(setting.grid.shape)
    of_octomap = {-1: UNKNOWN, 0: FREE, 1: OCCUPIED}
    assert set(np.unique(told)) == set(of_octomap)
    for number, name in of_octomap.items():
        np.testing.assert_array_equal(octree_classes(tree, setting.grid) == name, told == number)

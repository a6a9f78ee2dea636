from __future__ import annotations

from dataclasses import FrozenInstanceError, fields

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import CLASSES, cameras, grids

from jaxmap import types
from jaxmap.errors import JaxmapError
from jaxmap.fusion.params import logit, make_fusion_params

CAMERA = dict(fx_px=100.0, cx_px=10.0, cy_px=10.0, baseline_m=0.2, width_px=20, height_px=20)
NAN, INF = float("nan"), float("inf")


def assert_refused(make, *arguments, says: str, **options) -> None:
    """The factory refuses, in one line that names the fault."""
    with pytest.raises(JaxmapError, match=says) as caught:
        make(*arguments, **options)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        (dict(fx_px=NAN), "fx_px is nan in here; give a finite number"),
        (dict(cx_px=INF), "cx_px is inf"),
        (dict(doffs_px=NAN), "doffs_px is nan"),
        (dict(fx_px=0.0), "fx_px is 0, it must be positive"),
        (dict(fy_px=-3.0), "fy_px is -3, it must be positive"),
        (dict(baseline_m=-0.2), "baseline_m is -0.2.*right camera sits at"),
        (dict(width_px=0), "image size 0x20 in here; give a positive size"),
    ],
)
def test_a_wrong_camera_is_refused(wrong, says):
    assert_refused(types.make_stereo_camera, **{**CAMERA, **wrong}, where="here", says=says)


@pytest.mark.parametrize(
    ("lower", "upper", "size", "says"),
    [
        ([0, 0], [1, 1, 1], 0.1, "three lower and three upper bounds"),
        ([0, 0, 0], [1, 0, 1], 0.1, "do not span a box in grid bounds; each upper bound must be"),
        ([0, 0, 0], [1, 1, INF], 0.1, "do not span a box"),
        ([NAN, 0, 0], [1, 1, 1], 0.1, "do not span a box"),
        ([0, 0, 0], [1, 1, 1], 0.0, "voxel size .* give a positive size"),
        ([0, 0, 0], [1, 1, 1], [0.1, NAN, 0.1], "voxel size .* give a positive size"),
        ([0, 0, 0], [1, 1, 1], [0.1, 0.1], "voxel size"),
        ([0, 0, 0], [1e10, 1, 1], 1e-12, "voxel"),
    ],
)
def test_a_wrong_grid_is_refused(lower, upper, size, says):
    assert_refused(types.make_grid, lower, upper, size, says=says)


def test_a_map_too_large_for_its_indices_is_refused():
    grid = types.make_grid([0, 0, 0], [2000, 2000, 200], 0.5)
    assert_refused(
        types.make_voxel_map, grid, CLASSES, says=r"4 channels x 4000 x 4000 x 400 .*larger voxels or a smaller box"
    )


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        (dict(occupancy_prior=0.0), "fusion.occupancy_prior is 0.0: input should be greater than 0"),
        (dict(occupancy_threshold=1.0), "occupancy_threshold is 1.0"),
        (dict(class_threshold=NAN), "class_threshold is nan"),
        (dict(occupancy_hit=-0.1), "occupancy_hit is -0.1: input should be greater than or equal to 0"),
        (dict(occupancy_miss=0.1), "occupancy_miss is 0.1: input should be less than or equal to 0"),
        (dict(disparity_sigma_px=0.0), "disparity_sigma_px is 0.0: input should be greater than 0"),
        (dict(full_evidence_points=-1.0), "full_evidence_points is -1.0: input should be greater than 0"),
        (dict(class_increments=np.zeros((2, 3))), "class_increments is not a finite 3x3 matrix"),
        (dict(class_increments=[[1.0, 2.0], [3.0, 4.0]]), "class_increments is not a finite 3x3 matrix"),
        (dict(class_increments=np.full((3, 3), NAN)), "class_increments.0.0 is nan.*and 3 more"),
        (dict(class_hit=INF), "class_increments is not a finite 3x3 matrix|class_hit is inf"),
        (dict(class_prior=[0.5, 1.0, 0.5]), "class_prior.1 is 1.0: input should be less than 1"),
        (dict(class_prior=[0.5, 0.5]), "class_prior"),
        (dict(occupancy_hit=NAN), "occupancy_hit"),
        (dict(occupancy_hit=INF), "occupancy_hit"),
        (dict(occupancy_miss=NAN), "occupancy_miss"),
        (dict(disparity_sigma_px=NAN), "disparity_sigma_px"),
        (dict(full_evidence_points=NAN), "full_evidence_points"),
    ],
)
def test_wrong_fusion_parameters_are_refused(wrong, says):
    assert_refused(make_fusion_params, CLASSES, **wrong, says=says)


def test_increments_are_hit_on_the_diagonal_and_miss_beside_it():
    params = make_fusion_params(CLASSES, class_hit=1.5, class_miss=-0.5)
    np.testing.assert_array_equal(params.class_increments, np.full((3, 3), -0.5) + 2 * np.eye(3))
    named = make_fusion_params(CLASSES, class_increments=np.arange(9.0).reshape(3, 3))
    np.testing.assert_array_equal(named.class_increments, np.arange(9).reshape(3, 3))


@given(st.floats(0.01, 0.99))
def test_priors_become_log_odds(probability):
    params = make_fusion_params(CLASSES, occupancy_prior=probability, class_prior=probability)
    np.testing.assert_allclose(jax.nn.sigmoid(params.occupancy_prior), probability, rtol=1e-4)
    np.testing.assert_allclose(jax.nn.sigmoid(params.class_prior), np.full(3, probability), rtol=1e-4)
    np.testing.assert_allclose(1 / (1 + np.exp(-logit(probability))), probability)


@pytest.mark.parametrize("classes", [(), CLASSES, tuple(f"class {n}" for n in range(21))], ids=len)
def test_maps_and_parameters_fit_any_number_of_classes(classes):
    voxel_map = types.make_voxel_map(types.make_grid([0, 0, 0], [1, 2, 3], 0.5), list(classes))
    params = make_fusion_params(classes)
    assert voxel_map.log_odds.shape == (1 + len(classes), 2, 4, 6)
    assert not np.asarray(voxel_map.log_odds).any()
    assert voxel_map.classes == classes
    assert params.class_increments.shape == (len(classes), len(classes))
    assert params.class_prior.shape == (len(classes),)


@given(cameras(), grids())
def test_values_survive_flattening_and_hold_float32_leaves(camera, grid):
    for value in (camera, grid, types.make_voxel_map(grid, CLASSES), make_fusion_params(CLASSES)):
        leaves, structure = jax.tree.flatten(value)
        assert all(leaf.dtype in (jnp.float32, jnp.int32) for leaf in leaves)
        rebuilt = jax.tree.unflatten(structure, leaves)
        assert all(getattr(rebuilt, one.name) is getattr(value, one.name) for one in fields(camera) if value is camera)
        assert jax.tree.structure(rebuilt) == structure


def test_values_are_frozen():
    camera = types.make_stereo_camera(**CAMERA)
    with pytest.raises(FrozenInstanceError):
        camera.fx_px = jnp.zeros(())


def test_one_focal_length_serves_both_axes():
    camera = types.make_stereo_camera(**CAMERA)
    assert camera.fx_px == camera.fy_px == 100
    assert camera.doffs_px == 0


def test_voxels_may_be_flat_or_tall():
    grid = types.make_grid([0, 0, 0], [1, 1, 1], [0.5, 0.25, 0.1])
    assert grid.shape == (2, 4, 10)

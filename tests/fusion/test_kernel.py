from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import CLASSES, poses, rngs

from jaxmap.fusion.frame import Sighting, add_plainly
from jaxmap.fusion.kernel import add_sighting
from jaxmap.fusion.options import FusionRule
from jaxmap.fusion.params import make_fusion_params
from jaxmap.geometry.cloud import project
from jaxmap.labels import IGNORE
from jaxmap.native.build import FUSE_TARGET, has_kernel
from jaxmap.types import PointLabels, VoxelMap, make_grid, make_stereo_camera, make_voxel_map

HEIGHT_PX, WIDTH_PX = 28, 300
"""Several of the kernel's tiles beside and above each other, the last ones cut off."""
CAMERA = make_stereo_camera(
    fx_px=160, cx_px=149.2, cy_px=13.7, baseline_m=0.075, width_px=WIDTH_PX, height_px=HEIGHT_PX
)
DEPTHS_M = (0.3, 5.0)
GRID = make_grid([-4.1, -4.1, -2.9], [4.3, 4.2, 3.1], (0.15, 0.2, 0.3))
RULES = [
    *(FusionRule("sum", carve=False), FusionRule("once"), FusionRule("majority"), FusionRule("mean", carve=False)),
]
MEAN = FusionRule()

plainly = jax.jit(add_plainly, static_argnums=(4, 5))
by_kernel = jax.jit(add_sighting, static_argnums=(4, 5))
needs_kernel = pytest.mark.skipif(not has_kernel(FUSE_TARGET), reason="there is no compiler, or no CPU")


def sighting_of(pose: jaxlie.SE3, rng: np.random.Generator, *, soft: bool, classes: int = 3) -> Sighting:
    """Smooth ground and steps in it, with holes, seen from a pose."""
    row, column = np.mgrid[:HEIGHT_PX, :WIDTH_PX]
    depth_m = 1.0 + 3.0 * np.sin(row / 20 + rng.uniform(0, 6)) ** 2 + (column // rng.integers(5, 30)) % 2
    depth_m += rng.normal(0, 0.01, depth_m.shape)
    disparity_px = np.where(rng.random(depth_m.shape) < 0.9, 12.0 / depth_m, np.nan).astype(np.float32)
    points, keep = depth_m.size, project(CAMERA, pose, jnp.asarray(disparity_px), DEPTHS_M, 0.5).in_range.reshape(-1)
    shares = rng.dirichlet(np.ones(classes + 1), points)[:, :classes].astype(np.float32)
    hard = rng.choice(np.array([*range(classes), IGNORE]), points).astype(np.int32)
    labels = PointLabels(keep, probabilities=shares) if soft else PointLabels(keep, labels=hard)
    return Sighting(CAMERA, pose, disparity_px, labels)


def maps_equal(one: VoxelMap, other: VoxelMap, *, most: int = 2) -> None:
    """Equal to within rounding, but for a few voxels: points on their faces, and the border of what is seen through."""
    scale = max(1.0, float(np.abs(one.log_odds).max()))
    off = np.abs(np.asarray(one.log_odds) - np.asarray(other.log_odds)) > 2e-6 * scale
    assert off.any(axis=0).sum() <= most
    assert one.frames_fused == other.frames_fused
    if one.surface is not None:
        _, weights, means_m, _ = np.asarray(one.surface)
        near = np.isclose(other.surface, one.surface, rtol=2e-4, atol=2e-5)
        # The sum of squares about the mean is a small difference of large numbers, those about the layer's middle.
        squares = np.abs(np.asarray(other.surface[3]) - np.asarray(one.surface[3]))
        near[3] |= squares <= 1e-6 * weights * (means_m**2 + 1e-3)
        assert (~near).any(axis=0).sum() <= most


@needs_kernel
@settings(max_examples=10)
@given(poses(reach_m=1.0), rngs())
def test_the_kernel_equals_the_plain_form(pose, rng):
    compare(sighting_of(pose, rng, soft=True), MEAN)


@needs_kernel
@pytest.mark.slow
@given(poses(reach_m=1.0), rngs(), st.sampled_from(RULES), st.booleans())
def test_the_kernel_equals_the_plain_form_under_every_rule(pose, rng, rule, soft):
    compare(sighting_of(pose, rng, soft=soft and not rule.hard_labels), rule)


def compare(sighting: Sighting, rule: FusionRule) -> None:
    """Fuses a frame twice, in both forms."""
    params, before = make_fusion_params(CLASSES), make_voxel_map(GRID, CLASSES, surface=True)
    for _ in range(2):
        expected, count = plainly(before, sighting, GRID, params, rule, DEPTHS_M)
        got, counted = by_kernel(before, sighting, GRID, params, rule, DEPTHS_M)
        maps_equal(expected, got)
        for expected_count, got_count in zip(count, counted, strict=True):
            assert abs(int(expected_count) - int(got_count)) <= 2
        before = expected


@needs_kernel
@pytest.mark.slow
@pytest.mark.parametrize("classes", [(), CLASSES[:1], tuple(f"class {n}" for n in range(9))], ids=len)
@pytest.mark.parametrize("soft", [False, True])
def test_the_kernel_takes_any_number_of_classes(classes, soft):
    rng, pose = np.random.default_rng(3), jaxlie.SE3.identity()
    sighting = sighting_of(pose, rng, soft=soft, classes=len(classes))
    arguments = (make_voxel_map(GRID, classes), sighting, GRID, make_fusion_params(classes), MEAN, DEPTHS_M)
    maps_equal(plainly(*arguments)[0], by_kernel(*arguments)[0])


@needs_kernel
@settings(max_examples=10)
@given(poses(reach_m=1.0), rngs(), st.booleans())
def test_through_any_window_the_kernel_adds_the_same_bits(pose, rng, soft):
    sighting = sighting_of(pose, rng, soft=soft)
    params, empty = make_fusion_params(CLASSES), make_voxel_map(GRID, CLASSES, surface=True)
    whole, _ = by_kernel(empty, sighting, GRID, params, MEAN, DEPTHS_M)
    first = tuple(int(rng.integers(0, 8)) for _ in range(3))
    part = replace(GRID, first=jnp.asarray(GRID.first + np.array(first, np.int32)), shape=(40, 30, 11))
    box = tuple(slice(a, a + n) for a, n in zip(first, part.shape, strict=True))
    windowed, _ = by_kernel(empty, sighting, part, params, MEAN, DEPTHS_M)
    np.testing.assert_array_equal(windowed.log_odds[(slice(None), *box)], whole.log_odds[(slice(None), *box)])
    # A map of that part alone: a tile.
    tile = make_voxel_map(part, CLASSES, surface=True)
    tiled, _ = by_kernel(tile, sighting, part, params, MEAN, DEPTHS_M)
    np.testing.assert_array_equal(tiled.log_odds, whole.log_odds[(slice(None), *box)])
    layers = tiled.surface.shape[3]
    np.testing.assert_array_equal(tiled.surface, windowed.surface[(slice(None), *box[:2], slice(layers))])
    outside = np.array(windowed.log_odds)
    outside[(slice(None), *box)] = 0
    assert not outside.any()


@needs_kernel
@pytest.mark.slow
def test_pixels_without_a_depth_or_finite_labels_say_nothing():
    rng, pose, rule = np.random.default_rng(4), jaxlie.SE3.identity(), FusionRule(carve=False)
    sighting = sighting_of(pose, rng, soft=True)
    params, empty = make_fusion_params(CLASSES), make_voxel_map(GRID, CLASSES)
    bad = rng.random(len(sighting.labels.keep)) < 0.5
    kept = sighting._replace(labels=sighting.labels._replace(keep=sighting.labels.keep & ~bad))
    expected, _ = by_kernel(empty, kept, GRID, params, rule, DEPTHS_M)
    none = rng.choice(np.array([np.nan, np.inf, -np.inf, -3.0, 0.0, 1e-5], np.float32), bad.size)
    disparity_px = np.where(bad, none, sighting.disparity_px.reshape(-1)).reshape(sighting.disparity_px.shape)
    blind = sighting._replace(disparity_px=disparity_px)
    shares = np.where(bad[:, None], np.inf, sighting.labels.probabilities)
    doubtful = sighting._replace(labels=sighting.labels._replace(probabilities=shares))
    got, _ = by_kernel(empty, blind, GRID, params, rule, DEPTHS_M)
    # Runs of pixels end where there is no depth, as where a point does not count: not a bit differs.
    np.testing.assert_array_equal(got.log_odds, expected.log_odds)
    for fuse, sighted in ((plainly, blind), (plainly, doubtful), (by_kernel, doubtful)):
        maps_equal(expected, fuse(empty, sighted, GRID, params, rule, DEPTHS_M)[0])


@needs_kernel
@pytest.mark.slow
def test_gradients_are_those_of_the_plain_form():
    sighting = sighting_of(jaxlie.SE3.identity(), np.random.default_rng(5), soft=True)
    empty, weighing = make_voxel_map(GRID, CLASSES, surface=True), jnp.sin(jnp.arange(4.0))[:, None, None, None]

    def score(add, params, disparity_px, camera):
        seen = sighting._replace(disparity_px=disparity_px, camera=camera)
        fused, _ = add(empty, seen, GRID, params, MEAN, DEPTHS_M)
        return (weighing * fused.log_odds**2).sum() + fused.surface[2].sum()

    arguments = (make_fusion_params(CLASSES), sighting.disparity_px, CAMERA)
    expected = jax.jit(jax.grad(partial(score, add_plainly), argnums=(0, 1, 2)))(*arguments)
    got = jax.jit(jax.grad(partial(score, add_sighting), argnums=(0, 1, 2)))(*arguments)
    for one, other in zip(jax.tree.leaves(expected), jax.tree.leaves(got), strict=True):
        np.testing.assert_allclose(other, one, rtol=1e-6, atol=1e-6)


@needs_kernel
@pytest.mark.slow
def test_several_maps_at_once_are_each_their_own():
    rng = np.random.default_rng(6)
    sighting = sighting_of(jaxlie.SE3.identity(), rng, soft=True)
    params, empty = make_fusion_params(CLASSES), make_voxel_map(GRID, CLASSES)
    factors = jnp.array([1.0, 0.5])

    def fused(factor):
        lighter = replace(params, class_increments=params.class_increments * factor)
        return add_sighting(empty, sighting, GRID, lighter, MEAN, DEPTHS_M)[0].log_odds

    together = jax.jit(jax.vmap(fused))(factors)
    for index, factor in enumerate(factors):
        np.testing.assert_array_equal(together[index], jax.jit(fused)(factor))


def fused_hash() -> str:
    """Of the bits of a map of a few frames."""
    rng, params = np.random.default_rng(7), make_fusion_params(CLASSES)
    voxel_map = make_voxel_map(GRID, CLASSES, surface=True)
    for turn in range(3):
        pose = jaxlie.SE3.from_rotation(jaxlie.SO3.from_z_radians(0.3 * turn))
        sighting = sighting_of(pose, rng, soft=True)
        voxel_map, _ = by_kernel(voxel_map, sighting, GRID, params, MEAN, DEPTHS_M)
    tensors = (np.asarray(voxel_map.log_odds), np.asarray(voxel_map.surface))
    return hashlib.sha256(b"".join(tensor.tobytes() for tensor in tensors)).hexdigest()


@needs_kernel
@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="the system does not bind processes to cores")
def test_on_one_core_the_map_has_the_same_bits():
    bind = "import os; os.sched_setaffinity(0, [min(os.sched_getaffinity(0))])"
    command = [sys.executable, "-c", f"{bind}; import test_kernel; print(test_kernel.fused_hash())"]
    folders = (os.path.dirname(__file__), os.path.dirname(os.path.dirname(__file__)), os.environ.get("PYTHONPATH", ""))
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(folders)}
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    assert done.stdout.split()[-1] == fused_hash()


def test_without_a_compiler_the_plain_form_is_taken(monkeypatch):
    monkeypatch.setenv("JAXMAP_NATIVE", "0")
    sighting = sighting_of(jaxlie.SE3.identity(), np.random.default_rng(8), soft=True)
    arguments = (make_voxel_map(GRID, CLASSES), sighting, GRID, make_fusion_params(CLASSES))
    text = jax.jit(lambda *given: add_sighting(*given, MEAN, DEPTHS_M)).lower(*arguments).as_text()
    assert FUSE_TARGET not in text

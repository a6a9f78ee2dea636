"""Stereo inside the step: two images and their map are one function, which is matching and then the usual step."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from rigs import RIG
from scenes import BASELINE_M, CX_PX, CY_PX, F_PX, SceneFrame, raw_frame, scene_frame

from jaxmap.errors import JaxmapError
from jaxmap.fusion.options import FusionRule
from jaxmap.fusion.params import make_fusion_params
from jaxmap.labellers.base import make_no_labeller
from jaxmap.mapping.devices import _seen_nothing
from jaxmap.mapping.step import Mapper, MapperParams, make_mapper
from jaxmap.matching.design import MatchDesign, make_match_params
from jaxmap.matching.match import match
from jaxmap.matching.rectify import RawPair
from jaxmap.stereo.front_end import StereoFrontEnd
from jaxmap.stereo.match import StereoOptions
from jaxmap.stereo.rectify import make_raw_pair, make_rectifier
from jaxmap.types import Frame, make_grid, make_stereo_camera

TOP, LEFT, HEIGHT_PX, WIDTH_PX = 62, 30, 36, 72
"""A part of the scene: sand, and the foot of a box."""
CAMERA = make_stereo_camera(
    fx_px=F_PX, cx_px=CX_PX - LEFT, cy_px=CY_PX - TOP, baseline_m=BASELINE_M, width_px=WIDTH_PX, height_px=HEIGHT_PX
)
GRID = make_grid([-2, 0, -0.5], [2, 5, 1], 0.1)
HARD = MatchDesign(num_disparities=16, speckle_window_px=0)
SOFT = replace(HARD, soft=True)
PARAMS = MapperParams(CAMERA, make_fusion_params(()), match=make_match_params())
KEY = jax.random.key(0)


def mapper_of(design: MatchDesign | None) -> Mapper:
    return make_mapper(CAMERA, GRID, make_no_labeller(), FusionRule(), (0.3, 4.0), match=design)


def frame_of(index: int = 0) -> Frame:
    view = scene_frame(index)
    left, right = (
        jnp.asarray(image[TOP : TOP + HEIGHT_PX, LEFT : LEFT + WIDTH_PX]) for image in (view.left, view.right)
    )
    blind = np.zeros((HEIGHT_PX, WIDTH_PX), bool)
    blind[:4] = True
    pose = jaxlie.SE3.from_matrix(jnp.asarray(view.T_world_camera, jnp.float32))
    return Frame(None, pose, image=left, right_image=right, blind=jnp.asarray(blind))


def matched(design: MatchDesign, frame: Frame) -> Frame:
    assert frame.image is not None and frame.right_image is not None and PARAMS.match is not None
    disparity_px = np.array(jax.jit(match, static_argnums=0)(design, frame.image, frame.right_image, PARAMS.match))
    disparity_px[np.asarray(frame.blind)] = np.nan
    return Frame(jnp.asarray(disparity_px), frame.T_world_camera)


@pytest.mark.slow
def test_the_step_of_two_images_is_matching_and_the_usual_step():
    mapper, usual = mapper_of(HARD), mapper_of(None)
    one, other = mapper.init(), usual.init()
    for index in range(2):
        frame = frame_of(index)
        one, report = mapper.step(one, frame, PARAMS, KEY)
        other, expected = usual.step(other, matched(HARD, frame), PARAMS, KEY)
        assert int(report.points_valid) > HEIGHT_PX * WIDTH_PX / 4
        jax.tree.map(np.testing.assert_array_equal, report, expected)
    np.testing.assert_array_equal(one.log_odds, other.log_odds)
    assert mapper.compilations() == 1


@pytest.mark.slow
def test_what_is_blind_is_not_seen():
    mapper = mapper_of(HARD)
    frame = frame_of()
    nothing = _seen_nothing(frame)
    voxel_map, report = mapper.step(mapper.init(), nothing, PARAMS, KEY)
    assert int(report.points_valid) == 0 and not np.asarray(voxel_map.log_odds).any()
    _, report = mapper.step(mapper.init(), replace(frame, blind=jnp.zeros_like(frame.blind)), PARAMS, KEY)
    assert int(report.points_valid) > int(mapper.step(mapper.init(), frame, PARAMS, KEY)[1].points_valid)


@pytest.mark.slow
def test_the_step_compiled_is_the_step():
    mapper, frame = mapper_of(HARD), frame_of()
    fused, _ = mapper.fuse(mapper.init(), frame, PARAMS, KEY)
    np.testing.assert_allclose(mapper.step(mapper.init(), frame, PARAMS, KEY)[0].log_odds, fused.log_odds, atol=1e-5)


@pytest.mark.slow
def test_a_score_of_the_map_has_gradients_in_penalties_and_images():
    mapper, frame = mapper_of(SOFT), frame_of()
    floats = replace(frame, image=frame.image.astype(jnp.float32), right_image=frame.right_image.astype(jnp.float32))
    weight = np.random.default_rng(9).normal(size=mapper.init().log_odds.shape)

    @jax.jit
    @jax.grad
    def gradient(inputs: tuple[MapperParams, jax.Array, jax.Array]) -> jax.Array:
        params, left, right = inputs
        seen = replace(floats, image=left, right_image=right)
        return (weight * jnp.tanh(mapper.fuse(mapper.init(), seen, params, KEY)[0].log_odds)).sum()

    params, *images = gradient((PARAMS, floats.image, floats.right_image))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((params, images)))
    for leaf in (params.match.p1, params.match.p2, params.match.temperature, *images, params.camera.baseline_m):
        assert np.abs(leaf).max() > 0


@pytest.mark.parametrize(
    ("design", "change", "message"),
    [
        (HARD, {"disparity_px": jnp.zeros((HEIGHT_PX, WIDTH_PX))}, "matched already"),
        (HARD, {"right_image": None}, "nothing to match"),
        (HARD, {"right_image": jnp.zeros((HEIGHT_PX, WIDTH_PX + 1), jnp.uint8)}, "the right one"),
        (None, {}, "no disparity"),
    ],
)
def test_frames_that_cannot_be_matched_are_refused(design, change, message):
    mapper = mapper_of(design)
    with pytest.raises(JaxmapError, match=message):
        mapper.step(mapper.init(), replace(frame_of(), **change), PARAMS, KEY)


def raw_frame_of(rig_frame: SceneFrame) -> Frame:
    pose = jaxlie.SE3.from_matrix(jnp.asarray(rig_frame.T_world_camera, jnp.float32))
    return Frame(None, pose, image=jnp.asarray(rig_frame.left), right_image=jnp.asarray(rig_frame.right))


@pytest.mark.slow
def test_raw_images_are_rectified_within_the_step():
    design, seen = replace(HARD, num_disparities=32), raw_frame(RIG, 0)
    front_end = StereoFrontEnd(RIG, StereoOptions())
    mapper = make_mapper(front_end.camera, GRID, make_no_labeller(), FusionRule(), (0.3, 4.0), match=design)
    params = replace(PARAMS, camera=front_end.camera)
    ready = front_end.ready(seen.left, seen.right)
    T_rectified = jnp.asarray(seen.T_world_camera @ front_end.T_raw_rectified, jnp.float32)
    before = Frame(
        None,
        jaxlie.SE3.from_matrix(T_rectified),
        image=jnp.asarray(ready.left),
        right_image=jnp.asarray(ready.right),
        blind=jnp.asarray(ready.blind),
    )
    within, _ = mapper.step(mapper.init(), raw_frame_of(seen), replace(params, raw=make_raw_pair(RIG)), KEY)
    on_host, _ = mapper.step(mapper.init(), before, params, KEY)
    # OpenCV rounds places in the raw image to 32nds of a pixel.
    one, other = (np.asarray(made.log_odds)[0] > 0.5 for made in (within, on_host))
    assert other.sum() > 200 and (one & other).sum() > 0.9 * (one | other).sum()


@pytest.mark.slow
def test_a_score_of_the_map_has_gradients_in_the_calibration():
    camera, seen = make_rectifier(RIG).camera, raw_frame(RIG, 0)
    small = replace(camera, cx_px=camera.cx_px - LEFT, cy_px=camera.cy_px - TOP, width_px=WIDTH_PX, height_px=HEIGHT_PX)
    mapper = make_mapper(small, GRID, make_no_labeller(), FusionRule(), (0.3, 4.0), match=SOFT)
    weight = np.random.default_rng(9).normal(size=mapper.init().log_odds.shape)

    @jax.jit
    @jax.grad
    def gradient(raw: RawPair) -> jax.Array:
        params = replace(PARAMS, camera=small, raw=raw)
        return (weight * jnp.tanh(mapper.fuse(mapper.init(), raw_frame_of(seen), params, KEY)[0].log_odds)).sum()

    found = gradient(make_raw_pair(RIG))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found))
    for leaf in (found.left.fx_px, found.right.cx_px, found.right.distortion, found.T_right_left.wxyz_xyz):
        assert np.abs(leaf).max() > 0

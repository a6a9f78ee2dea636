"""Rectification in the step: the images of OpenCV's maps, with gradients."""

from __future__ import annotations

from dataclasses import replace

import cv2
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from rigs import RIG
from scipy.ndimage import map_coordinates

from jaxmap.matching.rectify import RawPair, rectify_pair, rectifying_rotations
from jaxmap.stereo.rectify import Rectifier, StereoRig, make_raw_pair, make_rectifier

pytestmark = pytest.mark.slow
"""Each compiles the rectification of a pair."""

rectified = jax.jit(rectify_pair)

TILTED = np.array([-0.12, 0.02, 1e-3, -1e-3, 2e-3, 0.01, -0.02, 3e-3, 1e-3, -1e-3, 2e-3, 1e-3, 0.03, -0.02])
RIGS = {
    "4 coefficients": RIG,
    "14 coefficients": replace(RIG, distortion_left=TILTED, distortion_right=TILTED),
    "equidistant": replace(RIG, model="equidistant", R_right_left=cv2.Rodrigues(np.array([0.02, 0.01, -0.02]))[0]),
}


def smooth_image(seed: int, rig: StereoRig, channels: int = 1) -> np.ndarray:
    """A picture whose grey levels change slowly from pixel to pixel."""
    noise = np.random.default_rng(seed).uniform(-1, 1, (rig.height_px, rig.width_px, channels))
    waves = cv2.GaussianBlur(noise, (0, 0), 3.0).reshape(noise.shape)
    return np.clip(128 + 500 * waves, 0, 255).astype(np.uint8).squeeze()


def twin(image: np.ndarray, rig: StereoRig, rectifier: Rectifier) -> np.ndarray:
    """The left image at the places that OpenCV names as floats, black around it."""
    fx, fy, cx, cy = (float(getattr(rectifier.camera, name)) for name in ("fx_px", "fy_px", "cx_px", "cy_px"))
    P = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    places = cv2.fisheye.initUndistortRectifyMap if rig.model == "equidistant" else cv2.initUndistortRectifyMap
    size = (rig.width_px, rig.height_px)
    u, v = places(rig.K_left, rig.distortion_left, rectifier.R_rectified_left, P, size, cv2.CV_32FC1)
    return map_coordinates(np.pad(image.astype(np.float64), 1), [v + 1, u + 1], order=1, mode="constant")


@pytest.mark.parametrize("alpha", [0.0, 1.0])
@pytest.mark.parametrize("rig", RIGS.values(), ids=RIGS.keys())
def test_the_images_are_opencvs(rig, alpha):
    rectifier = make_rectifier(rig, alpha=alpha)
    images = smooth_image(1, rig), smooth_image(2, rig)
    made = rectified(make_raw_pair(rig), rectifier.camera, *images)
    sides = [(made.left, made.left_seen, rectifier.left_maps), (made.right, made.right_seen, rectifier.right_maps)]
    for image, (ours, seen, maps) in zip(images, sides, strict=True):
        assert np.abs(ours - cv2.remap(image, *maps, cv2.INTER_LINEAR))[seen].max() <= 1.0
        black = cv2.remap(np.full_like(image, 255), *maps, cv2.INTER_LINEAR) < 255
        assert (black != ~seen).mean() < 0.01
    assert np.abs(made.left - twin(images[0], rig, rectifier)).max() < 0.1


def test_colours_are_rectified_alike():
    camera, pair = make_rectifier(RIG).camera, make_raw_pair(RIG)
    colours = smooth_image(3, RIG, 3)
    made = rectified(pair, camera, colours, colours)
    alone = rectified(pair, camera, colours[..., 1], colours[..., 1])
    np.testing.assert_allclose(made.right[..., 1], alone.right, atol=1e-4)
    np.testing.assert_array_equal(made.right_seen, alone.right_seen)


def test_a_corrected_pair_turns_the_right_camera_alone():
    turn = cv2.Rodrigues(np.array([0.01, 0.004, -0.003]))[0]
    rectifier, plain = make_rectifier(RIG, R_aligned=turn), make_rectifier(RIG)
    images = smooth_image(4, RIG), smooth_image(5, RIG)
    made = rectified(make_raw_pair(RIG, turn), plain.camera, *images)
    expected = cv2.remap(images[1], *rectifier.right_maps, cv2.INTER_LINEAR)
    assert np.abs(made.right - expected)[made.right_seen].max() <= 1.0
    left = cv2.remap(images[0], *plain.left_maps, cv2.INTER_LINEAR)
    assert np.abs(made.left - left)[made.left_seen].max() <= 1.0


def test_the_rotations_are_bouguets():
    R_left, R_right = rectifying_rotations(make_raw_pair(RIG))
    np.testing.assert_allclose(R_left.as_matrix(), make_rectifier(RIG).R_rectified_left, atol=1e-6)
    baseline = R_right @ jnp.asarray(RIG.t_right_left_m, jnp.float32)
    np.testing.assert_allclose(baseline, [-np.linalg.norm(RIG.t_right_left_m), 0, 0], atol=1e-7)


def test_a_pair_that_is_rectified_already_has_finite_gradients():
    """Where the half turn and the turn onto the baseline are none."""
    pair = make_raw_pair(replace(RIG, R_right_left=np.eye(3), t_right_left_m=np.array([-0.1, 0, 0])))
    camera = make_rectifier(RIG).camera
    image = smooth_image(6, RIG)
    gradient = jax.jit(jax.grad(lambda pair: rectify_pair(pair, camera, image, image).right.mean()))(pair)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))


NUDGES = {
    "principal point": lambda pair, by: replace(pair, left=replace(pair.left, cx_px=pair.left.cx_px + by)),
    "focal length": lambda pair, by: replace(pair, right=replace(pair.right, fy_px=pair.right.fy_px + 5 * by)),
    "distortion": lambda pair, by: replace(
        pair, right=replace(pair.right, distortion=pair.right.distortion.at[0].add(0.05 * by))
    ),
    "rotation": lambda pair, by: replace(
        pair, T_right_left=jaxlie.manifold.rplus(pair.T_right_left, 0.01 * by * jnp.array([0, 0, 0, 0.5, 1.0, -1.0]))
    ),
    "baseline": lambda pair, by: replace(
        pair, T_right_left=jaxlie.manifold.rplus(pair.T_right_left, 1e-3 * by * jnp.array([0, 1.0, -1.0, 0, 0, 0]))
    ),
}


@pytest.mark.parametrize("nudge", NUDGES.values(), ids=NUDGES.keys())
def test_gradients_of_the_calibration_are_finite_differences(nudge):
    camera, pair = make_rectifier(RIG).camera, make_raw_pair(RIG)
    left, right = smooth_image(7, RIG), smooth_image(8, RIG)
    wanted = rectified(nudge(pair, 0.6), camera, left, right)

    @jax.jit
    def loss(by: jax.Array) -> jax.Array:
        made = rectify_pair(nudge(pair, by), camera, left, right)
        inside = made.left_seen & made.right_seen & wanted.left_seen & wanted.right_seen
        apart = (made.left - wanted.left) ** 2 + (made.right - wanted.right) ** 2
        return jnp.where(inside, apart, 0).mean()

    slope, step = jax.jit(jax.grad(loss))(0.0), 0.02
    assert abs(slope) > 1e-3
    np.testing.assert_allclose(slope, (loss(step) - loss(-step)) / (2 * step), rtol=0.03)


def test_gradients_of_an_image_are_its_weights():
    """Bilinear interpolation is linear: what a pixel gives away adds up to what its neighbours take."""
    camera, pair = make_rectifier(RIG).camera, make_raw_pair(RIG)
    image = jnp.asarray(smooth_image(9, RIG), jnp.float32)
    total, weights = jax.jit(jax.value_and_grad(lambda raw: rectify_pair(pair, camera, raw, image).left.sum()))(image)
    np.testing.assert_allclose((weights * image).sum(), total, rtol=1e-5)


def test_a_pair_is_a_pytree():
    pair = make_raw_pair(RIG)
    assert isinstance(jax.tree.map(lambda leaf: leaf, pair), RawPair)
    assert len(jax.tree.leaves(pair)) == 12

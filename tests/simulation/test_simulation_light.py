"""Sun, sky, rays and the camera's electronics."""

from __future__ import annotations

import numpy as np
import pytest
import reference_simulation as reference
from hypothesis import given
from hypothesis import strategies as st

from jaxmap.simulation.develop import corner_distance, develop, exposure_gain
from jaxmap.simulation.draw import Draw, draw_sky, draw_world
from jaxmap.simulation.lighting import irradiance_map, make_lighting, sky_irradiance
from jaxmap.simulation.materials import make_textures
from jaxmap.simulation.rays import camera_rays, downward_rays, pixel_offsets

seeds = st.integers(0, 2**31 - 1)


@given(seed=seeds)
def test_light_is_finite_and_positive(seed):
    lighting = make_lighting(draw_sky(Draw(seed, "sky"), (0.4, 0.3, 0.2)))
    assert np.linalg.norm(lighting.sun_direction) == pytest.approx(1)
    assert np.isfinite(lighting.sky).all() and lighting.sky.min() >= 0 and (lighting.sun_irradiance >= 0).all()
    assert (lighting.level_irradiance() > 0.01).all()
    assert sky_irradiance(lighting.sky) == pytest.approx(lighting.sky_irradiance, rel=1e-4)


def test_an_even_sky_gives_pi_times_its_radiance_to_a_level_plane():
    sky = np.ones((48, 192, 3), np.float32)
    assert sky_irradiance(sky) == pytest.approx(np.pi, rel=1e-3)
    table = irradiance_map(sky)
    # With the horizon's light going on below it, a plane of any direction sees half a sphere of it.
    assert table == pytest.approx(np.pi, rel=0.01)


def test_the_table_of_irradiance_equals_its_twin():
    sky = make_lighting(draw_world(12, "random").sky).sky
    coarse = sky.reshape(24, 8, 64, 12, 3).mean(axis=(1, 3))
    table = irradiance_map(sky)
    for row, column in ((47, 5), (40, 20), (30, 50), (24, 0)):
        elevation, azimuth = np.pi * ((row + 0.5) / 48 - 0.5), np.pi * (2 * (column + 0.5) / 64 - 1)
        flat = np.cos(elevation)
        normal = np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])
        assert table[row, column] == pytest.approx(reference.sky_irradiance(coarse, normal), rel=0.02)


def test_textures_are_about_neutral_and_the_same_for_the_same_seed():
    recipe = draw_world(6, "random")
    first, second = (make_textures(recipe.sand, recipe.stone, size=64) for _ in range(2))
    for one, other in zip(first, second, strict=True):
        assert np.array_equal(one, other) and np.isfinite(one).all()
    assert abs(first.stone[..., 0].mean()) < 0.01 and abs(first.mottle.mean()) < 0.01
    assert np.abs(first.grain[..., 3:].mean(axis=(0, 1))).max() < 1e-4


@given(seed=st.integers(0, 1000), sample=st.integers(0, 50))
def test_pixel_offsets_stay_in_their_pixel(seed, sample):
    for offset in pixel_offsets((3, 4), sample, (seed,)):
        assert offset.shape == (3, 4) and np.abs(offset).max() <= 0.5


def test_offsets_of_many_passes_fill_the_pixel():
    offsets = np.array([pixel_offsets((2, 2), sample, (1,)) for sample in range(64)])
    assert np.abs(offsets.mean(axis=0)).max() < 0.03
    assert offsets.std(axis=0) == pytest.approx(1 / np.sqrt(12), abs=0.02)


def test_camera_rays_start_at_the_camera_and_have_depth_one():
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, 7), np.linspace(-0.4, 0.4, 5))
    T = np.eye(4)
    T[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    T[:3, 3] = 1, 2, 3
    rays = camera_rays(np.stack([x, y]), T)
    origin, direction = rays.at(np.zeros((5, 7)), np.zeros((5, 7)))
    assert np.allclose(origin, np.array([1, 2, 3])[:, None, None])
    assert np.allclose(np.einsum("i,ihw->hw", T[:3, 2], direction), 1)
    # Half a pixel to the right lies half way to the next one.
    right = rays.at(np.full((5, 7), 0.5), np.zeros((5, 7)))[1]
    assert np.allclose(right[:, :, 2], (direction[:, :, 2] + direction[:, :, 3]) / 2, atol=1e-6)


def test_downward_rays_pass_the_middles_of_north_up_cells():
    rays = downward_rays(10.0, 20.0, 0.5, (4, 6), 50.0, -10.0)
    assert rays.origin_m[:, 0, 0] == pytest.approx([10.25, 19.75, 50.0])
    assert rays.origin_m[:2, -1, -1] == pytest.approx([12.75, 18.25])
    assert (rays.direction[2] == -60).all()


def test_exposure_brings_sand_to_its_level():
    recipe = draw_world(1, "random").exposure
    plain = type(recipe)(
        level=0.25,
        gamma=2.0,
        contrast=0.0,
        white_balance=(1.0, 1.0, 1.0),
        saturation=1.0,
        vignetting=0.0,
        blur_px=0.5,
        photons=1e9,
        read_noise=0.0,
        mosaic=True,
    )
    radiance = np.full((40, 50, 3), 0.7, np.float32)
    image = develop(radiance, plain, exposure_gain(plain, 0.7), np.random.default_rng(0), corner_distance(40, 50))
    assert np.abs(image.astype(int) - round(255 * 0.25**0.5)).max() <= 1


def test_a_camera_adds_noise_and_darkens_its_corners():
    recipe = draw_world(1, "random").exposure
    noisy = type(recipe)(**{**vars(recipe), "vignetting": 0.3, "photons": 500.0, "mosaic": False})
    corner = corner_distance(60, 80)
    image = develop(np.full((60, 80, 3), 0.3, np.float32), noisy, 1.0, np.random.default_rng(0), corner)
    again = develop(np.full((60, 80, 3), 0.3, np.float32), noisy, 1.0, np.random.default_rng(0), corner)
    assert np.array_equal(image, again) and image.std() > 1
    assert image[:8, :8].mean() < image[26:34, 36:44].mean() - 5
    assert corner[0, 0] == pytest.approx(1) and corner.min() < 0.01

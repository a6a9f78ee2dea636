"""Sun, sky and haze: the CIE's general sky with a coloured sun, clouds, and dust in the air."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32

from jaxmap.simulation.noise import fractal_noise, smoothstep
from jaxmap.simulation.recipe import SkyRecipe

SKY_SHAPE = (192, 768)
"""Rows (horizon to zenith, finer near the horizon) and columns (all around) of the map of the sky."""

_CIE_SKIES = {
    "clear": (-1.0, -0.32, 10.0, -3.0, 0.45),
    "turbid": (-1.0, -0.15, 16.0, -3.0, 0.30),
    "hazy": (-1.0, -0.15, 2.0, -1.5, 0.15),
    "overcast": (4.0, -0.70, 0.0, -1.0, 0.0),
}
"""a, b, c, d, e of four of the fifteen skies of CIE S 011 (2003): 12, 14, 11 (paler) and 1."""

_RAYLEIGH = np.array([0.059, 0.114, 0.240])
"""Optical depth of clean air straight up, at the wavelengths of red, green and blue."""


class Lighting(NamedTuple):
    """What shines on a world, in linear RGB; the unit of radiance is free, exposure takes care of it.

    Attributes:
        sun_direction: unit vector towards the sun.
        sun_irradiance: on a plane that faces the sun.
        sun_radius_rad: of the sun's disc.
        sky: radiance (rows, columns, 3); row r is elevation 90 (r / rows)^2 degrees, columns go from
            west by south, east and north, that is by atan2(north, east) from -180 degrees on.
        sky_irradiance: of the whole sky on a level plane.
        visibility_m: distance at which haze has taken all but 1 / e.
        haze: radiance of thick haze.
    """

    sun_direction: Float[np.ndarray, "3"]
    sun_irradiance: Float[np.ndarray, "3"]
    sun_radius_rad: float
    sky: Float32[np.ndarray, "R C 3"]
    sky_irradiance: Float[np.ndarray, "3"]
    visibility_m: float
    haze: Float[np.ndarray, "3"]

    def level_irradiance(self) -> Float[np.ndarray, "3"]:
        """Of sun and sky together on a level plane."""
        return self.sun_irradiance * max(self.sun_direction[2], 0.0) + self.sky_irradiance


def make_lighting(recipe: SkyRecipe) -> Lighting:
    """The lighting that a recipe describes."""
    sun = _unit_vector(recipe.sun_azimuth_deg, recipe.sun_elevation_deg)
    # Kasten and Young (1989) would differ under 5 degrees only; suns that low are not drawn.
    air_mass = 1.0 / max(sun[2], 0.05)
    dust = np.array([1.0, 1.0 + recipe.dust_blueness * 0.25, 1.0 + recipe.dust_blueness])
    optical_depth = _RAYLEIGH * recipe.air + recipe.dust_depth * dust
    beam = 3.0 * np.exp(-optical_depth * air_mass) * (1.0 - recipe.overcast)
    sky = _sky_map(recipe, sun)
    # Light that the beam has lost comes down from the sky, half of it at least.
    lost = 3.0 * sun[2] * (1.0 - np.exp(-optical_depth * air_mass).mean())
    level = recipe.sky_share * lost + 1.6 * sun[2] * recipe.overcast + 0.04
    irradiance = sky_irradiance(sky)
    sky *= np.float32(level / irradiance.mean())
    rows = sky.shape[0]
    return Lighting(
        sun_direction=sun,
        sun_irradiance=beam,
        sun_radius_rad=np.deg2rad(0.27 + 2.0 * recipe.overcast),
        sky=sky,
        sky_irradiance=irradiance * (level / irradiance.mean()),
        visibility_m=recipe.visibility_m,
        haze=sky[: rows // 8].mean(axis=(0, 1)).astype(np.float64),
    )


def sky_irradiance(sky: Float32[np.ndarray, "R C 3"]) -> Float[np.ndarray, "3"]:
    """Irradiance of a map of the sky on a level plane."""
    rows, columns = sky.shape[:2]
    edges = np.pi / 2 * (np.arange(rows + 1) / rows) ** 2
    # The integral of sin(elevation) cos(elevation) over a row, times the width of a column.
    weight = (np.sin(edges[1:]) ** 2 - np.sin(edges[:-1]) ** 2) / 2 * (2 * np.pi / columns)
    return np.einsum("rck,r->k", sky.astype(np.float64), weight)


def irradiance_map(sky: Float32[np.ndarray, "R C 3"]) -> Float32[np.ndarray, "P Q 3"]:
    """Irradiance of the sky on planes of all directions; under the horizon the sky goes on as it is there.

    Returns:
        Rows from straight down to straight up, evenly in elevation; columns as in the map of the sky.
    """
    rows, columns = 24, 64
    step = sky.shape[0] // rows
    coarse = sky.reshape(rows, step, columns, sky.shape[1] // columns, 3).mean(axis=(1, 3))
    edges = np.pi / 2 * (np.arange(rows + 1) / rows) ** 2
    below = np.linspace(-np.pi / 2, 0, rows + 1)
    edges = np.concatenate([below[:-1], edges])
    radiance = np.concatenate([np.broadcast_to(coarse[:1], coarse.shape), coarse])
    azimuth = np.pi * (2 * (np.arange(columns) + 0.5) / columns - 1)
    directions = _directions((edges[1:] + edges[:-1]) / 2, azimuth)
    solid_angle = (np.sin(edges[1:]) - np.sin(edges[:-1])) * (2 * np.pi / columns)
    arriving = radiance * solid_angle[:, None, None]
    normals = _directions(np.pi * ((np.arange(48) + 0.5) / 48 - 0.5), azimuth)
    cosines = np.maximum(normals.reshape(-1, 3) @ directions.reshape(-1, 3).T, 0)
    return (cosines @ arriving.reshape(-1, 3)).reshape(48, columns, 3).astype(np.float32)


def _directions(elevation: np.ndarray, azimuth: np.ndarray) -> Float[np.ndarray, "R C 3"]:
    flat, up = np.cos(elevation)[:, None], np.sin(elevation)[:, None] * np.ones(len(azimuth))
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), up], axis=-1)


def _sky_map(recipe: SkyRecipe, sun: np.ndarray) -> Float32[np.ndarray, "R C 3"]:
    rows, columns = SKY_SHAPE
    elevation = np.pi / 2 * ((np.arange(rows) + 0.5) / rows) ** 2
    azimuth = np.pi * (2 * (np.arange(columns) + 0.5) / columns - 1)
    east, north, up = np.moveaxis(_directions(elevation, azimuth), -1, 0)
    cos_sun = np.clip(east * sun[0] + north * sun[1] + up * sun[2], -1, 1)
    a, b, c, d, e = _CIE_SKIES[recipe.kind]
    angle = np.arccos(cos_sun)
    gradation = 1 + a * np.exp(b / np.maximum(up, 0.02))
    indicatrix = 1 + c * (np.exp(d * angle) - np.exp(d * np.pi / 2)) + e * cos_sun**2
    luminance = gradation * indicatrix
    to_zenith = np.clip(up, 0, 1)[..., None] ** 0.45
    horizon, zenith = np.array(recipe.horizon_colour), np.array(recipe.zenith_colour)
    sky = luminance[..., None] * (horizon + (zenith - horizon) * to_zenith)
    cover = _clouds(recipe, east, north, up)[..., None]
    cloud = np.array([1.0, 0.99, 0.97]) * (luminance.mean() * 1.6 + 0.3 * luminance[..., None])
    return (sky * (1 - cover) + cloud * cover).astype(np.float32)


def _clouds(recipe: SkyRecipe, east: np.ndarray, north: np.ndarray, up: np.ndarray) -> np.ndarray:
    if recipe.cloud_cover <= 0:
        return np.zeros_like(up)
    height = 1.0 / (up + 0.12)
    stretch = 2.5 if recipe.streaky_clouds else 1.0
    noise = fractal_noise([east * height, north * height * stretch], recipe.cloud_seed, wavelength=2.2, octaves=6)
    edge = 1.3 - 2.6 * recipe.cloud_cover
    return smoothstep(noise, edge, edge + 1.6) * 0.9


def _unit_vector(azimuth_deg: float, elevation_deg: float) -> np.ndarray:
    """Azimuth counts from east by north."""
    azimuth, elevation = np.deg2rad([azimuth_deg, elevation_deg])
    return np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])

"""What a world is made of: every number that is drawn from its seed, as frozen records."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Colour = tuple[float, float, float]
"""Linear RGB reflectance."""

SceneKind = Literal["few", "small", "medium", "random"]
"""The looks of the paper's Data 01 (few big rocks), 02 (many small, flat ones), 03 (medium ones and the rover's own
shadow), or anything."""


@dataclass(frozen=True)
class ReliefRecipe:
    """The shape of the ground: noise of several wavelengths, ripples, and what has walked and driven there."""

    seed: int
    band_wavelengths_m: tuple[float, ...]
    """Wavelength of each band of noise, the longest first."""
    band_heights_m: tuple[float, ...]
    """Standard deviation of each band."""
    ripple_wavelength_m: float
    ripple_height_m: float
    ripple_direction_deg: float
    ripple_cover: float
    """Share of the ground that has ripples, 0 for none."""
    walks: int
    """People who have walked across."""
    tracks: int
    """Rovers that have driven across."""
    drift: float
    """How high sand is heaped against rocks, in parts of their height."""


@dataclass(frozen=True)
class SandRecipe:
    """The look of the ground."""

    seed: int
    colours: tuple[Colour, Colour, Colour]
    """The usual colour, that of patches, and that of damp or scoured ground."""
    patch_size_m: float
    patch_strength: float
    damp_cover: float
    grain_contrast: float
    grain_tint: float
    grain_slope: float
    """How coarse the grain is: power of the wave number that contrast falls with."""
    grain_relief: float
    """Slope of the grain, which shades it."""
    specks_per_m2: float
    speck_brightness: float
    """Share of the specks that are brighter than the sand."""
    mottle_contrast: float
    mottle_slope: float


@dataclass(frozen=True)
class StoneRecipe:
    """The look of rocks and pebbles."""

    seed: int
    colours: tuple[Colour, ...]
    sand_coloured: float
    """Share of the rocks that have the colour of the sand."""
    dusty: float
    """Share of the rocks that have sand lying on them."""
    layered: float
    """Share of the rocks that are built of layers."""
    contrast: float
    relief: float
    texture_slope: float


@dataclass(frozen=True)
class RockFieldRecipe:
    """How many rocks of which size and shape.

    Sizes follow the size-frequency distribution that Golombek and Rapp (1997) found on Mars: rocks
    of diameter D and more cover `k exp(-q(k) D)` of the ground, with q(k) = 1.79 + 0.152 / k.
    """

    seed: int
    cover: float
    """k: the share of the ground that all rocks would cover."""
    smallest_m: float
    largest_m: float
    feature_rocks: int
    """Big rocks put in view of the path beside those that chance brings."""
    feature_size_m: tuple[float, float]
    clustered: float
    """Share of the rocks that lie in groups."""
    flatness: tuple[float, float]
    """Range of height over diameter."""
    roundness: tuple[float, float]
    """Range from 0 (sharp-edged) to 1 (a pebble)."""
    burial: tuple[float, float]
    """Range of the part of a rock's height that is in the ground."""
    pebbles_per_m2: float


@dataclass(frozen=True)
class SkyRecipe:
    """Sun, sky and haze."""

    kind: Literal["clear", "turbid", "hazy", "overcast"]
    sun_azimuth_deg: float
    """From east by north."""
    sun_elevation_deg: float
    air: float
    """Air over the world, in parts of Earth's."""
    dust_depth: float
    """Optical depth of dust straight up, in red."""
    dust_blueness: float
    """How much deeper dust is in blue."""
    overcast: float
    """Share of the sun's beam that clouds take."""
    sky_share: float
    """Share of the light the beam has lost that the sky sends down."""
    horizon_colour: Colour
    zenith_colour: Colour
    cloud_cover: float
    cloud_seed: int
    streaky_clouds: bool
    visibility_m: float


@dataclass(frozen=True)
class BackdropRecipe:
    """What lies beyond the sand, all of it background."""

    seed: int
    sea: bool
    sea_direction_deg: float
    """From east by north."""
    sea_distance_m: float
    ridge_distance_m: float
    ridge_height_m: float
    ridge_colours: tuple[Colour, Colour]
    clutter: int
    """People, poles, boxes and tents standing about."""


@dataclass(frozen=True)
class ExposureRecipe:
    """How a camera turns light into numbers."""

    level: float
    """Brightness that sand in full light is exposed to, linear, 1 being full scale."""
    gamma: float
    contrast: float
    white_balance: Colour
    saturation: float
    vignetting: float
    """Loss of light in the corners beside that of the lens."""
    blur_px: float
    photons: float
    """Electrons at full scale, which set the shot noise."""
    read_noise: float
    """Noise of the dark, full scale being 1."""
    mosaic: bool
    """Whether colours are taken through a Bayer mosaic and filled in."""


@dataclass(frozen=True)
class DriveRecipe:
    """Where and when the rover drives."""

    seed: int
    heading_deg: float
    """At the start, from east by north."""
    bend_per_m: float
    """Mean curvature of the path, to the left."""
    wander_per_m: float
    """Standard deviation of what its curvature adds to that."""
    speed_m_s: float
    start_time_s: float
    """When the recording starts, Unix time in UTC, in whole milliseconds."""
    site_utm_m: tuple[float, float, float]
    """Easting, northing (EPSG:32631) and altitude of the world's origin."""


@dataclass(frozen=True)
class WorldRecipe:
    """Everything that is drawn for one world."""

    seed: int
    kind: SceneKind
    relief: ReliefRecipe
    sand: SandRecipe
    stone: StoneRecipe
    rocks: RockFieldRecipe
    sky: SkyRecipe
    backdrop: BackdropRecipe
    exposure: ExposureRecipe
    drive: DriveRecipe

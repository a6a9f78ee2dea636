"""Drawing a world from a seed. Ranges are wide on purpose: a network trained on these worlds must meet any look."""

from __future__ import annotations

import calendar
import colorsys
import zlib
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from jaxmap.simulation.recipe import (
    BackdropRecipe,
    Colour,
    DriveRecipe,
    ExposureRecipe,
    ReliefRecipe,
    RockFieldRecipe,
    SandRecipe,
    SceneKind,
    SkyRecipe,
    StoneRecipe,
    WorldRecipe,
)


class Draw:
    """Random numbers of one part of a world: other parts do not shift them."""

    def __init__(self, seed: int, part: str) -> None:
        self.rng = np.random.default_rng([seed, zlib.crc32(part.encode())])

    def uniform(self, lower: float, upper: float) -> float:
        """Evenly between the bounds."""
        return float(self.rng.uniform(lower, upper))

    def ratio(self, lower: float, upper: float) -> float:
        """Between the bounds, its logarithm evenly."""
        return float(np.exp(self.rng.uniform(np.log(lower), np.log(upper))))

    def chance(self, probability: float) -> bool:
        """True with this probability."""
        return bool(self.rng.random() < probability)

    def whole(self, lower: int, upper: int) -> int:
        """A whole number, both bounds included."""
        return int(self.rng.integers(lower, upper + 1))

    def seed(self) -> int:
        """A seed for something else."""
        return int(self.rng.integers(2**31))

    def one_of(self, options: tuple, weights: tuple[float, ...]) -> Any:
        """One of the options."""
        return options[int(self.rng.choice(len(options), p=np.array(weights) / sum(weights)))]

    def colour(self, hue: tuple[float, float], saturation: tuple[float, float], value: tuple[float, float]) -> Colour:
        """A colour; hue in degrees, value the linear reflectance of its brightest channel."""
        return hsv(self.uniform(*hue), self.uniform(*saturation), self.ratio(*value))


def hsv(hue_deg: float, saturation: float, value: float) -> Colour:
    """Linear RGB of hue (degrees), saturation and value."""
    red, green, blue = colorsys.hsv_to_rgb(hue_deg / 360 % 1, min(saturation, 0.95), min(value, 1.0))
    return round(red, 4), round(green, 4), round(blue, 4)


def as_colour(values: Iterable[float]) -> Colour:
    """Three numbers as a colour."""
    red, green, blue = map(float, values)
    return red, green, blue


def draw_world(seed: int, kind: SceneKind) -> WorldRecipe:
    """All that is drawn for the world of a seed; the kind narrows the rocks and the sun's place."""
    sand = _draw_sand(Draw(seed, "sand"))
    drive = _draw_drive(Draw(seed, "drive"))
    sky = draw_sky(Draw(seed, "sky"), sand.colours[0])
    if kind == "medium":
        sky = _with_sun_behind(sky, drive, Draw(seed, "sun"))
    return WorldRecipe(
        seed=seed,
        kind=kind,
        relief=_draw_relief(Draw(seed, "relief"), kind),
        sand=sand,
        stone=_draw_stone(Draw(seed, "stone")),
        rocks=_draw_rocks(Draw(seed, "rocks"), kind),
        sky=sky,
        backdrop=_draw_backdrop(Draw(seed, "backdrop"), sand.colours[0]),
        exposure=_draw_exposure(Draw(seed, "exposure")),
        drive=drive,
    )


def widen_looks(recipe: WorldRecipe) -> WorldRecipe:
    """The same world with looks beyond those of beaches: for images to train on, which no two cameras take alike.

    Grounds as dark as basalt or as pale as salt, strong patches, coarse and fine grain, gravel; rocks of the ground's
    own colour, or none of it; exposures from dim to glaring, lenses from soft to sharp.
    """
    draw = Draw(recipe.seed, "looks")
    sand, stone, exposure = recipe.sand, recipe.stone, recipe.exposure
    usual, patch, damp = sand.colours
    if draw.chance(0.3):
        usual = draw.colour((0, 360), (0.0, 0.45), (0.03, 0.75))
        damp = as_colour(0.55 * np.array(usual))
        patch = as_colour(np.clip(np.array(usual) * draw.ratio(0.35, 2.2), 0.01, 0.85))
    elif draw.chance(0.35):
        patch = as_colour(np.clip(np.array(patch) * draw.ratio(0.35, 2.2), 0.01, 0.85))
    colours = stone.colours
    if draw.chance(0.25):
        # The rocks of basalt plains have the colour of the ground, a little brighter or darker.
        colours = tuple(as_colour(np.clip(np.array(usual) * draw.ratio(0.6, 1.6), 0.01, 0.85)) for _ in colours)
    return replace(
        recipe,
        sand=replace(
            sand,
            colours=(usual, patch, damp),
            patch_size_m=draw.ratio(0.25, 6.0),
            damp_cover=draw.uniform(0.1, 0.6) if draw.chance(0.4) else sand.damp_cover,
            grain_contrast=sand.grain_contrast * draw.ratio(0.5, 1.8),
            mottle_contrast=sand.mottle_contrast * draw.ratio(0.5, 2.2),
            specks_per_m2=draw.ratio(10, 12000),
        ),
        stone=replace(stone, colours=colours, contrast=stone.contrast * draw.ratio(0.6, 1.8)),
        exposure=replace(
            exposure,
            level=draw.ratio(0.1, 0.5),
            contrast=draw.uniform(0.0, 0.6),
            saturation=draw.uniform(0.0, 0.3) if draw.chance(0.15) else exposure.saturation,
            blur_px=draw.ratio(0.25, 1.3),
        ),
    )


def _draw_relief(draw: Draw, kind: SceneKind) -> ReliefRecipe:
    calm = {"few": 0.8, "small": 1.0, "medium": 0.8}.get(kind, draw.ratio(0.5, 1.6))
    bands = ((34.0, 0.28), (11.0, 0.10), (4.2, 0.035), (1.6, 0.017), (0.6, 0.0075), (0.24, 0.0042), (0.1, 0.0022))
    rippled = draw.chance(0.45)
    return ReliefRecipe(
        seed=draw.seed(),
        band_wavelengths_m=tuple(round(wavelength * draw.ratio(0.8, 1.25), 3) for wavelength, _ in bands),
        band_heights_m=tuple(round(height * calm * draw.ratio(0.5, 1.7), 5) for _, height in bands),
        ripple_wavelength_m=draw.ratio(0.07, 0.35),
        ripple_height_m=draw.uniform(0.03, 0.09),
        ripple_direction_deg=draw.uniform(0, 360),
        ripple_cover=draw.uniform(0.15, 0.9) if rippled else 0.0,
        walks=draw.whole(0, 4) if draw.chance(0.6) else 0,
        tracks=draw.whole(1, 3) if draw.chance(0.4) else 0,
        drift=draw.uniform(0.0, 0.25),
    )


def _draw_sand(draw: Draw) -> SandRecipe:
    # Quartz, shell, coral; rust and basalt; and whatever else there may be.
    look = draw.one_of(("beach", "rust", "dark", "pale", "any"), (5, 2.5, 1, 1, 1.5))
    hues, saturations, values = {
        "beach": ((24, 42), (0.22, 0.55), (0.22, 0.5)),
        "rust": ((12, 30), (0.45, 0.8), (0.2, 0.45)),
        "dark": ((15, 50), (0.0, 0.22), (0.07, 0.16)),
        "pale": ((28, 52), (0.05, 0.25), (0.45, 0.7)),
        "any": ((5, 60), (0.05, 0.6), (0.12, 0.55)),
    }[look]
    hue, saturation, value = draw.uniform(*hues), draw.uniform(*saturations), draw.ratio(*values)
    usual = hsv(hue, saturation, value)
    patch = hsv(hue + draw.uniform(-8, 8), saturation * draw.ratio(0.6, 1.4), value * draw.ratio(0.65, 1.4))
    damp = hsv(hue + draw.uniform(-4, 4), min(saturation * 1.2, 0.9), value * draw.uniform(0.4, 0.7))
    return SandRecipe(
        seed=draw.seed(),
        colours=(usual, patch, damp),
        patch_size_m=draw.ratio(0.5, 6.0),
        patch_strength=draw.uniform(0.1, 0.9),
        damp_cover=draw.uniform(0.05, 0.5) if draw.chance(0.35) else 0.0,
        grain_contrast=draw.ratio(0.09, 0.3),
        grain_tint=draw.uniform(0.0, 0.04),
        grain_slope=draw.uniform(0.3, 1.3),
        grain_relief=draw.ratio(0.08, 0.35),
        specks_per_m2=draw.ratio(30, 6000),
        speck_brightness=draw.uniform(0.1, 0.9),
        mottle_contrast=draw.ratio(0.04, 0.14),
        mottle_slope=draw.uniform(0.4, 1.4),
    )


def _draw_stone(draw: Draw) -> StoneRecipe:
    palettes = (
        ((20, 60), (0.0, 0.12), (0.12, 0.5)),
        ((190, 240), (0.0, 0.1), (0.04, 0.3)),
        ((10, 45), (0.15, 0.5), (0.1, 0.5)),
        ((0, 25), (0.3, 0.65), (0.08, 0.35)),
        ((0, 360), (0.0, 0.15), (0.03, 0.65)),
    )
    chosen = [palettes[draw.whole(0, len(palettes) - 1)] for _ in range(draw.whole(1, 3))]
    colours = tuple(draw.colour(*chosen[i % len(chosen)]) for i in range(6))
    return StoneRecipe(
        seed=draw.seed(),
        colours=colours,
        sand_coloured=draw.uniform(0.0, 0.6),
        dusty=draw.uniform(0.0, 0.8),
        layered=draw.uniform(0.2, 0.9) if draw.chance(0.35) else 0.0,
        contrast=draw.ratio(0.06, 0.25),
        relief=draw.ratio(0.06, 0.3),
        texture_slope=draw.uniform(0.8, 1.8),
    )


def _draw_rocks(draw: Draw, kind: SceneKind) -> RockFieldRecipe:
    covers = {"few": (0.012, 0.02), "small": (0.05, 0.09), "medium": (0.025, 0.045)}
    sizes = {"few": (0.8, 1.3), "small": (0.25, 0.4), "medium": (0.5, 0.75)}
    features = {"few": (4, 6), "small": (4, 8), "medium": (6, 10)}
    feature_sizes = {"few": (0.6, 1.2), "small": (0.2, 0.35), "medium": (0.35, 0.65)}
    largest = draw.uniform(*sizes[kind]) if kind in sizes else draw.ratio(0.2, 1.6)
    flat = draw.uniform(0.15, 0.9)
    low, high = sorted((draw.uniform(0, 1), draw.uniform(0, 1)))
    return RockFieldRecipe(
        seed=draw.seed(),
        cover=draw.ratio(*covers[kind]) if kind in covers else draw.ratio(0.008, 0.16),
        smallest_m=SMALLEST_ROCK_M,
        largest_m=largest,
        feature_rocks=draw.whole(*features[kind]) if kind in features else draw.whole(0, 8),
        feature_size_m=feature_sizes.get(kind, (0.4 * largest, largest)),
        clustered=draw.uniform(0.0, 0.7),
        flatness=(0.15, 0.5) if kind == "small" else (flat * 0.7, min(1.0, flat + 0.35)),
        roundness=(low, high),
        burial=(0.15, draw.uniform(0.3, 0.75)),
        pebbles_per_m2=draw.ratio(0.3, 25.0) if draw.chance(0.85) else 0.0,
    )


SMALLEST_ROCK_M = 0.09
"""Diameter of the smallest stone that is labelled rock."""

LARGEST_PEBBLE_M = 0.07
"""Diameter of the largest that is labelled sand; between the two nothing is drawn, so no label hangs on a hair."""


def draw_sky(draw: Draw, sand_colour: Colour) -> SkyRecipe:
    """A sky; under dusty ones the horizon takes something of the colour of the ground."""
    kind = draw.one_of(("clear", "turbid", "hazy", "overcast"), (4, 2, 2, 2))
    dusty = draw.chance(0.25)
    overcast = draw.uniform(0.75, 1.0) if kind == "overcast" else draw.uniform(0.0, 0.5) ** 2
    pale = draw.uniform(0.7, 1.0)
    zenith, horizon = hsv(draw.uniform(205, 222), draw.uniform(0.45, 0.75), 1.0), (pale, pale, 1.0)
    if kind == "overcast":
        zenith = horizon = hsv(draw.uniform(190, 230), draw.uniform(0.0, 0.12), 1.0)
    elif dusty:
        tint = np.array(sand_colour) / max(sand_colour)
        horizon = as_colour(0.4 + 0.6 * tint)
        zenith = as_colour(0.55 + 0.35 * tint)
    return SkyRecipe(
        kind=kind,
        sun_azimuth_deg=draw.uniform(-180, 180),
        sun_elevation_deg=draw.uniform(12, 70),
        air=draw.uniform(0.05, 0.3) if dusty else draw.uniform(0.7, 1.3),
        dust_depth=draw.uniform(0.2, 0.9) if dusty else draw.uniform(0.02, 0.3),
        dust_blueness=draw.uniform(0.0, 0.4),
        overcast=overcast,
        sky_share=draw.uniform(0.5, 0.9),
        horizon_colour=horizon,
        zenith_colour=zenith,
        cloud_cover=0.0 if kind == "overcast" or dusty else draw.uniform(0.0, 0.8),
        cloud_seed=draw.seed(),
        streaky_clouds=draw.chance(0.5),
        visibility_m=draw.ratio(150, 3000),
    )


def _draw_backdrop(draw: Draw, sand_colour: Colour) -> BackdropRecipe:
    grassy = draw.chance(0.5)
    green = draw.colour((55, 110), (0.25, 0.55), (0.06, 0.22))
    shade = draw.uniform(0.5, 1.1)
    bare = as_colour(c * shade * draw.ratio(0.93, 1.07) for c in sand_colour)
    return BackdropRecipe(
        seed=draw.seed(),
        sea=draw.chance(0.4),
        sea_direction_deg=draw.uniform(0, 360),
        sea_distance_m=draw.uniform(25, 70),
        ridge_distance_m=draw.uniform(35, 140),
        ridge_height_m=draw.ratio(1.0, 16.0),
        ridge_colours=(green if grassy else bare, bare),
        clutter=draw.whole(1, 7) if draw.chance(0.5) else 0,
    )


def _draw_exposure(draw: Draw) -> ExposureRecipe:
    warm = draw.uniform(-0.08, 0.08)
    return ExposureRecipe(
        level=draw.ratio(0.13, 0.34),
        gamma=draw.uniform(1.8, 2.4),
        contrast=draw.uniform(0.0, 0.35),
        white_balance=(1 + warm, 1 + draw.uniform(-0.03, 0.03), 1 - warm),
        saturation=draw.uniform(0.65, 1.2),
        vignetting=draw.uniform(0.0, 0.35),
        blur_px=draw.uniform(0.3, 0.8),
        photons=draw.ratio(3000, 20000),
        read_noise=draw.ratio(0.0008, 0.004),
        mosaic=draw.chance(0.6),
    )


def _draw_drive(draw: Draw) -> DriveRecipe:
    midnight_s = calendar.timegm((2015, 11, draw.whole(1, 28), 0, 0, 0))
    return DriveRecipe(
        seed=draw.seed(),
        heading_deg=draw.uniform(-180, 180),
        bend_per_m=draw.uniform(-0.06, 0.06),
        wander_per_m=draw.uniform(0.0, 0.05),
        speed_m_s=draw.uniform(0.2, 0.35),
        start_time_s=midnight_s + draw.whole(9 * 3600_000, 15 * 3600_000) / 1000,
        # On the beach of the data set, to whole metres.
        site_utm_m=(595000.0 + draw.whole(0, 900), 5785000.0 + draw.whole(0, 1500), 44.0 + draw.whole(-10, 10) / 10),
    )


def _with_sun_behind(sky: SkyRecipe, drive: DriveRecipe, draw: Draw) -> SkyRecipe:
    """A clear sun, low behind the rover, so that its shadow falls into its own view."""
    return replace(
        sky,
        kind="clear",
        sun_azimuth_deg=drive.heading_deg + 180 + draw.uniform(-25, 25),
        sun_elevation_deg=draw.uniform(18, 32),
        overcast=draw.uniform(0.0, 0.1),
    )

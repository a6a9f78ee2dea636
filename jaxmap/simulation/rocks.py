"""Which rocks lie where: sizes as on Mars, some in groups, none inside another or under the rover's wheels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from jaxmap.simulation.draw import LARGEST_PEBBLE_M, Draw, as_colour
from jaxmap.simulation.recipe import Colour, RockFieldRecipe, SandRecipe, StoneRecipe

PATH_CLEARANCE_M = 0.45
"""Half of the width that the rover drives over: no rock reaches into it."""


@dataclass(frozen=True)
class Rock:
    """One rock or pebble.

    Attributes:
        x_m, y_m: where its middle lies.
        diameter_m: mean horizontal diameter.
        height_m: of the whole stone, with what is in the ground.
        stretch: length over width.
        heading_rad: direction of its length.
        tilt_rad: how far it leans, and `lean_rad` which way.
        burial: the part of its height that is in the ground.
        roundness: 0 sharp-edged, 1 a pebble.
        roughness: height of its bumps over its diameter.
        layers: layers it is built of, 0 for none.
        dust: 0 clean to 1 covered with sand on top.
        colour: linear reflectance.
        seed: of its shape.
    """

    x_m: float
    y_m: float
    diameter_m: float
    height_m: float
    stretch: float
    heading_rad: float
    tilt_rad: float
    lean_rad: float
    burial: float
    roundness: float
    roughness: float
    layers: int
    dust: float
    colour: Colour
    seed: int


def cumulative_cover(diameter_m: np.ndarray, k: float) -> np.ndarray:
    """Share of the ground under rocks of a diameter and more, Golombek and Rapp (1997)."""
    return k * np.exp(-(1.79 + 0.152 / k) * diameter_m)


def size_density(diameter_m: np.ndarray, k: float) -> np.ndarray:
    """Rocks per square metre and metre of diameter: the cover's derivative over the area of one rock."""
    q = 1.79 + 0.152 / k
    return k * q * np.exp(-q * diameter_m) / (np.pi / 4 * diameter_m**2)


def draw_diameters(recipe: RockFieldRecipe, area_m2: float, rng: np.random.Generator) -> Float[np.ndarray, "N"]:
    """Diameters of the rocks that chance puts on so large a ground, the biggest first."""
    edges = np.geomspace(recipe.smallest_m, recipe.largest_m, 400)
    middle = np.sqrt(edges[1:] * edges[:-1])
    expected = size_density(middle, recipe.cover) * np.diff(edges) * area_m2
    cumulative = np.concatenate([[0], np.cumsum(expected)])
    places = rng.uniform(0, cumulative[-1], rng.poisson(cumulative[-1]))
    return np.sort(np.interp(places, cumulative, edges))[::-1]


def draw_rocks(
    recipe: RockFieldRecipe,
    stone: StoneRecipe,
    sand: SandRecipe,
    path_m: Float[np.ndarray, "P 2"],
    reach_m: float,
    feature_places_m: Float[np.ndarray, "Q 2"],
    most: int = 4000,
) -> list[Rock]:
    """The rocks within `reach_m` of a driven path; big ones first at the places given, so far as free.

    Args:
        recipe: sizes and shapes.
        stone: colours.
        sand: the ground's, for rocks of its colour.
        path_m: points of the path of the rover's middle.
        reach_m: how far from it rocks lie.
        feature_places_m: where `feature_rocks` may be put, in order.
        most: at most so many, the smallest left out.
    """
    draw = Draw(recipe.seed, "field")
    lower, upper = path_m.min(axis=0) - reach_m, path_m.max(axis=0) + reach_m
    diameters = draw_diameters(recipe, float(np.prod(upper - lower)), draw.rng)[:most]
    places = _places(recipe, lower, upper, len(diameters), draw.rng)
    features = feature_places_m[: recipe.feature_rocks]
    sizes = draw.rng.uniform(*recipe.feature_size_m, len(features))
    places, diameters = np.concatenate([features, places]), np.concatenate([sizes, diameters])
    on_path = KDTree(path_m).query(places)[0]
    kept = on_path > PATH_CLEARANCE_M + 0.75 * diameters
    kept &= on_path < reach_m
    kept[kept] = _apart(places[kept], diameters[kept])
    shape = Draw(recipe.seed, "shapes")
    return [
        _draw_rock(place, size, recipe, stone, sand, shape)
        for place, size in zip(places[kept], diameters[kept], strict=True)
    ]


def draw_pebbles(
    recipe: RockFieldRecipe,
    stone: StoneRecipe,
    sand: SandRecipe,
    path_m: Float[np.ndarray, "P 2"],
    reach_m: float,
    most: int = 6000,
) -> list[Rock]:
    """Stones too small to count as rock, down to 1 cm, near the path and ever fewer away from it."""
    draw = Draw(recipe.seed, "pebbles")
    lower, upper = path_m.min(axis=0) - reach_m, path_m.max(axis=0) + reach_m
    count = min(draw.rng.poisson(recipe.pebbles_per_m2 * float(np.prod(upper - lower))), 20 * most)
    places = draw.rng.uniform(lower, upper, (count, 2))
    distance = KDTree(path_m).query(places)[0]
    keep = draw.rng.random(count) < 1.0 - distance / reach_m
    places = places[keep][:most]
    # As rocks do, they grow many as they grow small: their number falls with the square of the diameter.
    diameters = 1 / draw.rng.uniform(1 / LARGEST_PEBBLE_M, 1 / 0.012, len(places))
    shape = Draw(recipe.seed, "pebble shapes")
    return [_draw_rock(place, size, recipe, stone, sand, shape) for place, size in zip(places, diameters, strict=True)]


def _places(
    recipe: RockFieldRecipe, lower: np.ndarray, upper: np.ndarray, count: int, rng: np.random.Generator
) -> np.ndarray:
    places = rng.uniform(lower, upper, (count, 2))
    groups = rng.uniform(lower, upper, (max(1, int(np.prod(upper - lower) / 30)), 2))
    grouped = rng.random(count) < recipe.clustered
    around = groups[rng.integers(0, len(groups), count)] + rng.normal(0, 0.7, (count, 2))
    return np.where(grouped[:, None], around, places)


def _apart(places: np.ndarray, diameters: np.ndarray) -> np.ndarray:
    """Which to keep so that none lies in one before it."""
    keep = np.ones(len(places), bool)
    if len(places) < 2:
        return keep
    for first, second in sorted(KDTree(places).query_pairs(1.2 * float(diameters.max()))):
        gap = np.linalg.norm(places[first] - places[second])
        if keep[first] and gap < 0.55 * (diameters[first] + diameters[second]):
            keep[second] = False
    return keep


def _draw_rock(
    place: np.ndarray, diameter: float, recipe: RockFieldRecipe, stone: StoneRecipe, sand: SandRecipe, draw: Draw
) -> Rock:
    flatness = draw.uniform(*recipe.flatness)
    like_sand, shade = draw.chance(stone.sand_coloured), draw.ratio(0.75, 1.33)
    plain = sand.colours[0] if like_sand else stone.colours[draw.whole(0, len(stone.colours) - 1)]
    colour = as_colour(c * shade * draw.ratio(0.96, 1.04) for c in plain)
    layered = draw.chance(stone.layered)
    return Rock(
        x_m=float(place[0]),
        y_m=float(place[1]),
        diameter_m=float(diameter),
        height_m=float(diameter * flatness),
        stretch=draw.ratio(1.0, 1.9),
        heading_rad=draw.uniform(0, 2 * np.pi),
        tilt_rad=abs(draw.rng.normal(0, 0.2)),
        lean_rad=draw.uniform(0, 2 * np.pi),
        burial=draw.uniform(*recipe.burial),
        roundness=draw.uniform(*recipe.roundness),
        roughness=draw.ratio(0.006, 0.06),
        layers=draw.whole(3, 9) if layered else 0,
        dust=draw.uniform(0.2, 1.0) if draw.chance(stone.dusty) else 0.0,
        colour=colour,
        seed=draw.seed(),
    )

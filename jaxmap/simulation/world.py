"""A whole world, built from its recipe: ground, rocks, pebbles, backdrop, light, and the rover's path through it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from jaxmap.simulation.backdrop import backdrop_meshes, clutter_meshes
from jaxmap.simulation.drive import Path
from jaxmap.simulation.marks import Marks, make_marks
from jaxmap.simulation.mesh import Mesh, Surface, join
from jaxmap.simulation.recipe import WorldRecipe
from jaxmap.simulation.rock_shapes import Height, stone_meshes, subdivisions_for
from jaxmap.simulation.rocks import Rock, draw_pebbles, draw_rocks
from jaxmap.simulation.terrain import Ground, ground_mesh

ROCK_REACH_M, PEBBLE_REACH_M, MARKS_REACH_M = 32.0, 9.0, 12.5
"""How far from the path there are rocks, pebbles and marks."""

WHEEL_FEEL_M = 0.15
"""The rover's wheels do not feel what is finer."""


class Points(NamedTuple):
    """The points of a mesh of the ground: x, y, spacing (N,) and triangles."""

    x: Float[np.ndarray, "N"]
    y: Float[np.ndarray, "N"]
    spacing_m: Float[np.ndarray, "N"]
    faces: np.ndarray


class World(NamedTuple):
    """What was built; `mesh` holds everything, and its parts number the rocks."""

    recipe: WorldRecipe
    ground: Ground
    marks: Marks
    rocks: list[Rock]
    pebbles: list[Rock]
    mesh: Mesh


def build_world(
    recipe: WorldRecipe,
    path: Path,
    points: Points,
    feature_places_m: Float[np.ndarray, "Q 2"],
    in_view: tuple[Float[np.ndarray, "2"], float, float] | None = None,
) -> World:
    """Builds a world around a path.

    Args:
        recipe: all that was drawn.
        path: where the rover drives; rocks keep off it.
        points: where the mesh of the ground has its vertices.
        feature_places_m: where the recipe's big rocks may lie, in order.
        in_view: where the only camera stands, its heading and half the angle it sees (radians):
            stones elsewhere are left out.
    """
    ground = Ground(recipe.relief, recipe.sand, recipe.backdrop)
    line = path.points_m[::4]
    rocks = draw_rocks(recipe.rocks, recipe.stone, recipe.sand, line, ROCK_REACH_M, feature_places_m)
    pebbles = draw_pebbles(recipe.rocks, recipe.stone, recipe.sand, line, PEBBLE_REACH_M)
    if in_view is not None:
        rocks, pebbles = ([one for one in stones if _is_in_view(one, *in_view)] for stones in (rocks, pebbles))
    marks = make_marks(recipe.relief, rocks, line.min(axis=0) - MARKS_REACH_M, line.max(axis=0) + MARKS_REACH_M)
    height = ground.height_m(points.x, points.y, points.spacing_m)
    added, disturbed = marks.at(points.x, points.y)
    colour = ground.colour(points.x, points.y, height) * (1 - 0.22 * disturbed)[:, None]
    meshes = [ground_mesh(points.x, points.y, height + added, colour, points.faces)]

    tree = KDTree(line)
    bare = bare_ground(ground)
    for stones, surface in ((rocks, Surface.ROCK), (pebbles, Surface.PEBBLE)):
        if stones:
            distance = tree.query([(stone.x_m, stone.y_m) for stone in stones])[0]
            fineness = [subdivisions_for(stone.diameter_m, gap) for stone, gap in zip(stones, distance, strict=True)]
            meshes.append(stone_meshes(stones, fineness, bare, recipe.sand.colours[0], surface))
    meshes += backdrop_meshes(recipe.backdrop, bare)
    meshes += clutter_meshes(recipe.backdrop, bare, path.points_m)
    return World(recipe, ground, marks, rocks, pebbles, join(meshes))


def bare_ground(ground: Ground, spacing_m: float = 0.05) -> Height:
    """The height of the ground without marks, smoothed to a spacing."""
    return lambda x, y: ground.height_m(np.asarray(x, np.float32), np.asarray(y, np.float32), spacing_m)


def _is_in_view(stone: Rock, camera_m: np.ndarray, heading_rad: float, half_angle_rad: float) -> bool:
    east, north = stone.x_m - camera_m[0], stone.y_m - camera_m[1]
    off = (np.arctan2(north, east) - heading_rad + np.pi) % (2 * np.pi) - np.pi
    # What lies close by casts its shadow into the view from the side, too.
    return bool(abs(off) < half_angle_rad or np.hypot(east, north) < 2.5)

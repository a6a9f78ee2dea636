"""What lies beyond the sand: the sea, dunes and ridges, and people, poles and boxes standing about."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from jaxmap.simulation.draw import Draw, hsv
from jaxmap.simulation.mesh import Mesh, Surface, grid_faces, icosphere, join, make_mesh
from jaxmap.simulation.noise import fractal_noise, smoothstep
from jaxmap.simulation.recipe import BackdropRecipe
from jaxmap.simulation.rock_shapes import Height

_FARTHEST_M = 900.0


def backdrop_meshes(recipe: BackdropRecipe, ground_m: Height) -> list[Mesh]:
    """The ridge all around and, where there is one, the sea."""
    meshes = [_ridge(recipe, ground_m)]
    if recipe.sea:
        meshes.append(_sea(recipe))
    return meshes


def _ridge(recipe: BackdropRecipe, ground_m: Height) -> Mesh:
    """A ring of hills, low towards the sea, noise all over, grass or bare earth by patches."""
    angles = np.linspace(0, 2 * np.pi, 721)
    shares = np.concatenate([[0.0, 0.12], np.linspace(0.15, 1.0, 40), [1.5, 3.0]])
    angle, share = np.meshgrid(angles, shares)
    around = [3 * np.cos(angle), 3 * np.sin(angle)]
    distance = recipe.ridge_distance_m * (
        1 + 0.25 * np.clip(fractal_noise(around, recipe.seed, wavelength=2.0), -1.5, 2)
    )
    radius = distance * (1 + 0.9 * share)
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    profile = smoothstep(share, 0.0, 1.0) * (
        1 + 0.5 * fractal_noise(around, recipe.seed + 1, wavelength=1.1, octaves=5)
    )
    if recipe.sea:
        towards_sea = np.cos(angle - np.deg2rad(recipe.sea_direction_deg))
        profile = profile * smoothstep(towards_sea, 0.35, -0.1)
    rough = fractal_noise([x, y], recipe.seed + 2, wavelength=recipe.ridge_height_m * 2 + 2, octaves=5)
    height = recipe.ridge_height_m * (
        np.maximum(profile, 0.03 * share) + 0.1 * smoothstep(share, 0, 0.5) * rough * profile
    )
    foot = ground_m(x, y) - 0.15
    z = np.where(share <= 0.15, foot, foot[2] + height)
    first, second = (np.array(colour) for colour in recipe.ridge_colours)
    mix = smoothstep(fractal_noise([x, y], recipe.seed + 3, wavelength=6.0, octaves=6, gain=0.7), -0.7, 0.7)[..., None]
    fleck = 1 + 0.25 * np.clip(fractal_noise([x, y], recipe.seed + 4, wavelength=0.9, octaves=3), -2, 2)[..., None]
    colour = np.clip((first + (second - first) * mix) * fleck, 0.02, 0.8)
    vertices = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    return make_mesh(vertices, grid_faces(*share.shape)[:, ::-1], colour.reshape(-1, 3), Surface.SCENERY)


def _sea(recipe: BackdropRecipe) -> Mesh:
    """A level sheet of water; the beach dips under it where the sea begins."""
    angle = np.deg2rad(recipe.sea_direction_deg)
    outward, along = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    level = -0.05 * 0.4 * recipe.sea_distance_m
    corners = [
        outward * (0.75 * recipe.sea_distance_m + (_FARTHEST_M if far else 0)) + along * side * _FARTHEST_M
        for far in (False, True)
        for side in (1, -1)
    ]
    vertices = np.array([[*corner, level] for corner in corners])
    return make_mesh(vertices, np.array([[0, 1, 3], [0, 3, 2]]), (0.03, 0.06, 0.07), Surface.WATER)


def clutter_meshes(recipe: BackdropRecipe, ground_m: Height, path_m: Float[np.ndarray, "P 2"]) -> list[Mesh]:
    """Things that are no part of a beach, at some distance from the path and in front of it."""
    draw = Draw(recipe.seed, "clutter")
    ahead = path_m[-1] - path_m[0]
    heading = np.arctan2(ahead[1], ahead[0])
    meshes = []
    for _ in range(recipe.clutter):
        angle, distance = heading + draw.uniform(-0.8, 0.8), draw.ratio(6.0, 35.0)
        x, y = path_m[-1] + distance * np.array([np.cos(angle), np.sin(angle)])
        z = float(ground_m(np.array([x], np.float32), np.array([y], np.float32))[0])
        make = draw.one_of((_person, _pole, _box, _tent), (4, 2, 2, 1))
        thing = make(draw)
        turn = draw.uniform(0, 2 * np.pi)
        R = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
        meshes.append(thing._replace(vertices_m=(thing.vertices_m @ R.T + (x, y, z)).astype(np.float32)))
    return meshes


def _ellipsoid(centre: tuple[float, float, float], radii: tuple[float, float, float], colour: object) -> Mesh:
    vertices, faces = icosphere(2)
    return make_mesh(vertices * radii + centre, faces, np.asarray(colour), Surface.SCENERY)


def box_mesh(centre: tuple[float, float, float], size: tuple[float, float, float], colour: object) -> Mesh:
    """A box as scenery; edges along the axes."""
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    # Corners of their own for each side keep its edges sharp when normals are smoothed.
    vertices = np.concatenate([corners[list(side)] for side in sides]) * size + centre
    faces = np.concatenate([[[4 * i, 4 * i + 1, 4 * i + 2], [4 * i, 4 * i + 2, 4 * i + 3]] for i in range(6)])
    return make_mesh(vertices, faces, np.asarray(colour), Surface.SCENERY)


def _any_colour(draw: Draw) -> tuple[float, float, float]:
    return hsv(draw.uniform(0, 360), draw.uniform(0, 0.9), draw.ratio(0.03, 0.8))


def _person(draw: Draw) -> Mesh:
    tall = draw.uniform(1.5, 1.95)
    coat, trousers, skin = _any_colour(draw), _any_colour(draw), draw.colour((15, 30), (0.3, 0.6), (0.1, 0.6))
    step = draw.uniform(0.05, 0.3)
    parts = [
        _ellipsoid((0, 0, 0.67 * tall), (0.15, 0.21, 0.2 * tall), coat),
        _ellipsoid((0, 0, 0.5 * tall), (0.15, 0.18, 0.07 * tall), trousers),
        _ellipsoid((0, 0, 0.93 * tall), (0.1, 0.09, 0.075 * tall), skin),
        _ellipsoid((0, 0, 0.85 * tall), (0.07, 0.07, 0.06 * tall), skin),
    ]
    for side in (-1, 1):
        parts.append(_ellipsoid((side * step / 2, side * 0.09, 0.27 * tall), (0.09, 0.09, 0.28 * tall), trousers))
        parts.append(_ellipsoid((0.05 * side, side * 0.23, 0.63 * tall), (0.07, 0.07, 0.19 * tall), coat))
    return join(parts)


def _pole(draw: Draw) -> Mesh:
    height, width = draw.uniform(0.8, 4.0), draw.uniform(0.03, 0.12)
    return box_mesh((0, 0, height / 2), (width, width, height), _any_colour(draw))


def _box(draw: Draw) -> Mesh:
    size = draw.uniform(0.3, 1.2), draw.uniform(0.3, 1.2), draw.uniform(0.2, 0.9)
    return box_mesh((0, 0, size[2] / 2), size, _any_colour(draw))


def _tent(draw: Draw) -> Mesh:
    length, width, height = draw.uniform(1.5, 3.0), draw.uniform(1.5, 2.5), draw.uniform(1.0, 2.2)
    x, y = length / 2, width / 2
    vertices = np.array([[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0], [-x, 0, height], [x, 0, height]])
    faces = np.array([[0, 1, 5], [0, 5, 4], [2, 3, 4], [2, 4, 5], [0, 4, 3], [1, 2, 5]])
    return make_mesh(vertices[faces].reshape(-1, 3), np.arange(18).reshape(6, 3), _any_colour(draw), Surface.SCENERY)

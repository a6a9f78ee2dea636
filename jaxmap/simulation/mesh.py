"""Triangle meshes: what the parts of a world are built as and what is rendered."""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt8

from jaxmap.labels import ROVER_CLASSES
from jaxmap.simulation.recipe import Colour

BACKGROUND, SAND, ROCK = (ROVER_CLASSES.index(name) for name in ("background", "sand", "rock"))


class Surface(IntEnum):
    """What a triangle is made of; it decides its label and how it is shaded."""

    SAND = 0
    ROCK = 1
    PEBBLE = 2
    SCENERY = 3
    WATER = 4


SURFACE_LABEL = np.array([SAND, ROCK, SAND, BACKGROUND, BACKGROUND], np.uint8)
"""Label of each `Surface`: pebbles are part of the sand."""


class Mesh(NamedTuple):
    """Triangles with colours and surfaces.

    Attributes:
        vertices_m: positions (V, 3) in the world (x east, y north, z up).
        faces: vertex indices (F, 3), counter-clockwise seen from outside.
        colours: linear RGB reflectance of each vertex (V, 3).
        surface: `Surface` of each triangle (F,).
        part: running number of the rock (or other part) each triangle belongs to, -1 for none (F,).
    """

    vertices_m: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]
    colours: Float[np.ndarray, "V 3"]
    surface: UInt8[np.ndarray, "F"]
    part: Int[np.ndarray, "F"]


def make_mesh(
    vertices_m: np.ndarray, faces: np.ndarray, colours: np.ndarray | Colour, surface: Surface, part: int = -1
) -> Mesh:
    """A mesh of one surface; `colours` may be one colour for all."""
    return Mesh(
        np.asarray(vertices_m, np.float32),
        np.asarray(faces, np.int32),
        np.broadcast_to(np.asarray(colours, np.float32), np.shape(vertices_m)),
        np.full(len(faces), surface, np.uint8),
        np.full(len(faces), part, np.int32),
    )


def join(meshes: Sequence[Mesh]) -> Mesh:
    """All triangles in one mesh, in their order."""
    starts = np.cumsum([0] + [len(mesh.vertices_m) for mesh in meshes[:-1]])
    return Mesh(
        np.concatenate([mesh.vertices_m for mesh in meshes]),
        np.concatenate([mesh.faces + np.int32(start) for mesh, start in zip(meshes, starts, strict=True)]),
        np.concatenate([mesh.colours for mesh in meshes]),
        np.concatenate([mesh.surface for mesh in meshes]),
        np.concatenate([mesh.part for mesh in meshes]),
    )


def vertex_normals(vertices_m: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> Float[np.ndarray, "V 3"]:
    """Unit normals of vertices: the mean of their triangles' normals, weighted by area."""
    first, second, third = (vertices_m[faces[:, corner]] for corner in range(3))
    across = np.cross(second - first, third - first)
    normals = np.empty_like(vertices_m)
    for axis in range(3):
        weights = np.repeat(across[:, axis], 3)
        normals[:, axis] = np.bincount(faces.reshape(-1), weights, minlength=len(vertices_m))
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)


def grid_faces(rows: int, columns: int) -> Int[np.ndarray, "F 3"]:
    """Triangles between the vertices of a grid, row after row; upwards where rows go north and columns east."""
    index = np.arange(rows * columns, dtype=np.int32).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    return np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], 2).reshape(-1, 3)


@lru_cache(maxsize=8)
def icosphere(subdivisions: int) -> tuple[np.ndarray, np.ndarray]:
    """The icosahedron, each triangle split in four so many times, on the unit sphere.

    Returns:
        float64 vertices (10 * 4^n + 2, 3) and int32 faces (20 * 4^n, 3); not to be written to.
    """
    phi = (1 + 5**0.5) / 2
    corners = [(0, s, t * phi) for s in (-1, 1) for t in (-1, 1)]
    vertices = np.array([np.roll(corner, shift) for shift in range(3) for corner in corners], float)
    vertices /= np.linalg.norm(vertices[0])
    distance = np.linalg.norm(vertices[:, None] - vertices[None], axis=2)
    near = distance < 1.1
    faces = [
        (a, b, c)
        for a in range(12)
        for b in range(a + 1, 12)
        for c in range(b + 1, 12)
        if near[a, b] and near[b, c] and near[a, c]
    ]
    faces = np.array([f if np.linalg.det(vertices[list(f)]) > 0 else f[::-1] for f in faces])
    for _ in range(subdivisions):
        vertices, faces = _split(vertices, faces)
    return vertices, faces.astype(np.int32)


def _split(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    unique, inverse = np.unique(edges, axis=0, return_inverse=True)
    middles = vertices[unique].sum(axis=1)
    middles /= np.linalg.norm(middles, axis=1, keepdims=True)
    ab, bc, ca = (inverse.reshape(-1) + len(vertices)).reshape(3, -1)
    a, b, c = faces.T
    parts = [np.stack(corners, 1) for corners in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
    return np.concatenate([vertices, middles]), np.concatenate(parts)

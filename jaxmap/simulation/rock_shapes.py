"""Meshes of rocks: rounded polyhedra with bumps and layers, leaning and sunk into the ground.

All stones of a world are shaped together: an array operation over all their vertices costs little
more than one over those of a single stone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxmap.simulation.mesh import Mesh, Surface, icosphere, vertex_normals
from jaxmap.simulation.noise import fractal_noise, smoothstep
from jaxmap.simulation.recipe import Colour
from jaxmap.simulation.rocks import Rock

Height = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Height of the ground over world x and y."""


def stone_meshes(
    stones: Sequence[Rock], subdivisions: Sequence[int], ground_m: Height, sand: Colour, surface: Surface
) -> Mesh:
    """The meshes of all stones where they lie, in one; its parts are their places in the list.

    Args:
        stones: rocks or pebbles.
        subdivisions: of the icosphere that each is made from (`subdivisions_for`).
        ground_m: height of the ground.
        sand: colour of the sand that lies on them.
        surface: rock or pebble.
    """
    spheres = [icosphere(count) for count in subdivisions]
    counts = np.array([len(directions) for directions, _ in spheres])
    starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
    faces = np.concatenate([faces + start for (_, faces), start in zip(spheres, starts, strict=True)])
    per_face = np.repeat(np.arange(len(stones)), [len(faces) for _, faces in spheres])
    owner = np.repeat(np.arange(len(stones)), counts)
    base = np.concatenate(
        [
            directions * _radius(directions, stone)[:, None]
            for (directions, _), stone in zip(spheres, stones, strict=True)
        ]
    )
    noise_at = list((base + _scatter(stones)[owner]).T)
    points = _layered(_bumpy(base, noise_at, stones, owner), noise_at, stones, owner)
    vertices, ground = _placed(points, stones, starts, counts, ground_m)
    colours = _colours(vertices, vertex_normals(vertices, faces), noise_at, stones, owner, ground, sand)
    return Mesh(
        vertices.astype(np.float32),
        faces.astype(np.int32),
        colours.astype(np.float32),
        np.full(len(faces), surface, np.uint8),
        per_face.astype(np.int32),
    )


def subdivisions_for(diameter_m: float, distance_m: float, pixel_rad: float = 0.0012) -> int:
    """How finely a stone is split so that its edges are some pixels long at this distance."""
    pixels = diameter_m / (max(distance_m, 1.0) * pixel_rad)
    return int(np.clip(np.ceil(np.log2(max(pixels, 1.0) / 8.0)), 1, 6))


def _radius(directions: Float[np.ndarray, "V 3"], stone: Rock) -> Float[np.ndarray, "V"]:
    """Of a stone about as big as the unit sphere: a soft least distance to planes, so that facets have worn edges."""
    rng = np.random.default_rng([stone.seed, 0x40C4])
    normals = rng.normal(size=(int(rng.integers(7, 16)), 3))
    if rng.random() < 0.35:
        # Blocks break along three planes that stand nearly upright on each other.
        axes = np.concatenate([np.eye(3), -np.eye(3)]) + rng.normal(0, 0.12, (6, 3))
        normals = np.concatenate([axes, normals[:3]])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    # A ball of planes all around closes the stone, whatever was drawn.
    closing, _ = icosphere(0)
    offsets = np.concatenate([rng.uniform(0.55, 1.0, len(normals)), np.full(len(closing), 1.15)])
    power = 6.0 + 60.0 * (1 - stone.roundness) ** 2
    slopes = np.maximum(directions @ np.concatenate([normals, closing]).T, 0) / offsets
    # Over the greatest one, lest a high power leave the range of floats.
    greatest = slopes.max(axis=1, keepdims=True)
    return 1 / (greatest[:, 0] * ((slopes / greatest) ** power).sum(axis=1) ** (1 / power))


def _scatter(stones: Sequence[Rock]) -> Float[np.ndarray, "N 3"]:
    """Where in the one field of noise each stone is cut from."""
    return np.array([np.random.default_rng([stone.seed, 0x5CA7]).uniform(-300, 300, 3) for stone in stones])


def _bumpy(base: np.ndarray, noise_at: list[np.ndarray], stones: Sequence[Rock], owner: np.ndarray) -> np.ndarray:
    roughness = np.array([stone.roughness for stone in stones])[owner]
    roundness = np.array([stone.roundness for stone in stones])[owner]
    pitted = np.array([stone.seed % 4 == 0 for stone in stones])[owner]
    bumps = 1.2 * fractal_noise(noise_at, 11, wavelength=1.5, octaves=2) * (0.3 + 0.7 * roundness)
    fine = np.empty(len(base), np.float32)
    for ridged in (False, True):
        chosen = pitted == ridged
        fine[chosen] = fractal_noise(
            [axis[chosen] for axis in noise_at], 12, wavelength=0.45, octaves=4, gain=0.55, ridged=ridged
        )
    return base * (1 + np.clip(roughness * (bumps + fine), -0.3, 0.4))[:, None]


def _layered(points: np.ndarray, noise_at: list[np.ndarray], stones: Sequence[Rock], owner: np.ndarray) -> np.ndarray:
    """Soft layers weather back, hard ones stand out, along a direction near the vertical."""
    layers = np.array([stone.layers for stone in stones])[owner]
    chosen = layers > 0
    if not chosen.any():
        return points
    rng = np.random.default_rng([stones[0].seed, 0x1A7E])
    axes = Rotation.from_rotvec(rng.normal(0, 0.25, (len(stones), 3))).apply([0, 0, 1])[owner[chosen]]
    depth = rng.uniform(0.04, 0.14, len(stones))[owner[chosen]]
    along = (points[chosen] * axes).sum(axis=1)
    wave = 0.25 * fractal_noise([axis[chosen] for axis in noise_at], 13, wavelength=0.9, octaves=2)
    phase = (along * layers[chosen] / 2 + wave) % 1
    shelf = smoothstep(phase, 0.0, 0.12) * smoothstep(phase, 0.85, 0.6)
    sideways = points[chosen] - along[:, None] * axes
    result = points.copy()
    result[chosen] -= sideways * (depth * (1 - shelf))[:, None]
    return result


def _placed(
    points: np.ndarray, stones: Sequence[Rock], starts: np.ndarray, counts: np.ndarray, ground_m: Height
) -> tuple[np.ndarray, np.ndarray]:
    """The vertices in the world, and the height of the ground under each stone."""
    lowest, highest = np.minimum.reduceat(points, starts), np.maximum.reduceat(points, starts)
    places = np.array([(stone.x_m, stone.y_m) for stone in stones], np.float32)
    ground = ground_m(places[:, 0], places[:, 1]).astype(np.float64)
    vertices = np.empty_like(points)
    for index, stone in enumerate(stones):
        part = slice(starts[index], starts[index] + counts[index])
        size = stone.diameter_m * stone.stretch**0.5, stone.diameter_m * stone.stretch**-0.5, stone.height_m
        middle, span = (highest[index] + lowest[index]) / 2, highest[index] - lowest[index]
        shape = (points[part] - middle) * (np.array(size) / span) @ _attitude(stone).T
        low, high = shape[:, 2].min(), shape[:, 2].max()
        shape[:, 2] += ground[index] - low - stone.burial * (high - low)
        shape[:, :2] += (stone.x_m, stone.y_m)
        vertices[part] = shape
    return vertices, ground


def _attitude(stone: Rock) -> Float[np.ndarray, "3 3"]:
    lean = stone.tilt_rad * np.array([np.cos(stone.lean_rad), np.sin(stone.lean_rad), 0.0])
    return (Rotation.from_rotvec(lean) * Rotation.from_euler("z", stone.heading_rad)).as_matrix()


def _colours(
    vertices: np.ndarray,
    normals: np.ndarray,
    noise_at: list[np.ndarray],
    stones: Sequence[Rock],
    owner: np.ndarray,
    ground: np.ndarray,
    sand: Colour,
) -> Float[np.ndarray, "V 3"]:
    own = np.array([stone.colour for stone in stones])[owner]
    layered = np.array([stone.layers > 0 for stone in stones])[owner]
    dust = np.array([stone.dust for stone in stones])[owner]
    height = np.array([stone.height_m for stone in stones])[owner]
    patches = fractal_noise(noise_at, 21, wavelength=1.2, octaves=3)
    bands = fractal_noise([vertices[:, 2] / height + owner], 22, wavelength=0.25, octaves=3)
    colour = own * (1 + 0.13 * patches + 0.12 * bands * layered)[:, None]
    lying = normals[:, 2] + 0.12 * fractal_noise(noise_at, 23, wavelength=0.6, octaves=3)
    share = dust * smoothstep(lying - 0.95 + 0.5 * dust, 0.0, 0.2)
    # Sand that is blown against the foot clings to its lowest few centimetres.
    above = vertices[:, 2] - ground[owner]
    share = np.maximum(share, 0.45 * (dust > 0) * smoothstep(above / (0.12 * height + 0.01), 1.0, 0.0))
    return np.clip(colour + (np.array(sand) - colour) * share[:, None], 0.015, 0.9)

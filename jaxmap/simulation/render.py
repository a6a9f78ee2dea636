"""A path tracer over Mitsuba's rays: sun, sky, one bounce, textures in space, water and haze.

The ground's grain is far finer than any mesh, so textures are looked up at the points that are hit,
and the sun and the sky are no emitters of the scene but functions of direction. Each sample of a
pixel costs four rays: the pixel's, one to the sun, one bounce, one from there to the sun.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int

from jaxmap.simulation.lighting import Lighting
from jaxmap.simulation.materials import Textures
from jaxmap.simulation.mesh import Mesh, vertex_normals
from jaxmap.simulation.rays import RayImage, pixel_offsets
from jaxmap.simulation.shading import Shading
from jaxmap.simulation.tracer import load_mitsuba, make_scene, run_kernel

# Powers of the inverse of the generalised golden ratio in four dimensions (Roberts 2018).
_ALPHAS = (1.0 / 1.1673039782614187 ** np.arange(1, 5)).astype(np.float32)[:, None, None]


_MOST_LANES = 1 << 20
"""Rays traced in one go: starting a kernel costs some hundredths of a second, and each ray some hundred bytes."""


class FirstHits(NamedTuple):
    """What the middle of each pixel sees: triangle (-1 for sky) and ray parameter (0 for sky)."""

    face: Int[np.ndarray, "H W"]
    depth: Float32[np.ndarray, "H W"]


class Renderer:
    """A world ready to be rendered, again and again, from anywhere.

    Args:
        world: all that is seen.
        textures: the grain of sand and rock.
        lighting: sun, sky and haze.
        rover: a mesh in the body frame that is not seen itself but keeps light away.
    """

    def __init__(self, world: Mesh, textures: Textures, lighting: Lighting, rover: Mesh | None = None) -> None:
        self._world, self._textures, self._lighting, self._rover = world, textures, lighting, rover
        self._scene = make_scene(world.vertices_m, world.faces)
        self._rover_scene = None if rover is None else make_scene(rover.vertices_m, rover.faces)
        self._normals = vertex_normals(world.vertices_m, world.faces)
        self._shading = Shading(self._scene, world, self._normals, textures, lighting)

    def relight(self, lighting: Lighting) -> None:
        """Puts another sun and sky over the world."""
        self._lighting = lighting
        self._shading = Shading(self._scene, self._world, self._normals, self._textures, lighting)

    def place_rover(self, T_world_body: Float[np.ndarray, "4 4"] | None) -> None:
        """Puts the rover somewhere, or (None) takes it away."""
        self._shading.rover = None if T_world_body is None else (self._rover_scene, np.linalg.inv(T_world_body))

    def radiance(self, rays: RayImage, samples: int, seed: Sequence[int]) -> Float32[np.ndarray, "H W 3"]:
        """Radiance that comes along the rays, the mean of `samples` per pixel; a pass over the image for each."""
        rows, columns = rays.shape
        start = np.random.default_rng([*seed, 0x11647]).random((4, rows, columns), np.float32)
        total = np.zeros((3, rows * columns), np.float32)
        at_once = max(1, _MOST_LANES // (rows * columns))
        for first in range(0, samples, at_once):
            lanes = []
            for sample in range(first, min(first + at_once, samples)):
                origin, direction = rays.at(*pixel_offsets(rays.shape, sample, seed))
                numbers = (start + np.float32(sample) * _ALPHAS) % 1
                lanes.append(np.concatenate([origin, direction, numbers]).reshape(10, -1))
            light = run_kernel(
                lambda *lane: self._shading.sample(lane, rays.spread, rays.footprint_m), np.concatenate(lanes, axis=1)
            )
            total += light.reshape(3, len(lanes), -1).sum(axis=1)
        return (total / np.float32(samples)).reshape(3, rows, columns).transpose(1, 2, 0)

    def first_hits(self, rays: RayImage) -> FirstHits:
        """What the very middle of each pixel sees."""
        mi = load_mitsuba()

        def hit(*lane: Any) -> tuple:
            ray = mi.Ray3f(mi.Point3f(*lane[:3]), mi.Vector3f(*lane[3:6]))
            found = self._scene.ray_intersect_preliminary(ray, coherent=True)
            return found.t, found.prim_index

        zero = np.zeros(rays.shape, np.float32)
        t, face = run_kernel(hit, np.concatenate(rays.at(zero, zero)).reshape(6, -1), (np.float32, np.int64))
        valid = np.isfinite(t) & (t < 1e30)
        face, depth = np.where(valid, face, -1), np.where(valid, t, 0).astype(np.float32)
        return FirstHits(face.reshape(rays.shape), depth.reshape(rays.shape))

"""What a ray of light brings: the shading of sand, rock, scenery, water and sky, as one kernel of Dr.Jit.

The same lines work on millions of rays (LLVM) and on single ones (scalar): nothing branches on a ray.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxmap.simulation.lighting import Lighting, irradiance_map
from jaxmap.simulation.materials import GRAIN_PERIOD_M, MOTTLE_PERIOD_M, STONE_PERIODS_M, Textures
from jaxmap.simulation.mesh import Mesh, Surface
from jaxmap.simulation.tracer import Table, constant, load_drjit, load_mitsuba, repeating_texture

_LIFT_M = 2e-3
"""Secondary rays start so far off the surface."""

_GRAIN_FEATURE_M, _STONE_FEATURES_M = 0.004, (0.02, 0.005)
"""Textures fade where a pixel is wider than these."""


class _Hit(NamedTuple):
    """A point on a surface: where, how it faces, its reflectance and kind; or the sky.

    `facing` is the normal of the triangle, on the side that the ray came from; `normal` is the one it is shaded by.
    """

    valid: Any
    point: Any
    facing: Any
    normal: Any
    albedo: Any
    surface: Any
    distance: Any


class Shading:
    """The light along rays in one world under one sky.

    `rover`, a scene and `T_body_world`, keeps light away without being seen; None for no rover.
    """

    def __init__(
        self, scene: Any, world: Mesh, normals: Float[np.ndarray, "V 3"], textures: Textures, lighting: Lighting
    ) -> None:
        self._mi = mi = load_mitsuba()
        self._dr = load_drjit()
        self._scene = scene
        self.rover: tuple[Any, np.ndarray] | None = None
        self._faces = [Table(world.faces[:, corner], np.uint32) for corner in range(3)]
        self._surface = Table(world.surface, np.uint32)
        self._vertices = [Table(world.vertices_m[:, axis]) for axis in range(3)]
        self._normals = [Table(normals[:, axis]) for axis in range(3)]
        self._colours = [Table(world.colours[:, channel]) for channel in range(3)]
        self._grain, self._mottle = repeating_texture(textures.grain), repeating_texture(textures.mottle)
        self._stone, self._sky_map = repeating_texture(textures.stone), repeating_texture(lighting.sky)
        self._irradiance_map = repeating_texture(irradiance_map(lighting.sky))
        self._sun = constant(mi.Vector3f, *lighting.sun_direction)
        self._sun_irradiance = constant(mi.Color3f, *lighting.sun_irradiance)
        self._sky_irradiance = constant(mi.Color3f, *lighting.sky_irradiance)
        self._haze = constant(mi.Color3f, *lighting.haze)
        self._sun_radius = constant(mi.Float, lighting.sun_radius_rad)
        self._visibility_m = constant(mi.Float, lighting.visibility_m)

    def sample(self, lane: tuple, spread: float, footprint_m: float) -> Any:
        """Radiance (RGB) along a ray.

        Args:
            lane: origin (3), direction (3, of any length) and four random numbers of each ray.
            spread: angle of a pixel, radians.
            footprint_m: width of a pixel at the camera.
        """
        mi, dr = self._mi, self._dr
        direction = dr.normalize(mi.Vector3f(*lane[3:6]))
        hit = self._hit(mi.Point3f(*lane[:3]), direction, coherent=True)
        hit = self._with_texture(hit, hit.distance * constant(mi.Float, spread) + constant(mi.Float, footprint_m))
        sun = self._towards_sun(lane[6], lane[7])
        light = self._sun_irradiance * (dr.maximum(dr.dot(hit.normal, sun), 0.0) * self._open(hit, sun))
        bounce = self._cosine_direction(hit.normal, lane[8], lane[9])
        # The open sky's light is known; the bounce only finds what stands in its way, so open ground has no noise.
        light += self._open_sky(hit.normal) + math.pi * (self._incoming(hit, bounce) - self._sky(bounce))
        light = dr.maximum(light, 0.0)
        matt = hit.albedo / math.pi * light
        wet = self._water(hit, direction)
        seen = dr.select(hit.surface == int(Surface.WATER), wet, matt)
        clear = dr.exp(-hit.distance / self._visibility_m)
        seen = seen * clear + self._haze * (1.0 - clear)
        return dr.select(hit.valid, seen, self._sky(direction))

    def _hit(self, origin: Any, direction: Any, *, coherent: bool) -> _Hit:
        mi, dr = self._mi, self._dr
        found = self._scene.ray_intersect_preliminary(mi.Ray3f(origin, direction), coherent=coherent)
        valid = found.is_valid()
        face = dr.select(valid, found.prim_index, 0)
        second, third = found.prim_uv.x, found.prim_uv.y
        shares = (1.0 - second - third, second, third)
        corners = [table(face) for table in self._faces]

        def at_corners(tables: list[Table], kind: Any) -> list:
            return [kind(*(table(corner) for table in tables)) for corner in corners]

        def blend(values: list) -> Any:
            return values[0] * shares[0] + values[1] * shares[1] + values[2] * shares[2]

        places = at_corners(self._vertices, mi.Vector3f)
        facing = dr.normalize(dr.cross(places[1] - places[0], places[2] - places[0]))
        facing = dr.select(dr.dot(facing, direction) > 0.0, -facing, facing)
        return _Hit(
            valid=valid,
            point=blend(places),
            facing=facing,
            normal=dr.normalize(blend(at_corners(self._normals, mi.Vector3f))),
            albedo=blend(at_corners(self._colours, mi.Color3f)),
            surface=self._surface(face),
            distance=dr.select(valid, found.t, 0.0),
        )

    def _with_texture(self, hit: _Hit, footprint_m: Any) -> _Hit:
        mi, dr = self._mi, self._dr
        x, y, z = hit.point.x, hit.point.y, hit.point.z
        grain = self._grain.eval(mi.Point2f(x / GRAIN_PERIOD_M, y / GRAIN_PERIOD_M))
        # Turned by a third, lest both tiles repeat along the same lines.
        mottle = self._mottle.eval(
            mi.Point2f((0.8 * x + 0.6 * y) / MOTTLE_PERIOD_M, (0.8 * y - 0.6 * x) / MOTTLE_PERIOD_M)
        )
        fade = dr.minimum(1.0, _GRAIN_FEATURE_M / footprint_m)
        sand = mi.Color3f(*(1.0 + fade * grain[i] + mottle[i] for i in range(3)))
        sand_normal = hit.normal - fade * mi.Vector3f(grain[3], grain[4], 0.0)
        brightness, stone_slope = 1.0, mi.Vector3f(0.0)
        for period, feature in zip(STONE_PERIODS_M, _STONE_FEATURES_M, strict=True):
            stone = self._stone.eval(mi.Point3f(x / period, y / period, z / period))
            weight = dr.minimum(1.0, feature / footprint_m)
            brightness += weight * stone[0]
            stone_slope += weight * mi.Vector3f(stone[1], stone[2], stone[3])
        is_sand = hit.surface == int(Surface.SAND)
        is_stone = (hit.surface == int(Surface.ROCK)) | (hit.surface == int(Surface.PEBBLE))
        gain = dr.select(is_sand, sand, dr.select(is_stone, mi.Color3f(brightness), mi.Color3f(1.0)))
        normal = dr.select(is_sand, sand_normal, dr.select(is_stone, hit.normal - stone_slope, hit.normal))
        return hit._replace(albedo=dr.clip(hit.albedo * gain, 0.01, 0.92), normal=dr.normalize(normal))

    def _incoming(self, hit: _Hit, direction: Any) -> Any:
        """Radiance from a direction: the sky's, or that of what stands in the way, lit by sun and sky."""
        dr = self._dr
        other = self._hit(hit.point + _LIFT_M * hit.facing, direction, coherent=False)
        sun = dr.maximum(dr.dot(other.normal, self._sun), 0.0) * self._open(other, self._sun)
        # The second surface sees about half of the sky.
        lit = other.albedo / math.pi * (self._sun_irradiance * sun + 0.5 * self._sky_irradiance)
        free = dr.select(other.valid, lit, self._sky(direction))
        return dr.select(self._rover_hides(hit, direction), free * 0.0, free)

    def _open(self, hit: _Hit, direction: Any) -> Any:
        """1 where nothing stands between a surface and what lies in a direction, else 0."""
        mi, dr = self._mi, self._dr
        origin = hit.point + _LIFT_M * hit.facing
        blocked = self._scene.ray_test(mi.Ray3f(origin, direction), coherent=False) | self._rover_hides(hit, direction)
        return dr.select(blocked, 0.0, 1.0)

    def _rover_hides(self, hit: _Hit, direction: Any) -> Any:
        mi = self._mi
        if self.rover is None:
            return mi.Bool(False)
        scene, T_body_world = self.rover
        R = [constant(mi.Vector3f, *row) for row in T_body_world[:3, :3]]
        dot, shift = self._dr.dot, constant(mi.Vector3f, *T_body_world[:3, 3])
        origin = mi.Point3f(*(dot(row, hit.point) + t for row, t in zip(R, shift, strict=True)))
        return scene.ray_test(mi.Ray3f(origin, mi.Vector3f(*(dot(row, direction) for row in R))), coherent=False)

    def _water(self, hit: _Hit, direction: Any) -> Any:
        """The sky mirrored by waves (Schlick's reflectance, 2 % head on), over the water's own colour."""
        mi, dr = self._mi, self._dr
        wave = self._grain.eval(mi.Point2f(hit.point.x / 23.0, hit.point.y / 17.0))
        swell = self._grain.eval(mi.Point2f(hit.point.y / 131.0, hit.point.x / 97.0))
        tilt = 0.5 / (1.0 + hit.distance / 60.0)
        normal = dr.normalize(mi.Vector3f(tilt * (wave[3] + swell[3]), tilt * (wave[4] + swell[4]), 1.0))
        cosine = dr.clip(-dr.dot(normal, direction), 0.0, 1.0)
        mirrored = direction + 2.0 * cosine * normal
        share = 0.02 + 0.98 * (1.0 - cosine) ** 5
        body = hit.albedo / math.pi * (self._sun_irradiance * dr.maximum(self._sun.z, 0.0) + self._sky_irradiance)
        return share * self._sky(mirrored) + (1.0 - share) * body

    def _sky(self, direction: Any) -> Any:
        mi, dr = self._mi, self._dr
        elevation = dr.asin(dr.clip(direction.z, 0.0, 1.0))
        row = dr.sqrt(elevation / (math.pi / 2))
        # Half a texel in from both ends: the texture repeats, the sky's rows do not.
        row = dr.clip(row, 0.5 / self._sky_map.shape[0], 1.0 - 0.5 / self._sky_map.shape[0])
        column = dr.atan2(direction.y, direction.x) / (2 * math.pi) + 0.5
        return mi.Color3f(*self._sky_map.eval(mi.Point2f(column, row)))

    def _open_sky(self, normal: Any) -> Any:
        """Irradiance of the whole sky on a plane with this normal."""
        mi, dr = self._mi, self._dr
        rows = self._irradiance_map.shape[0]
        row = dr.asin(dr.clip(normal.z, -1.0, 1.0)) / math.pi + 0.5
        row = dr.clip(row, 0.5 / rows, 1.0 - 0.5 / rows)
        column = dr.atan2(normal.y, normal.x) / (2 * math.pi) + 0.5
        return mi.Color3f(*self._irradiance_map.eval(mi.Point2f(column, row)))

    def _towards_sun(self, first: Any, second: Any) -> Any:
        dr = self._dr
        frame = self._mi.Frame3f(self._sun)
        radius, angle = self._sun_radius * dr.sqrt(first), 2 * math.pi * second
        return dr.normalize(self._sun + radius * (dr.cos(angle) * frame.s + dr.sin(angle) * frame.t))

    def _cosine_direction(self, normal: Any, first: Any, second: Any) -> Any:
        dr = self._dr
        frame = self._mi.Frame3f(normal)
        radius, angle = dr.sqrt(first), 2 * math.pi * second
        flat = radius * (dr.cos(angle) * frame.s + dr.sin(angle) * frame.t)
        return dr.normalize(flat + dr.sqrt(dr.maximum(1.0 - first, 1e-6)) * normal)

"""The trial of a tracing library: renders a small world with all the simulator's kernels, in a child process."""

from __future__ import annotations

import resource

import numpy as np

from jaxmap.simulation.lighting import Lighting, sky_irradiance
from jaxmap.simulation.materials import Textures
from jaxmap.simulation.mesh import Surface, make_mesh
from jaxmap.simulation.orthomosaic import Raster, raster_rays
from jaxmap.simulation.render import Renderer


def main() -> None:
    """Renders open sand under sun and sky, with and without a rover beside it.

    Raises:
        SystemExit: the radiance is not that of the closed form.
    """
    # A library that aborts shall not leave a core file behind.
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    corners = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    sand = make_mesh(corners * 25, faces, (0.5, 0.5, 0.5), Surface.SAND)
    rover = make_mesh(corners + np.array([10, 0, 1]), faces, (0.5, 0.5, 0.5), Surface.ROCK)
    textures = Textures(*(np.zeros(shape, np.float32) for shape in ((4, 4, 5), (4, 4, 3), (4, 4, 4, 4))))
    sky = np.full((48, 192, 3), 0.7, np.float32)
    sun_direction = np.array([np.sqrt(0.75), 0, 0.5])
    lighting = Lighting(sun_direction, np.full(3, 2.0), 1e-4, sky, sky_irradiance(sky), 1e9, np.ones(3))
    renderer = Renderer(sand, textures, lighting, rover)
    rays = raster_rays(Raster(-1.0, 1.0, 0.1, (20, 20)))
    # Lambert: albedo / pi times the irradiance of the sun, at 30 degrees, and of the sky.
    expected = 0.5 / np.pi * (2.0 * 0.5 + 0.7 * np.pi)
    for pose in (None, np.eye(4)):
        renderer.place_rover(pose)
        radiance = renderer.radiance(rays, 2, (0,))
        if not np.allclose(radiance, expected, rtol=0.02):
            raise SystemExit(f"radiance of {radiance.min():.4g} to {radiance.max():.4g} in place of {expected:.4g}")
    if not (renderer.first_hits(rays).face >= 0).all():
        raise SystemExit("rays miss the ground")

"""The ground: its height and colour as functions of place, and meshes of it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxmap.simulation.mesh import Mesh, Surface, grid_faces, make_mesh
from jaxmap.simulation.noise import fractal_noise, gradient_noise, smoothstep
from jaxmap.simulation.recipe import BackdropRecipe, ReliefRecipe, SandRecipe


class Ground(NamedTuple):
    """The sand's height and colour everywhere; what walked, drove and drifted there is added by `marks`."""

    relief: ReliefRecipe
    sand: SandRecipe
    backdrop: BackdropRecipe

    def height_m(self, x: np.ndarray, y: np.ndarray, spacing_m: np.ndarray | float = 0.0) -> np.ndarray:
        """Height in metres at world x and y, float32.

        `spacing_m` leaves out what is finer than two spacings, as a mesh of that spacing must, and
        as a rover on wheels of that size feels it.
        """
        relief = self.relief
        height = np.zeros(np.shape(x), np.float32)
        bands = zip(relief.band_wavelengths_m, relief.band_heights_m, strict=True)
        for number, (wavelength, size) in enumerate(bands):
            weight = smoothstep(wavelength / np.maximum(spacing_m, 1e-6), 2.0, 4.0)
            if np.any(weight > 0):
                noise = gradient_noise([x / wavelength, y / wavelength], relief.seed + number)
                height += np.float32(size / 0.3) * weight.astype(np.float32) * noise
        height += self._ripples(x, y, spacing_m)
        return height - self._shore_m(x, y)

    def _ripples(self, x: np.ndarray, y: np.ndarray, spacing_m: np.ndarray | float) -> np.ndarray:
        relief = self.relief
        weight = smoothstep(relief.ripple_wavelength_m / np.maximum(spacing_m, 1e-6), 3.0, 6.0)
        if relief.ripple_cover <= 0 or not np.any(weight > 0):
            return np.zeros(np.shape(x), np.float32)
        angle, wavelength = np.deg2rad(relief.ripple_direction_deg), relief.ripple_wavelength_m
        bend = fractal_noise([x, y], relief.seed + 50, wavelength=9 * wavelength, octaves=3)
        along = (x * np.cos(angle) + y * np.sin(angle)) / wavelength + 0.55 * bend
        phase = along - np.floor(along)
        # Wind builds ripples with a long windward slope and a short lee.
        crest = np.where(phase < 0.68, smoothstep(phase, 0.0, 0.68), smoothstep(phase, 1.0, 0.68))
        mask = fractal_noise([x, y], relief.seed + 51, wavelength=3.1, octaves=3)
        edge = 1.6 - 3.2 * relief.ripple_cover
        size = relief.ripple_height_m * wavelength * smoothstep(mask, edge, edge + 1.2)
        return (weight * size * (crest - 0.5)).astype(np.float32)

    def _shore_m(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """How far the ground has sunk towards the sea."""
        if not self.backdrop.sea:
            return np.zeros(np.shape(x), np.float32)
        angle = np.deg2rad(self.backdrop.sea_direction_deg)
        beyond = x * np.cos(angle) + y * np.sin(angle) - 0.6 * self.backdrop.sea_distance_m
        return (0.05 * np.maximum(beyond, 0)).astype(np.float32)

    def colour(self, x: np.ndarray, y: np.ndarray, height_m: np.ndarray) -> Float[np.ndarray, "... 3"]:
        """Linear reflectance of the sand, without its grain."""
        sand = self.sand
        usual, patch, damp = (np.array(colour, np.float32) for colour in sand.colours)
        noise = fractal_noise([x, y], sand.seed + 11, wavelength=sand.patch_size_m, octaves=5, gain=0.6)
        share = sand.patch_strength * smoothstep(noise, -0.8, 1.2)[..., None]
        colour = usual + (patch - usual) * share
        wet = np.zeros(np.shape(x), np.float32)
        if sand.damp_cover > 0:
            edge = 1.5 - 3.0 * sand.damp_cover
            noise = fractal_noise([x, y], sand.seed + 12, wavelength=7.0, octaves=5)
            wet = smoothstep(noise - 2.0 * height_m, edge, edge + 0.8)
        wet = np.maximum(wet, smoothstep(self._shore_m(x, y), 0.15, 0.6))[..., None]
        return (colour + (damp - colour) * wet).astype(np.float32)


def graded_axis(lower_m: float, upper_m: float, fine_m: float, reach_m: float, growth: float = 0.05) -> np.ndarray:
    """Coordinates `fine_m` apart from `lower_m` to `upper_m`, and ever wider from there to `reach_m` beyond."""
    middle = lower_m + fine_m * np.arange(int(np.ceil((upper_m - lower_m) / fine_m)) + 1)
    count = int(np.ceil(np.log1p(reach_m * growth / fine_m) / np.log1p(growth)))
    tail = fine_m / growth * ((1 + growth) ** np.arange(1, count + 1) - 1)
    return np.concatenate([lower_m - tail[::-1], middle, middle[-1] + tail])


def lattice(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The points of a lattice with these columns and rows.

    Returns:
        x, y and the wider spacing of each point, (rows * columns,), and its triangles.
    """
    points_x, points_y = np.meshgrid(x, y)
    spacing = np.maximum(np.gradient(x)[None, :], np.gradient(y)[:, None])
    return points_x.ravel(), points_y.ravel(), spacing.ravel(), grid_faces(len(y), len(x))


def fan(
    centre_m: tuple[float, float],
    heading_rad: float,
    half_angle_rad: float,
    radii_m: tuple[float, float],
    steps: tuple[float, float],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The points of a fan in front of a camera, whose spacing grows with distance.

    All around the camera lies ground, too, but behind it the fan is eight times as coarse.

    Args:
        centre_m: under the camera.
        heading_rad: where it looks.
        half_angle_rad: of the fine part.
        radii_m: nearest and farthest.
        steps: spacing across and along the view, in parts of the distance.

    Returns:
        As `lattice` does.
    """
    across, along = steps
    ahead = np.arange(-half_angle_rad, half_angle_rad, across)
    behind = np.linspace(half_angle_rad, 2 * np.pi - half_angle_rad, int(np.pi / (4 * across)))
    angles = np.concatenate([ahead, behind])
    radii = np.append(0.02, np.geomspace(*radii_m, int(np.log(radii_m[1] / radii_m[0]) / along)))
    angle, radius = np.meshgrid(angles, radii)
    x = centre_m[0] + radius * np.cos(heading_rad + angle)
    y = centre_m[1] + radius * np.sin(heading_rad + angle)
    spacing = np.maximum(radius * np.gradient(angles)[None, :], np.gradient(radii)[:, None])
    # Rows go outwards and columns counter-clockwise, so triangles must be turned to face up.
    return x.ravel(), y.ravel(), spacing.ravel(), grid_faces(len(radii), len(angles))[:, ::-1]


def ground_mesh(x: np.ndarray, y: np.ndarray, height_m: np.ndarray, colour: np.ndarray, faces: np.ndarray) -> Mesh:
    """The mesh of the ground over these points."""
    return make_mesh(np.stack([x, y, height_m], axis=-1), faces, colour, Surface.SAND)

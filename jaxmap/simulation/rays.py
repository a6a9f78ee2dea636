"""The rays of an image: through the pixels of a distorted camera, or straight down for an orthomosaic."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

# Powers of the inverse of the generalised golden ratio: the additive sequence R_d of Roberts (2018).
_ALPHA_1, _ALPHA_2 = 0.7548776662466927, 0.5698402909980532


class RayImage(NamedTuple):
    """One ray per pixel in the world, and how it changes over a pixel to the right and one down.

    Directions need not be of unit length: a hit at parameter t of a camera's ray has depth t where
    directions are scaled to z = 1 in the camera. A pixel is `spread` times the distance plus
    `footprint_m` wide.
    """

    origin_m: Float[np.ndarray, "3 H W"]
    direction: Float[np.ndarray, "3 H W"]
    origin_step_m: Float[np.ndarray, "2 3 H W"]
    direction_step: Float[np.ndarray, "2 3 H W"]
    spread: float
    footprint_m: float

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.origin_m.shape[1], self.origin_m.shape[2]

    def at(self, offset_u_px: np.ndarray, offset_v_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Origins and directions (3, H, W) of the rays so far from the pixels' centres."""
        origin = self.origin_m + offset_u_px * self.origin_step_m[0] + offset_v_px * self.origin_step_m[1]
        direction = self.direction + offset_u_px * self.direction_step[0] + offset_v_px * self.direction_step[1]
        return origin.astype(np.float32), direction.astype(np.float32)


def camera_rays(normalised: Float[np.ndarray, "2 H W"], T_world_camera: Float[np.ndarray, "4 4"]) -> RayImage:
    """The rays of a camera whose pixels look along `(x, y, 1)`, where `normalised` holds x and y."""
    in_camera = np.concatenate([normalised, np.ones_like(normalised[:1])])
    direction = np.einsum("ij,jhw->ihw", T_world_camera[:3, :3], in_camera)
    origin = np.broadcast_to(T_world_camera[:3, 3, None, None], direction.shape)
    steps = np.stack([np.gradient(direction, axis=2), np.gradient(direction, axis=1)])
    spread = float(np.median(np.linalg.norm(steps[0], axis=0)))
    return RayImage(origin, direction, np.zeros_like(steps), steps, spread, 0.0)


def downward_rays(
    west_m: float, north_m: float, cell_m: float, shape: tuple[int, int], top_m: float, lowest_m: float
) -> RayImage:
    """Rays straight down through the cells of a north-up raster, from `top_m` to depth 1 at `lowest_m`."""
    x = west_m + cell_m * (np.arange(shape[1]) + 0.5)
    y = north_m - cell_m * (np.arange(shape[0]) + 0.5)
    origin = np.stack([*np.meshgrid(x, y), np.full(shape, top_m)])
    direction = np.zeros_like(origin)
    direction[2] = lowest_m - top_m
    steps = np.zeros((2, *origin.shape))
    steps[0, 0], steps[1, 1] = cell_m, -cell_m
    return RayImage(origin, direction, steps, np.zeros_like(steps), 0.0, cell_m)


def pixel_offsets(shape: tuple[int, int], sample: int, seed: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Where in its pixel each ray of a pass goes, within half a pixel: a sequence that fills pixels evenly."""
    start = np.random.default_rng([*seed, 0x0FF5E7]).random((2, *shape), np.float32)
    u = (start[0] + np.float32(sample * _ALPHA_1 % 1)) % 1 - np.float32(0.5)
    v = (start[1] + np.float32(sample * _ALPHA_2 % 1)) % 1 - np.float32(0.5)
    return u, v

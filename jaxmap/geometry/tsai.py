"""Pinhole cameras of NASA's Ames Stereo Pipeline (`.tsai`), with the lens models NULL, TSAI and BrownConrady.

Source: the manual of the Ames Stereo Pipeline, "Frame camera models".
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float64

_ROUNDS = 20


@dataclass(frozen=True)
class TsaiCamera:
    """A pinhole with a lens; lengths of the image plane in units of which `pitch` make a pixel.

    Attributes:
        C: float64 (3,), centre of projection in the world, metres.
        R_world_camera: float64 (3, 3), x right, y down, z forward.
        focal: float64 (2,), along x and y.
        offset: float64 (2,), the principal point, from the centre of the first pixel.
        pitch: size of a pixel.
        lens: NULL; TSAI (k1 k2 p1 p2 k3, as OpenCV's, from straight to bent, for unit focal length); BROWNCONRADY
            (xp yp k1 k2 k3 p1 p2 phi, from bent to straight, in units of the image plane).
        terms: float64, of the lens, in that order.
    """

    C: np.ndarray
    R_world_camera: np.ndarray
    focal: np.ndarray
    offset: np.ndarray
    pitch: float
    lens: Literal["NULL", "TSAI", "BROWNCONRADY"]
    terms: np.ndarray

    @property
    def centre(self) -> Float64[np.ndarray, "3"]:
        """The centre of projection."""
        return self.C

    @property
    def axes(self) -> Float64[np.ndarray, "3 3"]:
        """R_world_camera."""
        return self.R_world_camera

    def project(self, points: Float64[np.ndarray, "*s 3"]) -> Float64[np.ndarray, "*s 2"]:
        """Pixels (x, y) of points of the world; NaN where the lens cannot see them."""
        with np.errstate(all="ignore"):
            p = (np.asarray(points, np.float64) - self.C) @ self.R_world_camera
            straight = p[..., :2] / p[..., 2:]
            if self.lens == "TSAI":
                bent = np.where(_rises(self.terms[[0, 1, 4]], straight), _opencv(self.terms, straight), np.nan)
                plane = bent * self.focal + self.offset
            elif self.lens == "BROWNCONRADY":
                plane = _inverse(self._straightened, straight * self.focal) + self.offset
            else:
                plane = straight * self.focal + self.offset
            return np.where(p[..., 2:] > 0, plane / self.pitch, np.nan)

    def rays(
        self, pixels: Float64[np.ndarray, "*s 2"]
    ) -> tuple[Float64[np.ndarray, "*s 3"], Float64[np.ndarray, "*s 3"]]:
        """The centre, and the unit directions of the rays of pixels (x, y); NaN beyond the lens."""
        with np.errstate(all="ignore"):
            plane = np.asarray(pixels, np.float64) * self.pitch - self.offset
            if self.lens == "TSAI":
                straight = _inverse(lambda x: _opencv(self.terms, x), plane / self.focal)
                straight = np.where(_rises(self.terms[[0, 1, 4]], straight), straight, np.nan)
            elif self.lens == "BROWNCONRADY":
                straight = self._straightened(plane) / self.focal
            else:
                straight = plane / self.focal
            d = np.concatenate([straight, np.ones_like(straight[..., :1])], axis=-1)
            directions = d @ self.R_world_camera.T / np.linalg.norm(d, axis=-1, keepdims=True)
        return np.broadcast_to(self.C, directions.shape).copy(), directions

    def _straightened(self, bent: np.ndarray) -> np.ndarray:
        """Brown-Conrady, from places in the image plane, relative to the principal point."""
        xp, yp, k1, k2, k3, p1, p2, phi = self.terms
        moved = bent - [xp, yp]
        square = (moved**2).sum(axis=-1, keepdims=True)
        radial = 1 + (k1 + (k2 + k3 * square) * square) * square
        return moved * radial + (p1 + p2 * square) * square * [-np.sin(phi), np.cos(phi)]


def _opencv(terms: np.ndarray, straight: np.ndarray) -> np.ndarray:
    k1, k2, p1, p2, k3 = terms
    x, y = straight[..., 0], straight[..., 1]
    square = x**2 + y**2
    radial = 1 + (k1 + (k2 + k3 * square) * square) * square
    return np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (square + 2 * x**2),
            y * radial + p1 * (square + 2 * y**2) + 2 * p2 * x * y,
        ],
        axis=-1,
    )


def _rises(radial: np.ndarray, straight: np.ndarray) -> np.ndarray:
    """Whether the radial polynomial rises from the axis up to here; beyond, pixels repeat."""
    k1, k2, k3 = radial
    square = (straight**2).sum(axis=-1, keepdims=True)[..., None] * np.linspace(0.125, 1, 8)
    return (1 + (3 * k1 + (5 * k2 + 7 * k3 * square) * square) * square > 0).all(axis=-1)


def _inverse(function: Callable[[np.ndarray], np.ndarray], target: np.ndarray) -> np.ndarray:
    """Solves `function(x) = target` for (..., 2), by Newton's method from x = target; NaN where that fails."""
    x = target
    scale = max(1.0, float(np.nanmax(np.abs(target), initial=1.0)))
    step = 1e-6 * scale
    value = function(x)
    for _ in range(_ROUNDS):
        along = [(function(x + step * unit) - value) / step for unit in np.eye(2)]
        (a, c), (b, d) = (np.moveaxis(column, -1, 0) for column in along)
        error = value - target
        determinant = a * d - b * c
        change = np.stack([d * error[..., 0] - b * error[..., 1], a * error[..., 1] - c * error[..., 0]], axis=-1)
        x = x - change / determinant[..., None]
        value = function(x)
        if not (np.abs(value - target) > 1e-14 * scale).any():
            break
    return np.where((np.abs(value - target) < 1e-9 * scale).all(axis=-1, keepdims=True), x, np.nan)

"""Camera models of planetary archives: CAHV, CAHVOR, CAHVORE, in float64 NumPy.

Sources: Yakimovsky and Cunningham 1978, "A system for extracting three-dimensional measurements from a stereo pair of
TV cameras" (CAHV); Di and Li 2004, "CAHVOR camera model and its photogrammetric conversion for planetary
applications"; Gennery 2006, "Generalized camera calibration including fish-eye lenses" (CAHVORE).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float64

from jaxmap.errors import JaxmapError

LINEARITY = {1: 1.0, 2: 0.0}
"""Of a CAHVORE model's type: 1 perspective, 2 fisheye; type 3 carries its own."""

_ROUNDS = 30

Numbers = Any
"""An array of any shape, or one number."""


@dataclass(frozen=True)
class CahvModel:
    """A CAHVORE camera; CAHVOR is one with E = 0 and linearity 1, CAHV one with R = 0 and O = A as well.

    The frame is the one that the vectors are given in, in metres; pixels are (sample, line) with integer centres, the
    first one (0, 0).

    Attributes:
        C: float64 (3,), the centre of projection (of rays along O).
        A: float64 (3,), the axis, normal to the image plane.
        H: float64 (3,), horizontal: `f_x x + c_x A` for the unit vector x to the right.
        V: float64 (3,), vertical: `f_y y + c_y A` for the unit vector y downwards.
        O: float64 (3,), the unit axis of the lens, about which it distorts.
        R: float64 (3,), radial terms.
        E: float64 (3,), metres, terms by which the entrance pupil moves along O.
        linearity: 1 perspective, 0 fisheye, or between.
    """

    C: np.ndarray
    A: np.ndarray
    H: np.ndarray
    V: np.ndarray
    O: np.ndarray  # noqa: E741
    R: np.ndarray
    E: np.ndarray
    linearity: float = 1.0

    @property
    def centre(self) -> Float64[np.ndarray, "3"]:
        """The centre of projection, of rays along the axis of the lens."""
        return self.C

    @property
    def axes(self) -> Float64[np.ndarray, "3 3"]:
        """R_frame_camera: columns x right, y down, z forward, of the image plane."""
        z = self.A / np.linalg.norm(self.A)
        x = self.H - (self.H @ z) * z
        x /= np.linalg.norm(x)
        return np.stack([x, np.cross(z, x), z], axis=1)

    def project(self, points: Float64[np.ndarray, "*s 3"]) -> Float64[np.ndarray, "*s 2"]:
        """Pixels (sample, line) of points of the model's frame; NaN where the lens cannot see them.

        Gennery 2006, equations of section 3: with `zeta` and `lam` along and across O, the angle theta of the ray
        solves `zeta sin - lam cos - (theta - sin) (e0 + e1 theta^2 + e2 theta^4) = 0`.
        """
        with np.errstate(all="ignore"):
            p = np.asarray(points, np.float64) - self.C
            zeta = p @ self.O
            across = p - zeta[..., None] * self.O
            lam = np.linalg.norm(across, axis=-1)
            theta = self._angle(zeta, lam)
            limit = np.pi / 2 if self.linearity else np.pi
            chi = _bent(theta, self.linearity)
            beyond = (theta * max(abs(self.linearity), 1e-12) >= limit) | ~self._is_monotonic(chi)
            # Towards the axis lam / chi tends to zeta, less the movement of the pupil, which tends to 0.
            ahead = np.where(chi > 1e-9, lam / np.where(chi > 1e-9, chi, 1.0), zeta)
            bent = ahead[..., None] * self.O + (1 + _even(self.R, chi))[..., None] * across
            depth = bent @ self.A
            pixels = np.stack([bent @ self.H, bent @ self.V], axis=-1) / depth[..., None]
        return np.where((beyond | (depth <= 0))[..., None], np.nan, pixels)

    def rays(
        self, pixels: Float64[np.ndarray, "*s 2"]
    ) -> tuple[Float64[np.ndarray, "*s 3"], Float64[np.ndarray, "*s 3"]]:
        """The origins and the unit directions of the rays seen at pixels (sample, line); NaN beyond the lens."""
        with np.errstate(all="ignore"):
            pixels = np.asarray(pixels, np.float64)
            d = np.cross(self.V - pixels[..., 1:] * self.A, self.H - pixels[..., :1] * self.A)
            d *= np.sign(d @ self.A)[..., None]
            zeta = d @ self.O
            across = d - zeta[..., None] * self.O
            lam = np.linalg.norm(across, axis=-1)
            chi = self._unbent(lam / zeta)
            theta = _unbent_angle(chi, self.linearity)
            sine = np.where(theta > 1e-9, np.sin(theta), 1.0)
            shift = np.where(theta > 1e-9, theta / sine - 1, 0.0) * _even(self.E, theta)
            unit = across / np.where(lam > 0, lam, 1.0)[..., None]
            directions = np.cos(theta)[..., None] * self.O + np.sin(theta)[..., None] * unit
            origins = self.C + shift[..., None] * self.O
            seen = (np.isfinite(directions).all(axis=-1) & (zeta > 0))[..., None]
        return np.where(seen, origins, np.nan), np.where(seen, directions, np.nan)

    def moved(self, T_new_frame: Float64[np.ndarray, "4 4"]) -> CahvModel:
        """The same camera in another frame; `T_new_frame` is rigid and takes points of this one into it."""
        turn = T_new_frame[:3, :3]
        turned = {name: turn @ getattr(self, name) for name in "AHVO"}
        return replace(self, C=turn @ self.C + T_new_frame[:3, 3], **turned)

    def cropped(self, first_px: tuple[float, float], binning: tuple[float, float] = (1, 1)) -> CahvModel:
        """The model of a part of the image, averaged over blocks of pixels.

        Args:
            first_px: (sample, line) of the part's first pixel, from 0, before averaging.
            binning: width and height of the blocks.
        """
        offset = [first + (step - 1) / 2 for first, step in zip(first_px, binning, strict=True)]
        return replace(self, H=(self.H - offset[0] * self.A) / binning[0], V=(self.V - offset[1] * self.A) / binning[1])

    def _angle(self, zeta: Numbers, lam: Numbers) -> Numbers:
        """The angle of a ray from O at the entrance pupil, by Newton's method from that at C."""
        theta = np.arctan2(lam, zeta)
        if not self.E.any():
            return theta
        e0, e1, e2 = self.E
        step = np.inf
        for _ in range(_ROUNDS):
            sine, cosine, square = np.sin(theta), np.cos(theta), theta**2
            pupil = e0 + e1 * square + e2 * square**2
            value = zeta * sine - lam * cosine - (theta - sine) * pupil
            slope = zeta * cosine + lam * sine - (1 - cosine) * pupil
            slope -= (theta - sine) * theta * (2 * e1 + 4 * e2 * square)
            step = value / slope
            theta = theta - step
            if not (np.abs(step) > 1e-15).any():
                break
        return np.where((np.abs(step) < 1e-9) & (theta >= 0), theta, np.nan)

    def _unbent(self, bent: Numbers) -> Numbers:
        """Solves `(1 + r0) chi + r1 chi^3 + r2 chi^5 = bent` for chi, by Newton's method from chi = bent."""
        if not self.R.any():
            return bent
        r0, r1, r2 = self.R
        chi, step = bent, np.inf
        for _ in range(_ROUNDS):
            square = chi**2
            value = (1 + r0 + (r1 + r2 * square) * square) * chi - bent
            step = value / (1 + r0 + (3 * r1 + 5 * r2 * square) * square)
            chi = chi - step
            if not (np.abs(step) > 1e-15).any():
                break
        return np.where((np.abs(step) < 1e-9) & self._is_monotonic(chi), chi, np.nan)

    def _is_monotonic(self, chi: Numbers) -> Numbers:
        """Whether the radial polynomial rises from the axis up to here; beyond, pixels repeat."""
        r0, r1, r2 = self.R
        # The slope, with w = 1 / chi^2, is positive up to the greatest root w of (1 + r0) w^2 + 3 r1 w + 5 r2.
        inside = 9 * r1**2 - 20 * r2 * (1 + r0)
        greatest = (-3 * r1 + np.sqrt(inside)) / (2 * (1 + r0)) if inside >= 0 else 0.0
        return (chi >= 0) & (chi**2 * greatest < 1)


def make_cahv_model(
    components: Sequence[Sequence[float] | np.ndarray],
    kind: int = 1,
    parameter: float = 1.0,
    where: object = "camera model",
) -> CahvModel:
    """Checks and builds a camera model.

    Args:
        components: C A H V, C A H V O R or C A H V O R E, three numbers each.
        kind: of a CAHVORE model: 1 perspective, 2 fisheye, 3 as `parameter` says.
        parameter: the linearity of kind 3.
        where: for error messages.

    Raises:
        JaxmapError: a wrong count or shape, a number that is not finite, or vectors that make no camera.
    """
    vectors = [np.asarray(component, np.float64).reshape(-1) for component in components]
    if len(vectors) not in (4, 6, 7) or any(vector.size != 3 for vector in vectors):
        raise JaxmapError(
            f"a camera model of {len(vectors)} components ({', '.join(str(v.size) for v in vectors)} numbers)",
            where=where,
            fix="CAHV has 4 components of three numbers, CAHVOR 6, CAHVORE 7",
        )
    if not all(np.isfinite(vector).all() and np.abs(vector).max() < 1e12 for vector in vectors):
        raise JaxmapError("the camera model holds a number that is not finite", where=where, fix="restore the label")
    if kind not in (1, 2, 3) or not abs(parameter) <= 10:
        raise JaxmapError(
            f"a CAHVORE model of type {kind}, parameter {parameter}", where=where, fix="types are 1, 2 and 3"
        )
    C, A, H, V = vectors[:4]
    optical, R = vectors[4:6] if len(vectors) > 4 else (A, np.zeros(3))
    E = vectors[6] if len(vectors) == 7 else np.zeros(3)
    lengths = [np.linalg.norm(A), np.linalg.norm(optical)]
    if max(abs(length - 1) for length in lengths) > 1e-2:
        raise JaxmapError(
            f"the axes A and O have lengths {lengths[0]:.3g} and {lengths[1]:.3g}, not 1",
            where=where,
            fix="check the order of the components",
        )
    handed = np.linalg.det(np.stack([H, V, A]))
    if not handed > 1e-6 * np.linalg.norm(H) * np.linalg.norm(V) or optical @ A < 0.5:
        raise JaxmapError(
            "the vectors A, H, V, O make no camera that looks along A, x right, y down",
            where=where,
            fix="check the order of the components",
        )
    if R[0] <= -1:
        raise JaxmapError(f"the radial term r0 is {R[0]:g}", where=where, fix="it must be greater than -1")
    linearity = LINEARITY.get(kind, float(parameter))
    return CahvModel(C, A, H, V, optical / lengths[1], R, E, linearity)


def _even(terms: np.ndarray, x: Numbers) -> Numbers:
    square = x**2
    return terms[0] + (terms[1] + terms[2] * square) * square


def _bent(theta: Numbers, linearity: float) -> Numbers:
    """Distance from the axis in the image of an ideal lens of unit focal length, at an angle from the axis."""
    if abs(linearity) < 1e-15:
        return theta
    return (np.tan if linearity > 0 else np.sin)(linearity * theta) / linearity


def _unbent_angle(chi: Numbers, linearity: float) -> Numbers:
    if abs(linearity) < 1e-15:
        return chi
    return (np.arctan if linearity > 0 else np.arcsin)(linearity * chi) / linearity

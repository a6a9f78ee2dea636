"""Linearisation: two eyes of any camera model to one shared, epipolar aligned pinhole pair (Di and Li 2004, section 4).

The eyes' models are in one frame (a rover's, say); their lenses may be CAHV, CAHVOR, CAHVORE or others.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple, Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Float32, Float64

from jaxmap.errors import JaxmapError
from jaxmap.labels import IGNORE
from jaxmap.types import StereoCamera, make_stereo_camera

REFERENCE_M = 5.0
"""The images are rectified for points at this depth; only a lens whose entrance pupil moves can tell."""

NEAR_M = 1.0
"""The nearest depth for which the error of the linear model is told."""

_SAME_VIEW_PX = 2.0
_SAME_MAPS_PX = 0.05
_SAME_BASELINE = 0.003
_GRID = 9
_FLATTEST = 0.05
"""Rays are cut off at this cosine from the axis: a plane cannot hold a hemisphere."""

Maps = tuple[Float32[np.ndarray, "H W"], Float32[np.ndarray, "H W"]]


@runtime_checkable
class EyeModel(Protocol):
    """A camera in a frame; pixels are (x, y) with integer centres."""

    @property
    def centre(self) -> np.ndarray:
        """(3,) the centre of projection."""
        ...

    @property
    def axes(self) -> np.ndarray:
        """R_frame_camera (3, 3): columns x right, y down, z forward."""
        ...

    def project(self, points: np.ndarray) -> np.ndarray:
        """Pixels (..., 2) of points (..., 3) of the frame; NaN where unseen."""
        ...

    def rays(self, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Origins and unit directions (..., 3) of the rays of pixels (..., 2); NaN where unseen."""
        ...


class LinearView(NamedTuple):
    """The pinhole that both rectified images share, square pixels, in px."""

    focal_px: float
    cx_px: float
    cy_px: float
    width_px: int
    height_px: int


class LinearPair(NamedTuple):
    """A linearised pair.

    Attributes:
        left: the left eye.
        right: the right eye.
        T_frame_left: float64 (4, 4), the rectified left camera in the frame of the models.
        baseline_m: metres between the eyes.
        view: the pinhole of both.
    """

    left: EyeModel
    right: EyeModel
    T_frame_left: np.ndarray
    baseline_m: float
    view: LinearView

    @property
    def camera(self) -> StereoCamera:
        """The rectified camera."""
        focal_px, cx_px, cy_px, width_px, height_px = self.view
        return make_stereo_camera(
            fx_px=focal_px,
            cx_px=cx_px,
            cy_px=cy_px,
            baseline_m=self.baseline_m,
            width_px=width_px,
            height_px=height_px,
        )

    def raw_pixels(
        self, eye: EyeModel, pixels: Float64[np.ndarray, "*s 2"], depth_m: float = REFERENCE_M
    ) -> Float64[np.ndarray, "*s 2"]:
        """Where an eye's raw image shows what its rectified image shows at `pixels`, for points at a depth."""
        focal_px, cx_px, cy_px, *_ = self.view
        ahead = np.concatenate([(pixels - [cx_px, cy_px]) / focal_px, np.ones_like(pixels[..., :1])], axis=-1)
        return eye.project(eye.centre + depth_m * ahead @ self.T_frame_left[:3, :3].T)

    def maps(self, eye: EyeModel) -> Maps:
        """The maps (x, y) from an eye's raw image to its rectified one, for `cv2.remap`."""
        raw = self.raw_pixels(eye, _pixel_grid(self.view.width_px, self.view.height_px))
        # OpenCV leaves pixels far outside black.
        raw = np.where(np.isfinite(raw), raw, -1e6).astype(np.float32)
        return np.ascontiguousarray(raw[..., 0]), np.ascontiguousarray(raw[..., 1])

    def sampled_maps(self) -> Float64[np.ndarray, "2 rows columns 2"]:
        """The maps of both eyes at a few pixels, to compare pairs by."""
        grid = _pixel_grid(self.view.width_px, self.view.height_px, _GRID)
        return np.stack([self.raw_pixels(eye, grid) for eye in (self.left, self.right)])

    def residual_px(self) -> float:
        """What no linear model can hold, in px of the raw images: zero for a lens with one centre of projection.

        It is the greatest distance between where a rectified pixel is taken from and where it is seen, for points at
        `NEAR_M` and far away.
        """
        grid = _pixel_grid(self.view.width_px, self.view.height_px, _GRID)
        apart = [
            self.raw_pixels(eye, grid, depth_m) - self.raw_pixels(eye, grid)
            for eye in (self.left, self.right)
            for depth_m in (NEAR_M, 1e5)
        ]
        return float(np.nanmax(np.linalg.norm(apart, axis=-1)))


def linearise(
    left: EyeModel,
    right: EyeModel,
    size_px: tuple[int, int],
    view: LinearView | None = None,
    where: object = "camera models",
) -> LinearPair:
    """Linearises a pair: the shared x axis along the baseline, the shared z axis as near to both axes as that allows.

    Args:
        left: the left eye.
        right: the right eye, in the same frame.
        size_px: (width, height) of the raw images, and of the rectified ones.
        view: the pinhole; by default the widest one of `size_px` that shows only pixels that both eyes have, but
            not coarser than the raw images at the centre.
        where: for error messages.

    Raises:
        JaxmapError: the eyes are swapped, one above the other, have no baseline, or see nothing in common.
    """
    baseline = right.centre - left.centre
    baseline_m = float(np.linalg.norm(baseline))
    if not baseline_m > 1e-6:
        raise JaxmapError("the stereo baseline is zero", where=where, fix="give the models of both eyes")
    x = baseline / baseline_m
    along = left.axes.T @ x
    if along[0] < 0.7:
        if along[0] < -0.7:
            raise JaxmapError("the right eye stands left of the left one", where=where, fix="swap the two eyes")
        raise JaxmapError("the eyes do not stand side by side", where=where, fix="only horizontal pairs can be matched")
    z = left.axes[:, 2] + right.axes[:, 2]
    z -= (z @ x) * x
    z /= np.linalg.norm(z)
    T_frame_left = np.eye(4)
    T_frame_left[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    T_frame_left[:3, 3] = left.centre
    if view is None:
        view = _widest_view(left, right, T_frame_left[:3, :3], size_px, where)
    return LinearPair(left, right, T_frame_left, baseline_m, view)


class SharedView(NamedTuple):
    """Pairs that share one view: their indices among those given, and, for each, the first with the same maps."""

    kept: list[int]
    pairs: list[LinearPair]
    maps_of: list[int]


def share_view(pairs: Sequence[LinearPair]) -> SharedView:
    """The pairs of the view (size, zoom, part of the detector, baseline) that most have, with one view for all.

    Args:
        pairs: each with a view of its own.
    """
    groups: list[list[int]] = []
    for index, pair in enumerate(pairs):
        same = next((group for group in groups if _looks_the_same(pairs[group[0]], pair)), None)
        if same is None:
            groups.append(same := [])
        same.append(index)
    kept = max(groups, key=len)
    shared = [pairs[index]._replace(view=pairs[kept[0]].view) for index in kept]
    firsts: list[tuple[int, np.ndarray]] = []
    maps_of: list[int] = []
    for row, pair in enumerate(shared):
        sampled = pair.sampled_maps()
        near = (first for first, other in firsts if np.nanmax(np.abs(other - sampled)) < _SAME_MAPS_PX)
        maps_of.append(next(near, row))
        if maps_of[-1] == row:
            firsts.append((row, sampled))
    return SharedView(kept, shared, maps_of)


class PairRectifier:
    """Makes rectified images and labels of the pairs of a shared view; may be called from several threads."""

    def __init__(self, shared: SharedView) -> None:
        """Makes maps when they are first used, and keeps a few."""
        self._maps_of = shared.maps_of
        pairs = {row: shared.pairs[row] for row in set(shared.maps_of)}

        def maps(row: int) -> tuple[Maps, Maps]:
            return pairs[row].maps(pairs[row].left), pairs[row].maps(pairs[row].right)

        self._maps = lru_cache(maxsize=4)(maps)

    def __call__(self, row: int, left: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The rectified images of the pair of a row, bilinear; what lies outside the raw ones is black."""
        left_maps, right_maps = self._maps(self._maps_of[row])
        return _remap(left, left_maps), _remap(right, right_maps)

    def labels(self, row: int, labels: np.ndarray) -> np.ndarray:
        """Label image (H, W) or probabilities (H, W, C) of the raw left image of a row, rectified.

        Labels take the nearest pixel and are `IGNORE` outside; probabilities are interpolated and 0 outside.
        """
        maps = self._maps(self._maps_of[row])[0]
        if labels.ndim == 2:
            return cv2.remap(
                labels, *maps, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=(IGNORE,) * 4
            )
        # With a border, OpenCV remaps at most four channels at once.
        planes = [_remap(np.ascontiguousarray(labels[..., c]), maps) for c in range(labels.shape[2])]
        return np.stack(planes, axis=-1)


def _remap(image: np.ndarray, maps: Maps) -> np.ndarray:
    return cv2.remap(image, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)


def _looks_the_same(one: LinearPair, other: LinearPair) -> bool:
    apart_px = np.abs(np.subtract(one.view, other.view)).max()
    return bool(apart_px < _SAME_VIEW_PX and abs(one.baseline_m / other.baseline_m - 1) < _SAME_BASELINE)


def _widest_view(
    left: EyeModel, right: EyeModel, R_frame_left: np.ndarray, size_px: tuple[int, int], where: object
) -> LinearView:
    width_px, height_px = size_px
    first, last = np.full(2, -np.inf), np.full(2, np.inf)
    lines = np.linspace(0, 1, 33)[:, None] * (np.array(size_px) - 1)
    for eye in (left, right):
        for axis in (0, 1):
            for side, bound, inner in ((0, first, np.maximum), (size_px[axis] - 1, last, np.minimum)):
                edge = lines.copy()
                edge[:, axis] = side
                d = eye.rays(edge)[1] @ R_frame_left
                slopes = d[:, axis] / np.maximum(d[:, 2], _FLATTEST)
                slopes = slopes[np.isfinite(slopes)]
                if len(slopes):
                    bound[axis] = inner(bound[axis], inner.reduce(slopes))
    if not (np.isfinite(first).all() and np.isfinite(last).all() and (last - first > 1e-6).all()):
        raise JaxmapError("the two eyes see nothing in common", where=where, fix="check the camera models")
    middle = (first + last) / 2
    # One px of margin for the models of other pairs of the same eyes, which differ in their last printed digits.
    filling_px = float(((np.array(size_px) + 1) / (last - first)).max())
    focal_px = max(filling_px, _central_focal_px(left, R_frame_left, middle))
    cx_px, cy_px = (np.array(size_px) - 1) / 2 - focal_px * middle
    return LinearView(focal_px, float(cx_px), float(cy_px), width_px, height_px)


def _central_focal_px(eye: EyeModel, R_frame_left: np.ndarray, middle: np.ndarray) -> float:
    """The focal length at which rectified pixels in the middle have the size of raw ones; 0 where unseen."""
    step = 1e-4
    around = np.array([[0, 0, 1], [step, 0, 1], [0, step, 1]]) + np.append(middle, 0)
    raw = eye.project(eye.centre + REFERENCE_M * around @ R_frame_left.T)
    area = abs(np.linalg.det(raw[1:] - raw[0])) / step**2
    return float(np.sqrt(area)) if np.isfinite(area) else 0.0


def _pixel_grid(width_px: int, height_px: int, count: int | None = None) -> Float64[np.ndarray, "rows columns 2"]:
    """Pixels (x, y): all of them, or `count` a side from edge to edge."""
    rows, columns = (np.linspace(0, size - 1, count or size) for size in (height_px, width_px))
    return np.stack(np.meshgrid(columns, rows), axis=-1)

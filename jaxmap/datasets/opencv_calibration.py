"""Stereo calibrations as OpenCV's FileStorage keeps them, in YAML, XML or JSON: `M1 D1 M2 D2 R T`, or `P1 P2`, or `Q`.

The names are those of OpenCV's own samples, in the spellings that programs built on them use. Conventions are OpenCV's:
x_right = R x_left + T, integer pixel centres.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import numpy as np

from jaxmap.datasets.bag_cameras import CameraInfo, raw_rig
from jaxmap.errors import JaxmapError
from jaxmap.host.bounded_text import read_text
from jaxmap.stereo.rectify import StereoRig, make_stereo_rig
from jaxmap.types import StereoCamera, make_stereo_camera

Size = Callable[[], tuple[int, int]]
"""Gives (width, height) of the images, for files that lack it."""

_MOST_XML_BYTES = 2 << 20
_NAMES: dict[str, tuple[str, ...]] = {
    "M": (
        "m#",
        "k#",
        "cm#",
        "a#",
        "cameramatrix#",
        "intrinsic#",
        "intrinsics#",
        "intrinsicmatrix#",
        "mtx#",
    ),
    "D": ("d#", "distcoeffs#", "distcoeff#", "dist#", "distortion#", "distortioncoefficients#", "distcoef#", "dc#"),
    "W": ("r#", "rect#", "rectification#"),
    "P": ("p#", "projection#", "projectionmatrix#", "proj#", "projmatrix#"),
}
"""With the side in place of #, as `M1`, `cameraMatrix1`, `K_left`, `leftDistCoeffs`."""
_SIDES = (("1", "left", "l"), ("2", "right", "r"))
_BETWEEN = {"R": ("r", "rotation", "rotationmatrix", "rmatrix", "rot"), "T": ("t", "translation", "tvec", "trans")}
_SHAPES = {"M": (3, 3), "W": (3, 3), "P": (3, 4), "R": (3, 3), "T": (3,), "Q": (4, 4)}
_SIZES = ("imagesize", "size", "imgsize", "resolution", "imageshape")
_WIDTHS, _HEIGHTS = ("imagewidth", "width", "imgwidth", "cols"), ("imageheight", "height", "imgheight", "rows")


def read_xml(path: Path) -> dict[str, Any]:
    """The top level of a FileStorage in XML, in the form of the one in YAML.

    Raises:
        JaxmapError: it is malformed, too large, or declares entities.
    """
    text = read_text(path, _MOST_XML_BYTES)
    if "<!" in re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL):
        raise JaxmapError("XML with declarations, which is not read", where=path, fix="write it anew with OpenCV")
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError, RecursionError) as fault:
        raise JaxmapError(f"malformed XML ({fault})", where=path, fix="correct or restore the file") from fault
    return {child.tag: _of_xml(child) for child in root}


def _of_xml(element: ElementTree.Element) -> Any:
    fields = {child.tag: (child.text or "").split() for child in element}
    if "data" in fields:
        size = ("".join(fields.get(key, [])) for key in ("rows", "cols"))
        rows, columns = (int(word) if word.isdecimal() and len(word) < 10 else 0 for word in size)
        return {"rows": rows, "cols": columns, "data": fields["data"]}
    words = (element.text or "").split()
    return words[0] if len(words) == 1 else words


def is_opencv(content: Mapping[str, Any]) -> bool:
    """Whether a file holds a stereo calibration of OpenCV's, in whole or in part."""
    found = _Stereo(content, "")
    return found.both("M") or found.both("P") or found.q_there


def opencv_camera(
    content: Mapping[str, Any], path: Path, size_px: Size, *, rectified: bool
) -> tuple[StereoCamera | StereoRig, str]:
    """The camera of a file, and a line on what was taken from it.

    Args:
        content: of the file, and of the file of intrinsics beside it.
        path: the file.
        size_px: of the images; asked where the file does not tell.
        rectified: whether the images are known to be rectified already.

    Raises:
        JaxmapError: something is missing or no matrix, or the numbers are no stereo camera.
    """
    found = _Stereo(content, path)
    size = found.size() or size_px()
    intrinsics, projected, turned = found.both("M", "D"), found.both("P") or found.q_there, found.both("P", "W")
    if (rectified and projected) or (not intrinsics and projected):
        return _projected(found, size, path), "OpenCV's rectified projections, for rectified images"
    if intrinsics and found.between_there:
        rig = make_stereo_rig(
            K_left=found.of("M", 0),
            distortion_left=found.of("D", 0),
            K_right=found.of("M", 1),
            distortion_right=found.of("D", 1),
            R_right_left=found.between("R"),
            t_right_left_m=found.between("T"),
            size_px=size,
            where=path,
        )
        return rig, "OpenCV's M1 D1 M2 D2 R T, for raw images"
    if intrinsics and turned:
        left, right = (found.camera_info(side, size) for side in (0, 1))
        return raw_rig(left, right, None), "K, D, R and P of both cameras, for raw images"
    raise JaxmapError(
        f"no whole stereo calibration: there is {', '.join(map(str, [*content][:12]))}",
        where=path,
        fix="give M1 D1 M2 D2 R T of stereoCalibrate in one file (intrinsics may lie beside it), or P1 P2",
    )


def _projected(found: _Stereo, size_px: tuple[int, int], path: Path) -> StereoCamera:
    """From P1 and P2, or from Q: (X, Y, Z, W) = Q (u, v, d, 1), after `cv2.stereoRectify`."""
    if found.both("P"):
        left, right = found.of("P", 0), found.of("P", 1)
        f, fy, cx, cy = left[0, 0], left[1, 1], left[0, 2], left[1, 2]
        baseline, doffs = (left[0, 3] - right[0, 3]) / f if f else 0.0, right[0, 2] - cx
    else:
        Q = found.q()
        baseline = 0.0 if Q[3, 2] == 0 else 1 / Q[3, 2]
        f = fy = Q[2, 3]
        # d = u_left - u_right; W = (d - (cx_left - cx_right)) / baseline.
        cx, cy, doffs = -Q[0, 3], -Q[1, 3], Q[3, 3] * baseline
    return make_stereo_camera(
        fx_px=f,
        fy_px=fy,
        cx_px=cx,
        cy_px=cy,
        baseline_m=baseline,
        doffs_px=doffs,
        width_px=size_px[0],
        height_px=size_px[1],
        where=f"{path} (left and right swapped?)",
    )


class _Stereo:
    """The matrices of a file, by what they are instead of what they are called."""

    def __init__(self, content: Mapping[str, Any], where: object) -> None:
        self._where = where
        self._values = {re.sub(r"[^a-z0-9]", "", str(key).lower()): (key, value) for key, value in content.items()}
        self.between_there = all(self._find(_BETWEEN[name], name) is not None for name in "RT")
        self.q_there = self._find(("q", "disparitytodepth", "qmatrix"), "Q") is not None

    def both(self, *kinds: str) -> bool:
        return all(self._find(_spellings(kind, side), kind) is not None for kind in kinds for side in (0, 1))

    def camera_info(self, side: int, size_px: tuple[int, int]) -> CameraInfo:
        D = self.of("D", side)
        fields = {"K": self.of("M", side), "D": D, "R": self.of("W", side), "P": self.of("P", side)}
        model = "plumb_bob" if D.size < 8 else "rational_polynomial"
        size = {"width": size_px[0], "height": size_px[1]}
        return CameraInfo(SimpleNamespace(**fields, **size, distortion_model=model), f"{self._where}")

    def of(self, kind: str, side: int) -> np.ndarray:
        return self._matrix(_spellings(kind, side), kind)

    def between(self, name: str) -> np.ndarray:
        return self._matrix(_BETWEEN[name], name)

    def q(self) -> np.ndarray:
        return self._matrix(("q", "disparitytodepth", "qmatrix"), "Q")

    def size(self) -> tuple[int, int] | None:
        """(width, height), if the file tells them."""
        for name in _SIZES:
            numbers = _numbers(self._values.get(name, ("", None))[1])
            if numbers is not None and numbers.size == 2:
                return self._pixels(*numbers)
        width, height = (
            next((_numbers(self._values[name][1]) for name in names if name in self._values), None)
            for names in (_WIDTHS, _HEIGHTS)
        )
        if width is None or height is None or width.size != 1 or height.size != 1:
            return None
        return self._pixels(width.item(), height.item())

    def _pixels(self, width: float, height: float) -> tuple[int, int]:
        if not (1 <= width < 2**20 and 1 <= height < 2**20):
            raise JaxmapError(f"the image size is {width:g}x{height:g}", where=self._where, fix="correct the file")
        return int(width), int(height)

    def _find(self, names: tuple[str, ...], kind: str) -> Any:
        """The key in the file of the first of the names whose value has the form of its kind."""
        for name in names:
            key, value = self._values.get(name, ("", None))
            if value is not None and _shaped(_numbers(value), kind) is not None:
                return key
        return None

    def _matrix(self, names: tuple[str, ...], kind: str) -> np.ndarray:
        key = self._find(names, kind)
        values = next(_shaped(_numbers(value), kind) for found, value in self._values.values() if found == key)
        assert values is not None
        if not np.isfinite(values).all():
            raise JaxmapError(f"{key} holds a number that is not finite", where=self._where, fix="calibrate again")
        return values


def _spellings(kind: str, side: int) -> tuple[str, ...]:
    """All names of a matrix of one side, with the side behind, before or instead of its number."""
    names = [name.replace("#", "") for name in _NAMES[kind]]
    behind = [name + mark for mark in _SIDES[side] for name in names]
    before = [mark + name for mark in _SIDES[side][1:] for name in names]
    return (*behind, *before)


def _numbers(value: Any) -> np.ndarray | None:
    """The numbers of a matrix (`rows`, `cols`, `data`), of a list of rows or of numbers, or of a single one."""
    shape = None
    if isinstance(value, Mapping):
        shape, value = (value.get("rows"), value.get("cols")), value.get("data")
    try:
        numbers = np.asarray(_with_not_finite(value), np.float64)
        return numbers.reshape(shape) if shape is not None and None not in shape else numbers  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        return None


def _with_not_finite(value: Any) -> Any:
    """`.Nan` and `.Inf`, as OpenCV writes them, as Python reads them."""
    if isinstance(value, list):
        return [_with_not_finite(item) for item in value]
    word = value.lower().replace(".", "") if isinstance(value, str) else ""
    return word if word in ("nan", "inf", "-inf") else value


def _shaped(numbers: np.ndarray | None, kind: str) -> np.ndarray | None:
    """The numbers as the matrix that they should be; None where they are another."""
    if numbers is None or numbers.ndim == 0:
        return None
    if kind == "D":
        return numbers.ravel() if numbers.size in (4, 5, 8, 12, 14) and max(numbers.shape) == numbers.size else None
    if kind == "R" and numbers.size == 3:
        import cv2

        return cv2.Rodrigues(numbers.reshape(3, 1))[0]
    shape = _SHAPES[kind]
    return numbers.reshape(shape) if numbers.size == np.prod(shape) and (kind == "T" or numbers.ndim > 1) else None

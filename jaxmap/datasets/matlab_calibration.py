"""Stereo calibrations as MATLAB saves them: `stereoParameters`, as an object or as a plain struct."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxmap.datasets.matlab_objects import structs_of_objects
from jaxmap.errors import JaxmapError
from jaxmap.stereo.rectify import StereoRig, make_stereo_rig

_METRES = {"m": 1.0, "meters": 1.0, "cm": 0.01, "centimeters": 0.01, "mm": 0.001, "millimeters": 0.001, "in": 0.0254}
_METRES |= {"inches": 0.0254, "": 0.001}

_STEREO_KEYS = ("RotationOfCamera2", "TranslationOfCamera2")
_CAMERA_KEYS = ("CameraParameters1", "CameraParameters2")


def read_matlab_calibration(path: Path, size_px: tuple[int, int]) -> StereoRig:
    """Reads the `stereoParameters` of a MAT file (version 5 to 7).

    MATLAB multiplies row vectors from the left, so that its matrices are the transposes of OpenCV's,
    and counts pixels from 1. Lengths are in the calibration's world units, usually mm.

    Args:
        path: the file.
        size_px: (width, height), where the file does not say it; old ones do not.

    Raises:
        JaxmapError: no MAT file, without a stereo calibration, or with skewed pixels, which are not modelled.
    """
    # Loads much that no other reader needs.
    from scipy.io import loadmat

    if not path.is_file():
        raise JaxmapError(f"there is no file {path}", fix="check the path")
    try:
        content = loadmat(path, simplify_cells=True)
    except NotImplementedError as fault:
        raise JaxmapError("a MAT file of version 7.3", where=path, fix="save it in MATLAB with -v7") from fault
    except Exception as fault:
        # Damaged files raise nearly anything in the parser.
        raise JaxmapError(f"not a MAT file ({type(fault).__name__})", where=path, fix="restore the file") from fault
    for stereo in _structs(content):
        if all(isinstance(stereo.get(key), Mapping) for key in _CAMERA_KEYS) and set(_STEREO_KEYS) <= set(stereo):
            return _rig(stereo["CameraParameters1"], stereo["CameraParameters2"], stereo, size_px, path)
    # Objects refer to each other by numbers; the two cameras are saved in their order.
    hidden = content.get("__function_workspace__")
    structs = [] if hidden is None else structs_of_objects(np.asarray(hidden).tobytes(), path)
    cameras = [struct for struct in structs if "RadialDistortion" in struct]
    stereo = next((struct for struct in structs if set(_STEREO_KEYS) <= set(struct)), None)
    if stereo is None or len(cameras) < 2:
        raise JaxmapError(
            "no stereoParameters", where=path, fix="save that object or its toStruct, or write the numbers as YAML"
        )
    return _rig(cameras[0], cameras[1], stereo, size_px, path)


def _structs(value: Any) -> Iterator[Mapping[str, Any]]:
    """All structs inside a value, outer ones first."""
    if isinstance(value, Mapping):
        yield value
        for inner in value.values():
            yield from _structs(inner)


def _rig(
    left: Mapping[str, Any], right: Mapping[str, Any], stereo: Mapping[str, Any], size_px: tuple[int, int], path: Path
) -> StereoRig:
    unit = str(left.get("WorldUnits", "mm")).lower()
    if unit not in _METRES:
        raise JaxmapError(f"lengths in {unit!r}", where=path, fix=f"calibrate in {', '.join(filter(None, _METRES))}")
    cameras = {}
    for side, camera in (("left", left), ("right", right)):
        cameras[f"K_{side}"] = _pinhole(camera, path)
        cameras[f"distortion_{side}"] = _distortion(camera, path)
    return make_stereo_rig(
        **cameras,
        R_right_left=_array(stereo, "RotationOfCamera2", (3, 3), path).T,
        t_right_left_m=_array(stereo, "TranslationOfCamera2", (3,), path) * _METRES[unit],
        size_px=_image_size(left, size_px),
        where=path,
    )


def _pinhole(camera: Mapping[str, Any], path: Path) -> np.ndarray:
    # MATLAB calls the transpose IntrinsicMatrix; from R2022b on there is K as well.
    K = _array(camera, "IntrinsicMatrix", (3, 3), path).T if "IntrinsicMatrix" in camera else None
    K = np.array(_array(camera, "K", (3, 3), path) if K is None else K)
    if abs(K[0, 1]) > 1e-6 * abs(K[0, 0]):
        raise JaxmapError(f"skewed pixels (skew {K[0, 1]:g})", where=path, fix="calibrate without EstimateSkew")
    K[:2, 2] -= 1
    return K


def _distortion(camera: Mapping[str, Any], path: Path) -> np.ndarray:
    """OpenCV's k1 k2 p1 p2 k3."""
    radial, tangential = (
        np.ravel(camera.get("RadialDistortion", [])),
        np.ravel(camera.get("TangentialDistortion", [0, 0])),
    )
    if radial.size not in (2, 3) or tangential.size != 2 or {radial.dtype.kind, tangential.dtype.kind} - set("fiu"):
        raise JaxmapError("not 2 or 3 radial and 2 tangential coefficients", where=path, fix="restore the file")
    return np.concatenate([radial[:2], tangential, radial[2:]])


def _array(struct: Mapping[str, Any], key: str, shape: tuple[int, ...], path: Path) -> np.ndarray:
    try:
        return np.asarray(struct[key], np.float64).reshape(shape)
    except (KeyError, TypeError, ValueError) as fault:
        size = "x".join(map(str, shape))
        raise JaxmapError(f"{key} is missing, or is not {size} numbers", where=path, fix="restore the file") from fault


def _image_size(camera: Mapping[str, Any], size_px: tuple[int, int]) -> tuple[int, int]:
    """MATLAB's ImageSize is [rows, columns], and empty in old calibrations."""
    size = np.ravel(camera.get("ImageSize", []))
    return (int(size[1]), int(size[0])) if size.size == 2 and size.dtype.kind in "iuf" and size.all() else size_px

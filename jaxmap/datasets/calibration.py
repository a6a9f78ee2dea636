"""The calibration file of plain folders: a rectified or a raw stereo pair, and the mounting of the camera."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import get_args

import numpy as np
import yaml
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from jaxmap.datasets.matlab import is_matlab
from jaxmap.datasets.text_files import image_size, load_yaml, number, number_list
from jaxmap.errors import JaxmapError
from jaxmap.host.files import atomic_path
from jaxmap.stereo.rectify import StereoRig, make_stereo_rig
from jaxmap.types import DistortionModel, StereoCamera, make_stereo_camera

_RECTIFIED_KEYS = ("image_size_px", "fx_px", "cx_px", "cy_px", "baseline_m")
_RECTIFIED_OPTIONAL = ("fy_px", "doffs_px", "mounting")
_RAW_KEYS = ("image_size_px", "left", "right", "R_right_left", "t_right_left_m")
_RAW_OPTIONAL = ("doffs_px", "distortion_model", "mounting")
_RAW_CAMERA_KEYS = ("fx_px", "fy_px", "cx_px", "cy_px", "distortion")


def read_camera_yaml(path: Path) -> StereoCamera | StereoRig:
    """Reads the calibration of a plain folder: rectified or raw, depending on the keys.

    Rectified (`fy_px` is `fx_px` and `doffs_px`, the right principal point minus the left one, is 0
    where absent)::

        image_size_px: [1226, 370]     # width, height
        fx_px: 707.09
        cx_px: 601.89
        cy_px: 183.11
        baseline_m: 0.537

    Raw, with OpenCV's conventions: integer pixel centres, distortion `k1 k2 p1 p2 [k3 [k4 k5 k6]]`,
    `x_right = R_right_left x_left + t_right_left_m`::

        image_size_px: [752, 480]
        left: {fx_px: 458.6, fy_px: 457.3, cx_px: 367.2, cy_px: 248.4, distortion: [-0.28, 0.07, 0, 0]}
        right: {fx_px: 457.6, fy_px: 456.1, cx_px: 380.0, cy_px: 255.2, distortion: [-0.28, 0.07, 0, 0]}
        R_right_left: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
        t_right_left_m: [-0.11, 0, 0]
        doffs_px: 0.1                  # optional, added to the disparity offset of the rectified pair
        distortion_model: equidistant  # optional: fisheye cameras, distortion k1 k2 k3 k4 of cv2.fisheye

    Both may hold `mounting`, see `read_mounting`.

    Raises:
        JaxmapError: the file is malformed, keys are missing or unknown (all are named), a value has
            another type, or the numbers do not describe a camera pair.
    """
    content = load_yaml(path)
    if any(key in content for key in ("left", "right", "R_right_left", "t_right_left_m")):
        return _raw_rig(content, path)
    _check_keys(path, [("", content, _RECTIFIED_KEYS, _RECTIFIED_OPTIONAL)])
    width_px, height_px = image_size(content["image_size_px"], "image_size_px", path)
    present = [key for key in (*_RECTIFIED_KEYS[1:], "fy_px", "doffs_px") if key in content]
    numbers = {key: number(content[key], key, path) for key in present}
    return make_stereo_camera(**numbers, width_px=width_px, height_px=height_px, where=path)


_OWN_KEYS = ("fx_px", "baseline_m", "image_size_px", "R_right_left", "t_right_left_m")


def is_own(content: Mapping) -> bool:
    """Whether the keys of a file are some of those that `read_camera_yaml` reads."""
    return any(key in content for key in _OWN_KEYS)


def read_mounting(path: Path) -> Float64[np.ndarray, "4 4"]:
    """T_nominal_camera: where the left camera really sits in the nominal camera's frame; identity without `mounting`.

    Only jaxmap's own files hold one.

    It corrects poses that were derived for the nominal camera: `T_world_camera = T_world_nominal @ T_nominal_camera`::

        mounting:
          translation_m: [0.0, -0.02, 0.01]     # in the nominal camera frame (of the images as they lie on disk)
          rotation_vector_rad: [0.035, 0.0, 0.0]

    Raises:
        JaxmapError: the file is malformed, or the mounting is not those two lists of three numbers.
    """
    T = np.eye(4)
    if not path.is_file() or path.suffix.lower() == ".xml" or is_matlab(path):
        return T
    mounting = load_yaml(path).get("mounting")
    if mounting is None:
        return T
    keys = ("translation_m", "rotation_vector_rad")
    if not isinstance(mounting, Mapping) or set(mounting) != set(keys):
        raise JaxmapError(f"mounting does not hold {' and '.join(keys)}", where=path, fix="give both, or no mounting")
    translation, turn = (number_list(mounting[key], f"mounting.{key}", path, count=3) for key in keys)
    if not (np.isfinite(translation).all() and np.isfinite(turn).all()):
        raise JaxmapError("mounting holds a number that is not finite", where=path, fix="correct the file")
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), translation
    return T


def write_camera_yaml(
    path: Path, camera: StereoCamera | StereoRig, T_nominal_camera: Float64[np.ndarray, "4 4"] | None = None
) -> None:
    """Writes a calibration that `read_camera_yaml` and `read_mounting` read.

    Args:
        path: the file.
        camera: rectified or raw.
        T_nominal_camera: the mounting, left out where it is None.

    Raises:
        JaxmapError: the file cannot be written.
    """
    tree: dict[str, object] = {"image_size_px": [camera.width_px, camera.height_px]}
    if isinstance(camera, StereoCamera):
        names = ("fx_px", "fy_px", "cx_px", "cy_px", "baseline_m", "doffs_px")
        # The shortest decimals that give the float32 back.
        tree |= {name: float(str(np.float32(getattr(camera, name)))) for name in names}
    else:
        for side in ("left", "right"):
            K = getattr(camera, f"K_{side}")
            numbers = (K[0, 0], K[1, 1], K[0, 2], K[1, 2])
            named = {key: float(value) for key, value in zip(_RAW_CAMERA_KEYS[:4], numbers, strict=True)}
            tree[side] = {**named, "distortion": getattr(camera, f"distortion_{side}").tolist()}
        tree["R_right_left"] = camera.R_right_left.tolist()
        tree["t_right_left_m"] = camera.t_right_left_m.tolist()
        tree["doffs_px"] = float(camera.doffs_px)
        if camera.model != "opencv":
            tree["distortion_model"] = camera.model
    if T_nominal_camera is not None:
        turn = Rotation.from_matrix(T_nominal_camera[:3, :3]).as_rotvec()
        tree["mounting"] = {"translation_m": T_nominal_camera[:3, 3].tolist(), "rotation_vector_rad": turn.tolist()}
    with atomic_path(path) as temporary:
        temporary.write_text(yaml.safe_dump(tree, sort_keys=False), encoding="utf-8")


def _raw_rig(content: Mapping, path: Path) -> StereoRig:
    sections: list[tuple[str, Mapping, tuple[str, ...], tuple[str, ...]]] = [("", content, _RAW_KEYS, _RAW_OPTIONAL)]
    for side in ("left", "right"):
        if isinstance(content.get(side), Mapping):
            sections.append((f"{side}.", content[side], _RAW_CAMERA_KEYS, ()))
        elif side in content:
            raise JaxmapError(f"{side} is not a mapping", where=path, fix=f"give it {' '.join(_RAW_CAMERA_KEYS)}")
    _check_keys(path, sections)
    values = {}
    for side in ("left", "right"):
        values[f"K_{side}"] = pinhole_matrix(
            *(number(content[side][key], f"{side}.{key}", path) for key in _RAW_CAMERA_KEYS[:4])
        )
        values[f"distortion_{side}"] = number_list(content[side]["distortion"], f"{side}.distortion", path)
    rows = content["R_right_left"]
    if not isinstance(rows, Sequence) or isinstance(rows, str) or len(rows) != 3:
        raise JaxmapError("R_right_left is not three rows", where=path, fix="give [[..3], [..3], [..3]]")
    return make_stereo_rig(
        **values,
        R_right_left=np.stack([number_list(row, "R_right_left", path, count=3) for row in rows]),
        t_right_left_m=number_list(content["t_right_left_m"], "t_right_left_m", path, count=3),
        size_px=image_size(content["image_size_px"], "image_size_px", path),
        doffs_px=number(content.get("doffs_px", 0.0), "doffs_px", path),
        model=_distortion_model(content, path),
        where=path,
    )


def _distortion_model(content: Mapping, path: Path) -> DistortionModel:
    model = content.get("distortion_model", "opencv")
    if model not in get_args(DistortionModel):
        raise JaxmapError(
            f"distortion_model is {model!r:.40}", where=path, fix=f"give {' or '.join(get_args(DistortionModel))}"
        )
    return model


def pinhole_matrix(fx_px: float, fy_px: float, cx_px: float, cy_px: float) -> np.ndarray:
    """The 3x3 camera matrix."""
    return np.array([[fx_px, 0.0, cx_px], [0.0, fy_px, cy_px], [0.0, 0.0, 1.0]])


def _check_keys(path: Path, sections: Sequence[tuple[str, Mapping, Sequence[str], Sequence[str]]]) -> None:
    missing, unknown = [], []
    for prefix, content, required, optional in sections:
        missing += [prefix + key for key in required if key not in content]
        unknown += [f"{prefix}{key}" for key in content if key not in (*required, *optional)]
    if missing or unknown:
        faults = [f"missing {', '.join(missing)}"] * bool(missing) + [f"unknown {', '.join(unknown)}"] * bool(unknown)
        raise JaxmapError(
            f"calibration keys {' and '.join(faults)}",
            where=path,
            fix=f"a rectified pair has {' '.join(_RECTIFIED_KEYS)} [{' '.join(_RECTIFIED_OPTIONAL)}], "
            f"a raw one {' '.join(_RAW_KEYS)} [{' '.join(_RAW_OPTIONAL)}]; files of OpenCV, ROS, Kalibr and MATLAB are "
            "read as they are",
        )

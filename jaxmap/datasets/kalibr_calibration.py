"""Camera chains of Kalibr: `cam0` and `cam1` with intrinsics, distortion and the transform between them."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from jaxmap.datasets.calibration import pinhole_matrix
from jaxmap.datasets.text_files import image_size, number_list
from jaxmap.errors import JaxmapError
from jaxmap.stereo.rectify import StereoRig, make_stereo_rig
from jaxmap.types import DistortionModel

_MODELS: dict[str, DistortionModel] = {
    **dict.fromkeys(("radtan", "radial-tangential", "plumb_bob"), "opencv"),
    **dict.fromkeys(("equi", "equidistant"), "equidistant"),
}


def is_kalibr(content: Mapping[str, Any]) -> bool:
    """Whether a file is a chain of cameras."""
    return any(isinstance(content.get(name), Mapping) and "intrinsics" in content[name] for name in _cameras(content))


def _cameras(content: Mapping[str, Any]) -> list[str]:
    names = [name for name in content if isinstance(name, str) and re.fullmatch(r"cam[0-9]{1,3}", name)]
    return sorted(names, key=lambda name: int(name[3:]))


def kalibr_camera(content: Mapping[str, Any], path: Path) -> tuple[StereoRig, str]:
    """The rig of the first two cameras of a chain, and a line on which is which.

    `T_cn_cnm1` takes points of the camera before to this one, `T_cam_imu` those of the IMU. The camera that stands on
    the left is the left one.

    Raises:
        JaxmapError: fewer cameras than two, a model that is not supported, or no transform between them.
    """
    names = _cameras(content)
    if len(names) < 2:
        raise JaxmapError("a chain of one camera", where=path, fix="calibrate both cameras together")
    first, second = ((name, content[name]) for name in names[:2])
    cameras = [_camera(name, chain, path) for name, chain in (first, second)]
    if cameras[0]["size_px"] != cameras[1]["size_px"] or cameras[0]["model"] != cameras[1]["model"]:
        raise JaxmapError("the cameras differ in resolution or model", where=path, fix="calibrate both alike")
    T = _between(first, second, path)
    # x_second = T x_first: a first camera on the left sees the second's centre at positive x.
    if (-T[:3, :3].T @ T[:3, 3])[0] < 0:
        first, second, T = second, first, np.linalg.inv(T)
        cameras.reverse()
    rig = make_stereo_rig(
        K_left=cameras[0]["K"],
        distortion_left=cameras[0]["distortion"],
        K_right=cameras[1]["K"],
        distortion_right=cameras[1]["distortion"],
        R_right_left=T[:3, :3],
        t_right_left_m=T[:3, 3],
        size_px=cameras[0]["size_px"],
        model=cameras[0]["model"],
        where=path,
    )
    more = f"; {len(names) - 2} more cameras are left out" if len(names) > 2 else ""
    return rig, f"Kalibr's {first[0]} (left) and {second[0]} (right), for raw images{more}"


def _camera(name: str, chain: Any, path: Path) -> dict[str, Any]:
    if not isinstance(chain, Mapping):
        raise JaxmapError(f"{name} is no camera", where=path, fix="restore the file")
    needed = ("intrinsics", "resolution", "distortion_model", "distortion_coeffs")
    missing = [f"{name}.{key}" for key in needed if key not in chain]
    if missing:
        raise JaxmapError(f"keys are missing: {', '.join(missing)}", where=path, fix="restore the file")
    model = (str(chain.get("camera_model", "pinhole")), str(chain["distortion_model"]))
    if model[0] != "pinhole" or model[1] not in (*_MODELS, "none"):
        raise JaxmapError(
            f"{name} is {model[0]} with {model[1]} distortion"[:100],
            where=path,
            fix="pinhole with radtan or equi is read; calibrate with one of them",
        )
    none, coefficients = model[1] == "none", np.zeros(4)
    if not none:
        coefficients = number_list(chain["distortion_coeffs"], f"{name}.distortion_coeffs", path, count=4)
    return {
        "K": pinhole_matrix(*number_list(chain["intrinsics"], f"{name}.intrinsics", path, count=4)),
        "distortion": coefficients,
        "model": "opencv" if none else _MODELS[model[1]],
        "size_px": image_size(chain["resolution"], f"{name}.resolution", path),
    }


def _between(
    first: tuple[str, Mapping[str, Any]], second: tuple[str, Mapping[str, Any]], path: Path
) -> Float64[np.ndarray, "4 4"]:
    """T_second_first."""
    if "T_cn_cnm1" in second[1]:
        return _transform(second[1]["T_cn_cnm1"], f"{second[0]}.T_cn_cnm1", path)
    if all("T_cam_imu" in camera for _, camera in (first, second)):
        T = [_transform(camera["T_cam_imu"], f"{name}.T_cam_imu", path) for name, camera in (first, second)]
        return T[1] @ np.linalg.inv(T[0])
    raise JaxmapError(
        f"nothing says where {second[0]} is: no T_cn_cnm1, no T_cam_imu", where=path, fix="calibrate both together"
    )


def _transform(value: Any, key: str, path: Path) -> Float64[np.ndarray, "4 4"]:
    try:
        T = np.asarray(value, np.float64).reshape(4, 4)
    except (TypeError, ValueError) as fault:
        raise JaxmapError(f"{key} is not four rows of four numbers", where=path, fix="restore the file") from fault
    if not np.isfinite(T).all() or np.abs(T[3] - [0, 0, 0, 1]).max() > 1e-6:
        raise JaxmapError(f"{key} is no rigid transform", where=path, fix="restore the file")
    return T

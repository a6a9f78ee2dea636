"""Pairs of ROS's `camera_info` files: a YAML for each camera, as calibrators write it or as a message prints."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from jaxmap.datasets.bag_cameras import CameraInfo, raw_rig, rectified_camera
from jaxmap.datasets.text_files import load_yaml
from jaxmap.errors import JaxmapError
from jaxmap.stereo.rectify import StereoRig
from jaxmap.types import StereoCamera

_MATRICES = {
    "K": ("camera_matrix", 9),
    "D": ("distortion_coefficients", None),
    "R": ("rectification_matrix", 9),
    "P": ("projection_matrix", 12),
}
_PARTNERS = (
    ("left", "right"),
    ("Left", "Right"),
    ("LEFT", "RIGHT"),
    ("_l", "_r"),
    ("-l", "-r"),
    ("0", "1"),
    ("1", "2"),
)
_SUFFIXES = (".yaml", ".yml")


def is_camera_info(content: Mapping[str, Any]) -> bool:
    """Whether a file is the `camera_info` of one camera."""
    return any(key in content for key in ("projection_matrix", "P", "p")) and any(
        key in content for key in ("camera_matrix", "K", "k")
    )


def camera_info_pair(path: Path) -> tuple[Path, Path] | None:
    """The files of the left and the right camera: those in a folder, or a file and its partner of the other name.

    None where no partner is there.
    """
    if path.is_dir():
        files = sorted(file for file in path.iterdir() if file.suffix.lower() in _SUFFIXES)
        pairs = [pair for file in files if (pair := _partner(file)) is not None and pair[0] == file]
        return pairs[0] if len(pairs) == 1 else None
    return _partner(path)


def _partner(path: Path) -> tuple[Path, Path] | None:
    for left, right in _PARTNERS:
        for mine, other in ((left, right), (right, left)):
            # The last place first: left0_left.yaml.
            for match in reversed([*re.finditer(re.escape(mine), path.stem)]):
                name = path.stem[: match.start()] + other + path.stem[match.end() :]
                partner = path.with_name(name + path.suffix)
                if partner.is_file():
                    return (path, partner) if mine == left else (partner, path)
    return None


def ros_camera(path: Path, *, rectified: bool) -> tuple[StereoCamera | StereoRig, str]:
    """The camera of two files, and a line on what was taken from them.

    Args:
        path: the file of either camera, or the folder of both.
        rectified: whether the images are known to be rectified already.

    Raises:
        JaxmapError: the partner is missing, a file is malformed, or the numbers are no stereo camera.
    """
    pair = camera_info_pair(path)
    if pair is None:
        raise JaxmapError(
            "the camera_info of one camera, and no file of the other",
            where=path,
            fix="put both into one folder as left.yaml and right.yaml, and give either",
        )
    left, right = (camera_info(load_yaml(file), file) for file in pair)
    if left.size_px != right.size_px:
        raise JaxmapError("the cameras differ in resolution", where=f"{pair[0]} and {pair[1]}", fix="calibrate anew")
    names = f"{pair[0].name} (left) and {pair[1].name}"
    if rectified or (left.undistorted and right.undistorted):
        return rectified_camera(left, right, None), f"P of {names}, for rectified images"
    return raw_rig(left, right, None), f"K, D, R and P of {names}, for raw images"


def camera_info(content: Mapping[str, Any], path: Path) -> CameraInfo:
    """One camera: matrices under the names of the calibrators or of the message.

    Raises:
        JaxmapError: a matrix is missing or of another size.
    """
    fields: dict[str, Any] = {}
    for short, (long, count) in _MATRICES.items():
        value = next((content[key] for key in (long, short, short.lower()) if key in content), None)
        value = value.get("data") if isinstance(value, Mapping) else value
        try:
            numbers = np.asarray([] if value is None else value, np.float64).ravel()
        except (TypeError, ValueError) as fault:
            raise JaxmapError(f"{long} is not numbers", where=path, fix="restore the file") from fault
        if count is not None and numbers.size != count:
            raise JaxmapError(f"{long} has {numbers.size} numbers, not {count}", where=path, fix="restore the file")
        fields[short] = numbers
    try:
        size = {
            name: int(content.get(f"image_{name}", content.get(name, 0)))  # type: ignore[arg-type]
            for name in ("width", "height")
        }
    except (TypeError, ValueError) as fault:
        raise JaxmapError("image_width or image_height is no number", where=path, fix="correct the file") from fault
    model = str(content.get("distortion_model", content.get("camera_model", "plumb_bob")))
    return CameraInfo(SimpleNamespace(**fields, **size, distortion_model=model), str(path))

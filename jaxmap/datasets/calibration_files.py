"""`--calibration` of any reader: jaxmap's own YAML, or files of OpenCV, ROS, Kalibr or MATLAB, told by content."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from jaxmap.datasets.calibration import is_own, read_camera_yaml
from jaxmap.datasets.images import first_image_size_px
from jaxmap.datasets.kalibr_calibration import is_kalibr, kalibr_camera
from jaxmap.datasets.matlab import is_matlab, read_matlab_calibration
from jaxmap.datasets.opencv_calibration import is_opencv, opencv_camera, read_xml
from jaxmap.datasets.ros_calibration import camera_info_pair, is_camera_info, ros_camera
from jaxmap.datasets.text_files import load_yaml
from jaxmap.errors import JaxmapError
from jaxmap.stereo.rectify import StereoRig
from jaxmap.types import StereoCamera

_TEXTS = (".yaml", ".yml", ".xml", ".json")


class Calibration(NamedTuple):
    """A camera, and lines for the user on what was taken from the file."""

    camera: StereoCamera | StereoRig
    notes: tuple[str, ...] = ()


def read_calibration(path: Path, images: Sequence[Path] = (), *, rectified: bool | None = None) -> Calibration:
    """Reads a calibration of any kind.

    Files of OpenCV and ROS describe raw and rectified images at once. OpenCV's intrinsics may lie in another file
    beside the extrinsics; those of ROS lie in a file for each camera: either, or their folder, stands for both. Lengths
    are metres, except MATLAB's, whose unit the file tells.

    Args:
        path: the file, or the folder of two.
        images: left images, whose size is taken where the file does not tell it.
        rectified: whether the images are rectified, where the file is for both; by default they are if "rect" is in
            the name of the first of them or of its folder.

    Raises:
        JaxmapError: the file is of no known kind, incomplete, or its numbers are no stereo camera.
    """

    def size_px() -> tuple[int, int]:
        if not images:
            raise JaxmapError("the image size is missing", where=path, fix="add image_width and image_height")
        return first_image_size_px(images, path)

    if rectified is None:
        rectified = bool(images) and any("rect" in part.lower() for part in (images[0].stem, images[0].parent.name))
    if path.is_dir():
        return _of(path, *_of_folder(path, size_px, rectified=rectified))
    if is_matlab(path):
        return _of(path, read_matlab_calibration(path, size_px), "MATLAB's stereoParameters, for raw images")
    content = _content(path)
    if is_own(content):
        return Calibration(read_camera_yaml(path))
    if is_kalibr(content):
        return _of(path, *kalibr_camera(content, path))
    if is_camera_info(content):
        return _of(path, *ros_camera(path, rectified=rectified))
    content = _with_intrinsics(content, path)
    if is_opencv(content):
        return _of(path, *opencv_camera(content, path, size_px, rectified=rectified))
    if any(key in content for key in ("camera_matrix", "Camera_Matrix", "distortion_coefficients")):
        raise JaxmapError(
            "the calibration of one camera", where=path, fix="calibrate the pair: stereoCalibrate gives R and T as well"
        )
    if path.suffix.lower() in (".xml", ".json"):
        raise JaxmapError(
            f"no stereo calibration: there is {', '.join(map(str, [*content][:8])) or 'nothing'}"[:160],
            where=path,
            fix="OpenCV's M1 D1 M2 D2 R T, or P1 P2, are read",
        )
    # Its error names the keys of jaxmap's own files.
    return Calibration(read_camera_yaml(path))


def _of(path: Path, camera: StereoCamera | StereoRig, taken: str) -> Calibration:
    return Calibration(camera, (f"calibration from {path.name}: {taken}",))


def _content(path: Path) -> dict[str, Any]:
    if path.suffix.lower() == ".xml":
        return read_xml(path)
    return load_yaml(path)


def _with_intrinsics(content: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """The content, with that of the one file of intrinsics beside it where it has none itself.

    OpenCV's sample of stereo calibration writes intrinsics.yml and extrinsics.yml.
    """
    if "M1" in content or not {"R", "T"} <= content.keys():
        return dict(content)
    beside = [
        file
        for file in sorted(path.parent.iterdir())
        if "intrinsic" in file.name.lower() and file.suffix.lower() in _TEXTS and file != path
    ]
    return {**_content(beside[0]), **content} if len(beside) == 1 else dict(content)


def _of_folder(path: Path, size_px: Any, *, rectified: bool) -> tuple[StereoCamera | StereoRig, str]:
    extrinsics = [file for file in sorted(path.iterdir()) if file.name.lower().startswith("extrinsic")]
    extrinsics = [file for file in extrinsics if file.suffix.lower() in _TEXTS]
    if len(extrinsics) == 1:
        content = _with_intrinsics(_content(extrinsics[0]), extrinsics[0])
        return opencv_camera(content, extrinsics[0], size_px, rectified=rectified)
    if camera_info_pair(path) is None:
        raise JaxmapError(
            "a folder without one pair of camera_info files, left and right, and without OpenCV's extrinsics",
            where=path,
            fix="give the calibration file itself",
        )
    return ros_camera(path, rectified=rectified)

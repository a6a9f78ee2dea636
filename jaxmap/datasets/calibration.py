"""Calibration files of plain folders, and safe reading of text and YAML."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import yaml
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from jaxmap.errors import JaxmapError
from jaxmap.host.files import atomic_path
from jaxmap.stereo.rectify import StereoRig, make_stereo_rig
from jaxmap.types import StereoCamera, make_stereo_camera

_RECTIFIED_KEYS = ("image_size_px", "fx_px", "cx_px", "cy_px", "baseline_m")
_RECTIFIED_OPTIONAL = ("fy_px", "doffs_px", "mounting")
_RAW_KEYS = ("image_size_px", "left", "right", "R_right_left", "t_right_left_m")
_RAW_OPTIONAL = ("doffs_px", "mounting")
_RAW_CAMERA_KEYS = ("fx_px", "fy_px", "cx_px", "cy_px", "distortion")


def read_text(path: Path) -> str:
    """The text of a UTF-8 file (a byte order mark is dropped).

    Raises:
        JaxmapError: the file is missing, cannot be read, or is not text.
    """
    try:
        with open(path, "rb") as file:
            data = file.read(4096)
            # Stops here for a bag or an image given by mistake, before gigabytes are read.
            if b"\0" not in data:
                data += file.read()
    except FileNotFoundError as fault:
        raise JaxmapError(f"there is no file {path}", fix="check the path") from fault
    except (OSError, ValueError) as fault:
        raise JaxmapError(f"the file cannot be read ({fault})", where=path, fix="check the path") from fault
    try:
        if b"\0" in data:
            raise ValueError("it holds zero bytes")
        return data.decode("utf-8-sig")
    except ValueError as fault:
        raise JaxmapError("not a text file", where=path, fix="give a UTF-8 text file") from fault


def data_lines(path: Path) -> list[tuple[int, str]]:
    """The lines of a text file that are neither empty nor `#` comments, with their numbers from 1.

    Raises:
        JaxmapError: the file is missing or is not text.
    """
    lines = ((number, line.strip()) for number, line in enumerate(read_text(path).split("\n"), start=1))
    return [(number, line) for number, line in lines if line and not line.startswith("#")]


def load_yaml(path: Path) -> dict:
    """Safe-loads a YAML file whose top level is a mapping.

    OpenCV's header `%YAML:1.0`, which EuRoC's files carry and YAML does not allow, is tolerated.

    Raises:
        JaxmapError: the file is missing, is not text, is malformed (with the line), or is no mapping.
    """
    text = read_text(path)
    if text.startswith("%YAML:"):
        # The line break stays, so that errors name the right line.
        text = "".join(text.partition("\n")[1:])
    try:
        content = yaml.safe_load(text)
    except yaml.MarkedYAMLError as fault:
        mark = fault.problem_mark or fault.context_mark
        place = f"{path} line {mark.line + 1}" if mark else path
        raise JaxmapError(
            f"malformed YAML ({fault.problem or fault.context})", where=place, fix="correct or restore the file"
        ) from fault
    except Exception as fault:
        # PyYAML lets ValueError, KeyError, RecursionError and others of its constructors through.
        raise JaxmapError(f"malformed YAML ({fault})", where=path, fix="correct or restore the file") from fault
    if not isinstance(content, dict):
        raise JaxmapError("no keys and values", where=path, fix="the file must hold `key: value` lines; restore it")
    return content


def read_camera_yaml(path: Path) -> StereoCamera | StereoRig:
    """Reads the calibration of a plain folder: rectified or raw, told apart by the keys.

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

    Both may hold `mounting`, see `read_mounting`.

    Raises:
        JaxmapError: the file is malformed, keys are missing or unknown (all are named), a value has
            another type, or the numbers describe no camera pair.
    """
    content = load_yaml(path)
    if any(key in content for key in ("left", "right", "R_right_left", "t_right_left_m")):
        return _raw_rig(content, path)
    _check_keys(path, [("", content, _RECTIFIED_KEYS, _RECTIFIED_OPTIONAL)])
    width_px, height_px = image_size(content["image_size_px"], "image_size_px", path)
    present = [key for key in (*_RECTIFIED_KEYS[1:], "fy_px", "doffs_px") if key in content]
    numbers = {key: number(content[key], key, path) for key in present}
    return make_stereo_camera(**numbers, width_px=width_px, height_px=height_px, where=path)


def read_mounting(path: Path) -> Float64[np.ndarray, "4 4"]:
    """T_nominal_camera: where the left camera sits, if otherwise than its poses assume; else identity.

    Moves poses that were derived for the nominal camera: `T_world_camera = T_world_nominal @ T_nominal_camera`::

        mounting:
          translation_m: [0.0, -0.02, 0.01]     # in the nominal camera frame (of the images as they lie on disk)
          rotation_vector_rad: [0.035, 0.0, 0.0]

    Raises:
        JaxmapError: the file is malformed, or the mounting is not those two lists of three numbers.
    """
    T = np.eye(4)
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
        # float32 as the short decimals they stand for.
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
        where=path,
    )


def pinhole_matrix(fx_px: float, fy_px: float, cx_px: float, cy_px: float) -> np.ndarray:
    """The 3x3 camera matrix."""
    return np.array([[fx_px, 0.0, cx_px], [0.0, fy_px, cy_px], [0.0, 0.0, 1.0]])


def number(value: object, key: str, path: Path) -> float:
    """A number of a YAML file; text that reads as one counts, since YAML 1.1 takes `1e-3` for text.

    Raises:
        JaxmapError: it is none; the error names the key.
    """
    if isinstance(value, int | float | str) and not isinstance(value, bool):
        try:
            return float(value)
        except (ValueError, OverflowError):
            pass
    raise JaxmapError(f"{key} is {value!r:.60}, not a number", where=path, fix=f"give {key} a number")


def number_list(value: object, key: str, path: Path, count: int | None = None) -> np.ndarray:
    """A list of numbers of a YAML file as float64 (count,).

    Raises:
        JaxmapError: it is no list of that many numbers; the error names the key.
    """
    if not isinstance(value, list) or (count is not None and len(value) != count):
        raise JaxmapError(
            f"{key} is not a list of {'numbers' if count is None else f'{count} numbers'}",
            where=path,
            fix="write it as [a, b, ...]",
        )
    return np.array([number(item, key, path) for item in value], np.float64)


def image_size(value: object, key: str, path: Path) -> tuple[int, int]:
    """A `[width, height]` of a YAML file, in pixels.

    Raises:
        JaxmapError: it is none; the error names the key.
    """
    width, height = number_list(value, key, path, count=2)
    if not (1 <= width < 2**20 and 1 <= height < 2**20) or width % 1 or height % 1:
        raise JaxmapError(f"{key} is {value}", where=path, fix="give [width, height] in whole pixels")
    return int(width), int(height)


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
            f"a raw one {' '.join(_RAW_KEYS)} [{' '.join(_RAW_OPTIONAL)}]",
        )

"""Files of a simulated data set: images, depth, calibration and the record of what was drawn."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8

from jaxmap.datasets.images import read_image
from jaxmap.errors import FrameError, JaxmapError
from jaxmap.host.bounded_text import read_json
from jaxmap.host.files import atomic_path
from jaxmap.stereo.rectify import StereoRig


def write_png(path: Path, image: UInt8[np.ndarray, "H W *C"]) -> None:
    """Writes an 8-bit grey or RGB image.

    Raises:
        JaxmapError: the file cannot be written.
    """
    channels = image if image.ndim == 2 else image[..., ::-1]
    done, content = cv2.imencode(".png", channels, [cv2.IMWRITE_PNG_COMPRESSION, 4])
    if not done:
        raise JaxmapError("the image cannot be encoded", where=path)
    with atomic_path(path) as temporary:
        temporary.write_bytes(content.tobytes())


def write_array(path: Path, array: np.ndarray) -> None:
    """Writes an array as `.npy`.

    Raises:
        JaxmapError: the file cannot be written.
    """
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        np.save(file, array, allow_pickle=False)


def write_text(path: Path, text: str) -> None:
    """Writes UTF-8 text.

    Raises:
        JaxmapError: the file cannot be written.
    """
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf8")


def write_record(path: Path, record: Any) -> None:
    """Writes plain values as JSON.

    Raises:
        JaxmapError: the file cannot be written.
    """
    write_text(path, json.dumps(record, indent=1, allow_nan=False) + "\n")


def write_calibration(path: Path, rig: StereoRig) -> None:
    """Writes a raw pair as the YAML that plain folders and `--calibration` take.

    Raises:
        JaxmapError: the file cannot be written.
    """
    import yaml

    def camera(K: np.ndarray, distortion: np.ndarray) -> dict[str, Any]:
        numbers = dict(fx_px=K[0, 0], fy_px=K[1, 1], cx_px=K[0, 2], cy_px=K[1, 2])
        return {key: float(value) for key, value in numbers.items()} | {"distortion": distortion.tolist()}

    tree = {
        "image_size_px": [rig.width_px, rig.height_px],
        "left": camera(rig.K_left, rig.distortion_left),
        "right": camera(rig.K_right, rig.distortion_right),
        "R_right_left": rig.R_right_left.tolist(),
        "t_right_left_m": rig.t_right_left_m.tolist(),
    }
    write_text(path, yaml.safe_dump(tree, sort_keys=False, default_flow_style=None))


def claim_folder(folder: Path, record: Mapping[str, Any]) -> None:
    """Writes `scene.json`, or checks that the one there describes the same data set, which can then be finished.

    Raises:
        JaxmapError: the folder holds another data set, or cannot be written.
    """
    path = folder / "scene.json"
    fix = "choose another --out, or remove that folder"
    if not path.exists():
        if folder.is_dir() and any(folder.iterdir()):
            raise JaxmapError("the folder holds something else", where=folder, fix=fix)
        write_record(path, record)
        return
    if read_json(path) != json.loads(json.dumps(record)):
        raise JaxmapError("the folder holds a data set with other settings", where=folder, fix=fix)


def is_whole_image(path: Path, width_px: int, height_px: int) -> bool:
    """Whether an image is there, readable to its end, and of that size."""
    try:
        return read_image(path).shape[:2] == (height_px, width_px)
    except FrameError:
        return False

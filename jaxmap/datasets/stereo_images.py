"""The stereo side of training images: `disparity/NAME.png` and `cameras/NAME.json` beside `images/` and `masks/`.

Disparity is coded as KITTI's benchmark does: 16-bit, 1/256 px, 0 where unknown, on the pixels of the rectified left
image.
"""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import numpy as np
from jaxtyping import Float32
from PIL import Image
from pydantic import AfterValidator, ConfigDict, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass

from jaxmap.datasets.images import read_deep_image
from jaxmap.errors import JaxmapError
from jaxmap.host.bounded_text import read_json
from jaxmap.host.files import atomic_path
from jaxmap.host.settings import AnyNumber, Positive

DISPARITY_SCALE = 256


def _check_unit(vector: tuple[float, float, float]) -> tuple[float, float, float]:
    if abs(np.linalg.norm(vector) - 1) > 0.01:
        raise ValueError("must be of length 1")
    return vector


@dataclass(frozen=True, config=ConfigDict(extra="forbid", allow_inf_nan=False))
class LevelCamera:
    """A rectified camera and which way is up, all that relief needs to know of a frame.

    `up_camera` is the unit vector away from the ground in the left camera's frame (x right, y down, z forward).
    """

    fx_px: Annotated[float, Positive]
    fy_px: Annotated[float, Positive]
    cx_px: Annotated[float, AnyNumber]
    cy_px: Annotated[float, AnyNumber]
    baseline_m: Annotated[float, Positive]
    doffs_px: Annotated[float, AnyNumber]
    up_camera: Annotated[tuple[float, float, float], AfterValidator(_check_unit)]


_CAMERA = TypeAdapter(LevelCamera)


def stereo_paths(folder: Path, name: str) -> tuple[Path, Path]:
    """The files of disparity and camera of an image, which may have none."""
    return folder / "disparity" / f"{name}.png", folder / "cameras" / f"{name}.json"


def write_stereo(folder: Path, name: str, disparity_px: Float32[np.ndarray, "H W"], camera: LevelCamera) -> None:
    """Writes disparity and camera of an image.

    Raises:
        JaxmapError: a file cannot be written.
    """
    coded = np.nan_to_num(disparity_px * DISPARITY_SCALE, nan=0.0).round().clip(0, 65535).astype(np.uint16)
    disparity, level_camera = stereo_paths(folder, name)
    with atomic_path(disparity) as temporary:
        Image.fromarray(coded).save(temporary, format="PNG")
    with atomic_path(level_camera) as temporary:
        temporary.write_text(json.dumps(asdict(camera)) + "\n", encoding="utf8")


def read_stereo(folder: Path, name: str) -> tuple[Float32[np.ndarray, "H W"], LevelCamera] | None:
    """Disparity (NaN where unknown) and camera of an image; None where the image has none.

    Raises:
        JaxmapError: a file cannot be read, or one is there without the other.
    """
    disparity, camera = stereo_paths(folder, name)
    if not disparity.exists() and not camera.exists():
        return None
    for path in (disparity, camera):
        if not path.exists():
            raise JaxmapError("no such file", where=path, fix="give disparity and camera of an image, or neither")
    coded = read_deep_image(disparity)
    try:
        found = _CAMERA.validate_python(read_json(camera))
    except ValidationError as fault:
        raise JaxmapError(f"the camera cannot be read ({str(fault)[:200]})", where=camera) from fault
    return np.where(coded == 0, np.nan, coded.astype(np.float32) / DISPARITY_SCALE).astype(np.float32), found

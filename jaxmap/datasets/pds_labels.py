"""Labels of planetary image products, PDS3, PDS4 and VICAR: camera model, frames, clock, eye."""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from jaxmap.datasets.pds_groups import Groups, find, numbers, opened_product, read_groups
from jaxmap.errors import JaxmapError
from jaxmap.geometry.cahv import CahvModel, make_cahv_model

_COMPONENTS = {"CAHV": 4, "CAHVOR": 6, "CAHVORE": 7}

_PRODUCT_KIND = re.compile(r"[0-9]{9,10}(?:_[0-9]{3})?([A-Z]{3}[A-Z_]?)")

_DETECTORS_PX = (
    (r"MARS ?2020|\bM20\b", r"NAV|HAZ", (5120, 3840)),
    (r"MARS ?2020|\bM20\b|MSL|MARS SCIENCE", r"MCZ|ZCAM|MAST|MAHLI", (1648, 1200)),
    (r"MER|MSL|MARS SCIENCE|PHX|PHOENIX|INSIGHT|NSYT", r"", (1024, 1024)),
)
"""Mission, instrument, and (samples, lines) of their detectors, for labels that do not say."""


@dataclass(frozen=True)
class ProductLabel:
    """What is read from the label of one image.

    Attributes:
        path: the file to open.
        size_px: (samples, lines).
        bands: 1 or 3.
        depth: the name of the pixels' NumPy type.
        model: the camera, for the pixels as they are stored.
        model_is_of_frame: whether the label's model was one of the full frame, and was shifted or scaled.
        model_frame: the name of the frame that the model is given in.
        frames: parent frame and T_parent_frame, by the name of the frame.
        site: the number of the site that the rover's poses refer to, None where it is unknown.
        rig: the instrument, `*` for the eye.
        eye: left or right.
        product_kind: the three or four letters after the clock in the product's name, "" where there are none.
        clock_s: spacecraft clock at the start of the exposure.
        time_s: UTC in s since 1970, None where it is unknown.
    """

    path: Path
    size_px: tuple[int, int]
    bands: int
    depth: str
    model: CahvModel
    model_is_of_frame: bool
    model_frame: str
    frames: dict[str, tuple[str, np.ndarray]]
    site: int | None
    rig: str
    eye: Literal["left", "right"]
    product_kind: str
    clock_s: float
    time_s: float | None


def read_label(path: Path) -> ProductLabel | None:
    """Reads the label of an image; None for products derived from images (points, ranges, slopes, masks).

    Raises:
        JaxmapError: the file cannot be read, or the label has no camera model, eye or clock.
    """
    with opened_product(path) as product:
        size_px, bands = (product.width, product.height), product.count
        depth = product.dtypes[0] if bands else ""
        groups = read_groups(path, product)
    derived = str(find(groups, "DERIVED_IMAGE_TYPE", "DERIVED_IMAGE") or "IMAGE")
    points = bands == 3 and depth.startswith("float") and not find(groups, "DERIVED_IMAGE_TYPE")
    if bands not in (1, 3) or points or derived.upper() not in ("IMAGE", "N/A", "NULL", "UNK"):
        return None
    if size_px[0] * size_px[1] > 2**26:
        raise JaxmapError(f"an image of {size_px[0]}x{size_px[1]} px", where=path, fix="restore the label")
    model, model_frame = _camera_model(groups, path)
    fitted = _for_stored_pixels(model, groups, size_px)
    rig, eye = _rig_and_eye(groups, path)
    time_s = _time_s(groups)
    return ProductLabel(
        path=path,
        size_px=size_px,
        bands=bands,
        depth=depth,
        model=fitted,
        model_is_of_frame=fitted is not model,
        model_frame=model_frame,
        frames=_frames(groups),
        site=_site(groups),
        rig=rig,
        eye=eye,
        product_kind=kind[1] if (kind := _PRODUCT_KIND.search(path.stem.upper())) else "",
        clock_s=_clock_s(groups, path, time_s),
        time_s=time_s,
    )


def _camera_model(groups: Groups, path: Path) -> tuple[CahvModel, str]:
    group = groups.get("GEOMETRIC_CAMERA_MODEL", {})
    kind = str(group.get("MODEL_TYPE", "")).strip().upper()
    if kind in ("", "NONE", "NULL", "N/A", "UNK"):
        raise JaxmapError("the label has no camera model", where=path, fix="take products with GEOMETRIC_CAMERA_MODEL")
    if kind not in _COMPONENTS:
        raise JaxmapError(
            f"the camera model is of type {kind[:40]}", where=path, fix="CAHV, CAHVOR and CAHVORE are read"
        )
    components = [numbers(group.get(f"MODEL_COMPONENT_{index + 1}"), 3) for index in range(_COMPONENTS[kind])]
    given = [component for component in components if component is not None]
    if len(given) < len(components):
        raise JaxmapError(
            f"the {kind} camera model lacks three numbers for one of {' '.join(kind)}",
            where=path,
            fix="restore the label",
        )
    lens = [numbers(group.get(f"MODEL_COMPONENT_{index}"), 1) for index in (8, 9)]
    type_, parameter = (default if one is None else float(one[0]) for one, default in zip(lens, (1, 1), strict=True))
    frame = str(group.get("REFERENCE_COORD_SYSTEM_NAME") or "ROVER_FRAME").strip().upper()
    return make_cahv_model(given, int(type_), float(parameter), path), frame


def _for_stored_pixels(model: CahvModel, groups: Groups, size_px: tuple[int, int]) -> CahvModel:
    """The model for the pixels as they are stored, where the image is a part of the frame or averaged.

    Labels of MSL and Mars 2020 give it for these pixels; others give the model of the full frame, which is told by
    where the axis then meets the detector: near its middle.
    """
    first = _pair(groups, ("FIRST_LINE_SAMPLE", "FIRST_LINE"), ("IMAGE", "SUBFRAME_REQUEST")) - 1
    binning = _pair(groups, ("PIXEL_AVERAGING_WIDTH", "PIXEL_AVERAGING_HEIGHT"), ("IMAGE", "INSTRUMENT_STATE"))
    first, binning = np.maximum(first, 0), np.maximum(binning, 1)
    if not first.any() and (binning == 1).all():
        return model
    axis_px = np.array([model.O @ model.H, model.O @ model.V]) / (model.O @ model.A)
    if_stored_px = first + binning * (axis_px + 0.5) - 0.5
    detector_px = _detector_px(groups)
    if detector_px is not None:
        middle = (detector_px - 1) / 2
        of_frame = 2 * np.linalg.norm(axis_px - middle) < np.linalg.norm(if_stored_px - middle)
    else:
        # A detector about this axis would have to hold the image.
        of_frame = (2 * axis_px > 0.95 * (first + binning * np.array(size_px))).all()
    if not of_frame:
        return model
    return model.cropped((float(first[0]), float(first[1])), (float(binning[0]), float(binning[1])))


def _detector_px(groups: Groups) -> np.ndarray | None:
    samples, lines = (numbers(find(groups, key), 1) for key in ("DETECTOR_SAMPLES", "DETECTOR_LINES"))
    if samples is not None and lines is not None:
        return np.concatenate([samples, lines])
    mission = " ".join(str(find(groups, f"INSTRUMENT_HOST_{key}") or "") for key in ("ID", "NAME")).upper()
    instrument = " ".join(str(find(groups, f"INSTRUMENT_{key}") or "") for key in ("ID", "NAME")).upper()
    for host, camera, size_px in _DETECTORS_PX:
        if re.search(host, mission) and re.search(camera, instrument):
            return np.array(size_px, np.float64)
    return None


def _pair(groups: Groups, keys: tuple[str, str], names: tuple[str, ...]) -> np.ndarray:
    found = [numbers(find(groups, key, *names), 1) for key in keys]
    return np.array([1.0 if one is None else one[0] for one in found])


def _frames(groups: Groups) -> dict[str, tuple[str, np.ndarray]]:
    frames: dict[str, tuple[str, np.ndarray]] = {}
    for key, group in groups.items():
        quaternion = numbers(group.get("ORIGIN_ROTATION_QUATERNION"), 4)
        offset = numbers(group.get("ORIGIN_OFFSET_VECTOR"), 3)
        # A group may name itself only: ROVER_COORDINATE_SYSTEM.
        name = str(group.get("COORDINATE_SYSTEM_NAME") or key.replace("COORDINATE_SYSTEM", "FRAME")).strip().upper()
        if quaternion is None or offset is None or not name or abs(np.linalg.norm(quaternion) - 1) > 1e-2:
            continue
        T = np.eye(4)
        T[:3, :3] = Rotation.from_quat(quaternion[[1, 2, 3, 0]]).as_matrix()
        T[:3, 3] = offset
        parent = str(group.get("REFERENCE_COORD_SYSTEM_NAME") or "SITE_FRAME").strip().upper()
        frames.setdefault(name, (parent, T))
    return frames


def _site(groups: Groups) -> int | None:
    rover = [group for group in groups.values() if "ROVER" in str(group.get("COORDINATE_SYSTEM_NAME", "")).upper()]
    for value in (*(group.get("COORDINATE_SYSTEM_INDEX") for group in rover), find(groups, "ROVER_MOTION_COUNTER")):
        first = numbers(value[0] if isinstance(value, list) and value else value, 1)
        if first is not None:
            return int(first[0])
    return None


def _clock_s(groups: Groups, path: Path, time_s: float | None) -> float:
    """The spacecraft clock: of the label, else of the product's name, else the time."""
    said = str(find(groups, "SPACECRAFT_CLOCK_START_COUNT", "IDENTIFICATION") or "").rpartition("/")[2]
    found = re.search(r"[0-9]{1,12}(\.[0-9]{1,6})?", said)
    named = (re.search(r"(?<![0-9])[0-9]{9,10}(?![0-9])", name) for name in _names(groups, path))
    found = found or next((match for match in named if match), None)
    if found is None and time_s is None:
        raise JaxmapError("the label has no SPACECRAFT_CLOCK_START_COUNT", where=path, fix="restore the label")
    return float(found[0]) if found else float(time_s or 0.0)


def _names(groups: Groups, path: Path) -> tuple[str, str]:
    return path.stem.upper(), str(find(groups, "PRODUCT_ID", "IDENTIFICATION") or "").upper()


def _time_s(groups: Groups) -> float | None:
    for key in ("START_TIME", "IMAGE_TIME"):
        text = str(find(groups, key, "IDENTIFICATION") or "").strip('" Z')
        for form in ("%Y-%m-%dT%H:%M:%S.%f", "%Y-%m-%dT%H:%M:%S", "%Y-%jT%H:%M:%S.%f", "%Y-%jT%H:%M:%S"):
            try:
                return datetime.strptime(text[:26], form).replace(tzinfo=UTC).timestamp()
            except ValueError:
                continue
    return None


def _rig_and_eye(groups: Groups, path: Path) -> tuple[str, Literal["left", "right"]]:
    """The instrument with `*` for the eye, and the eye: from the instrument's id or name, or the product's name."""
    for key in ("INSTRUMENT_ID", "INSTRUMENT_NAME"):
        text = str(find(groups, key, "IDENTIFICATION") or "").upper()
        found = re.search(r"(?<![A-Z])(LEFT|RIGHT)(?![A-Z])", text) or re.search(r"(?<![A-Z])[LR](?![A-Z])", text)
        if found:
            return text[: found.start()] + "*" + text[found.end() :], "left" if found[0][0] == "L" else "right"
    frame = str(find(groups, "FRAME_ID", "IDENTIFICATION") or "").upper()
    if frame in ("LEFT", "RIGHT"):
        rig = f"{find(groups, 'INSTRUMENT_ID', 'IDENTIFICATION') or ''} *".upper()
        return rig, "left" if frame == "LEFT" else "right"
    # MER: rover, camera, clock ... eye, filter; MSL and Mars 2020: camera, eye; MSL's colour cameras: sol, camera, eye.
    forms = (r"([0-9][A-Z])[0-9]{9}.{12}([LR])", r"([NFRZ])([LR])[A-Z0-9]_", r"[0-9]{4}(M)([LR])[0-9]")
    for name in _names(groups, path):
        for form in (*forms, r"()(?:.*[^A-Z])?(LEFT|RIGHT)(?![A-Z])"):
            found = re.match(form, name)
            if found:
                return f"{found[1]}*", "left" if found[2][0] == "L" else "right"
    raise JaxmapError("neither label nor name say which eye this is", where=path, fix="INSTRUMENT_ID names it")

"""Stereo calibrations as MATLAB saves them: `stereoParameters`, as an object or as a plain struct.

`scipy.io` does not open MATLAB objects. A MAT file keeps their contents in a hidden variable, a stream of elements in
the format of MAT files themselves (version 5: "MAT-File Format", The MathWorks). A class that saves itself as a
struct, such as `stereoParameters`, leaves that struct in the stream with all its names.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxmap.errors import JaxmapError
from jaxmap.host.files import check_regular
from jaxmap.stereo.rectify import StereoRig, make_stereo_rig

_METRES = {"m": 1.0, "meters": 1.0, "cm": 0.01, "centimeters": 0.01, "mm": 0.001, "millimeters": 0.001, "in": 0.0254}
_METRES |= {"inches": 0.0254, "": 0.001}

_STEREO_KEYS = ("RotationOfCamera2", "TranslationOfCamera2")
_CAMERA_KEYS = ("CameraParameters1", "CameraParameters2")

_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
"""Storage types of elements."""

_MATRIX, _CELL, _STRUCT, _CHAR, _OPAQUE = 14, 1, 2, 4, 17
_NUMERIC = range(6, 16)
_COMPRESSED, _MOST_BYTES, _PIECE_BYTES = 15, 256 << 20, 1 << 20
_HEADER = 8
_MAX_DEPTH = 16


def read_matlab_calibration(path: Path, size_px: tuple[int, int]) -> StereoRig:
    """Reads the `stereoParameters` of a MAT file (version 5 to 7).

    MATLAB multiplies row vectors from the left, so that its matrices are the transposes of OpenCV's,
    and counts pixels from 1. Lengths are in the calibration's world units, usually mm.

    Args:
        path: the file.
        size_px: (width, height), for old files, which lack it.

    Raises:
        JaxmapError: not a MAT file, without a stereo calibration, or with skewed pixels, which are not modelled.
    """
    # Imported here: no other reader needs it.
    from scipy.io import loadmat

    check_regular(path, _MOST_BYTES)
    try:
        _check_inflated(path)
        content = loadmat(path, simplify_cells=True)
    except NotImplementedError as fault:
        raise JaxmapError("a MAT file of version 7.3", where=path, fix="save it in MATLAB with -v7") from fault
    except JaxmapError:
        raise
    except Exception as fault:
        # On damaged files the parser raises nearly anything.
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


def _check_inflated(path: Path) -> None:
    """Refuses a file that grows beyond bounds when its variables are inflated: megabytes can hold gigabytes of zeros.

    Raises:
        JaxmapError: it is one.
        Exception: it is damaged.
    """
    total = 0
    with open(path, "rb") as file:
        header = file.read(128)
        order = ">" if header[126:128] == b"MI" else "<"
        while len(tag := file.read(_HEADER)) == _HEADER:
            kind, length = struct.unpack(f"{order}2I", tag)
            end = file.tell() + length
            engine = zlib.decompressobj() if kind == _COMPRESSED else None
            total += 0 if engine else length
            while engine and file.tell() < end and not engine.eof:
                left = file.read(min(_PIECE_BYTES, end - file.tell()))
                if not left:
                    break
                while left and total <= _MOST_BYTES:
                    total += len(engine.decompress(left, _PIECE_BYTES))
                    left = engine.unconsumed_tail
            if total > _MOST_BYTES:
                raise JaxmapError(
                    f"its variables take more than {_MOST_BYTES >> 20} MiB",
                    where=path,
                    fix="save the calibration alone",
                )
            file.seek(end)


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


def structs_of_objects(stream: bytes, where: object) -> list[dict[str, Any]]:
    """All structs of a `__function_workspace__`, in their order: name -> array, text or None.

    Arrays have their MATLAB shape; values that are neither numbers nor text are None.

    Raises:
        JaxmapError: the stream is damaged.
    """
    if len(stream) < _HEADER or stream[2:4] not in (b"IM", b"MI"):
        raise JaxmapError("the objects in the file cannot be read", where=where, fix="save them as plain structs")
    order = "<" if stream[2:4] == b"IM" else ">"
    found: list[dict[str, Any]] = []
    try:
        for kind, data in _elements(stream[_HEADER:], order):
            if kind == _MATRIX:
                _value(data, order, found, 0)
    except (struct.error, ValueError, IndexError, UnicodeDecodeError) as fault:
        raise JaxmapError(
            f"the objects in the file are damaged ({fault})", where=where, fix="restore the file"
        ) from fault
    return found


def _elements(data: bytes, order: str) -> Iterator[tuple[int, bytes]]:
    """Type and content of each element."""
    position = 0
    while position + 8 <= len(data):
        kind, size = struct.unpack_from(f"{order}II", data, position)
        if kind >> 16:
            # Small elements hold size and type in one word, and up to four bytes in the next.
            yield kind & 0xFFFF, data[position + 4 : position + 4 + (kind >> 16)]
            position += 8
            continue
        if position + 8 + size > len(data):
            raise ValueError("an element is cut off")
        yield kind, data[position + 8 : position + 8 + size]
        position += 8 + (size + 7) // 8 * 8


def _value(data: bytes, order: str, found: list[dict[str, Any]], depth: int) -> Any:
    """The value of a matrix element; structs in it are added to `found`."""
    if depth > _MAX_DEPTH:
        raise ValueError("nested too deep")
    parts = [*_elements(data, order)]
    if not parts:
        return None
    flags = int.from_bytes(parts[0][1][:4], "little" if order == "<" else "big")
    array_class = flags & 0xFF
    if array_class == _OPAQUE:
        # Names of type and class, then what the object was made from.
        for kind, inner in parts[1:]:
            if kind == _MATRIX:
                _value(inner, order, found, depth + 1)
        return None
    shape = np.frombuffer(parts[1][1], f"{order}i4")
    if array_class == _CELL:
        for _, inner in parts[3:]:
            _value(inner, order, found, depth + 1)
    elif array_class == _STRUCT:
        # The names are one text, each padded to the length in the element before it.
        width = int(np.frombuffer(parts[3][1], f"{order}i4")[0])
        text = parts[4][1]
        names = [text[at : at + width].split(b"\0")[0].decode("ascii") for at in range(0, len(text), max(width, 1))]
        whole: dict[str, Any] = {}
        found.append(whole)
        whole |= {
            name: _value(inner, order, found, depth + 1) for name, (_, inner) in zip(names, parts[5:], strict=False)
        }
    elif array_class == _CHAR:
        kind, raw = parts[3]
        return raw.decode(f"utf-16-{'le' if order == '<' else 'be'}" if kind in (4, 17) else "utf-8", "replace")
    elif array_class in _NUMERIC and len(parts) > 3:
        kind, raw = parts[3]
        return np.frombuffer(raw, order + _NUMBERS.get(kind, "u1")).reshape(shape, order="F")
    return None

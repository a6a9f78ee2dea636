"""Telling what a file of weights is by its first bytes, and what to do with one that is not read."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Literal

from jaxmap.errors import JaxmapError

Kind = Literal["safetensors", "torch", "unknown"]

_FROM_TORCH = "save the state dict of the network it was made from: safetensors.torch.save_file(net.state_dict(), F)"
_FROM_KERAS = (
    "label the images with it and take those labels by jaxmap map --labeller files; or, of a network that is known, "
    "write its variables by name with safetensors.numpy.save_file"
)
_FETCH = "download the file itself"

_BY_START: tuple[tuple[int, bytes, str, str], ...] = (
    (0, b"\x89HDF\r\n\x1a\n", "an HDF5 file (Keras or MATLAB), which is not read", _FROM_KERAS),
    (4, b"TFL3", "a TensorFlow Lite model, which is not read", _FROM_KERAS),
    (0, b"version https://git-lfs", "a pointer of Git LFS, not the file itself", "fetch it with git lfs pull"),
    (0, b"<!doctype html", "a web page, no weights", _FETCH),
    (0, b"<html", "a web page, no weights", _FETCH),
    (0, b"\x93NUMPY", "a single NumPy array", "save all arrays by name: safetensors.numpy.save_file(arrays, F)"),
    (0, b"\x1f\x8b", "compressed with gzip", "unpack it first"),
    (0, b"BZh", "compressed with bzip2", "unpack it first"),
    (0, b"\xfd7zXZ", "compressed with xz", "unpack it first"),
    (0, b"7z\xbc\xaf", "a 7z archive", "unpack it first"),
    (257, b"ustar", "a tar archive", "unpack it first"),
)
_BY_SUFFIX: dict[str, tuple[str, str]] = {
    **dict.fromkeys((".h5", ".hdf5", ".keras"), ("a Keras file, which is not read", _FROM_KERAS)),
    ".onnx": ("an ONNX graph, which is not read", _FROM_TORCH),
    ".pb": ("a TensorFlow graph, which is not read", _FROM_KERAS),
    ".tflite": ("a TensorFlow Lite model, which is not read", _FROM_KERAS),
    **dict.fromkeys((".index", ".meta"), ("a part of a TensorFlow checkpoint, which is not read", _FROM_KERAS)),
    **dict.fromkeys((".engine", ".trt", ".plan"), ("a TensorRT engine, which is not read", _FROM_TORCH)),
    **dict.fromkeys((".mlmodel", ".mlpackage"), ("a Core ML model, which is not read", _FROM_TORCH)),
    ".pdparams": ("a Paddle file, which is not read", "save its arrays with safetensors.numpy.save_file"),
}


def kind_of_weights(path: Path) -> Kind:
    """What a file is, by its content.

    Raises:
        JaxmapError: it is missing, or of a kind that is known and not read; the error says how to convert it.
    """
    if path.is_dir() and (path / "saved_model.pb").is_file():
        raise JaxmapError("a SavedModel of TensorFlow's, which is not read", where=path, fix=_FROM_KERAS)
    if not path.is_file():
        raise JaxmapError("no such file", where=path, fix="give a .safetensors or .pth file of weights")
    try:
        with path.open("rb") as file:
            start = file.read(512)
    except OSError as fault:
        raise JaxmapError(f"cannot be read ({fault.strerror or fault})", where=path, fix="check the file") from fault
    for offset, bytes_there, what, fix in _BY_START:
        if start[offset : offset + len(bytes_there)].lower() == bytes_there.lower():
            raise JaxmapError(what, where=path, fix=fix)
    if start[8:9] == b"{" and 2 <= int.from_bytes(start[:8], "little") <= path.stat().st_size - 8:
        return "safetensors"
    if start.startswith(b"PK\x03\x04"):
        _refuse_other_archives(path)
        return "torch"
    if path.suffix.lower() in _BY_SUFFIX or ".data-0" in path.name:
        what, fix = _BY_SUFFIX.get(path.suffix.lower(), _BY_SUFFIX[".index"])
        raise JaxmapError(what, where=path, fix=fix)
    return "torch" if start[:1] == b"\x80" else "unknown"


def _refuse_other_archives(path: Path) -> None:
    """Refuses zip files that are not PyTorch's tensors; those that cannot be opened are left to their reader."""
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError):
        return
    if "model.weights.h5" in names:
        raise JaxmapError("a Keras file, which is not read", where=path, fix=_FROM_KERAS)
    if any(name.endswith("/constants.pkl") for name in names) and any("/code/" in name for name in names):
        raise JaxmapError("a TorchScript program, which is not read", where=path, fix=_FROM_TORCH)
    if names and all(name.endswith(".npy") for name in names):
        fix = "save the arrays by name: safetensors.numpy.save_file(dict(numpy.load(F)), G)"
        raise JaxmapError("an archive of NumPy arrays, which is not read", where=path, fix=fix)

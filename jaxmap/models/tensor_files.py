"""Reading the tensors of weight files, which are not trusted."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jaxmap.errors import JaxmapError
from jaxmap.models.torch_files import Tensors, read_torch_file

_FLOATS = {"F16": np.float16, "F32": np.float32, "F64": np.float64}


def read_tensors(path: Path) -> Tensors:
    """The tensors of a `.safetensors` file or of one of PyTorch's (`.pth`, `.pt`, `.bin`), by name.

    Raises:
        JaxmapError: the file is missing, truncated, of another kind, or asks for more than tensors.
    """
    if path.suffix.lower() in (".pth", ".pt", ".bin", ".ckpt", ".tar"):
        return read_torch_file(path)
    return read_safetensors(path)[1]


def read_safetensors(path: Path) -> tuple[dict[str, str], Tensors]:
    """Metadata and tensors of a safetensors file; integer tensors (counters) are left out.

    The library compares every declared shape and offset with the size of the file before it
    allocates anything.

    Raises:
        JaxmapError: the file is missing, truncated or not safetensors, or a tensor is of another
            type than a float of 16, 32 or 64 bits.
    """
    from safetensors import SafetensorError, safe_open

    if not path.is_file():
        raise JaxmapError("no such file", where=path, fix="give a .safetensors or .pth file of weights")
    try:
        with safe_open(path, framework="numpy") as file:
            types = {name: file.get_slice(name).get_dtype() for name in file.keys()}  # noqa: SIM118
            wrong = [f"{name} is {kind}" for name, kind in types.items() if kind not in _FLOATS and kind[0] not in "IU"]
            if wrong:
                raise JaxmapError(
                    f"tensors of a type that is not read: {shortened(wrong)}",
                    where=path,
                    fix="save the weights as float32",
                )
            tensors = {name: file.get_tensor(name) for name, kind in types.items() if kind in _FLOATS}
            return dict(file.metadata() or {}), tensors
    except (SafetensorError, ValueError, MemoryError) as fault:
        # NumPy has its own limits: a tensor of more than 64 axes is well-formed, but no array.
        raise JaxmapError(
            f"not a whole safetensors file ({' '.join(str(fault).split())[:120]})",
            where=path,
            fix="it may be truncated: copy or download it again",
        ) from fault
    except OSError as fault:
        raise JaxmapError(f"cannot be read ({fault.strerror or fault})", where=path, fix="check the file") from fault


def shortened(items: Sequence[str], at_most: int = 3, length: int = 100) -> str:
    """The first of them, each cut to `length`, and how many more there are."""
    more = f" and {len(items) - at_most} more" if len(items) > at_most else ""
    return ", ".join(item if len(item) <= length else f"{item[:length]}..." for item in items[:at_most]) + more


def as_float32(array: np.ndarray) -> np.ndarray:
    """The array in float32; what is too large for it becomes infinite, and is reported with what is not finite."""
    with np.errstate(over="ignore"):
        return np.ascontiguousarray(array, np.float32)

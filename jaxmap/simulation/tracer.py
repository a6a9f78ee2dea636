"""Mitsuba 3: finding a variant that works on this machine, and a scene of triangles to cast rays into."""

from __future__ import annotations

import ctypes.util
import importlib
import os
import re
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from jaxmap.errors import JaxmapError

LEAST_LLVM = 15
"""Older ones abort the process on processors they do not know."""

_PLACES = ("/usr/lib/*/libLLVM*.so*", "/usr/lib/llvm-*/lib/libLLVM*.so*", "/usr/lib64/libLLVM*.so*")

ADVICE = (
    "install LLVM's library, 19 for choice (Debian, Ubuntu: apt install libllvm19), or name it in DRJIT_LIBLLVM_PATH"
)


@lru_cache(maxsize=1)
def load_mitsuba() -> Any:
    """Mitsuba with its variant set: `llvm_ad_rgb` where LLVM's library is found, else `scalar_rgb`.

    `JAXMAP_MITSUBA_VARIANT` chooses another one.

    Raises:
        JaxmapError: Mitsuba is not installed, or that variant does not work.
    """
    wish = os.environ.get("JAXMAP_MITSUBA_VARIANT")
    if wish is None or wish.startswith("llvm"):
        library = find_llvm()
        if library is not None:
            os.environ["DRJIT_LIBLLVM_PATH"] = library
    try:
        mitsuba = importlib.import_module("mitsuba")
    except ImportError as error:
        raise JaxmapError(
            f"Mitsuba cannot be loaded ({error})", where="jaxmap simulate", fix="pip install 'jaxmap[sim]'"
        ) from error
    variant = wish or ("llvm_ad_rgb" if os.environ.get("DRJIT_LIBLLVM_PATH") else "scalar_rgb")
    try:
        mitsuba.set_variant(variant)
        float(np.asarray(mitsuba.Float(1.0) + 1.0).reshape(-1)[0])
    except (ImportError, AttributeError, RuntimeError) as error:
        raise JaxmapError(f"Mitsuba's variant {variant} does not work ({error})", fix=ADVICE) from error
    mitsuba.set_log_level(mitsuba.LogLevel.Error)
    return mitsuba


def is_vectorised(mitsuba: Any) -> bool:
    """Whether rays are traced by the million; the scalar variant takes them one by one."""
    return not str(mitsuba.variant()).startswith("scalar")


def load_drjit() -> Any:
    """The array library under Mitsuba."""
    return importlib.import_module("drjit")


def constant(kind: Any, *numbers: float) -> Any:
    """A value that differs from world to world, kept out of the compiled kernel, which can then be used again."""
    mi = load_mitsuba()
    if is_vectorised(mi):
        return kind(*(load_drjit().opaque(mi.Float, float(number)) for number in numbers))
    return kind(*map(float, numbers))


def find_llvm() -> str | None:
    """LLVM's library: what `DRJIT_LIBLLVM_PATH` names, else the one nearest to version 19 from 15 on."""
    named = os.environ.get("DRJIT_LIBLLVM_PATH")
    if named:
        return named
    found = {}
    for pattern in _PLACES:
        for path in sorted(Path("/").glob(pattern[1:])):
            if (version := llvm_version(path.resolve())) is not None and version >= LEAST_LLVM:
                found.setdefault(version, str(path))
    if found:
        return found[min(found, key=lambda version: (abs(version - 19), -version))]
    return next((name for v in range(19, 23) if (name := ctypes.util.find_library(f"LLVM-{v}"))), None)


def llvm_version(path: Path) -> int | None:
    """The major version that a library's path tells, or None."""
    numbers = re.findall(r"(?:LLVM[-.]|\.so\.|llvm[-@/])(\d+)", str(path))
    return max(map(int, numbers), default=None)


def make_scene(vertices_m: np.ndarray, faces: np.ndarray) -> Any:
    """A Mitsuba scene of one mesh; hits report its triangles by their index."""
    mi = load_mitsuba()
    mesh = mi.Mesh("world", len(vertices_m), len(faces))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = np.ascontiguousarray(vertices_m, np.float32).reshape(-1)
    parameters["faces"] = np.ascontiguousarray(faces, np.uint32).reshape(-1)
    parameters.update()
    return mi.load_dict({"type": "scene", "mesh": mesh})


class Table:
    """An array of numbers that a kernel looks up by index."""

    def __init__(self, values: np.ndarray, kind: Any = np.float32) -> None:
        mi = load_mitsuba()
        self._vectorised = is_vectorised(mi)
        self._gather = load_drjit().gather
        self._values = np.ascontiguousarray(values, kind)
        self._kind = mi.UInt32 if kind is np.uint32 else mi.Float
        self._buffer = self._kind(self._values) if self._vectorised else None

    def __call__(self, index: Any) -> Any:
        """The numbers at these places."""
        if self._vectorised:
            return self._gather(self._kind, self._buffer, index)
        return self._kind(self._values[index])


def repeating_texture(values: np.ndarray) -> Any:
    """A texture (rows, columns, channels) or (layers, rows, columns, channels) that repeats, interpolated linearly."""
    mi, dr = load_mitsuba(), load_drjit()
    kind = mi.Texture2f if values.ndim == 3 else mi.Texture3f
    tensor = mi.TensorXf(np.ascontiguousarray(values, np.float32))
    return kind(tensor, filter_mode=dr.FilterMode.Linear, wrap_mode=dr.WrapMode.Repeat)


def run_kernel(
    kernel: Callable[..., Any], lanes: Float32[np.ndarray, "K N"], kinds: Sequence[Any] | None = None
) -> Any:
    """Runs a kernel on N lanes of K numbers each.

    Returns:
        The components of what it gives as arrays (N,) of these kinds; float32 (components, N) where none are given.
    """
    mi, dr = load_mitsuba(), load_drjit()
    if is_vectorised(mi):
        result = kernel(*(mi.Float(np.ascontiguousarray(row)) for row in lanes))
        dr.eval(result)
        columns = [np.asarray(component.numpy()) for component in result]
    else:
        rows = [tuple(kernel(*map(float, lane))) for lane in lanes.T]
        columns = [np.array(column) for column in zip(*rows, strict=True)]
    if kinds is None:
        return np.stack(columns).astype(np.float32)
    return tuple(column.astype(kind) for column, kind in zip(columns, kinds, strict=True))

"""Mitsuba 3, loaded with a library that works on this machine, and a scene of triangles to cast rays into."""

from __future__ import annotations

import importlib
import importlib.util
import os
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from jaxtyping import Float32

from jaxmap.errors import JaxmapError
from jaxmap.simulation.llvm import NAMED, working_llvm

_INSTALL = "pip install 'jaxmap[sim]'"


@lru_cache(maxsize=1)
def load_mitsuba() -> Any:
    """Mitsuba with its variant set: `llvm_ad_rgb`, or `cuda_ad_rgb` where `JAXMAP_MITSUBA_VARIANT` says so.

    Its scalar variants, which need no library, trace rays one by one: an hour for each pair of images.

    Raises:
        JaxmapError: Mitsuba is not installed, or nothing on this machine compiles its kernels.
    """
    if importlib.util.find_spec("mitsuba") is None:
        raise JaxmapError("Mitsuba is not installed", where="jaxmap simulate", fix=_INSTALL)
    variant = os.environ.get("JAXMAP_MITSUBA_VARIANT") or "llvm_ad_rgb"
    if variant not in ("llvm_ad_rgb", "cuda_ad_rgb"):
        raise JaxmapError(f"unknown variant {variant}", where="JAXMAP_MITSUBA_VARIANT", fix="llvm_ad_rgb, cuda_ad_rgb")
    if variant == "llvm_ad_rgb":
        # Before the import, which opens the library.
        os.environ[NAMED] = working_llvm()
    try:
        mitsuba = importlib.import_module("mitsuba")
        mitsuba.set_variant(variant)
        float(np.asarray(mitsuba.Float(1.0) + 1.0).reshape(-1)[0])
    except (ImportError, AttributeError, RuntimeError) as error:
        raise JaxmapError(f"Mitsuba's variant {variant} does not work ({error})", fix=_INSTALL) from error
    mitsuba.set_log_level(mitsuba.LogLevel.Error)
    return mitsuba


def load_drjit() -> Any:
    """The array library under Mitsuba."""
    return importlib.import_module("drjit")


def constant(kind: Any, *numbers: float) -> Any:
    """A value that differs from world to world, kept out of the compiled kernel, which can then be used again."""
    mi = load_mitsuba()
    return kind(*(load_drjit().opaque(mi.Float, float(number)) for number in numbers))


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
        self._gather = load_drjit().gather
        self._kind = mi.UInt32 if kind is np.uint32 else mi.Float
        self._buffer = self._kind(np.ascontiguousarray(values, kind))

    def __call__(self, index: Any) -> Any:
        """The numbers at these places."""
        return self._gather(self._kind, self._buffer, index)


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
    result = kernel(*(mi.Float(np.ascontiguousarray(row)) for row in lanes))
    dr.eval(result)
    columns = [np.asarray(component.numpy()) for component in result]
    if kinds is None:
        return np.stack(columns).astype(np.float32)
    return tuple(column.astype(kind) for column, kind in zip(columns, kinds, strict=True))

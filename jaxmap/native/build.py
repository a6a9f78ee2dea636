"""Compiles the kernels for this processor, once, and makes them known to XLA.

Each compiled library lies in the cache folder (`native`), under a name that holds what it was made of: the sources, the
compiler's version, the processor's features and XLA's interface. Without a compiler, or if anything fails, all runs
as JAX compiles it, with the same results; one line on stderr says so. `JAXMAP_NATIVE=0` turns the kernels off.
"""

from __future__ import annotations

import ctypes
import hashlib
import logging
import os
import shutil
import subprocess
import tempfile
from functools import cache
from importlib.metadata import version
from pathlib import Path
from threading import Lock

import jax

from jaxmap.host.cache import cache_folder

TARGET, FUSE_TARGET, LABELS_TARGET = "jaxmap_block", "jaxmap_fuse", "jaxmap_labels"
SGM_TARGET, SELECT_TARGET = "jaxmap_sgm", "jaxmap_select"
"""The kernels' names in compiled programs: blocks of convolutions, a frame into the map, logits to labels, and the two
halves of matching."""

_SOURCES = {
    TARGET: "blocks.cpp",
    FUSE_TARGET: "fuse.cpp",
    LABELS_TARGET: "labels.cpp",
    SGM_TARGET: "sgm.cpp",
    SELECT_TARGET: "select.cpp",
}
_COMPILERS = ("c++", "g++", "clang++")
# Products and sums may be fused; nothing else may change what is computed.
_FLAGS = ("-O3", "-march=native", "-fno-math-errno", "-fno-trapping-math", "-std=c++17", "-shared", "-fPIC", "-w")
_PATIENCE_S = 300
_LOCK = Lock()


def has_kernel(target: str = TARGET) -> bool:
    """Whether programs traced from now on may call this kernel; the first call compiles it."""
    if os.environ.get("JAXMAP_NATIVE") == "0" or jax.default_backend() != "cpu":
        return False
    with _LOCK:
        return _registered(target)


@cache
def _registered(target: str) -> bool:
    try:
        library = _load(_compiled(target))
        jax.ffi.register_ffi_target(target, jax.ffi.pycapsule(getattr(library, target)), platform="cpu")
    except (OSError, subprocess.SubprocessError) as error:
        reason = (getattr(error, "stderr", None) or str(error)).strip().splitlines() or [type(error).__name__]
        logging.getLogger(__name__).warning(
            "jaxmap: the kernel of %s could not be compiled, all runs slower: %s (JAXMAP_NATIVE=0 hides this)",
            _SOURCES[target],
            reason[0],
        )
        return False
    return True


def _compiled(target: str = TARGET) -> Path:
    """The library for this processor; made if it is not there yet.

    Raises:
        OSError: there is no compiler, or the cache folder cannot be written to.
        subprocess.SubprocessError: the compiler fails.
    """
    asked, source = os.environ.get("CXX"), Path(__file__).with_name(_SOURCES[target])
    compiler = next(filter(None, map(shutil.which, (asked,) if asked else _COMPILERS)), None)
    if compiler is None:
        raise OSError(f"no C++ compiler ({asked or ', '.join(_COMPILERS)}) on PATH")
    # What it defines for this processor names its version and the instructions that it may use.
    macros = _run(compiler, *_FLAGS, "-dM", "-E", "-x", "c++", os.devnull)
    texts = (path.read_text("utf-8") for path in (source, *sorted(source.parent.glob("*.h"))))
    parts = (*texts, macros, " ".join(_FLAGS), version("jaxlib"))
    name = hashlib.sha256("\0".join(parts).encode()).hexdigest()[:20]
    library = cache_folder() / "native" / f"{source.stem}-{name}.so"
    if not library.exists():
        library.parent.mkdir(parents=True, exist_ok=True)
        # Under its name only once it is whole: another process may be doing the same.
        with tempfile.TemporaryDirectory(dir=library.parent) as folder:
            made = Path(folder) / library.name
            _run(compiler, *_FLAGS, f"-I{jax.ffi.include_dir()}", str(source), "-o", str(made))
            os.replace(made, library)
    return library


def _load(library: Path) -> ctypes.CDLL:
    try:
        return ctypes.CDLL(str(library))
    except OSError:
        # A damaged file is made anew by the next run.
        library.unlink(missing_ok=True)
        raise


def _run(*command: str) -> str:
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=_PATIENCE_S)
    return done.stdout

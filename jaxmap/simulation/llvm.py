"""LLVM's library, which compiles Mitsuba's kernels: found, and tried out in a child process before it is used.

Some versions abort the process, at a kernel they cannot compile or on a processor they do not know, and no version
number says which. So each candidate first renders a small world in a process of its own (`jaxmap.simulation.trial`);
the verdict is kept in the cache folder.
"""

from __future__ import annotations

import ctypes.util
import hashlib
import importlib.metadata
import json
import os
import platform
import re
import signal
import subprocess
import sys
import tempfile
import textwrap
from contextlib import suppress
from pathlib import Path

import jaxmap
from jaxmap.errors import JaxmapError
from jaxmap.host.bounded_text import read_json
from jaxmap.host.cache import cache_folder
from jaxmap.host.files import atomic_path

NAMED = "DRJIT_LIBLLVM_PATH"
"""The environment variable by which Dr.Jit takes the library."""

UNDER_TRIAL = "JAXMAP_LLVM_UNDER_TRIAL"
"""Set in the child process: the library that it was given is used as it is."""

_PREFERRED = 19
_PLACES = (
    "/usr/lib/*/libLLVM[-.]*so*",
    "/usr/lib/llvm-*/lib/libLLVM[-.]*so*",
    "/usr/lib64/libLLVM[-.]*so*",
    "/usr/local/lib/libLLVM[-.]*so*",
    f"{sys.prefix}/lib/libLLVM[-.]*so*",
)
_TRIAL = "from jaxmap.simulation.trial import main; main()"
_TRIAL_S = 120.0
"""A trial takes one or two seconds; a busy machine needs longer."""

_ADVICE = "install LLVM 19 (Debian, Ubuntu: apt install libllvm19), or give the path of its library in " + NAMED


def working_llvm() -> str:
    """The path of the library that `DRJIT_LIBLLVM_PATH` names, else of the working one nearest to version 19.

    Raises:
        JaxmapError: the named one does not work, or none does.
    """
    if os.environ.get(UNDER_TRIAL):
        return os.environ[NAMED]
    if named := os.environ.get(NAMED):
        if (fault := fault_of(named)) is not None:
            raise JaxmapError(
                f"the LLVM library that {NAMED} names does not work ({fault})",
                where=named,
                fix=f"unset it, or {_ADVICE}",
            )
        return named
    faults = []
    for path in find_llvm():
        if (fault := fault_of(path)) is None:
            return path
        faults.append(f"{path}: {fault}")
    if faults:
        raise JaxmapError(f"no LLVM library of this machine can render ({'; '.join(faults)})", fix=_ADVICE)
    raise JaxmapError(
        f"no LLVM library found in {', '.join(str(Path(place).parent) for place in _PLACES)}", fix=_ADVICE
    )


def find_llvm() -> list[str]:
    """LLVM's libraries on this machine, those nearest to version 19 first, newer before older."""
    found = {path.resolve() for place in _PLACES for path in Path("/").glob(place[1:])}
    versions = {str(path): llvm_version(path) for path in found}
    if not versions:
        # Where else the loader looks; Dr.Jit opens the library by name as well.
        names = (ctypes.util.find_library(name) for name in (*(f"LLVM-{v}" for v in range(15, 24)), "LLVM"))
        versions = {name: llvm_version(Path(name)) for name in names if name}
    return sorted(versions, key=lambda path: (abs(versions[path] - _PREFERRED), -versions[path], path))


def llvm_version(path: Path) -> int:
    """The major version in a library's path, 0 where there is none."""
    numbers = re.findall(r"(?:LLVM[-.]|\.so\.|llvm[-@/])(\d+)", str(path))
    return max(map(int, numbers), default=0)


def fault_of(path: str) -> str | None:
    """Why a library does not work, None where it does; from the cache where it was tried before."""
    file = None
    # Without a cache folder, or with a damaged file, the library is tried again.
    with suppress(JaxmapError, OSError, ImportError, RuntimeError, ValueError, KeyError, TypeError):
        file = cache_folder() / "llvm" / f"{_trial_key(path)}.json"
        return read_json(file)["fault"]
    fault, lasting = _try_out(path)
    if file is not None and lasting:
        with suppress(JaxmapError, OSError), atomic_path(file) as temporary:
            temporary.write_text(json.dumps({"path": path, "fault": fault}))
    return fault


def _trial_key(path: str) -> str:
    """What a verdict depends on: the library's file, the versions of what uses it, and the processor.

    Raises:
        OSError: there is no such file.
    """
    status = os.stat(path)
    versions = [importlib.metadata.version(name) for name in ("drjit", "mitsuba")]
    processor = [platform.machine(), platform.processor()]
    with suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        processor = sorted({line for line in lines if line.startswith(("model name", "flags", "Features"))})
    key = (os.path.abspath(path), status.st_size, status.st_mtime_ns, jaxmap.__version__, versions, processor)
    return hashlib.sha256(repr(key).encode()).hexdigest()[:32]


def _try_out(path: str) -> tuple[str | None, bool]:
    """Renders with a library in a child process.

    Returns:
        Why it does not work, or None; and whether that will be so the next time, too.
    """
    # Dr.Jit would take kernels that another library has compiled from its own cache.
    with tempfile.TemporaryDirectory(prefix="jaxmap-llvm-") as empty:
        environment = {**os.environ, NAMED: path, UNDER_TRIAL: "1", "HOME": empty, "DRJIT_CACHE_DIR": empty}
        try:
            done = subprocess.run(
                [sys.executable, "-c", f"import sys; sys.path[:] = {sys.path!r}; {_TRIAL}"],
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                timeout=_TRIAL_S,
            )
        except subprocess.TimeoutExpired:
            return f"no picture within {_TRIAL_S:g} s", False
    if done.returncode == 0:
        return None, True
    lines = [line.strip() for line in done.stderr.decode(errors="replace").splitlines() if line.strip()] or [
        "no message"
    ]
    # Without the addresses, which differ from time to time.
    message = re.sub(r"0x[0-9a-f]+:? ?", "", lines[-1] if lines[0].startswith("Traceback") else lines[0])
    end = f"exit status {done.returncode}"
    if done.returncode < 0:
        end = f"killed by {signal.Signals(-done.returncode).name}"
    # What the system or a user kills says nothing about the library.
    lasting = done.returncode not in (-signal.SIGKILL, -signal.SIGTERM, -signal.SIGINT)
    return f"{end}, {textwrap.shorten(message, 100, placeholder=' ...')}", lasting

"""The memory of the process: how it is given (in large pages, and for good, for long work), and how much it took."""

from __future__ import annotations

import os
import platform
import resource
import sys
from pathlib import Path

_TUNABLES = "GLIBC_TUNABLES"
_SETTINGS = {
    # Pages of 2 MiB, where the system grants them to those who ask.
    "glibc.malloc.hugetlb": "1",
    # Nothing is handed back to the system: neither large blocks, which otherwise come and go by themselves, nor the
    # end of the heap; and there is one heap for all threads, as others cannot hold large blocks.
    "glibc.malloc.mmap_max": "0",
    "glibc.malloc.trim_threshold": str(1 << 62),
    "glibc.malloc.arena_max": "1",
}
_SINCE = (2, 26)


def restart_with_lasting_memory() -> None:
    """Starts this process again, under the same number, so that the C library keeps the memory it was given.

    A training step takes gigabytes and frees them at its end. Handed back and fetched anew, zeroed by the system page
    by page, they take as long as the step's own work. The library reads these settings only when a process starts;
    where it is not glibc, or the user has set one of them, nothing happens.
    """
    settings = os.environ.get(_TUNABLES, "")
    if any(name in settings for name in _SETTINGS) or not _understood():
        return
    settings = ":".join([*filter(None, [settings]), *(f"{name}={value}" for name, value in _SETTINGS.items())])
    sys.stdout.flush()
    os.execve(sys.executable, [sys.executable, *sys.orig_argv[1:]], {**os.environ, _TUNABLES: settings})


def peak_resident_mib() -> float:
    """The greatest resident size of this program so far.

    Linux tells it of the program itself. `getrusage`, which every Unix has, also counts the process that started it.
    """
    status = Path("/proc/self/status")
    if status.exists():
        for line in status.read_text().splitlines():
            name, _, value = line.partition(":")
            if name == "VmHWM":
                return int(value.split()[0]) / 2**10
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 2**10)


def _understood() -> bool:
    library, version = platform.libc_ver()
    try:
        return library == "glibc" and tuple(map(int, version.split("."))) >= _SINCE
    except ValueError:
        return False

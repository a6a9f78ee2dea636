"""Memory of the process: allocation in large pages that are kept for reuse, and the peak resident size."""

from __future__ import annotations

import os
import platform
import resource
import sys
from contextlib import suppress
from pathlib import Path

_TUNABLES = "GLIBC_TUNABLES"
_SETTINGS = {
    # Pages of 2 MiB, where the system grants them on request.
    "glibc.malloc.hugetlb": "1",
    # Nothing is returned to the system: neither large blocks, which are otherwise mapped and unmapped one by one, nor
    # the end of the heap. All threads share one arena, as other arenas cannot hold large blocks.
    "glibc.malloc.mmap_max": "0",
    "glibc.malloc.trim_threshold": str(1 << 62),
    "glibc.malloc.arena_max": "1",
}
_SINCE = (2, 26)


def restart_with_lasting_memory() -> None:
    """Restarts this process, under the same process ID, with an allocator that keeps freed memory for reuse.

    A training step allocates gigabytes and frees them at its end. Returned to the system and fetched again, zeroed
    page by page, they take as long as the step's own work. glibc reads these settings only when a process starts;
    with another C library, or where the user has set one of them, nothing happens.
    """
    settings = os.environ.get(_TUNABLES, "")
    if any(name in settings for name in _SETTINGS) or not _is_supported():
        return
    settings = ":".join([*filter(None, [settings]), *(f"{name}={value}" for name, value in _SETTINGS.items())])
    sys.stdout.flush()
    os.execve(sys.executable, [sys.executable, *sys.orig_argv[1:]], {**os.environ, _TUNABLES: settings})


def peak_resident_mib() -> float:
    """The peak resident size of this program so far, in MiB.

    Linux reports it for the program itself; `getrusage`, the fallback, also counts the process that started it.
    """
    status = Path("/proc/self/status")
    if status.exists():
        for line in status.read_text().splitlines():
            name, _, value = line.partition(":")
            if name == "VmHWM":
                return int(value.split()[0]) / 2**10
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 2**10)


def most_memory_bytes() -> int:
    """The memory that this process may use at most: what the machine has, or what a container or a limit leaves it."""
    limits = [os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")]
    if (limit := resource.getrlimit(resource.RLIMIT_AS)[0]) != resource.RLIM_INFINITY:
        limits.append(limit)
    for name in ("memory.max", "memory/memory.limit_in_bytes"):
        with suppress(OSError, ValueError):
            limits.append(int(Path("/sys/fs/cgroup", name).read_text()))
    return min(limits)


def available_bytes() -> int | None:
    """The memory that a program may still take, or None where the system does not say."""
    status = Path("/proc/meminfo")
    if status.exists():
        for line in status.read_text().splitlines():
            name, _, value = line.partition(":")
            if name == "MemAvailable":
                return int(value.split()[0]) * 2**10
    return None


def _is_supported() -> bool:
    """Whether the C library is a glibc that has these settings."""
    library, version = platform.libc_ver()
    try:
        return library == "glibc" and tuple(map(int, version.split("."))) >= _SINCE
    except ValueError:
        return False

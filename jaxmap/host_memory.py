"""How the process is given its memory: in large pages, where it uses gigabytes for seconds at a time."""

from __future__ import annotations

import os
import platform
import sys
from pathlib import Path

_TUNABLES, _LARGE_PAGES = "GLIBC_TUNABLES", "glibc.malloc.hugetlb"
_SYSTEM = Path("/sys/kernel/mm/transparent_hugepage/enabled")
_SINCE = (2, 35)


def restart_with_large_pages() -> None:
    """Starts this process again, under the same number, so that the C library asks for large pages.

    A training step takes gigabytes, and gives them back at its end. In pages of 4 KiB, fetched and zeroed one by
    one, that is a third of the step. The library reads its settings only when a process starts; where it is not
    glibc, or the system grants large pages to all or to none, nothing happens.
    """
    settings = os.environ.get(_TUNABLES, "")
    if _LARGE_PAGES in settings or not _would_help():
        return
    settings = f"{settings}:{_LARGE_PAGES}=1".lstrip(":")
    sys.stdout.flush()
    os.execve(sys.executable, [sys.executable, *sys.orig_argv[1:]], {**os.environ, _TUNABLES: settings})


def _would_help() -> bool:
    library, version = platform.libc_ver()
    try:
        return (
            library == "glibc"
            and tuple(map(int, version.split("."))) >= _SINCE
            # What the system grants is in brackets.
            and "[madvise]" in _SYSTEM.read_text()
        )
    except (OSError, ValueError):
        return False

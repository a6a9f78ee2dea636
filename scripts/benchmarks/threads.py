"""How many threads the libraries may use; imports none of them."""

from __future__ import annotations

import os


def limit_threads(count: int) -> None:
    """Binds the process to so many cores; must run before the libraries are loaded, which look once."""
    os.environ["OMP_NUM_THREADS"] = str(count)
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:count])


def usable_cores() -> int:
    """The cores that the process is bound to."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1

"""Stages of the work on the host: timed, and marked in a trace that is being recorded."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

import jax


@contextmanager
def timed_stage(name: str, stages_s: dict[str, float]) -> Iterator[None]:
    """Times a block in seconds, under a name that `jax.profiler` traces show too."""
    started_s = time.perf_counter()
    with jax.profiler.TraceAnnotation(name):
        yield
    stages_s[name] = time.perf_counter() - started_s

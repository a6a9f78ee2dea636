"""Stages of the host's work: timed, and marked in the trace where one is being recorded."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

import jax


@contextmanager
def timed_stage(name: str, stages_s: dict[str, float]) -> Iterator[None]:
    """Times a block, in seconds, under its name; `jax.profiler` traces show it under the same."""
    started_s = time.perf_counter()
    with jax.profiler.TraceAnnotation(name):
        yield
    stages_s[name] = time.perf_counter() - started_s

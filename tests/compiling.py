"""How much the programs of a test file are optimised: quickly compiled programs are slow ones."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import jax

_FLAG = "jax_disable_most_optimizations"


@contextmanager
def optimised(fully: bool) -> Iterator[None]:
    """Within it, programs are compiled with all optimisations, or with few, which takes less time."""
    before = jax.config.read(_FLAG)
    jax.config.update(_FLAG, not fully)
    try:
        yield
    finally:
        jax.config.update(_FLAG, before)


def compiled_quickly() -> Iterator[None]:
    """The fixture of files with many programs that run once, with `--all`, too."""
    with optimised(False):
        yield


def compiled_in_full() -> Iterator[None]:
    """The fixture of files whose few programs compute for longer than it takes to compile them."""
    with optimised(True):
        yield

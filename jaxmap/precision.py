"""Arithmetic that comes out alike on every device."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import jax

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def in_full_float32(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """The same with products of matrices in full float32: a GPU by itself rounds the factors to ten bits.

    Positions of many metres would be off by centimetres. A CPU computes them in full whatever it is told.
    """

    @functools.wraps(function)
    def exact(*arguments: Arguments.args, **options: Arguments.kwargs) -> Result:
        with jax.default_matmul_precision(None if jax.default_backend() == "cpu" else "highest"):
            return function(*arguments, **options)

    return exact

"""Compiling a network for inference."""

from __future__ import annotations

from functools import cache

import jax

EIGEN_PRODUCTS = {"xla_cpu_experimental_ynn_fusion_type": ""}
"""Matrix products by Eigen, which takes a tenth less time than YNNPACK, the default from jaxlib 0.9 on."""


@cache
def inference_options() -> dict[str, str] | None:
    """What to give `jax.jit` as `compiler_options` for inference: None where the installed XLA knows no better."""
    if jax.default_backend() != "cpu":
        return None
    try:
        jax.jit(lambda: 0).lower().compile(compiler_options=EIGEN_PRODUCTS)
    except jax.errors.JaxRuntimeError:
        return None
    return EIGEN_PRODUCTS

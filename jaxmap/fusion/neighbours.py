"""A small kernel over neighbouring columns, applied when a map is read: what a column lacks, its neighbours may know.

As in ConvBKI (Wilson et al. 2023, "Convolutional Bayesian Kernel Inference for 3D Semantic Mapping") each class has a
depthwise kernel of its own. It acts on sums of log-odds, so that fusion stays additive and a map can be read with
another kernel, or with none.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float


def kernel_margin(kernel: Float[Array, "C K K"] | None) -> int:
    """How many columns around a part of a map decide with it."""
    return 0 if kernel is None else kernel.shape[1] // 2


def spread_evidence(evidence: Float[Array, "C X Y *z"], kernel: Float[Array, "C K K"]) -> Float[Array, "C X Y *z"]:
    """Each class's evidence, correlated with its kernel along x and y; there is none beyond the edges.

    `out[c, x, y] = sum over i, j of kernel[c, i, j] evidence[c, x + i - K // 2, y + j - K // 2]`.
    """
    size, (width, depth) = kernel.shape[1], evidence.shape[1:3]
    reach = size // 2
    edges = [(0, 0), (reach, reach), (reach, reach)] + [(0, 0)] * (evidence.ndim - 3)
    padded = jnp.pad(evidence, edges)
    weights = kernel.reshape(*kernel.shape, *[1] * (evidence.ndim - 1))
    # Shifted slices: as a grouped convolution it is many times slower on CPU.
    out = jnp.zeros_like(evidence)
    for i in range(size):
        for j in range(size):
            out = out + weights[:, i, j] * padded[:, i : i + width, j : j + depth]
    return out

"""The paths that a GPU walks: bit for bit those of the scan over rows."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import AbstractDevice, AbstractMesh, use_abstract_mesh

from jaxmap.matching.aggregate import aggregate
from jaxmap.matching.aggregate_gpu import aggregate_gpu

P1, P2 = jnp.uint8(13), jnp.uint8(68)


def random_volume(*shape: int) -> np.ndarray:
    return np.random.default_rng(shape).integers(0, 86, shape, np.uint8)


@pytest.mark.slow
@pytest.mark.parametrize("paths", [4, 8])
@pytest.mark.parametrize("shape", [(5, 7, 128), (9, 6, 16), (3, 5, 144)], ids=str)
def test_the_kernel_sums_what_the_scan_sums(shape, paths):
    """Also with disparities that leave some threads idle, or give each more than one word."""
    volume = random_volume(*shape)
    ours = jax.jit(lambda volume: aggregate_gpu(volume, P1, P2, paths, interpret=True))(volume)
    assert ours.dtype == jnp.uint16
    np.testing.assert_array_equal(ours, aggregate(jnp.asarray(volume), P1, P2, paths))


@pytest.mark.slow
def test_the_greatest_sums_do_not_overflow():
    volume = np.full((4, 4, 16), 85, np.uint8)
    volume[..., 3] = 0
    p1, p2 = jnp.uint8(85), jnp.uint8(170)
    ours = jax.jit(lambda volume: aggregate_gpu(volume, p1, p2, 8, interpret=True))(volume)
    np.testing.assert_array_equal(ours, aggregate(jnp.asarray(volume), p1, p2, 8))


@pytest.mark.slow
def test_the_kernel_can_be_lowered_for_cuda():
    """Without a GPU; whether it compiles there, `scripts/benchmarks/gpu_step.py` tells."""
    forms = jax.ShapeDtypeStruct((48, 64, 128), jnp.uint8), *[jax.ShapeDtypeStruct((), jnp.uint8)] * 2
    device = AbstractDevice("NVIDIA H100 80GB HBM3", None, "gpu")  # pyright: ignore[reportCallIssue]
    with use_abstract_mesh(AbstractMesh((), (), abstract_device=device)):
        lowered = jax.jit(aggregate_gpu).trace(*forms).lower(lowering_platforms=("cuda",))
    assert "triton" in lowered.as_text()

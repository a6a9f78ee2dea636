"""What is made for a GPU: bit for bit what the CPU's ways give."""

from __future__ import annotations

from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import AbstractDevice, AbstractMesh, use_abstract_mesh

from jaxmap.errors import UsageError
from jaxmap.matching.aggregate import aggregate
from jaxmap.matching.aggregate_gpu import check_cards, winners_gpu
from jaxmap.matching.blobs import labels_by_hooks, labels_handed_on
from jaxmap.matching.costs import cost_volume
from jaxmap.matching.design import MatchDesign, make_match_params
from jaxmap.matching.select import Winners, winners


def assert_same_winners(volume: np.ndarray, p1: int, p2: int, paths: int) -> None:
    penalties = jnp.uint8(p1), jnp.uint8(p2)
    ours = jax.jit(lambda volume: winners_gpu(volume, *penalties, paths, interpret=True))(volume)
    expected = jax.vmap(winners)(aggregate(jnp.asarray(volume), *penalties, paths).swapaxes(1, 2))
    for name in Winners._fields:
        np.testing.assert_array_equal(getattr(ours, name), getattr(expected, name), err_msg=name)
        assert getattr(ours, name).dtype == getattr(expected, name).dtype


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shape", "paths"), [((4, 7, 16), 4), ((5, 6, 16), 8), ((2, 133, 128), 8), ((3, 5, 144), 8)], ids=str
)
def test_the_kernels_find_the_winners_of_the_scan(shape, paths):
    """Also in rows of several parts, with disparities that leave threads idle, or give each more than one word."""
    assert_same_winners(np.random.default_rng(shape).integers(0, 63, shape, np.uint8), 9, 50, paths)


@pytest.mark.slow
def test_the_greatest_costs_do_not_overflow():
    volume = np.full((4, 4, 16), 127, np.uint8)
    volume[..., 3] = 0
    assert_same_winners(volume, 127, 127, 8)


@pytest.mark.slow
def test_the_kernels_can_be_lowered_for_cuda():
    """Without a GPU; whether they compile there, `scripts/benchmarks/gpu_step.py` tells."""
    forms = jax.ShapeDtypeStruct((48, 64, 128), jnp.uint8), *[jax.ShapeDtypeStruct((), jnp.uint8)] * 2
    device = AbstractDevice("NVIDIA H100 80GB HBM3", None, "gpu")
    with use_abstract_mesh(AbstractMesh((), (), abstract_device=device)):
        lowered = jax.jit(winners_gpu).trace(*forms).lower(lowering_platforms=("cuda",))
    assert lowered.as_text().count("triton") >= 2


@pytest.mark.slow
@pytest.mark.parametrize("tied", [0.5, 0.75, 0.95])
def test_hooks_label_blobs_as_handing_on_does(tied):
    random = np.random.default_rng(3)
    down, along = (random.random((40, 50)) < tied for _ in range(2))
    down[0], along[:, 0] = False, False
    ours, settled = jax.jit(labels_by_hooks)(down, along)
    expected, _ = jax.jit(labels_handed_on)(down, along)
    assert settled
    np.testing.assert_array_equal(ours, expected)


@pytest.mark.parametrize("capability", ["8.0", "9.0", "12.0", "gfx942", None])
def test_cards_that_kernels_compile_for_pass(capability):
    check_cards([SimpleNamespace(device_kind="a card", compute_capability=capability), *jax.devices("cpu")])


def test_an_older_card_is_refused_with_the_way_round():
    cards = [SimpleNamespace(device_kind="Tesla T4", compute_capability="7.5")]
    with pytest.raises(UsageError, match=r"Tesla T4 has .* 7\.5.*--stereo\.no-kernels"):
        check_cards(cards)


def test_volumes_with_more_costs_than_places_are_refused():
    """They would be written over each other."""
    volume, penalty = jax.ShapeDtypeStruct((3008, 4112, 256), jnp.uint8), jax.ShapeDtypeStruct((), jnp.uint8)
    with pytest.raises(UsageError, match=r"4112x3008 px, 256 disparities and 8 paths .*--stereo\.no-kernels"):
        jax.eval_shape(winners_gpu, volume, penalty, penalty)


@pytest.mark.slow
@pytest.mark.parametrize(("cost", "block_size"), [("census", 1), ("census", 5), ("bt", 5)])
def test_costs_at_once_are_those_in_turn(cost, block_size):
    pair = np.random.default_rng(5).integers(0, 256, (2, 20, 40), np.uint8)
    design = MatchDesign(cost=cost, num_disparities=16, block_size=block_size)
    in_turn, at_once = (
        jax.jit(partial(cost_volume, design, params=make_match_params(cost), at_once=way))(*pair)
        for way in (False, True)
    )
    np.testing.assert_array_equal(at_once, in_turn)

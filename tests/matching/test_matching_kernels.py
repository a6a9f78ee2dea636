"""Matching by the kernels in C++ is that of the slow twin, and of the plain form, bit for bit."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference_matching as twin
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxmap.matching.design import MOST_P2, MatchDesign, MatchParams, make_match_params
from jaxmap.matching.kernel import decide_cpu, winners_cpu
from jaxmap.matching.match import find_winners, match, penalties
from jaxmap.matching.select import Winners, decide
from jaxmap.native.build import SELECT_TARGET, SGM_TARGET, has_kernel

HEIGHT, WIDTH, COUNT = 9, 40, 20
SMALL = MatchDesign(census_window_px=(3, 3))

pytestmark = pytest.mark.skipif(
    not all(map(has_kernel, (SGM_TARGET, SELECT_TARGET))), reason="no C++ compiler, or no CPU"
)


def seen(seed: int, shape: tuple[int, int], disparity: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """A wall of noise at a disparity, with more noise on the right image."""
    random = np.random.default_rng(seed)
    wall = random.integers(0, 256, (shape[0], shape[1] + disparity), dtype=np.uint8)
    disturbed = wall[:, disparity:] + random.integers(0, 9, shape, dtype=np.uint8)
    return wall[:, : shape[1]], disturbed


def drawn_winners(seed: int, shape: tuple[int, int]) -> Winners:
    """Of surfaces a few pixels wide, with ties and outliers."""
    random = np.random.default_rng(seed)
    coarse = random.integers(0, COUNT, (shape[0], -(-shape[1] // 6))).repeat(6, 1)[:, : shape[1]]
    place = np.clip(coarse + random.integers(0, 2, shape), 0, COUNT - 1).astype(np.int16)
    cost, *others = (random.integers(least, 60, shape).astype(np.uint16) for least in (0, 20, 20, 20))
    return Winners(place, np.minimum(cost, 30).astype(np.uint16), *others)


@settings(max_examples=15)
@given(
    seed=st.integers(0, 99),
    height=st.integers(1, 4),
    width=st.integers(1, 18),
    disparities=st.sampled_from([1, 2, 3, 15, 32, 40, 64, 70, 100, 130]),
    first=st.integers(-5, 5),
    block=st.sampled_from([1, 3, 5]),
    paths=st.sampled_from([4, 8]),
    p1=st.floats(0, 1),
    p2=st.floats(0, MOST_P2),
)
def test_winners_are_those_of_the_twin(seed, height, width, disparities, first, block, paths, p1, p2):
    design = replace(SMALL, num_disparities=disparities, min_disparity_px=first, block_size=block, paths=paths)
    check_winners(design, *seen(seed, (height, width)), make_match_params(p1=p1, p2=p2))


@pytest.mark.parametrize("disparities", [290, 2032])
def test_many_disparities_go_through_as_many_vectors(disparities):
    design = replace(SMALL, num_disparities=disparities, min_disparity_px=-9)
    check_winners(design, *seen(1, (2, 3)), make_match_params())


def check_winners(design: MatchDesign, left: np.ndarray, right: np.ndarray, params: MatchParams) -> None:
    """They are those of the twin."""
    first, steps = design.min_disparity_px, [int(penalty) for penalty in penalties(design, params)]
    disparities, window_px = range(first, first + design.num_disparities), design.census_window_px
    costs = twin.mean_census_costs(left, right, disparities, window_px, design.block_size, design.cost_steps)
    expected = twin.winners(twin.aggregate(costs, *steps, design.paths))
    found = winners_cpu(design, jnp.asarray(left), jnp.asarray(right), params, *penalties(design, params))
    for name, one, other in zip(Winners._fields, found, expected, strict=True):
        np.testing.assert_array_equal(one, other, err_msg=name)


@pytest.mark.parametrize("cost", ["census", "bt"])
def test_winners_are_those_of_the_plain_form(cost):
    design, params = MatchDesign(cost=cost, num_disparities=COUNT, block_size=3), make_match_params(cost)
    by_kernel, plain = (
        jax.jit(partial(find_winners, one))(*seen(0, (HEIGHT, WIDTH)), params)
        for one in (design, replace(design, kernels=False))
    )
    for name, one, other in zip(Winners._fields, by_kernel, plain, strict=True):
        assert one.dtype == other.dtype, name
        np.testing.assert_array_equal(one, other, err_msg=name)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"min_disparity_px": -6, "left_right_max_diff_px": -1},
        {"speckle_window_px": 9, "edge_step_px": 0.0},
        {"speckle_window_px": 0, "edge_window_px": 3, "left_right_max_diff_px": 0},
    ],
)
def test_what_is_doubtful_is_that_of_the_plain_form(changes):
    design = replace(MatchDesign(num_disparities=COUNT, speckle_window_px=4), **changes)
    plain = jax.jit(partial(decide, design))
    kept = 0
    for seed in range(8):
        winners, params = drawn_winners(seed, (HEIGHT, WIDTH)), make_match_params(uniqueness=0.05 * seed)
        expected = plain(winners, params)
        np.testing.assert_array_equal(decide_cpu(design, winners, params), expected)
        kept += int(np.isfinite(expected).sum())
    assert 0 < kept < 8 * HEIGHT * WIDTH


def test_programs_call_the_kernels_where_the_design_says_so():
    pair, params = seen(0, (HEIGHT, WIDTH)), make_match_params()
    for kernels in (True, False):
        design = MatchDesign(num_disparities=COUNT, kernels=kernels)
        text = jax.jit(partial(match, design)).lower(*pair, params).as_text()
        assert [target in text for target in (SGM_TARGET, SELECT_TARGET)] == [kernels, kernels]


def test_a_stack_of_pairs_is_matched_pair_by_pair():
    design, params = MatchDesign(num_disparities=COUNT), make_match_params()
    pairs = [seen(seed, (HEIGHT, WIDTH)) for seed in range(3)]
    stacked = jax.vmap(partial(match, design), (0, 0, None))(*map(np.stack, zip(*pairs, strict=True)), params)
    for one, (left, right) in zip(stacked, pairs, strict=True):
        np.testing.assert_array_equal(one, match(design, left, right, params))

"""Semi-global matching in JAX against its slow twin, and the laws that it keeps."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference_matching as twin
from scenes import BACKGROUND, WIDTH_PX, scene_frame

from jaxmap.matching.aggregate import aggregate
from jaxmap.matching.blobs import drop_blobs
from jaxmap.matching.costs import cost_volume
from jaxmap.matching.design import MOST_P2, MatchDesign, make_match_params
from jaxmap.matching.match import grey, match, penalties
from jaxmap.matching.select import drop_edges, select

HEIGHT, WIDTH, COUNT = 9, 24, 8
PLAIN = MatchDesign(num_disparities=COUNT, speckle_window_px=0, edge_step_px=0.0)
"""No blob and no edge is dropped, which small images consist of."""

CHECKS = [(0.0, -1), (0.125, -1), (0.0, 1), (0.0625, 2)]
"""Uniqueness, and the greatest difference between left and right."""

run = jax.jit(match, static_argnums=0)
costs_of = jax.jit(cost_volume, static_argnums=0)
summed = jax.jit(aggregate, static_argnums=3)
decided = jax.jit(select, static_argnums=0)


def noise(seed: int, shape: tuple[int, ...] = (HEIGHT, WIDTH)) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


def pair(disparity: int, shape: tuple[int, int] = (HEIGHT, WIDTH)) -> tuple[np.ndarray, np.ndarray]:
    """Of a wall of noise, seen at that disparity."""
    wall = noise(7, (shape[0], shape[1] + abs(disparity)))
    left, right = wall[:, : shape[1]], wall[:, abs(disparity) :]
    return (left, right) if disparity >= 0 else (right, left)


def volume(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 64, (HEIGHT, WIDTH, COUNT)).astype(np.uint8)


def all_of(*ranges: Sequence, quick: Sequence[tuple]) -> list:
    """All combinations, each a program of its own, of which some are enough for the quick suite."""
    return [one if one in quick else pytest.param(*one, marks=pytest.mark.slow) for one in itertools.product(*ranges)]


# --- against the twin


@pytest.mark.parametrize(
    ("window_px", "first"),
    all_of([(7, 9), (5, 5)], [0, 3, -4], quick=[((7, 9), 3), ((5, 5), -4)]),
)
def test_census_costs_are_those_of_the_twin(first, window_px):
    design = replace(PLAIN, min_disparity_px=first, census_window_px=window_px)
    bits = window_px[0] * window_px[1] - 1
    expected = twin.census_cost(noise(0), noise(1), range(first, first + COUNT), window_px)
    cost = costs_of(design, noise(0), noise(1), make_match_params())
    assert cost.dtype == jnp.uint8
    np.testing.assert_array_equal(np.asarray(cost, int) * bits, expected * design.cost_steps)


@pytest.mark.parametrize(("first", "soft"), all_of([0, -4], [False, True], quick=[(-4, False), (0, True)]))
def test_birchfield_tomasi_costs_are_those_of_the_twin(first, soft):
    design = replace(PLAIN, cost="bt", min_disparity_px=first, soft=soft)
    cap = design.pre_filter_cap
    left, right = (noise(seed).astype(float) for seed in (2, 3))
    expected = twin.birchfield_tomasi_cost(left, right, range(first, first + COUNT), cap) / (2 * cap + 255 / 4)
    cost = np.asarray(costs_of(design, noise(2), noise(3), make_match_params("bt")))
    if not soft:
        cost, expected = cost / design.cost_steps, np.round(expected * design.cost_steps) / design.cost_steps
    np.testing.assert_allclose(cost, expected, atol=1e-5)


@pytest.mark.parametrize("cost", ["census", "bt"])
def test_blocks_have_the_mean_of_their_costs(cost):
    design, params = replace(PLAIN, cost=cost), make_match_params(cost)
    size, half = 3, 1
    blocks = costs_of(replace(design, block_size=size), noise(0), noise(1), params)
    plain = np.asarray(costs_of(design, noise(0), noise(1), params), float)
    means = np.zeros(plain.shape)
    for v, u in np.ndindex(HEIGHT - 2 * half, WIDTH - 2 * half):
        means[v + half, u + half] = plain[v : v + size, u : u + size].mean((0, 1))
    within = (slice(half, -half), slice(COUNT, -half))
    np.testing.assert_array_equal(np.asarray(blocks)[within], np.floor(means + 0.5)[within])


@pytest.mark.parametrize("paths", [4, 8])
@pytest.mark.parametrize(("p1", "p2"), [(3, 20), (0, 0), (63, 127), (9, 4)])
def test_sums_of_small_integers_are_exact(paths, p1, p2):
    total = summed(volume(), p1, p2, paths)
    assert total.dtype == jnp.uint16
    np.testing.assert_array_equal(total, twin.aggregate(volume(), p1, p2, paths))


def test_sums_of_floats_are_those_of_the_twin():
    costs = np.random.default_rng(1).random((HEIGHT, WIDTH, COUNT)).astype(np.float32)
    np.testing.assert_allclose(summed(costs, 0.1, 0.5, 8), twin.aggregate(costs, 0.1, 0.5, 8), rtol=1e-5)


@pytest.mark.parametrize(
    ("first", "checks"),
    all_of([0, 2, -3], CHECKS, quick=[(0, CHECKS[0]), (2, CHECKS[1]), (-3, CHECKS[2]), (2, CHECKS[3])]),
)
def test_what_is_selected_is_what_the_twin_selects(first, checks):
    uniqueness, left_right = checks
    total = np.random.default_rng(first + 5).integers(0, 400, (HEIGHT, WIDTH, COUNT)).astype(np.uint16)
    design = replace(PLAIN, min_disparity_px=first, left_right_max_diff_px=left_right)
    params = make_match_params(uniqueness=uniqueness)
    expected = twin.select(total.astype(int), first, uniqueness, left_right)
    np.testing.assert_allclose(decided(design, total, params), expected, rtol=1e-5)


@pytest.mark.slow
def test_the_whole_is_its_parts():
    """Picking winners row by row is selecting from the sums, in sixteenths of a pixel."""
    design, params = PLAIN, make_match_params()
    left, right = pair(3)
    total = summed(costs_of(design, left, right, params), *penalties(design, params), 8)
    np.testing.assert_allclose(16 * run(design, left, right, params), np.round(16 * decided(design, total, params)))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("most_px", [1, 5, 40])
def test_blobs_are_those_of_the_twin(seed, most_px):
    random = np.random.default_rng(seed)
    disparity_px = random.choice([0.0, 1.5, 3.0, 9.0, np.nan], (20, 30), p=[0.3, 0.2, 0.2, 0.1, 0.2]).astype(np.float32)
    dropped = jax.jit(drop_blobs, static_argnums=(1, 2))(disparity_px, 2.0, most_px)
    np.testing.assert_array_equal(dropped, twin.drop_blobs(disparity_px, 2.0, most_px))


def test_a_coiled_blob_is_one_blob():
    coil = np.full((21, 21), np.nan, np.float32)
    v, u, dv, du = 0, 0, 0, 1
    coil[0, 0] = 5
    for length in [20, 20, 20, *np.repeat(np.arange(18, 0, -2), 2)]:
        for _ in range(length):
            v, u = v + dv, u + du
            coil[v, u] = 5
        dv, du = du, -dv
    size = int(np.isfinite(coil).sum())
    assert np.isfinite(drop_blobs(coil, 1.0, size - 1)).sum() == size
    assert np.isnan(drop_blobs(coil, 1.0, size)).all()


def test_edges_are_those_of_the_twin():
    random = np.random.default_rng(4)
    disparity_px = np.where(random.random((15, 20)) < 0.2, np.nan, 10 + (random.random((15, 20)) < 0.05) * 4.0)
    design = replace(PLAIN, edge_step_px=1.5, edge_window_px=3)
    dropped = drop_edges(design, jnp.asarray(disparity_px, jnp.float32))
    np.testing.assert_array_equal(dropped, twin.drop_edges(disparity_px, 1.5, 3).astype(np.float32))


# --- laws


@pytest.mark.slow
@pytest.mark.parametrize("cost", ["census", "bt"])
@pytest.mark.parametrize("disparity", [0, 3, -2])
def test_a_shifted_image_has_that_disparity(cost, disparity):
    design = replace(PLAIN, cost=cost, min_disparity_px=-3, block_size=3 if cost == "bt" else 1)
    found = np.asarray(run(design, *pair(disparity, (24, 40)), make_match_params(cost)))
    inner = found[:, 10:-10]
    assert np.isfinite(inner).mean() > 0.95
    assert np.nanmax(np.abs(inner - disparity)) < 0.5


def test_census_does_not_mind_brightness():
    left, right = (image // 2 for image in pair(3))
    params = make_match_params()
    np.testing.assert_array_equal(run(PLAIN, left, right * 2 + 1, params), run(PLAIN, left, right, params))


@pytest.mark.parametrize("paths", [4, 8])
def test_without_penalties_sums_are_costs_times_paths(paths):
    np.testing.assert_array_equal(summed(volume(), 0, 0, paths), volume().astype(int) * paths)


def test_turning_all_upside_down_changes_nothing():
    turned = summed(volume()[::-1], 4, 30, 8)[::-1]
    np.testing.assert_array_equal(turned, summed(volume(), 4, 30, 8))
    left, right = pair(3)
    params = make_match_params()
    upside_down = run(PLAIN, left[::-1], right[::-1], params)[::-1]
    np.testing.assert_array_equal(upside_down, run(PLAIN, left, right, params))


def test_sums_mirror_and_turn_with_the_costs():
    total = np.asarray(summed(volume(), 4, 30, 8))
    np.testing.assert_array_equal(summed(volume()[:, ::-1], 4, 30, 8)[:, ::-1], total)
    np.testing.assert_array_equal(summed(volume().swapaxes(0, 1), 4, 30, 8).swapaxes(0, 1), total)
    np.testing.assert_array_equal(summed(volume()[..., ::-1], 4, 30, 8)[..., ::-1], total)


@pytest.mark.slow
@pytest.mark.parametrize("first", [0, 5, -3])
def test_what_is_found_lies_in_the_range_and_in_the_right_image(first):
    design = replace(PLAIN, min_disparity_px=first, left_right_max_diff_px=-1)
    found = np.asarray(run(design, noise(0), noise(1), make_match_params(uniqueness=0.0)))
    known = np.isfinite(found)
    assert known.any()
    assert found[known].min() >= first
    assert found[known].max() <= first + COUNT - 1
    match_column = np.arange(WIDTH) - found
    assert match_column[known].min() > -1
    assert match_column[known].max() < WIDTH


def test_penalties_beyond_8_bits_are_taken_for_the_greatest():
    params = make_match_params(p1=5.0, p2=50.0)
    p1, p2 = penalties(PLAIN, params)
    assert (p1, p2) == (PLAIN.cost_steps, MOST_P2 * PLAIN.cost_steps)


def test_images_without_texture_have_no_depth():
    flat = np.full((HEIGHT, WIDTH), 90, np.uint8)
    found = np.asarray(run(PLAIN, flat, flat, make_match_params()))
    assert not (found > 0).any()


def test_colours_become_grey_as_opencv_has_it():
    cv2 = pytest.importorskip("cv2")
    image = noise(3, (20, 30, 3))
    difference = np.abs(np.asarray(grey(image)).astype(int) - cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
    assert difference.max() <= 1
    assert (difference > 0).mean() < 0.01


@pytest.mark.slow
@pytest.mark.parametrize(("cost", "block"), [("census", 1), ("bt", 5)])
def test_a_scene_has_its_true_disparity(cost, block):
    frame = scene_frame(0)
    design = MatchDesign(cost=cost, num_disparities=-(-WIDTH_PX // 128) * 16, block_size=block, edge_step_px=0.0)
    disparity_px = np.asarray(run(design, frame.left, frame.right, make_match_params(cost)))
    error_px = np.abs(disparity_px - frame.disparity_px)[frame.labels != BACKGROUND]
    assert np.nanmedian(error_px) < 0.3
    assert np.nanmean(error_px > 2) < 0.05
    assert np.isfinite(error_px).mean() > 0.8

"""Descent, what is held out, and intervals: the parts of tuning that know nothing of maps."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference_cells
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.ndimage import label

from jaxmap.datasets.label_raster import OTHER, TARGET
from jaxmap.errors import JaxmapError, UsageError
from jaxmap.evaluation.cells import CellGrid
from jaxmap.evaluation.truth_cells import TruthCells, cell_counts
from jaxmap.fusion.bijectors import positive
from jaxmap.fusion.params import make_fusion_params
from jaxmap.tuning.cell_scores import ScoredCells, calibration_rows, joined, score_with_intervals
from jaxmap.tuning.descent import LEAST_SHARE, Slope, descend, go_down
from jaxmap.tuning.options import DescentOptions
from jaxmap.tuning.parametrisation import TunedParams, constrained, unconstrained
from jaxmap.tuning.split import ground_groups, hold_out

CLASSES = ("background", "sand", "rock")
BIJECTORS = {"temperature": positive(0.02, 50.0), "threshold_m": positive(5e-3, 1.9)}
START = TunedParams(
    make_fusion_params(CLASSES, class_kernel=np.pad(np.ones((3, 1, 1)), ((0, 0), (1, 1), (1, 1)))),
    {"temperature": jnp.float32(1.0), "threshold_m": jnp.float32(0.1)},
)
QUICK = DescentOptions(steps=60, learning_rate=0.3, patience=60)


def bowl(free):
    """Lowest at 1; what is held out is lowest at 0.8."""
    return ((free - 1.0) ** 2).sum(), ((free - 0.8) ** 2).sum()


def test_it_keeps_the_step_that_is_best_on_what_is_held_out():
    steps = []
    best = descend(bowl, jnp.array([-2.0]), QUICK, on_step=steps.append)
    assert best.losses.held_out == min(step.losses.held_out for step in steps)
    np.testing.assert_allclose(best.free, [0.8], atol=0.1)
    # Whoever writes down each step marked as best has the best at any time.
    kept = [step.losses.held_out for step in steps if step.best]
    assert kept == sorted(kept, reverse=True)
    assert steps[0].best and steps[0].number == 0


def test_it_stops_when_nothing_gets_better():
    best = descend(lambda free: ((free - 1.0) ** 2, free**2), jnp.array(0.0), replace(QUICK, patience=5))
    assert best.number == 0


def test_what_shall_stay_stays():
    best = descend(bowl, jnp.array([-2.0, -2.0]), QUICK, moves=jnp.array([1.0, 0.0]))
    assert best.free[1] == -2.0 and best.free[0] > 0.0


@pytest.mark.parametrize("after", [0, 3])
def test_a_loss_that_is_not_finite_is_told_and_what_was_best_is_kept(after):
    steps = []

    def breaking(free):
        worth = jnp.where(free[0] > 0.25 * after, jnp.nan, -free[0])
        return worth, worth

    advice = "the best parameters before are kept" if after else "after 0 steps in tuning"
    with pytest.raises(JaxmapError, match=f"the loss diverges: nan.*{advice}"):
        descend(breaking, jnp.array([0.1]), QUICK, on_step=steps.append)
    assert bool(steps) == bool(after)
    assert all(np.isfinite(step.losses.tuned) for step in steps)


def slope_of(loss):
    """A loss for `go_down`, its gradient taken apart."""
    return Slope(lambda free: (loss(free), free), lambda free, kept: jax.grad(lambda free: loss(free)[0])(kept))


@given(start=st.floats(-5, 5), rough=st.floats(0, 0.3), rate=st.floats(0.01, 3))
def test_going_down_never_goes_up(start, rough, rate):
    """However rough the loss and however long the first step."""

    def loss(free):
        value = ((free - 1.0) ** 2).sum() + rough * jnp.floor(jnp.sin(40.0 * free) * 2.0).sum()
        return value, value

    steps = []
    options = replace(QUICK, steps=20, learning_rate=rate)
    best = go_down(slope_of(loss), jnp.array([start]), options, on_step=steps.append)
    losses = [step.losses.tuned for step in steps if step.taken]
    assert losses == sorted(set(losses), reverse=True)
    assert best.losses.tuned == losses[-1] and [step.number for step in steps] == list(range(len(steps)))


def test_going_down_finds_the_bottom_whatever_the_rate():
    for rate in (1e-3, 1.0, 30.0):
        best = go_down(slope_of(bowl), jnp.array([-2.0, 4.0]), replace(QUICK, learning_rate=rate, steps=120))
        np.testing.assert_allclose(best.free, [0.8, 0.8], atol=0.25)


def test_where_nothing_leads_down_it_says_so_by_its_first_step():
    steps = []
    best = go_down(slope_of(lambda free: ((free * free).sum(),) * 2), jnp.zeros(2), QUICK, on_step=steps.append)
    assert best.number == 0 and not any(step.taken for step in steps[1:])
    assert 2.0 ** -(len(steps) - 2) >= LEAST_SHARE > 2.0 ** -(len(steps) - 1)


def test_going_down_turns_back_from_what_is_not_finite_and_keeps_what_shall_stay():
    def loss(free):
        value = jnp.where((free > 1.5).any(), jnp.nan, -free.sum())
        return value, value

    best = go_down(slope_of(loss), jnp.zeros(2), QUICK, moves=jnp.array([1.0, 0.0]))
    assert best.free[1] == 0.0 and 1.4 < best.free[0] <= 1.5
    with pytest.raises(JaxmapError, match="the loss is not finite.*after 0 steps"):
        go_down(slope_of(loss), jnp.full(2, 2.0), QUICK)


def test_a_loss_that_grows_a_hundredfold_diverges():
    with pytest.raises(JaxmapError, match="the loss diverges"):
        descend(
            lambda free: (jnp.exp(3 * free[1]) - 0 * free[0], free[0]), jnp.array([0.0, 0.0]), QUICK, moves=-jnp.ones(2)
        )


@pytest.mark.parametrize("wrong", [{"steps": 0}, {"learning_rate": 0.0}, {"patience": 0}, {"max_norm": np.inf}])
def test_options_that_make_no_sense_are_refused(wrong):
    with pytest.raises(UsageError, match=next(iter(wrong))):
        DescentOptions(**wrong)


def test_parameters_come_back_through_their_unconstrained_numbers():
    start = constrained(unconstrained(START, BIJECTORS), BIJECTORS)
    again = constrained(unconstrained(start, BIJECTORS), BIJECTORS)
    for one, other in zip(jax.tree.leaves(start), jax.tree.leaves(again), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-3)
    # The defaults lie at an end of one range only: the threshold is a little above the prior.
    for name in ("occupancy_hit", "occupancy_miss", "occupancy_prior", "disparity_sigma_px", "full_evidence_points"):
        np.testing.assert_allclose(getattr(start.fusion, name), getattr(START.fusion, name), rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(start.fusion.occupancy_threshold, START.fusion.occupancy_threshold, atol=0.01)
    np.testing.assert_allclose(start.fusion.class_increments, START.fusion.class_increments, rtol=1e-3)
    np.testing.assert_allclose(start.fusion.class_kernel, START.fusion.class_kernel, atol=1e-6)
    np.testing.assert_allclose(start.labeller["temperature"], 1.0, rtol=1e-3)


@given(st.integers(0, 2**20), st.sampled_from([0.1, 3.0, 100.0, 1e6]))
def test_whatever_the_unconstrained_numbers_the_parameters_are_legal_and_ordered(seed, scale):
    rng = np.random.default_rng(seed)
    free = jax.tree.map(lambda leaf: jnp.asarray(scale * rng.normal(size=leaf.shape), jnp.float32), START)
    legal = constrained(free, BIJECTORS)
    f = {name: np.asarray(value, np.float64) for name, value in vars(legal.fusion).items()}
    sigmoid = lambda x: 1 / (1 + np.exp(-x))  # noqa: E731
    make_fusion_params(
        CLASSES,
        **{name: f[name].tolist() for name in f if name not in ("occupancy_prior", "class_prior")},
        occupancy_prior=sigmoid(f["occupancy_prior"]),
        class_prior=sigmoid(f["class_prior"]),
    )
    logit = np.log(f["occupancy_threshold"]) - np.log1p(-f["occupancy_threshold"])
    assert f["occupancy_miss"] < f["occupancy_prior"] < f["occupancy_hit"]
    assert f["occupancy_prior"] < logit
    assert (np.diagonal(f["class_increments"]) > 0).all()
    for column in range(3):
        assert f["class_increments"][:, column].argmax() == column
    kernel = f["class_kernel"]
    assert (kernel[:, 1, 1] == 1).all()
    np.testing.assert_allclose(kernel, kernel.transpose(0, 2, 1))
    np.testing.assert_allclose(kernel, kernel[:, ::-1])
    for name, (low, high) in {"temperature": (0.02, 50.0), "threshold_m": (5e-3, 1.9)}.items():
        assert low * 0.999 <= float(legal.labeller[name]) <= high * 1.001


def truth_of(rock: np.ndarray, per_cell: int = 2) -> tuple[TruthCells, CellGrid]:
    fine = np.where(rock, TARGET, OTHER).astype(np.uint8)
    share = cell_counts(fine == TARGET, per_cell) / per_cell**2
    return TruthCells(share, np.ones(share.shape, bool), fine, per_cell), CellGrid((0.0, 0.0), 0.2, share.shape)


@given(arrays(bool, (40, 32), elements=st.booleans(), fill=st.just(False)), st.integers(0, 99))
def test_no_rock_lies_on_both_sides_of_what_is_held_out(rock, seed):
    truth, cells = truth_of(rock)
    groups = ground_groups(truth, cells, block_m=1.0)
    held = hold_out(groups, truth.truly(), truth.labelled, 0.3, seed)
    pieces, count = label(rock, np.ones((3, 3)))
    for piece in range(1, count + 1):
        rows, columns = np.nonzero(pieces == piece)
        assert len(set(held[rows // 2, columns // 2].tolist())) == 1
    for group in np.unique(groups):
        assert len(set(held[groups == group].tolist())) == 1


def test_about_the_share_that_was_asked_for_is_held_out_of_rocks_and_of_ground():
    rock = np.zeros((200, 200), bool)
    rock[::8, ::8] = rock[1::8, ::8] = rock[::8, 1::8] = rock[1::8, 1::8] = True
    truth, cells = truth_of(rock)
    groups = ground_groups(truth, cells)
    for share in (0.2, 0.5):
        held = hold_out(groups, truth.truly(), truth.labelled, share, 0)
        np.testing.assert_allclose(held[truth.truly()].mean(), share, atol=0.02)
        np.testing.assert_allclose(held[~truth.truly()].mean(), share, atol=0.05)
        assert (hold_out(groups, truth.truly(), truth.labelled, share, 0) == held).all()
        assert (hold_out(groups, truth.truly(), truth.labelled, share, 1) != held).any()


def some_cells(seed: int, count: int = 400, groups: int = 40) -> tuple[ScoredCells, ScoredCells]:
    rng = np.random.default_rng(seed)
    truly, group = rng.random(count) < 0.3, rng.integers(0, groups, count)
    before, after = (np.clip(np.where(truly, 0.6, 0.4) + rng.normal(0, s, count), 0, 1) for s in (0.4, 0.1))
    return tuple(ScoredCells(p > 0.5, p, truly, group) for p in (before, after))


@pytest.mark.parametrize("seed", range(3))
def test_scores_are_those_of_evaluate_and_lie_in_their_intervals(seed):
    before, after = some_cells(seed)
    table = score_with_intervals(before, after)
    for when, cells in (("before", before), ("after", after)):
        counted = np.ones(len(cells.truly), bool)
        nll, brier, ece = reference_cells.calibration(cells.probability, cells.truly, counted)
        counts = reference_cells.confusion(cells.called, cells.truly, counted)
        iou = counts["tp"] / (counts["tp"] + counts["fp"] + counts["fn"])
        for name, value in (("nll", nll), ("brier", brier), ("ece", ece), ("iou", iou)):
            np.testing.assert_allclose(table[name][when], value, err_msg=name)
        for row in table.values():
            low, high = row[f"{when}_interval"]
            assert low <= high
        low, high = table["iou"][f"{when}_interval"]
        assert low < iou < high
    assert table["iou"]["change"] == pytest.approx(table["iou"]["after"] - table["iou"]["before"])


def test_intervals_narrow_with_groups_and_vanish_where_nothing_changes():
    few, many = (score_with_intervals(*some_cells(1, groups=groups))["iou"]["after_interval"] for groups in (4, 200))
    same = score_with_intervals(some_cells(1)[0], some_cells(1)[0])
    assert same["iou"]["change_interval"] == [0.0, 0.0]
    assert few is not None and many is not None


def test_cells_of_traverses_are_joined_and_their_groups_kept_apart():
    one, other = some_cells(0)
    both = joined([one, other])
    assert len(both.truly) == 800
    assert len(np.unique(both.group)) == len(np.unique(one.group)) + len(np.unique(other.group))
    rows = calibration_rows(both)
    assert sum(row["cells"] for row in rows) == 800
    assert all(0 <= row["true"] <= 1 for row in rows)


def test_scores_without_a_quotient_are_none():
    nothing = ScoredCells(np.zeros(3, bool), np.full(3, 0.1), np.zeros(3, bool), np.arange(3))
    table = score_with_intervals(nothing, nothing)
    assert table["iou"]["before"] is None and table["iou"]["change_interval"] is None
    assert table["accuracy"]["after"] == 1.0

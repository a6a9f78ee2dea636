"""Scores of maps: each aggregation against its twin, the laws, and a hand-made case with known counts."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference_cells as twin
from hypothesis import given, settings
from hypothesis import strategies as st
from truth_files import class_layer

from jaxmap.datasets.label_raster import LabelRaster
from jaxmap.errors import JaxmapError, UsageError
from jaxmap.evaluation.camera_track import CameraTrack, ground_height, view_range
from jaxmap.evaluation.cells import column_shares, make_cells, map_cells
from jaxmap.evaluation.evaluate import evaluate_map, find_rocks, rock_table
from jaxmap.evaluation.map_scores import score_cells
from jaxmap.evaluation.options import ScoringOptions
from jaxmap.evaluation.truth_cells import Alignment, samples_of, truth_cells
from jaxmap.types import GridSpec

KEYS = ["accuracy", "iou", "precision", "recall", "f1", "coverage", "tp", "fp", "fn", "tn", "nll", "brier", "ece"]
rngs = st.integers(0, 2**31).map(np.random.default_rng)


def raster(labels: np.ndarray, west=0.0, south=0.0, pixel_m=0.2) -> LabelRaster:
    """Labels given x first, y to the north."""
    rows = labels.T[::-1]
    transform = np.array([[pixel_m, 0, west], [0, -pixel_m, south + len(rows) * pixel_m], [0, 0, 1.0]])
    return LabelRaster(np.ascontiguousarray(rows).astype(np.uint8), transform)


def random_case(rng: np.random.Generator):
    """A map and labels of 9 x 7 cells, some unobserved, some unlabelled."""
    return rng.random((9, 7)) < 0.4, rng.random((9, 7)) < 0.8, rng.choice([0, 1, 2], (9, 7), p=[0.15, 0.5, 0.35])


@given(rngs)
def test_confusion_and_calibration_equal_their_twins(rng):
    called, truth, counted, observed = (rng.random((6, 5)) < share for share in (0.4, 0.5, 0.8, 0.7))
    counted[0, 0] = True
    probability = rng.choice([0.0, 1.0, 1 / 15, rng.random()], (6, 5))
    scores = score_cells(called, probability, truth, counted, observed)
    counts = twin.confusion(called, truth, counted)
    assert {key: scores[key] for key in counts} == counts
    assert sum(counts.values()) == counted.sum()
    expected = twin.calibration(probability, truth, counted)
    np.testing.assert_allclose([scores["nll"], scores["brier"], scores["ece"]], expected, atol=1e-12)
    assert scores["coverage"] == (observed & counted).sum() / counted.sum()
    assert set(scores) == set(KEYS)


@given(rngs)
def test_swapping_the_classes_swaps_the_roles(rng):
    called, truth, counted = (rng.random((6, 5)) < share for share in (0.4, 0.5, 0.8))
    probability = rng.random((6, 5))
    one = score_cells(called, probability, truth, counted)
    other = score_cells(~called, 1 - probability, ~truth, counted)
    assert [one[key] for key in ("tp", "fp", "fn", "tn")] == [other[key] for key in ("tn", "fn", "fp", "tp")]
    for key in ("accuracy", "nll", "brier"):
        assert one[key] == other[key] or one[key] == pytest.approx(other[key])


def test_scores_that_are_not_defined_are_none():
    nothing = np.zeros((2, 2), bool)
    empty = score_cells(nothing, np.full((2, 2), 0.5), nothing, nothing)
    assert all(empty[key] is None for key in KEYS if key not in ("tp", "fp", "fn", "tn"))
    no_rock = score_cells(nothing, np.full((2, 2), 0.5), nothing, ~nothing)
    assert no_rock["accuracy"] == 1.0 and no_rock["iou"] is None and no_rock["f1"] is None


@settings(max_examples=15)
@given(rngs, st.sampled_from([(0.05, 0.2), (0.2, 0.2), (0.1, 0.25), (0.15, 0.2), (0.4, 0.2)]))
def test_columns_come_to_cells_by_their_area(rng, sizes):
    voxel_m, cell_m = sizes
    origin_m = (float(rng.integers(-9, 9)) * voxel_m, 0.3)
    rock, observed = rng.random((7, 6)) < 0.5, rng.random((7, 6)) < 0.7
    probability = rng.random((7, 6)).astype(np.float32)
    said = class_layer(rock, observed, voxel_m=voxel_m, origin_m=origin_m)
    cells = make_cells(said.grid, cell_m)
    found = map_cells(rock, probability, observed, column_shares(said.grid, cells), prior=0.3)
    origin = np.array([float(str(np.float32(number))) for number in origin_m])
    expected = twin.map_cells(rock, probability, observed, origin, (voxel_m, voxel_m), cells, 0.3)
    np.testing.assert_array_equal(found.observed, expected[0])
    np.testing.assert_allclose(found.share, expected[1], atol=2e-5)
    np.testing.assert_allclose(found.probability, expected[2], atol=2e-5)


def test_maps_of_one_site_share_their_cells_whatever_their_voxels():
    def corner(origin: float, voxel: float) -> tuple[float, float]:
        grid = GridSpec(jnp.full(3, origin, jnp.float32), jnp.full(3, voxel, jnp.float32), (50, 50, 1))
        return make_cells(grid, 0.2).origin_m

    assert corner(-3.2, 0.2) == corner(-3.15, 0.05) == pytest.approx((-3.2, -3.2))
    assert corner(-3.15, 0.2) == pytest.approx((-3.15, -3.15))


def test_half_a_cell_is_enough_and_what_was_not_seen_is_no_rock():
    rock = np.zeros((8, 4), bool)
    rock[:2] = True  # half of the first cell
    rock[4, :] = rock[5, :3] = True  # seven of sixteen columns of the second
    observed = np.ones_like(rock)
    observed[6:] = False  # of which the others were not seen
    said = class_layer(rock, observed, voxel_m=0.05)
    cells = make_cells(said.grid, 0.2)
    found = map_cells(said.is_class, said.probability, observed, column_shares(said.grid, cells))
    np.testing.assert_array_equal(found.called(), [[True], [False]])


def test_the_probability_of_a_cell_is_differentiable():
    said = class_layer(np.ones((4, 4), bool), voxel_m=0.1)
    shares = column_shares(said.grid, make_cells(said.grid, 0.2))

    def total(probability):
        return map_cells(said.is_class, probability, said.observed, shares).probability.sum()

    np.testing.assert_allclose(jax.grad(total)(jnp.asarray(said.probability)), 0.25, atol=1e-6)


@settings(max_examples=10)
@given(rngs, st.sampled_from([0.05, 0.1, 0.2, 0.4]))
def test_truth_comes_to_cells_exactly_where_pixels_fill_them(rng, pixel_m):
    labels = rng.choice([0, 1, 2], (8, 8), p=[0.2, 0.4, 0.4])
    said = class_layer(np.zeros((4, 3), bool), origin_m=(0.2, -0.4))
    cells = make_cells(said.grid, 0.2)
    truth = truth_cells(raster(labels, west=0.0, south=-0.4, pixel_m=pixel_m), cells)
    expected = twin.truth_share(labels.T[::-1], 0.0, -0.4 + 8 * pixel_m, pixel_m, cells)
    np.testing.assert_array_equal(truth.labelled, np.isfinite(expected))
    np.testing.assert_allclose(truth.share[truth.labelled], expected[truth.labelled], atol=1e-12)


@settings(max_examples=10)
@given(rngs)
def test_truth_off_the_grid_of_cells_is_within_its_sampling(rng):
    labels = rng.choice([1, 2], (9, 9))
    cells = make_cells(class_layer(np.zeros((4, 4), bool)).grid, 0.2)
    west, south, pixel_m = -0.213, -0.117, 0.137
    truth = truth_cells(raster(labels, west, south, pixel_m), cells)
    expected = twin.truth_share(labels.T[::-1], west, south + 9 * pixel_m, pixel_m, cells)
    # Two edges of pixels in a cell, each known to half a sample.
    np.testing.assert_allclose(truth.share, expected, atol=4 / truth.per_cell)


def test_moving_the_truth_moves_it():
    labels = np.ones((40, 40), np.uint8)
    labels[18:22, 18:22] = 2
    cells = make_cells(class_layer(np.zeros((10, 10), bool), voxel_m=0.2).grid, 0.2)
    there = raster(labels, pixel_m=0.05)
    moved = truth_cells(there, cells, alignment=Alignment((0.2, -0.4)))
    still = truth_cells(there, cells)
    np.testing.assert_allclose(moved.share[1:, :-2], still.share[:-1, 2:], atol=1e-12)
    turned = truth_cells(there, cells, alignment=Alignment(heading_rad=np.pi / 2, pivot_m=(1.0, 1.0)))
    np.testing.assert_allclose(turned.share[1:-1, 1:-1], np.rot90(still.share)[1:-1, 1:-1], atol=1e-12)


def test_a_map_made_by_hand_has_the_counts_made_by_hand():
    labels = np.ones((10, 8), np.uint8)
    labels[1:4, 1:3] = 2
    labels[9, :] = 0
    rock = np.zeros((10, 8), bool)
    rock[2:6, 1:3] = True
    observed = np.ones_like(rock)
    observed[0, :] = observed[1, 1] = False
    evaluation = evaluate_map(class_layer(rock, observed), raster(labels))
    scores = evaluation.scores
    # Rock: six cells, one of them not observed; called: four over it, four beside it.
    assert {key: scores[key] for key in ("tp", "fp", "fn", "tn")} == dict(tp=4, fp=4, fn=1, tn=54)
    assert scores["iou"] == 4 / 9 and scores["accuracy"] == 58 / 63 and scores["f1"] == 8 / 13
    assert scores["cells"] == 63 and scores["rock_cells"] == 5
    view = scores["in_view"]
    assert {key: view[key] for key in ("tp", "fp", "fn", "tn")} == dict(tp=4, fp=4, fn=2, tn=62)
    assert scores["coverage"] == view["coverage"] == 63 / 72
    assert set(view) == set(KEYS)


@settings(max_examples=15)
@given(rngs, st.integers(-40, 40), st.integers(-40, 40))
def test_shifting_both_by_cells_changes_nothing(rng, east, north):
    rock, observed, labels = random_case(rng)
    observed[4, 3], labels[4, 3] = True, 2
    here = evaluate_map(class_layer(rock, observed), raster(labels)).scores
    corner = (0.2 * east, 0.2 * north)
    there = evaluate_map(class_layer(rock, observed, origin_m=corner), raster(labels, *corner)).scores
    assert here == there
    site = class_layer(rock, observed, site_origin=np.array([595683.0, 5785776.0, 0.0]))
    far = evaluate_map(site, raster(labels, 595683.0, 5785776.0)).scores
    assert here == far


@settings(max_examples=15)
@given(rngs)
def test_counts_sum_and_a_perfect_map_scores_1(rng):
    rock, observed, labels = random_case(rng)
    observed[4, 3], labels[4, 3] = True, 2
    scores = evaluate_map(class_layer(rock, observed), raster(labels)).scores
    assert sum(scores[key] for key in ("tp", "fp", "fn", "tn")) == scores["cells"] == (observed & (labels > 0)).sum()
    assert sum(scores["in_view"][key] for key in ("tp", "fp", "fn", "tn")) == (labels > 0).sum()
    perfect = evaluate_map(class_layer(labels == 2), raster(labels)).scores
    assert all(perfect[key] == 1.0 for key in ("accuracy", "iou", "precision", "recall", "f1", "coverage"))
    assert perfect["rocks"]["missed"] == 0


def test_a_perfect_map_scores_1_at_any_fraction():
    rng = np.random.default_rng(5)
    labels = rng.choice([1, 2], (24, 24))
    for fraction in (0.2, 0.5, 0.9):
        perfect = class_layer(labels == 2, voxel_m=0.05)
        scores = evaluate_map(perfect, raster(labels, pixel_m=0.05), options=ScoringOptions(rock_fraction=fraction))
        assert scores.scores["accuracy"] == 1.0, fraction


@pytest.mark.slow
def test_registration_finds_a_known_motion_and_says_so():
    rng = np.random.default_rng(3)
    labels = np.ones((120, 120), np.uint8)
    for x, y, r in zip(rng.integers(20, 100, 6), rng.integers(20, 100, 6), rng.integers(4, 10, 6), strict=True):
        i, j = np.ogrid[:120, :120]
        labels[(i - x) ** 2 + (j - y) ** 2 <= r * r] = 2
    true_map = class_layer(labels == 2, voxel_m=0.05)
    moved = raster(labels, west=-0.3, south=0.2, pixel_m=0.05)
    scores = evaluate_map(true_map, moved, options=ScoringOptions(register=True)).scores
    found = scores["registration"]
    assert found["shift_east_m"] == pytest.approx(0.3, abs=0.04)
    assert found["shift_north_m"] == pytest.approx(-0.2, abs=0.04)
    assert abs(found["heading_deg"]) < 0.5
    assert scores["iou"] > 0.9 > found["before"]["iou"]
    still = evaluate_map(true_map, raster(labels, pixel_m=0.05), options=ScoringOptions(register=True)).scores
    assert still["registration"]["shift_east_m"] == still["registration"]["heading_deg"] == 0.0
    assert "registration" not in evaluate_map(true_map, moved).scores


def looking_down_views(positions: np.ndarray, pitch_rad: float = 0.4) -> CameraTrack:
    """Cameras 1 m above the ground that look north and down."""
    c, s = np.cos(pitch_rad), np.sin(pitch_rad)
    T = np.tile(np.eye(4), (len(positions), 1, 1))
    T[:, :3, :3] = [[1, 0, 0], [0, -s, c], [0, -c, -s]]
    T[:, :2, 3], T[:, 2, 3] = positions, 1.0
    return CameraTrack(T, (60.0, 60.0), (39.5, 29.5), (80, 60), 6.0)


@settings(max_examples=10)
@given(rngs)
def test_the_view_equals_its_twin(rng):
    said = class_layer(np.zeros((20, 30), bool), origin_m=(-2.0, 0.0))
    cells, ground_m = make_cells(said.grid, 0.2), rng.normal(0, 0.05, (20, 30))
    views = looking_down_views(rng.uniform(-1, 2, (3, 2)))
    found = view_range(cells, ground_m, views, 3.0)
    np.testing.assert_allclose(found, twin.view_range(cells, ground_m, views, 3.0), atol=1e-12)
    assert np.isfinite(found).any() and np.isinf(found).any()


def test_a_range_keeps_what_was_looked_at_from_so_near():
    rock = np.zeros((40, 60), bool)
    rock[18:22, 10:12] = rock[18:22, 25:28] = True
    labels = np.where(rock, 2, 1)
    labels[0, 0] = 2
    said, views = class_layer(rock, origin_m=(-4.0, 0.0)), looking_down_views(np.array([[0.0, 0.0]]))
    truth = raster(labels, west=-4.0)
    whole = evaluate_map(said, truth, views).scores
    near = evaluate_map(said, truth, views, ScoringOptions(max_range_m=4.0)).scores
    assert near["cells"] < whole["cells"] == 2400
    assert near["in_view"]["tp"] == near["tp"] == 8 and whole["in_view"]["tp"] == whole["tp"] == 20
    assert whole["fn"] == 1 and near["fn"] == 0, "the corner was not looked at"
    assert near["rocks"]["count"] == 1 and whole["rocks"]["count"] == 2
    with pytest.raises(JaxmapError, match="poses"):
        evaluate_map(said, truth, None, ScoringOptions(max_range_m=4.0))


def test_the_ground_is_that_of_the_sand_beside_rocks():
    height_m = np.tile(np.linspace(0, 1, 100)[:, None], (1, 100))
    rocky = height_m.copy()
    rocky[40:45, 40:45] += 2.0
    observed = np.ones((100, 100), bool)
    observed[70:] = False
    ground = ground_height(np.where(observed, rocky, np.nan), observed, (0.2, 0.2))
    assert np.abs(ground - height_m)[observed].max() < 0.11
    assert np.isfinite(ground).all() and (ground_height(rocky, np.zeros_like(observed), (0.2, 0.2)) == 0).all()


def test_stones_smaller_than_a_cell_are_found_by_the_columns_of_the_map():
    labels = np.ones((40, 40), np.uint8)
    labels[8:10, 8:10] = labels[24:26, 24:26] = 2
    called = np.zeros((40, 40), bool)
    called[8:10, 8:9] = True
    scores = evaluate_map(class_layer(called, voxel_m=0.05), raster(labels, pixel_m=0.05)).scores
    assert scores["tp"] == scores["rock_cells"] == 0
    assert (scores["rocks"]["count"], scores["rocks"]["missed"]) == (2, 1)


def test_rocks_are_found_and_missed_by_size_and_range():
    labels = np.ones((60, 60), np.uint8)
    labels[4:8, 4:8] = 2  # one cell, found
    labels[20:32, 20:32] = 2  # nine cells, three called
    labels[40:42, 40:42] = labels[42:44, 42:44] = 2  # corners connect: one rock in one cell
    called = np.zeros((15, 15), bool)
    called[1, 1] = called[5, 5:8] = called[10, 10] = True
    cells = make_cells(class_layer(np.zeros((15, 15), bool)).grid, 0.2)
    truth = truth_cells(raster(labels, pixel_m=0.05), cells)
    range_m = np.full((15, 15), 3.0)
    range_m[5:8, 5:8] = 7.0
    called = samples_of(called, truth.per_cell)
    rocks = find_rocks(truth, 0.2, called, np.ones((15, 15), bool), range_m)
    np.testing.assert_allclose(sorted(rocks.diameter_m), 2 * np.sqrt(np.array([8, 16, 144]) * 0.05**2 / np.pi))
    table = rock_table(rocks)
    assert (table["count"], table["missed"]) == (3, 1)
    assert table["by_range_m"] == [
        {"from": 2.0, "to": 4.0, "count": 2, "missed": 0},
        {"from": 6.0, "to": 8.0, "count": 1, "missed": 1},
    ]
    assert rock_table(rocks, found_share=1 / 3)["missed"] == 0
    assert sum(row["count"] for row in table["by_diameter_m"]) == 3
    nowhere = find_rocks(truth, 0.2, called, np.zeros((15, 15), bool), range_m)
    assert rock_table(nowhere)["count"] == 0


@pytest.mark.parametrize(
    "wrong", [{"cell_size_m": 0.0}, {"rock_fraction": 1.5}, {"max_range_m": float("nan")}, {"found_share": -1.0}]
)
def test_options_that_make_no_sense_are_refused(wrong):
    with pytest.raises(UsageError, match=next(iter(wrong))):
        ScoringOptions(**wrong)


def test_nothing_in_common_is_an_error():
    labels = np.zeros((5, 5), np.uint8)
    with pytest.raises(JaxmapError, match="no observed cell is labelled: 25 cells were observed, 0 are labelled"):
        evaluate_map(class_layer(np.zeros((5, 5), bool)), raster(labels))

"""Tuning through stereo: its gradient is that of the loss, numbers keep their ranges, files are what map reads."""

from __future__ import annotations

import json
from dataclasses import replace

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
import yaml
from fixtures import cli, scene_folder, shared_cache  # noqa: F401
from hypothesis import given
from hypothesis import strategies as st
from scenes import scene_frame
from small_scenes import small_camera as camera_of
from tune_faults import tune_words, write_truth

from jaxmap.evaluation.cells import column_shares, make_cells
from jaxmap.fusion.options import FusionRule
from jaxmap.fusion.params import make_fusion_params
from jaxmap.fusion.sensor_model import frame_evidence
from jaxmap.labellers.files import make_files_labeller
from jaxmap.labels import ROVER_CLASSES
from jaxmap.mapping.step import MapperParams, make_mapper
from jaxmap.matching.design import MOST_P1, MOST_P2, MatchDesign, make_match_params
from jaxmap.runs.config import load_config
from jaxmap.runs.tuning import descent_notes
from jaxmap.stereo.front_end import RectifiedFrame
from jaxmap.tuning.evidence_cache import CacheRecipe
from jaxmap.tuning.map_loss import MapTruth
from jaxmap.tuning.options import MapLossOptions
from jaxmap.tuning.small_frames import SmallPair, at_full_size, small_design, small_pair
from jaxmap.tuning.stereo_evidence import StereoTraverse, make_stereo_gradient, soft_misses, stereo_losses
from jaxmap.tuning.stereo_params import free_match, matched_by
from jaxmap.tuning.traverse_loss import Traverse, TraverseArrays
from jaxmap.types import Frame, make_grid

THROUGH = ("--through", "stereo", "--stereo.matcher", "sgm")
EVERY_PX = 4


def doubled(tree: object) -> object:
    """Every float in double precision."""
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.float64) if jnp.issubdtype(x.dtype, jnp.floating) else x, tree)


def small_traverse() -> StereoTraverse:
    """Two views of the scene, small, with textured images, and truth of the scene from above."""
    camera = camera_of(EVERY_PX)
    grid = make_grid([-1.6, 0.4, -0.4], [1.6, 4.4, 1.2], 0.4)
    rule = FusionRule()
    labeller = make_files_labeller(ROVER_CLASSES, soft=True)
    design = MatchDesign(num_disparities=12, soft=True, census_window_px=(3, 5), edge_step_px=0.0, speckle_window_px=0)
    design = replace(design, left_right_max_diff_px=-1)
    mapper = make_mapper(camera, grid, labeller, rule, (0.3, 4.0), match=design)
    rng = np.random.default_rng(6)
    frames = []
    for index in range(2):
        seen = scene_frame(index)
        images = [
            image[: camera.height_px * EVERY_PX : EVERY_PX, : camera.width_px * EVERY_PX : EVERY_PX] + rng.uniform(0, 9)
            for image in (seen.left, seen.right)
        ]
        labels = np.eye(len(ROVER_CLASSES))[seen.labels[::EVERY_PX, ::EVERY_PX]] * 0.8 + 0.05
        pose = jaxlie.SE3.from_matrix(jnp.asarray(seen.T_world_camera, jnp.float32))
        grey = [jnp.asarray(image, jnp.float32).reshape(*image.shape[:2], -1).mean(-1) for image in images]
        soft = jnp.asarray(labels, jnp.float32)
        frames.append((Frame(None, pose, class_probabilities=soft), SmallPair(*grey)))
    cells = make_cells(grid, 0.4)
    shape = grid.shape[:2]
    truly = jnp.asarray(rng.uniform(size=shape) < 0.4, jnp.float32)
    truth = MapTruth(column_shares(grid, cells), truly, jnp.ones(shape, bool))
    recipe = CacheRecipe(camera, grid, labeller, rule, (0.3, 4.0))
    held_out = jnp.asarray(rng.uniform(size=shape) < 0.3)
    arrays = TraverseArrays(None, truth, held_out)  # type: ignore[arg-type]
    scored = Traverse("scene", recipe, arrays, np.zeros(shape, np.int32), 0.5)
    params = MapperParams(camera, make_fusion_params(ROVER_CLASSES), match=make_match_params(temperature=0.05))
    return StereoTraverse(scored, mapper, frames, params, jax.random.key(0), 1)


@pytest.mark.slow
def test_the_gradient_is_that_of_the_loss():
    """Against finite differences, in double precision, with decisions that hold still."""
    with jax.enable_x64(True):
        traverse = small_traverse()
        frames, params = (doubled(part) for part in (traverse.frames, traverse.params))
        mapper = traverse.mapper._replace(init=lambda empty=traverse.mapper.init: doubled(empty()))
        traverse = replace(traverse, frames=frames, params=params, mapper=mapper)
        gradient = make_stereo_gradient(traverse, ROVER_CLASSES.index("rock"), MapLossOptions())
        match = traverse.params.match
        assert match is not None
        (tuned, held_out), slopes = gradient.of(match)
        assert float(tuned) != float(held_out)
        for name in ("p1", "p2", "uniqueness", "temperature"):
            step = 1e-6
            moved = [replace(match, **{name: getattr(match, name) + sign * step}) for sign in (1, -1)]
            difference = (gradient.of(moved[0])[0][0] - gradient.of(moved[1])[0][0]) / (2 * step)
            np.testing.assert_allclose(getattr(slopes, name), difference, rtol=1e-3, atol=1e-6, err_msg=name)
            assert abs(float(difference)) > 0


def test_less_than_a_point_takes_less_than_a_whole_one_from_being_free():
    fusion = make_fusion_params(ROVER_CLASSES)
    points = jnp.array([0.0, 1e-4, 0.5, 1.0, 9.0])
    counts = jnp.zeros((len(ROVER_CLASSES) + 1, 1, 1, 5)).at[1, 0, 0].set(points)
    free = jnp.ones((1, 1, 5), bool)
    miss = fusion.occupancy_miss - fusion.occupancy_prior
    np.testing.assert_allclose(
        soft_misses(counts, free, fusion)[0, 0], miss * np.array([1, 1 - 1e-4, 0.5, 0, 0]), rtol=1e-5
    )
    assert not soft_misses(counts, ~free, fusion).any()
    # With whole points or none it is what the step takes.
    hard = frame_evidence(counts, free, fusion, FusionRule())[0] - frame_evidence(counts, None, fusion, FusionRule())[0]
    np.testing.assert_allclose(soft_misses(counts, free, fusion)[..., [0, 3, 4]], hard[..., [0, 3, 4]], atol=1e-6)


def test_a_trace_of_evidence_changes_the_loss_by_a_trace():
    """A share of a point that comes near a voxel, and nothing, are about the same."""
    traverse = small_traverse()
    target, options = ROVER_CLASSES.index("rock"), MapLossOptions()
    log_odds = jnp.zeros_like(traverse.mapper.init().log_odds).at[:, ::2].set(1.0)
    trace = jnp.where(log_odds == 0, 1e-4, log_odds)
    np.testing.assert_allclose(
        stereo_losses(trace, traverse, target, options), stereo_losses(log_odds, traverse, target, options), atol=5e-3
    )


@given(numbers=st.tuples(*[st.floats(-9, 9, width=32)] * 3))
def test_numbers_stay_in_their_ranges(numbers):
    start = make_match_params("census")
    free = dict(zip(("step_penalty", "jump_penalty", "uniqueness"), map(jnp.float32, numbers), strict=True))
    match = matched_by(free | {"cost_network": {}}, start)
    assert 0 < match.p1 < match.p2 <= MOST_P2 and match.p1 <= MOST_P1
    assert 0 <= match.uniqueness < 1
    assert match.temperature == start.temperature


def test_the_start_is_where_the_settings_are():
    weights = (jnp.arange(6.0).reshape(2, 3),)
    start = make_match_params("mccnn", p1=0.08, p2=0.4, uniqueness=0.12, weights=weights)
    match = matched_by(free_match(start), start)
    for ours, expected in zip(jax.tree.leaves(match), jax.tree.leaves(start), strict=True):
        np.testing.assert_allclose(ours, expected, rtol=1e-4)


@pytest.mark.parametrize("times", [1, 2, 4])
def test_a_small_design_searches_the_same_depths_and_checks_as_strictly(times):
    design = MatchDesign(min_disparity_px=-3, num_disparities=50, edge_window_px=7, block_size=9)
    small = small_design(design, 800 * 256, times)
    assert small.soft
    assert small.min_disparity_px * times <= -3
    assert (small.min_disparity_px + small.num_disparities) * times >= 47
    assert small.speckle_window_px == 256 // times**2
    assert small.edge_step_px * times == design.edge_step_px
    assert abs(small.block_size * times - 9) <= times and small.block_size % 2 and small.edge_window_px % 2


def test_as_it_is_a_design_is_only_made_soft():
    design = MatchDesign(speckle_window_px=100)
    assert small_design(design, 10_000, 1) == replace(design, soft=True)


@pytest.mark.parametrize("times", [1, 2, 4])
def test_a_shift_of_small_images_is_that_of_large_ones(times):
    """Matched small and brought to full size, noise that is shifted has its shift, and what is left over has none."""
    rng = np.random.default_rng(3)
    shift, shape = 8, (42, 103)
    wide = np.repeat(np.repeat(rng.integers(0, 255, (11, 32)), 4, 0), 4, 1)[: shape[0], : shape[1] + shift]
    wide = wide.astype(np.uint8)
    pair = small_pair(RectifiedFrame(wide[:, : shape[1]], wide[:, shift:], None, 0.0, 0.0), times)
    assert pair.left.shape == (shape[0] // times, shape[1] // times)
    np.testing.assert_allclose(pair.left[1, 2], wide[times : 2 * times, 2 * times : 3 * times].mean(), atol=0.51)
    same = (np.asarray(pair.left)[:, shift // times :] == np.asarray(pair.right)[:, : -(shift // times)]).mean()
    assert same == 1.0
    large = at_full_size(jnp.full(pair.left.shape, shift / times), shape, times) * times
    known = np.isfinite(large)
    assert large.shape == shape and (np.asarray(large)[known] == shift).all()
    assert known[: shape[0] // times * times, : shape[1] // times * times].all()
    assert known.sum() == pair.left.size * times**2


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("--through", "stereo"), "OpenCV's matcher passes no gradient"),
        ((*THROUGH, "--kernel", "3"), "--kernel is of the fusion"),
        ((*THROUGH, "--stereo.soft"), "a map is matched with hard minima"),
        ((*THROUGH, "--fusion.per-frame", "once"), "passes no gradient"),
        ((*THROUGH, "--frozen", "class_prior"), "name some of step_penalty jump_penalty"),
    ],
)
def test_what_does_not_serve_is_refused(cli, scene_folder, tmp_path, words, told):
    outcome = cli(*tune_words(scene_folder, write_truth(tmp_path / "truth.tif"), tmp_path / "stereo.yaml", *words))
    assert outcome.status == 2
    assert told in outcome.error
    assert not (tmp_path / "stereo.yaml").exists()


def test_a_loss_that_falls_nowhere_is_told():
    stage = {"name": "tuned", "best_step": 0, "tried": 7, "history": [{"step": 0, "loss": 1.0, "held_out": 1.0}]}
    (note,) = descent_notes(stage)
    assert "the loss falls nowhere around the start, whose numbers are kept (7 steps tried" in note


@pytest.mark.slow
def test_it_writes_what_map_reads(cli, scene_folder, tmp_path):
    out = tmp_path / "stereo.yaml"
    truth = write_truth(tmp_path / "truth.tif")
    small = ("--steps", "2", "--held-out-share", "0.4", "--smaller", "2", "--stop", "3")
    outcome = cli(*tune_words(scene_folder, truth, out, *THROUGH, *small, "--frozen", "uniqueness"))
    assert outcome.status == 0, outcome
    tree = yaml.safe_load(out.read_text())
    assert tree["stereo"]["matcher"] == "sgm" and not tree["stereo"]["soft"]
    assert tree["stereo"]["uniqueness_ratio"] == 10
    config = load_config(str(out))
    told = json.loads(out.with_suffix(".json").read_text())
    (stage,) = told["stages"]
    assert config.stereo.step_penalty == pytest.approx(stage["parameters"]["step_penalty"], abs=1e-5)
    losses = [row["loss"] for row in stage["history"]]
    assert stage["tried"] == 2 and np.isfinite(losses).all()
    assert losses == sorted(set(losses), reverse=True)
    assert stage["scores"]["held_out"]["iou"]["before"] is not None
    assert out.with_suffix(".html").exists() and not out.with_suffix(".safetensors").exists()

"""`jaxmap map --stereo.matcher sgm`: matched in the step or ahead, kept or not, it is one map."""

from __future__ import annotations

import hashlib
import json

import numpy as np
import pytest
from fixtures import cli, map_words, scene_folder, shared_cache  # noqa: F401
from planned_runs import config_of, log_odds, planned
from safetensors.numpy import save_file
from scenes import scene_frame

from jaxmap.errors import UsageError
from jaxmap.host.output_folder import check_same_settings
from jaxmap.mapping.observations import open_observations
from jaxmap.runs.config import load_config
from jaxmap.runs.folder import RunFolder
from jaxmap.runs.mapping_plan import plan_run
from jaxmap.stereo.jax_matcher import JaxMatcher

SGM = ("--stereo.matcher", "sgm")
SETTINGS = {"stereo": {"matcher": "sgm"}, "stop": 3}


def quiet(line: str) -> None:
    pass


def test_the_step_gets_two_images_where_no_disparity_is_asked_for(scene_folder):
    plan = plan_run(str(scene_folder), config_of(**SETTINGS), quiet, match_in_step=True)
    assert plan.mapper.design.match is not None and plan.params.match is not None
    for prepared in plan.prepare([0, 2]):
        frame, form, view = prepared.frame, plan.frame_form, scene_frame(prepared.index)
        assert frame is not None and frame.disparity_px is None and prepared.stages_s["match"] >= 0
        np.testing.assert_array_equal(np.asarray(frame.image)[..., 0], view.left)
        np.testing.assert_array_equal(frame.right_image, view.right)
        assert {name: (leaf.shape, leaf.dtype) for name, leaf in vars(form).items() if hasattr(leaf, "shape")} == {
            name: (leaf.shape, leaf.dtype) for name, leaf in vars(frame).items() if hasattr(leaf, "shape")
        }


@pytest.mark.parametrize("settings", [{"stop": 3}, SETTINGS])
def test_frames_are_matched_ahead_where_the_step_does_not(scene_folder, settings):
    plan = plan_run(str(scene_folder), config_of(**settings), quiet, match_in_step="stereo" not in settings)
    assert plan.mapper.design.match is None and plan.params.match is None
    assert isinstance(plan.front_end.matcher, JaxMatcher) == ("stereo" in settings)


def test_a_true_disparity_is_compared_frame_by_frame():
    config = config_of(stereo={"matcher": "sgm"}, grid={"lower_m": None, "upper_m": None})
    assert plan_run("sample:motorcycle", config, quiet, match_in_step=True).mapper.design.match is None


@pytest.mark.slow
def test_a_map_is_the_same_however_its_frames_were_matched(scene_folder, cli, tmp_path):
    """Within the step; ahead, kept on the way; and from what was perceived before; and its parts add up."""
    ways = {"step": (), "kept": ("--keep-observations",)}
    for name, more in ways.items():
        outcome = cli(*map_words(scene_folder, tmp_path / name), "--stop", 3, *SGM, *more)
        assert outcome.status == 0, outcome.err
    words = ("perceive", scene_folder, "--out", tmp_path / "seen", "--stop", 3, "--labeller", "plane", *SGM)
    assert cli(*words).status == 0
    assert cli(*map_words(tmp_path / "seen", tmp_path / "anew")).status == 0
    for name in ("kept", "anew"):
        np.testing.assert_array_equal(log_odds(tmp_path / name), log_odds(tmp_path / "step"))
    observations, front_end = (
        open_observations(RunFolder(tmp_path / "seen").observations),
        planned(scene_folder, **SETTINGS).front_end,
    )
    for index in range(2):
        view = scene_frame(index)
        disparity_px = front_end(view.left, view.right).disparity_px
        np.testing.assert_array_equal(observations.observation(index).disparity_px, disparity_px)
        off = np.abs(disparity_px - view.disparity_px)
        assert np.nanmedian(off) < 0.3 and np.isfinite(disparity_px).mean() > 0.4
    outcome = cli("explain", tmp_path / "step", "--at", 0.6, 2.6, "--out", tmp_path / "why.html")
    assert outcome.status == 0, outcome.err


@pytest.mark.slow
def test_a_run_goes_on_with_its_matcher_alone(scene_folder, cli, tmp_path):
    assert cli(*map_words(scene_folder, tmp_path), "--stop", 2, *SGM).status == 0
    assert len(list((tmp_path / "pictures").glob("*_disparity.png"))) == 2
    assert json.loads((tmp_path / "metrics.json").read_text())["points"]["valid_fraction"] > 0.2
    assert "matcher: sgm" in (tmp_path / "config.yaml").read_text()
    error = cli(*map_words(scene_folder, tmp_path), "--stop", 2, "--resume").error
    assert "stereo.matcher" in error


def write_cost_network(path, seed: int) -> str:
    """A small network of random weights; gives the file's SHA-256."""
    rng = np.random.default_rng(seed)
    tensors = {"conv_blocks.0.weight": rng.normal(size=(4, 1, 3, 3)), "conv_blocks.0.bias": np.zeros(4)}
    save_file({name: values.astype(np.float32) for name, values in tensors.items()}, path)
    return hashlib.sha256(path.read_bytes()).hexdigest()


def test_weights_swapped_under_one_name_are_noticed(scene_folder, tmp_path):
    weights, run = tmp_path / "cost.safetensors", RunFolder(tmp_path / "run")
    sha256 = write_cost_network(weights, 1)
    stereo = {"matcher": "mccnn", "cost_network": str(weights)}
    config = config_of(stereo=stereo, stop=2)
    plan = planned(scene_folder, stereo=stereo, stop=2)
    assert plan.settings(config)["stereo"]["cost_network_sha256"] == sha256
    run.begin(plan.settings(config), resume=False, overwrite=False)
    for again in ({}, {"cost_network_sha256": sha256.upper()}):
        planned(scene_folder, stereo=stereo | again, stop=2)
    check_same_settings(run.config, planned(scene_folder, stereo=stereo, stop=2).settings(config))

    write_cost_network(weights, 2)
    with pytest.raises(UsageError, match="begun with another stereo.cost_network_sha256"):
        check_same_settings(run.config, planned(scene_folder, stereo=stereo, stop=2).settings(config))
    recorded = load_config(str(run.config)).stereo.cost_network_sha256
    with pytest.raises(UsageError, match="the cost network's SHA-256 does not start with"):
        planned(scene_folder, stereo=stereo | {"cost_network_sha256": recorded}, stop=2)


@pytest.mark.slow
def test_observations_hold_what_matched_them(scene_folder, cli, tmp_path):
    weights = tmp_path / "cost.safetensors"
    sha256 = write_cost_network(weights, 1)
    words = ("--stop", 2, "--labeller", "plane", "--stereo.matcher", "mccnn", "--stereo.cost-network", weights)
    assert cli("perceive", scene_folder, "--out", tmp_path / "seen", *words).status == 0
    settings = open_observations(RunFolder(tmp_path / "seen").observations).attributes.settings
    assert settings["stereo"]["cost_network_sha256"] == sha256
    assert cli(*map_words(tmp_path / "seen", tmp_path / "map")).status == 0
    write_cost_network(weights, 2)
    outcome = cli(*map_words(tmp_path / "seen", tmp_path / "again"))
    assert outcome.status == 2 and "cost network's SHA-256" in outcome.error
    outcome = cli("perceive", scene_folder, "--out", tmp_path / "seen", *words)
    assert outcome.status != 0 and "cost_network_sha256" in outcome.error


@pytest.mark.parametrize(
    "words",
    [
        ("--stereo.matcher", "sgm", "--stereo.mode", "hh"),
        ("--stereo.matcher", "mccnn", "--stereo.cost", "bt"),
        ("--stereo.soft",),
    ],
)
def test_options_of_another_matcher_are_refused(words, scene_folder, cli, tmp_path):
    outcome = cli(*map_words(scene_folder, tmp_path), *words)
    assert outcome.status == 2 and "means nothing to the matcher" in outcome.error

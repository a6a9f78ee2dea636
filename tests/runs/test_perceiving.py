"""Perceiving once and fusing often: nothing is perceived twice, nothing is lost, and what differs is refused."""

from __future__ import annotations

import errno
import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
import yaml
from fixtures import FRAMES, cli, map_words, scene_copy, scene_folder, shared_cache  # noqa: F401
from killed import SLOW_DISK, kill_when
from networks import write_small_model
from planned_runs import BOUNDS, config_of, log_odds, metrics_of, planned
from scenes import frame_name, pose, timestamp_s

import jaxmap.mapping.observations as store
from jaxmap.datasets.poses import write_tum
from jaxmap.ensemble.options import EnsembleOptions
from jaxmap.errors import JaxmapError, UsageError
from jaxmap.mapping.observations import open_observations
from jaxmap.runs.config import PerceiveConfig, config_of_observations
from jaxmap.runs.folder import RunFolder
from jaxmap.runs.mapping_plan import Plan, plan_run
from jaxmap.runs.perceiving import keep_frames, make_keeper
from jaxmap.runs.perception import plan_perception

PLANE = ("--labeller", "plane")


def observed(out: Path) -> Path:
    return out / "observations.zarr"


@pytest.fixture(scope="module")
def perceived(tmp_path_factory, scene_folder) -> Path:
    """The scene, perceived for the plane; only to be read."""
    from jaxmap.commands.main import main

    out = tmp_path_factory.mktemp("perceived") / "obs"
    assert main(["perceive", str(scene_folder), "--out", str(out), *PLANE]) == 0
    return out


@pytest.fixture
def copy(perceived, tmp_path) -> Path:
    return Path(shutil.copytree(perceived, tmp_path / "copy"))


def plan_of(out: Path, notes: list[str] | None = None, **changes: object) -> Plan:
    config = config_of_observations(observed(out), None)
    config = replace(config, grid=replace(config.grid, **BOUNDS), **changes)
    return plan_run(str(out), config, (lambda line: None) if notes is None else notes.append)


def frames_of(plan: Plan) -> list:
    return [prepared.frame for prepared in plan.prepare()]


def test_every_frame_is_kept_with_settings_metrics_and_pictures(perceived, scene_folder):
    observations = open_observations(observed(perceived))
    assert [frame.name for frame in observations.frames] == [frame_name(index) for index in range(FRAMES)]
    assert observations.attributes.complete and observations.attributes.frames == FRAMES
    np.testing.assert_allclose(observations.T_world_camera, [pose(index) for index in range(FRAMES)], atol=1e-12)
    metrics = json.loads((perceived / "metrics.json").read_text())
    assert metrics["sequence"]["kept"] == metrics["times"]["perceived"] == FRAMES
    assert metrics["digest"] == observations.attributes.digest()
    tree = yaml.safe_load((perceived / "config.yaml").read_text())
    assert tree["sequence"] == str(scene_folder) and tree["labeller"] == "plane" and "grid" not in tree
    assert len(list((perceived / "pictures").glob("*_left.png"))) == FRAMES


def test_the_plan_and_the_frames_are_those_of_the_sequence(perceived, scene_folder):
    direct, again = planned(scene_folder), plan_of(perceived)
    assert again.digest(FRAMES) == direct.digest(FRAMES)
    assert again.grid.shape == direct.grid.shape and again.key_frames == direct.key_frames
    assert jax.tree.structure(again.frame_form) == jax.tree.structure(direct.frame_form)
    for one, other in zip(frames_of(again), frames_of(direct), strict=True):
        jax.tree.map(np.testing.assert_array_equal, one, other)


@pytest.mark.slow
@pytest.mark.parametrize("soft", [False, True])
def test_labels_of_files_are_kept(soft, scene_copy, cli, tmp_path):
    labels = scene_copy / "labels"
    if soft:
        labels, rng = tmp_path / "soft", np.random.default_rng(0)
        labels.mkdir()
        for index in range(FRAMES):
            np.save(labels / f"{frame_name(index)}.npy", rng.dirichlet(np.ones(3), (120, 160)).astype(np.float32))
    words = ("--labeller", "files", "--labels", labels)
    assert cli("perceive", scene_copy, "--out", tmp_path / "obs", *words).status == 0
    field = "class_probabilities" if soft else "labels"
    direct = frames_of(planned(scene_copy, labeller="files", labels=labels))
    shutil.rmtree(labels)
    for one, other in zip(frames_of(plan_of(tmp_path / "obs")), direct, strict=True):
        np.testing.assert_allclose(getattr(one, field), getattr(other, field), atol=0.0 if not soft else 0.002)


def test_what_is_there_is_not_perceived_again(cli, copy, scene_folder):
    before = {path: path.stat().st_mtime_ns for path in observed(copy).rglob("c.*")}
    lost = observed(copy) / frame_name(3)
    shutil.rmtree(lost)
    outcome = cli("perceive", scene_folder, "--out", copy, *PLANE)
    assert outcome.status == 0 and f"{FRAMES - 1} of {FRAMES} frames are there already" in outcome.err
    assert "1 were perceived now" in outcome.err
    changed = [path for path, at in before.items() if path.stat().st_mtime_ns != at]
    assert {path.parents[1] for path in changed} == {lost}
    assert "nothing is left to do" in cli("perceive", scene_folder, "--out", copy, *PLANE).err


@pytest.mark.slow
def test_other_settings_poses_or_a_run_in_the_folder_are_refused(cli, copy, scene_copy, scene_folder, tmp_path):
    words = ("perceive", scene_folder, "--out", copy)
    outcome = cli(*words, *PLANE, "--stereo.block-size", "5")
    assert outcome.status == 2 and "begun with another stereo.block_size" in outcome.error
    write_tum(tmp_path / "moved.tum", *moved(0.1))
    (scene_copy / "poses.tum").write_bytes((tmp_path / "moved.tum").read_bytes())
    tree = yaml.safe_load((copy / "config.yaml").read_text())
    (copy / "config.yaml").write_text(yaml.safe_dump(tree | {"sequence": str(scene_copy)}))
    outcome = cli("perceive", scene_copy, "--out", copy, *PLANE)
    assert outcome.status == 1 and f"frame {frame_name(0)} was perceived at another pose or time" in outcome.error
    assert cli("perceive", scene_copy, "--out", copy, *PLANE, "--overwrite").status == 0
    assert open_observations(observed(copy)).T_world_camera[0, 0, 3] == pytest.approx(0.1)
    (copy / "map.zarr").mkdir()
    assert "the folder holds a run" in cli(*words, *PLANE).error


@pytest.mark.slow
def test_frames_that_cannot_be_used_are_told_and_left_out(cli, scene_copy, tmp_path):
    (scene_copy / "right" / f"{frame_name(2)}.png").write_bytes(b"no picture")
    outcome = cli("perceive", scene_copy, "--out", tmp_path / "obs", *PLANE)
    assert outcome.status == 0 and f"skipped {frame_name(2)}: " in outcome.err
    notes: list[str] = []
    assert len(plan_of(tmp_path / "obs", notes).sequence.frames) == FRAMES - 1
    assert any(note.startswith(f"note: not perceived: {frame_name(2)}") for note in notes)
    assert cli("perceive", scene_copy, "--out", tmp_path / "strict", *PLANE, "--strict").status == 1


@pytest.mark.slow
def test_a_full_disk_keeps_what_is_whole_and_the_next_run_goes_on(cli, scene_folder, tmp_path, monkeypatch):
    written, sync = [], store.sync

    def full(path: Path) -> None:
        if path.name == "observations.zarr":
            written.append(path)
        if len(written) > 2:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        sync(path)

    with monkeypatch.context() as patch:
        patch.setattr(store, "sync", full)
        outcome = cli("perceive", scene_folder, "--out", tmp_path / "obs", *PLANE)
        assert outcome.status == 1 and "disk full" in outcome.error
    there = open_observations(observed(tmp_path / "obs"))
    assert 2 <= len(there.frames) < FRAMES and not there.attributes.complete
    notes: list[str] = []
    plan_of(tmp_path / "obs", notes)
    assert any("the observations are not complete" in note for note in notes)
    assert cli("perceive", scene_folder, "--out", tmp_path / "obs", *PLANE).status == 0
    assert open_observations(observed(tmp_path / "obs")).attributes.complete


@pytest.mark.slow
def test_a_killed_perception_goes_on_and_ends_as_if_nothing_had_happened(cli, scene_folder, perceived, tmp_path):
    out = tmp_path / "obs"
    words = ("perceive", scene_folder, "--out", out, *PLANE)
    kill_when(lambda: [*observed(out).glob(f"{frame_name(1)[:1]}*/disparity/c.0.0")], SLOW_DISK, words)
    assert cli(*words).status == 0
    one, other = (open_observations(observed(folder)) for folder in (out, perceived))
    for index in range(FRAMES):
        np.testing.assert_array_equal(one.observation(index).disparity_px, other.observation(index).disparity_px)
    assert not [path for path in observed(out).iterdir() if path.name.startswith(".f")]


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("--stereo.mode", "hh"), "the frames were perceived with another stereo.mode"),
        (("--calibration", "other.yaml"), "the frames were perceived with another calibration"),
        (("--labeller", "deeplab"), "the observations hold no labels of deeplab: they were perceived with plane"),
        (("--labeller", "files", "--labels", "x"), "the observations hold no labels of files"),
        (("--keep-observations",), "--keep-observations keeps those of a sequence"),
        (("--start", "9"), f"select none of {FRAMES} frames"),
        (("--poses", "odometry"), "observations hold no images to estimate poses from"),
    ],
)
def test_what_only_perceiving_could_change_is_refused_in_a_line(cli, perceived, tmp_path, words, expected):
    outcome = cli(*map_words(perceived, tmp_path / "run", *PLANE, *words))
    assert outcome.status in (1, 2) and expected in outcome.error
    assert not (tmp_path / "run").exists()


def test_the_observations_own_folder_is_not_mapped_into(cli, copy):
    assert "the run folder is the sequence's own" in cli(*map_words(copy, copy, "--overwrite")).error
    assert observed(copy).is_dir()


def test_a_labeller_of_points_and_numbers_of_fusion_may_change(perceived):
    notes: list[str] = []
    assert plan_of(perceived, notes, labeller="relief").labeller.name == "relief"
    assert plan_of(perceived, notes, labeller="none", stride=2).labeller.name == "none"
    with pytest.raises(UsageError, match=r"another stereo\.block_size"):
        plan_of(perceived, stereo=replace(config_of().stereo, block_size=9))


def moved(by_m: float, count: int = FRAMES) -> tuple[np.ndarray, np.ndarray]:
    """Times and poses of the scene, moved to the east."""
    T = np.array([pose(index) for index in range(count)])
    T[:, 0, 3] += by_m
    return np.array([timestamp_s(index) for index in range(count)]), T


def test_other_poses_take_the_place_of_those_that_are_kept(perceived, tmp_path):
    notes: list[str] = []
    write_tum(tmp_path / "moved.tum", *moved(0.5, FRAMES - 2))
    plan = plan_of(perceived, notes, poses=tmp_path / "moved.tum")
    assert f"note: 2 of {FRAMES} frames have no pose in {tmp_path / 'moved.tum'} and are left out" in notes
    np.testing.assert_allclose(plan.sequence.T_world_camera, moved(0.5, FRAMES - 2)[1], atol=1e-9)
    assert float(frames_of(plan)[0].T_world_camera.translation()[0]) == pytest.approx(0.5)


def test_poses_of_another_place_are_refused(perceived, tmp_path):
    write_tum(tmp_path / "far.tum", *moved(6e5))
    with pytest.raises(JaxmapError, match="the poses lie 600 km from those that the frames were perceived with"):
        plan_of(perceived, poses=tmp_path / "far.tum")


def test_a_damaged_frame_is_left_out_with_its_reason(copy):
    (observed(copy) / frame_name(1) / "disparity" / "c.0.0").write_bytes(b"zstd it is not")
    prepared = list(plan_of(copy).prepare())
    assert [one.frame is None for one in prepared] == [index == 1 for index in range(FRAMES)]
    assert "remove that folder and run jaxmap perceive again" in str(prepared[1].fault)


@pytest.mark.slow
def test_the_members_of_an_ensemble_stand_where_they_stand_over_images(perceived, scene_folder):
    direct, again = (
        planned(scene_folder, ensemble={"members": 2}),
        plan_of(perceived, ensemble=EnsembleOptions(members=2)),
    )
    for one, other in zip(frames_of(again), frames_of(direct), strict=True):
        jax.tree.map(np.testing.assert_array_equal, one, other)


@pytest.mark.slow
def test_a_map_of_observations_is_that_of_the_sequence(cli, perceived, scene_folder, tmp_path):
    for name, source in (("direct", scene_folder), ("fused", perceived)):
        assert cli(*map_words(source, tmp_path / name, *PLANE)).status == 0
    np.testing.assert_array_equal(log_odds(tmp_path / "fused"), log_odds(tmp_path / "direct"))
    one, other = (metrics_of(tmp_path / name) for name in ("fused", "direct"))
    for part in ("sequence", "camera", "grid", "labeller", "points", "voxels"):
        assert one[part] == other[part], part
    assert (tmp_path / "fused" / "poses.tum").read_bytes() == (tmp_path / "direct" / "poses.tum").read_bytes()
    files = [sorted(path.name for path in (tmp_path / name / "pictures").iterdir()) for name in ("fused", "direct")]
    assert files[0] == files[1]


@pytest.mark.slow
def test_a_network_sees_each_frame_once_and_tuned_numbers_still_act(cli, scene_folder, tmp_path):
    model = write_small_model(tmp_path / "model.safetensors")
    network = ("--labeller", "deeplab")
    words = (*network, "--model", model, "--classes", "sand", "boulder", "--stop", 2)
    assert cli(*map_words(scene_folder, tmp_path / "direct", *words)).status == 0
    assert cli(*map_words(scene_folder, tmp_path / "kept", *words, "--keep-observations")).status == 0
    model.unlink()
    assert cli(*map_words(tmp_path / "kept", tmp_path / "fused", *network)).status == 0
    np.testing.assert_array_equal(log_odds(tmp_path / "fused"), log_odds(tmp_path / "kept"))
    np.testing.assert_allclose(log_odds(tmp_path / "fused"), log_odds(tmp_path / "direct"), atol=0.01)
    softer = cli(*map_words(tmp_path / "kept", tmp_path / "softer", *network, "--deeplab.temperature", 5))
    assert softer.status == 0
    assert np.abs(log_odds(tmp_path / "softer") - log_odds(tmp_path / "fused")).max() > 0.05
    refused = cli(*map_words(tmp_path / "kept", tmp_path / "refused", *network, "--deeplab.size-px", 64, 64))
    assert "perceived with another deeplab.size_px" in refused.error


def test_a_picture_that_a_killed_process_has_not_drawn_is_drawn_with_the_next_try(copy, scene_folder):
    config = PerceiveConfig(labeller="plane")
    keeper = make_keeper(plan_perception(str(scene_folder), config, lambda line: None), config, 0.5)
    picture = copy / "pictures" / "000001_left.png"
    drawn = picture.read_bytes()
    picture.unlink()
    assert [kept.fault for kept in keep_frames(keeper, RunFolder(copy), [1])] == [None]
    assert picture.read_bytes() == drawn

"""Errors of poses: laws, and the numbers of evo."""

from __future__ import annotations

import json
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fixtures import cli, shared_cache  # noqa: F401
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jaxmap.datasets.poses import read_poses, write_tum
from jaxmap.errors import JaxmapError
from jaxmap.evaluation.pose_errors import align, associate, pairs_by_way, pose_scores, relative_errors

SITE = np.array([588123.4, 5790321.6, 12.5])


def drive(rng: np.random.Generator, count: int = 60) -> np.ndarray:
    """Poses of a wandering drive, (N, 4, 4)."""
    headings = np.cumsum(rng.normal(0, 0.1, count))
    tilts = rng.normal(0, 0.05, (count, 2))
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3] = Rotation.from_euler("zyx", np.column_stack([headings, tilts])).as_matrix()
    steps = rng.uniform(0.05, 0.5, count)[:, None] * np.column_stack([np.cos(headings), np.sin(headings), tilts[:, 0]])
    T[:, :3, 3] = SITE + np.cumsum(steps, axis=0)
    return T


def disturbed(rng: np.random.Generator, T: np.ndarray) -> np.ndarray:
    """The same drive with a drift."""
    off = T.copy()
    turns = Rotation.from_rotvec(np.cumsum(rng.normal(0, 0.005, (len(T), 3)), axis=0))
    off[:, :3, :3] = (turns * Rotation.from_matrix(T[:, :3, :3])).as_matrix()
    off[:, :3, 3] += np.cumsum(rng.normal(0, 0.02, (len(T), 3)), axis=0)
    return off


@settings(max_examples=25)
@given(st.integers(0, 2**31), st.floats(0.5, 2.0))
def test_alignment_undoes_a_similarity(seed, scale) -> None:
    rng = np.random.default_rng(seed)
    true = drive(rng)[:, :3, 3]
    R, t = Rotation.random(random_state=seed).as_matrix(), rng.normal(0, 100, 3)
    moved = (true - t) @ R / scale
    found = align(moved, true, with_scale=True)
    np.testing.assert_allclose(found.scale, scale, rtol=1e-6)
    np.testing.assert_allclose(found.scale * moved @ found.R.T + found.t_m, true, atol=1e-5)
    assert np.linalg.det(found.R) == pytest.approx(1)
    rigid = align(moved * scale, true, with_scale=False)
    np.testing.assert_allclose(rigid.R, R, atol=1e-5)


@settings(max_examples=25)
@given(st.integers(0, 2**31))
def test_relative_errors_know_no_world(seed) -> None:
    rng = np.random.default_rng(seed)
    T_true = drive(rng)
    T, pairs = disturbed(rng, T_true), np.array([[0, 1], [3, 40], [10, 5]])
    other = np.eye(4)
    other[:3, :3], other[:3, 3] = Rotation.random(random_state=seed).as_matrix(), [5, -7, 3]
    for before, after in zip(relative_errors(T, T_true, pairs), relative_errors(other @ T, T_true, pairs), strict=True):
        np.testing.assert_allclose(before, after, atol=1e-6)
    assert max(*map(np.max, relative_errors(other @ T_true, T_true, pairs))) < 1e-5


@settings(max_examples=40)
@given(st.integers(0, 2**31), st.integers(1, 30), st.integers(1, 30))
def test_each_of_the_fewer_finds_the_nearest(seed, count, true_count) -> None:
    rng = np.random.default_rng(seed)
    times_s, true_times_s = (np.unique(rng.uniform(0, 5, n)) for n in (count, true_count))
    index, true_index = associate(times_s, true_times_s, 0.1)
    swapped = len(times_s) > len(true_times_s)
    fewer, more = (true_times_s, times_s) if swapped else (times_s, true_times_s)
    here, there = (true_index, index) if swapped else (index, true_index)
    expected = {i: int(np.argmin(np.abs(more - t))) for i, t in enumerate(fewer) if np.abs(more - t).min() <= 0.1}
    assert dict(zip(here.tolist(), there.tolist(), strict=True)) == expected


def test_a_straight_drive_and_a_standing_one() -> None:
    T_true = np.tile(np.eye(4), (10, 1, 1))
    T_true[:, 0, 3] = np.arange(10)
    T = T_true.copy()
    T[::2, 1, 3] = 0.1
    scores = pose_scores(T, T_true)
    assert scores["ate_m"]["max"] == pytest.approx(0.1) and scores["ate_aligned_m"]["rmse"] < 0.06
    assert len(pairs_by_way(T_true[:, :3, 3], 3.0)) == 3
    standing = np.tile(np.eye(4), (5, 1, 1))
    scores = pose_scores(standing, standing)
    assert scores["rpe_way_m"] is None and scores["ate_scaled_m"]["max"] == 0 and scores["scale"] == 1
    with pytest.raises(JaxmapError, match="2 poses to compare"):
        pose_scores(standing[:2], standing[:2])


@pytest.mark.parametrize("seed", [1, 2])
def test_the_numbers_are_those_of_evo(seed, tmp_path) -> None:
    # evo is under the GPL: no dependency of ours, not even of the tests. With `pip install evo` this one runs.
    metrics, sync = (pytest.importorskip(f"evo.core.{name}") for name in ("metrics", "sync"))
    read = pytest.importorskip("evo.tools.file_interface").read_tum_trajectory_file

    rng = np.random.default_rng(seed)
    T_true = drive(rng)
    times_s = 1.4e9 + np.arange(len(T_true)) * 0.25
    write_tum(tmp_path / "true.tum", times_s, T_true)
    kept = rng.random(len(T_true)) < 0.8
    write_tum(
        tmp_path / "mine.tum", times_s[kept] + rng.uniform(-0.015, 0.015, kept.sum()), disturbed(rng, T_true)[kept]
    )

    true, mine = (read_poses(tmp_path / name) for name in ("true.tum", "mine.tum"))
    index, true_index = associate(*(np.asarray(track.timestamps_s) for track in (mine, true)), 0.01)
    scores = pose_scores(mine.T[index], true.T[true_index])
    assert 0.4 * kept.sum() < scores["poses"] < kept.sum()

    theirs = (read(str(tmp_path / name)) for name in ("true.tum", "mine.tum"))
    reference, estimate = sync.associate_trajectories(*theirs, max_diff=0.01)

    def evo(metric: Any, **alignment: bool) -> dict[str, float]:
        moved = deepcopy(estimate)
        if alignment:
            moved.align(reference, **alignment)
        metric.process_data((reference, moved))
        return metric.get_all_statistics()

    translation, rotation = metrics.PoseRelation.translation_part, metrics.PoseRelation.rotation_angle_deg
    expected = {
        "ate_m": evo(metrics.APE(translation)),
        "ate_aligned_m": evo(metrics.APE(translation), correct_scale=False),
        "ate_scaled_m": evo(metrics.APE(translation), correct_scale=True),
        "rpe_frame_m": evo(metrics.RPE(translation, 1, metrics.Unit.frames)),
        "rpe_frame_deg": evo(metrics.RPE(rotation, 1, metrics.Unit.frames)),
        "rpe_way_m": evo(metrics.RPE(translation, 1.0, metrics.Unit.meters)),
        "rpe_way_deg": evo(metrics.RPE(rotation, 1.0, metrics.Unit.meters)),
    }
    for name, theirs in expected.items():
        for statistic in ("rmse", "mean", "median", "std", "min", "max"):
            assert scores[name][statistic] == pytest.approx(theirs[statistic], rel=1e-5, abs=1e-7), (name, statistic)


@pytest.fixture
def run(tmp_path) -> Path:
    """A folder with poses alone."""
    T, folder = drive(np.random.default_rng(5)), tmp_path / "run"
    folder.mkdir()
    write_tum(folder / "poses.tum", 1e9 + np.arange(len(T)) * 0.25, T)
    return folder


def test_the_command_compares_poses(cli, run, tmp_path) -> None:
    track, truth = read_poses(run / "poses.tum"), tmp_path / "true.tum"
    times_s = np.asarray(track.timestamps_s)
    write_tum(truth, times_s[::2], track.T[::2] + np.pad([[0.0], [0.03], [0.04]], ((0, 1), (3, 0))))
    outcome = cli("evaluate", run, "--poses", truth)
    assert outcome.status == 0, outcome.err
    scores = json.loads((run / "pose_scores.json").read_text())
    assert scores["poses"] == 30 and scores["poses_of_run"] == 60 and scores["scale"] == pytest.approx(1)
    assert scores["ate_m"]["max"] == pytest.approx(0.05) and scores["ate_aligned_m"]["max"] < 1e-6
    assert "30 of 60 poses compared" in outcome.out and "RPE, deg, over 1 m of the path" in outcome.out
    assert cli("evaluate", run, "--poses", truth, "--out", tmp_path / "f.json").status == 0
    assert json.loads((tmp_path / "f.json").read_text())["ate_m"] == scores["ate_m"]


def test_the_command_says_why_poses_cannot_be_compared(cli, run, tmp_path) -> None:
    track, truth = read_poses(run / "poses.tum"), tmp_path / "true.tum"
    times_s = np.asarray(track.timestamps_s)
    write_tum(truth, times_s + 0.1, track.T)
    error = cli("evaluate", run, "--poses", truth).error
    assert "0 of 60 poses have a true one within 0.01 s" in error and "--max-diff-s" in error
    assert cli("evaluate", run, "--poses", truth, "--max-diff-s", "0.11").status == 0
    (tmp_path / "kitti.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 3)
    assert "3 poses for 60 frames" in cli("evaluate", run, "--poses", tmp_path / "kitti.txt").error
    assert "no file" in cli("evaluate", run, "--poses", tmp_path / "none.tum").error
    assert cli("evaluate", run, "--poses", truth, "--way-m", "0").status == 2
    euroc = tmp_path / "data.csv"
    rows = [
        [int(t * 1e9), *T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat()[[3, 0, 1, 2]], *[0.0] * 9]
        for t, T in zip(times_s, track.T, strict=True)
    ]
    euroc.write_text("\n".join(",".join(map(repr, map(float, row[1:]))).join([f"{row[0]},", ""]) for row in rows))
    outcome = cli("evaluate", run, "--poses", euroc)
    assert outcome.status == 0 and "poses of the body" in outcome.err

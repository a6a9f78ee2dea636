"""The geometric half on recorded data; scripts/experiments/accuracy.py prints the same figures in full."""

from __future__ import annotations

import json
from pathlib import Path

import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from fixtures import cli, shared_cache  # noqa: F401

from jaxmap.datasets import ReadOptions, open_sequence
from jaxmap.datasets.euroc import read_rig
from jaxmap.datasets.samples import motorcycle_disparity
from jaxmap.evaluation.geometry_scores import depth_consistency, point_range_error, score_disparity
from jaxmap.stereo.front_end import StereoFrontEnd
from jaxmap.stereo.match import StereoOptions
from jaxmap.stereo.rectify import make_rectifier

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("mode", ["3way", "sgbm", "hh", "hh4"])
def test_the_motorcycle_is_matched_as_well_as_promised(mode):
    sequence = open_sequence("sample:motorcycle")
    front_end = StereoFrontEnd(sequence.camera, StereoOptions(mode=mode))
    frame = front_end(*sequence.read_pair(sequence.frames[0]))
    truth = motorcycle_disparity()
    scores = score_disparity(frame.disparity_px, truth)
    # What is promised of the default; the others come as close as their own rounding.
    assert scores.median_error_px <= (0.2 if mode == StereoOptions().mode else 0.26)
    assert scores.bad_2 <= 0.065
    assert scores.valid >= 0.75
    pose = jaxlie.SE3.from_matrix(jnp.asarray(sequence.T_world_camera[0], jnp.float32))
    assert point_range_error(front_end.camera, pose, frame.disparity_px, truth) <= 0.01
    front_end.check_order(frame)


def kitti_folder(realdata: Path) -> Path:
    return realdata / "kitti_odometry" / "sequences" / "01"


@pytest.mark.realdata
def test_depths_of_kitti_agree_between_frames(realdata):
    sequence = open_sequence(kitti_folder(realdata))
    front_end = StereoFrontEnd(sequence.camera, StereoOptions())
    everything = []
    for a, b in ((0, 5), (20, 25), (40, 45)):
        disparities = [front_end(*sequence.read_pair(sequence.frames[index])).disparity_px for index in (a, b)]
        T_b_a = np.linalg.inv(sequence.T_world_camera[b]) @ sequence.T_world_camera[a]
        pose = jaxlie.SE3.from_matrix(jnp.asarray(T_b_a, jnp.float32))
        errors = depth_consistency(front_end.camera, *disparities, pose)
        assert len(errors) > 10_000
        assert np.median(np.abs(errors)) < 0.06
        everything.append(np.abs(errors))
    assert np.median(np.concatenate(everything)) < 0.05


def check_kitti_run(run: Path, frames: int) -> None:
    metrics = json.loads((run / "metrics.json").read_text())
    assert metrics["sequence"]["frames"] == metrics["sequence"]["fused"] == frames
    assert metrics["sequence"]["skipped"] == []
    # Half of a street is near an edge of depth or far away.
    assert metrics["points"]["valid_fraction"] > 0.4
    assert metrics["voxels"]["occupied"] > 1000
    for name in ("map.zarr", "map.ply", "bev.tif", "bev.png", "poses.tum", "report.html"):
        assert (run / name).exists()


@pytest.mark.realdata
def test_every_tenth_frame_of_kitti_maps(cli, realdata, tmp_path):
    words = ("--grid.voxel-size-m", "0.5", "--depth.max-m", "15", "--stride", "10", "--strict", "--labeller", "none")
    outcome = cli("map", kitti_folder(realdata), "--out", tmp_path / "run", *words)
    assert outcome.status == 0, outcome.err
    check_kitti_run(tmp_path / "run", 6)


@pytest.mark.realdata
@pytest.mark.slow
def test_all_frames_of_kitti_map(cli, realdata, tmp_path):
    words = ("--grid.voxel-size-m", "0.3", "--strict")
    outcome = cli("map", kitti_folder(realdata), "--out", tmp_path / "run", *words)
    assert outcome.status == 0, outcome.err
    check_kitti_run(tmp_path / "run", 51)
    voxels = json.loads((tmp_path / "run" / "metrics.json").read_text())["voxels"]
    assert voxels["by_class"]["sand"] > voxels["occupied"] / 10


@pytest.mark.realdata
def test_swapped_cameras_of_kitti_are_noticed(realdata):
    sequence = open_sequence(kitti_folder(realdata), ReadOptions(stride=25))
    front_end = StereoFrontEnd(sequence.camera, StereoOptions())
    for frame in sequence.frames:
        left, right = sequence.read_pair(frame)
        matcher = front_end.matcher
        assert not matcher.looks_swapped(left, right, matcher(left, right))
        assert matcher.looks_swapped(right, left, matcher(right, left))


@pytest.mark.realdata
def test_the_rig_of_euroc_is_rectified_as_in_its_papers(realdata):
    camera = make_rectifier(read_rig(realdata / "euroc_micro")).camera
    assert float(camera.fx_px) == pytest.approx(436.24, abs=0.05)
    assert float(camera.baseline_m) == pytest.approx(0.11008, abs=1e-4)
    assert float(camera.doffs_px) == pytest.approx(0.0, abs=1e-3)

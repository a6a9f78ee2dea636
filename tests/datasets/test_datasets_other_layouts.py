"""Readers of MADMAX, TartanAir and Middlebury, on the scene of tests/scenes.py written in their forms."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import scenes
from fixtures import cli, map_words  # noqa: F401
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from scipy.spatial.transform import Rotation

from jaxmap.datasets import ReadOptions, StereoSequence, open_sequence
from jaxmap.datasets.middlebury import read_pfm
from jaxmap.errors import JaxmapError
from jaxmap.types import StereoCamera

FRAMES = 3
START_NS = 1_540_000_000_123_456_789
STEP_NS = 250_000_000
TRUTH = np.stack([scenes.pose(index) for index in range(FRAMES)])
K = f"{scenes.F_PX} 0 {scenes.CX_PX}; 0 {scenes.F_PX} {scenes.CY_PX}; 0 0 1"


def refused(folder: Path, options: ReadOptions | None = None) -> str:
    with pytest.raises(JaxmapError) as caught:
        open_sequence(folder, options)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def words(numbers: np.ndarray) -> str:
    return ", ".join(repr(float(number)) for number in numbers)


def assert_scene(sequence: StereoSequence, dataset: str) -> None:
    """The camera, the poses and the images of the scene."""
    assert sequence.dataset == dataset
    camera = sequence.camera
    assert isinstance(camera, StereoCamera)
    found = (camera.fx_px, camera.cx_px, camera.cy_px, camera.baseline_m, camera.doffs_px)
    np.testing.assert_allclose(found, (scenes.F_PX, scenes.CX_PX, scenes.CY_PX, scenes.BASELINE_M, 0), rtol=1e-6)
    np.testing.assert_allclose(sequence.T_world_camera, TRUTH[: len(sequence.frames)], atol=1e-6)
    for index, frame in enumerate(sequence.frames):
        pair, true = sequence.read_pair(frame), scenes.scene_frame(index)
        np.testing.assert_array_equal(pair.left, true.left)
        np.testing.assert_array_equal(pair.right, true.right)


def write_madmax(root: Path, calibration: str = "../calibration", ground_truth: str = "ground_truth") -> Path:
    folder = root / "A-0"
    T_imu_body, T_imu_camera = np.eye(4), np.eye(4)
    T_imu_body[:3, 3] = [0.1, -0.2, 0.3]
    T_imu_camera[:3, :3] = Rotation.from_euler("xyz", [0.3, -0.1, 1.2]).as_matrix()
    T_imu_camera[:3, 3] = [0.2, 0.0, -0.1]
    for side, shift_ns in (("left", 0), ("right", 1000)):
        images = folder / f"img_rect_{side}"
        images.mkdir(parents=True)
        for index in range(FRAMES):
            picture = Image.fromarray(getattr(scenes.scene_frame(index), side))
            picture.save(images / f"img_rect_{side}_{START_NS + index * STEP_NS + shift_ns}.png")
    (folder / calibration).mkdir()
    for side, tx in (("left", 0.0), ("right", -scenes.F_PX * scenes.BASELINE_M)):
        P = [scenes.F_PX, 0, scenes.CX_PX, tx, 0, scenes.F_PX, scenes.CY_PX, 0, 0, 0, 1, 0]
        text = (
            f"height: {scenes.HEIGHT_PX}\nwidth: {scenes.WIDTH_PX}\nD: [0.0, 0, 0, 0, 0]\nP: [{words(np.array(P))}]\n"
        )
        (folder / calibration / f"camera_rect_{side}_info.txt").write_text(text)
    for name, T in (("B", T_imu_body), ("camera_left", T_imu_camera)):
        line = words(np.r_[T[:3, 3], Rotation.from_matrix(T[:3, :3]).as_quat()])
        header = "#position.x, position.y, position.z, orientation.x, orientation.y, orientation.z, orientation.w"
        (folder / calibration / f"tf__imu_to_{name}.csv").write_text(f"{header}\n{line}\n")
    (folder / ground_truth).mkdir()
    rows = ["% MADMAX ground truth"] * 13 + ["% UNIX time, x-enu(m), y-enu(m), z-enu(m), std-e(m), std-n(m), std-u(m)"]
    for index in range(FRAMES):
        T = TRUTH[index] @ np.linalg.inv(T_imu_camera) @ T_imu_body
        x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
        time_s = (START_NS + index * STEP_NS) / 1e9
        rows.append(words(np.r_[time_s, T[:3, 3], 0.01, 0.01, 0.02, w, x, y, z, 0, 0, 0]))
    (folder / ground_truth / "gt_6DoF_gnss_and_imu.csv").write_text("\n".join(rows) + "\n")
    return folder


@pytest.mark.parametrize(
    ("calibration", "ground_truth"), [("../calibration", "ground_truth"), ("calibration", "../A-0_ground_truth")]
)
def test_a_madmax_run_is_read(tmp_path, calibration, ground_truth):
    sequence = open_sequence(write_madmax(tmp_path, calibration, ground_truth))
    assert_scene(sequence, "madmax")
    assert sequence.frames[0].timestamp_s == START_NS / 1e9 and not sequence.notes


def test_damage_to_a_madmax_run_is_named(tmp_path):
    folder = write_madmax(tmp_path)
    truth = folder / "ground_truth" / "gt_6DoF_gnss_and_imu.csv"
    text = truth.read_text()
    truth.write_text(text + "1540000002.0, nan, 0, 0, 0, 0, 0, 1, 0, 0, 0\n")
    assert "1 poses repeat a time or are not whole, and are left out" in open_sequence(folder).notes
    truth.write_text(text + "1540000002.0, 1, 0\n")
    assert "3 columns, not 11" in refused(folder)
    truth.unlink()
    assert "the sequence has no poses" in refused(folder)
    (folder.parent / "calibration" / "camera_rect_left_info.txt").write_text("width: 160\nheight: 120\n")
    assert "keys are missing: P" in refused(folder)
    (folder / "img_rect_left" / "img_rect_left_first.png").write_bytes(b"")
    assert "does not name a time" in refused(folder)


@pytest.mark.parametrize(
    ("left", "right", "size"), [("left", "right", (640, 480)), ("lcam_front", "rcam_front", (640, 640))]
)
def test_a_tartanair_trajectory_is_read(tmp_path, left, right, size):
    folder = tmp_path / "P001"
    for side in (left, right):
        (folder / f"image_{side}").mkdir(parents=True)
        for number in (0, 2):
            Image.new("RGB", size).save(folder / f"image_{side}" / f"{number:06d}_{side}.png")
    rows = []
    for T in TRUTH:
        # North is y and down is -z of the scene's world; the camera's x axis looks ahead, its z axis down.
        T_ned_frd = (
            np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]]) @ T[:3, :3] @ np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0]])
        )
        position = T[[1, 0, 2], 3] * [1, 1, -1]
        rows.append(words(np.r_[position, Rotation.from_matrix(T_ned_frd).as_quat()]).replace(",", ""))
    (folder / f"pose_{left}.txt").write_text("\n".join(rows) + "\n")
    sequence = open_sequence(folder)
    assert sequence.dataset == "tartanair" and [frame.timestamp_s for frame in sequence.frames] == [0, 2]
    camera = sequence.camera
    assert isinstance(camera, StereoCamera)
    found = (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px, camera.baseline_m)
    np.testing.assert_allclose(found, (320, 320, 320, size[1] / 2, 0.25))
    np.testing.assert_allclose(sequence.T_world_camera, TRUTH[[0, 2]], atol=1e-12)
    source = sequence.T_world_source @ [1, 2, 3, 1]
    np.testing.assert_array_equal(source, [2, 1, -3, 1])
    assert sequence.read_pair(sequence.frames[1]).right.shape == (size[1], 640, 3)
    (folder / f"pose_{left}.txt").write_text("\n".join(rows[:2]) + "\n")
    assert f"2 poses, but an image 000002_{left}" in refused(folder)
    for side in (left, right):
        Image.new("L", (64, 48)).save(folder / f"image_{side}" / f"000000_{side}.png")
    assert "images of 64x48 px are not TartanAir's" in refused(folder)


def pfm(values: np.ndarray, order: str) -> bytes:
    scale = {"<": "-1.0", ">": "1.0"}[order]
    return f"Pf\n{values.shape[1]} {values.shape[0]}\n{scale}\n".encode() + values[::-1].astype(f"{order}f4").tobytes()


def write_middlebury(folder: Path, truth: bool = True) -> Path:
    folder.mkdir()
    frame = scenes.scene_frame(0)
    for name, picture in (("im0", frame.left), ("im1", frame.right)):
        Image.fromarray(picture).save(folder / f"{name}.png")
    lines = [f"cam0=[{K}]", f"cam1=[{K}]", "doffs=0", f"baseline={1000 * scenes.BASELINE_M}"]
    lines += [f"width={scenes.WIDTH_PX}", f"height={scenes.HEIGHT_PX}", "ndisp=32", "vmin=1"]
    (folder / "calib.txt").write_text("\n".join(lines) + "\n")
    if truth:
        true_px = np.where(np.isfinite(frame.depth_m), frame.disparity_px, np.inf)
        (folder / "disp0.pfm").write_bytes(pfm(true_px, "<"))
    return folder


def test_a_middlebury_scene_is_read(tmp_path):
    sequence = open_sequence(write_middlebury(tmp_path / "scene"))
    assert len(sequence.frames) == 1 and sequence.true_disparity is not None
    # The camera stands at the origin of a camera-like world, which is turned z-up.
    np.testing.assert_array_equal(sequence.T_world_camera[0], sequence.T_world_source)
    assert any("disparities reach 32 px" in note for note in sequence.notes)
    truth_px = sequence.true_disparity(sequence.frames[0])
    assert truth_px is not None
    expected_px = scenes.scene_frame(0).disparity_px
    seen = np.isfinite(scenes.scene_frame(0).depth_m)
    np.testing.assert_allclose(truth_px[seen], expected_px[seen], rtol=1e-6)
    assert np.isnan(truth_px[~seen]).all()
    assert open_sequence(write_middlebury(tmp_path / "untrue", truth=False)).true_disparity is None


@given(st.integers(1, 9), st.integers(1, 9), st.sampled_from("<>"), st.integers(0, 2**32 - 1))
def test_float_maps_come_back(tmp_path_factory, height, width, order, seed):
    values = np.random.default_rng(seed).normal(size=(height, width)).astype(np.float32)
    path = tmp_path_factory.mktemp("pfm") / "a.pfm"
    path.write_bytes(pfm(values, order))
    np.testing.assert_array_equal(read_pfm(path), values)
    path.write_bytes(pfm(values, order)[:-1])
    with pytest.raises(JaxmapError, match=f"it does not hold {width}x{height} numbers"):
        read_pfm(path)


def test_damage_to_a_middlebury_scene_is_named(tmp_path):
    folder = write_middlebury(tmp_path / "scene")
    calibration = folder / "calib.txt"
    text = calibration.read_text()
    for old, new, told in (
        ("baseline=120.0", "", "baseline missing"),
        ("cam1=[140.0", "cam1=[four", "cam1 is no number"),
        ("width=160", "width=1.5", "width and height are 1.5 and 120"),
        ("width=160", "width=161", "the calibration is for 161x120 px"),
    ):
        assert old in text
        calibration.write_text(text.replace(old, new))
        assert told in refused(folder)


@pytest.mark.slow
def test_the_disparity_of_a_scene_is_scored_against_its_truth(tmp_path, cli):
    outcome = cli(*map_words(write_middlebury(tmp_path / "scene"), tmp_path / "run"))
    assert outcome.status == 0, outcome.err
    assert "against the true disparity: median error" in outcome.err
    scores = json.loads((tmp_path / "run" / "metrics.json").read_text())["disparity"]
    assert scores["median_error_px"] < 0.3 and scores["bad_2"] < 0.1 and scores["valid"] > 0.5

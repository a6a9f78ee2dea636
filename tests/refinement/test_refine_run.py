"""`jaxmap refine` on the small scene: poses that were made wrong come back, and bad input is told in one line."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import rasterio
import yaml
from fixtures import cli, map_words, scene_folder, shared_cache  # noqa: F401
from html_tables import tables_of
from killed import SLOW_DISK, fill_disk, kill_when
from rasterio.transform import from_origin
from refinement.synthetic import disturbed, pose_errors
from scenes import BOXES_M, CAMERA, pose, timestamp_s
from scipy.spatial.transform import Rotation
from tune_faults import labels_from_above, write_truth

import jaxmap.runs.refinement
from jaxmap.datasets import ReadOptions, open_sequence
from jaxmap.datasets.calibration import read_camera_yaml, read_mounting, write_camera_yaml
from jaxmap.datasets.pose_files import read_poses, write_tum
from jaxmap.host.output_folder import locked
from jaxmap.stereo.rectify import make_rectifier, make_stereo_rig

FRAMES = 4
T_TRUE = np.stack([pose(index) for index in range(FRAMES)])
TIMES_S = np.array([timestamp_s(index) for index in range(FRAMES)])
WORDS = ("--stop", FRAMES, "--max-depth-m", 5)


def write_dem(path: Path, offset_m: float = 0.0, origin: tuple[float, float] = (-6.0, 10.0)) -> Path:
    """Heights of the scene from above, at 0.05 m."""
    cell_m = 0.05
    height = np.full((320, 240), offset_m, np.float32)
    x = origin[0] + (np.arange(240) + 0.5) * cell_m
    y = origin[1] - (np.arange(320) + 0.5) * cell_m
    for lower, upper in BOXES_M:
        inside = ((x > lower[0]) & (x < upper[0]))[None] & ((y > lower[1]) & (y < upper[1]))[:, None]
        height[inside] = upper[2] + offset_m
    form = dict(driver="GTiff", width=240, height=320, count=1, dtype="float32")
    with rasterio.open(path, "w", transform=from_origin(*origin, cell_m, cell_m), **form) as raster:
        raster.write(height, 1)
    return path


@pytest.fixture(scope="module")
def wrong(tmp_path_factory) -> Path:
    """Poses off by 0.06 m and 0.5 degrees."""
    path = tmp_path_factory.mktemp("poses") / "wrong.tum"
    write_tum(path, TIMES_S, disturbed(T_TRUE, np.random.default_rng(0), 0.06, 0.5))
    return path


@pytest.fixture(scope="module")
def refined(wrong, scene_folder, tmp_path_factory) -> Path:
    """The scene with wrong poses, refined upon its elevation model."""
    from jaxmap.commands.main import main

    out = tmp_path_factory.mktemp("refined") / "out"
    dem = write_dem(out.parent / "dem.tif")
    words = ["refine", scene_folder, "--out", out, "--poses", wrong, "--dem", dem, *WORDS]
    assert main([str(word) for word in words]) == 0
    return out


def test_wrong_poses_come_back(refined, wrong):
    before, after = (pose_errors(read_poses(path).T, T_TRUE) for path in (wrong, refined / "poses.tum"))
    assert before.position_m.max() == pytest.approx(0.06)
    assert after.position_m.max() < 0.025
    assert after.angle_deg.max() < 0.25


def test_the_results_tell_what_was_found(refined):
    content = json.loads((refined / "refine.json").read_text())
    assert content["frames"] == ["f000", "f001", "f002", "f003"]
    assert content["skipped"] == []
    assert content["matches"]["pairs"] == 6
    assert content["match_residual_px"]["after"] < 0.3 * content["match_residual_px"]["before"]
    assert content["map_height_spread_m"]["after"] < 0.7 * content["map_height_spread_m"]["before"]
    assert content["poses"]["prior_estimated"] == {"position": True, "angle": True}
    whole = {row["name"]: row for row in content["whole_map"]}
    assert whole["up_m"]["observable"]
    assert content["parameters"] == []
    page = (refined / "report.html").read_text()
    assert "<html" in page
    assert "heading deg" in page
    assert 'class="chart"' in page and "svg.chart {" in page, "without its style, the curve is a black square"
    assert not (refined / "calibration.yaml").exists()
    whole_map, frames = tables_of(page)
    assert whole_map.headings == ["", "found", "± 1 σ", "prior ± 1 σ", "observable"]
    found = whole_map.row("up m")
    assert found[-1] == "yes" and float(found[1]) == pytest.approx(whole["up_m"]["sigma"], rel=0.02)
    assert float(found[2]) == pytest.approx(whole["up_m"]["prior_sigma"], rel=0.02)
    assert frames.headings == ["Frame", "moved, m", "± m", "turned, deg", "± deg", "matched"]
    moved, _, turned, _, matched = frames.row("f002")
    assert float(moved) == pytest.approx(content["poses"]["moved_m"][2], rel=0.02)
    assert float(turned) == pytest.approx(content["poses"]["turned_deg"][2], rel=0.02)
    assert matched == "yes"


def test_a_map_is_made_of_the_refined_poses(cli, refined, scene_folder, tmp_path):
    words = ["--poses", refined / "poses.tum", "--labeller", "none", "--stop", "1"]
    assert cli(*map_words(scene_folder, tmp_path / "run", *words)).status == 0


def test_mounting_and_offset_go_into_a_calibration(cli, scene_folder, tmp_path):
    D = np.eye(4)
    D[:3, :3] = Rotation.from_rotvec([np.radians(2), 0, 0]).as_matrix()
    write_tum(tmp_path / "wrong.tum", TIMES_S, T_TRUE @ D)
    words = ("--adjust", "poses", "mounting", "offset", "--sigma-position-m", 0.002, "--sigma-angle-deg", 0.02)
    out = tmp_path / "out"
    outcome = cli("refine", scene_folder, "--out", out, "--poses", tmp_path / "wrong.tum", *words, *WORDS)
    assert outcome.status == 0, outcome.err
    assert pose_errors(read_poses(out / "poses.tum").T, T_TRUE).angle_deg.max() < 0.35
    mounting = read_mounting(out / "calibration.yaml")
    np.testing.assert_allclose(Rotation.from_matrix(mounting[:3, :3]).as_rotvec(degrees=True), [-2, 0, 0], atol=0.35)
    assert abs(float(read_camera_yaml(out / "calibration.yaml").doffs_px)) < 0.3
    names = [row["name"] for row in json.loads((out / "refine.json").read_text())["parameters"]]
    assert names[-1] == "disparity_offset_px"
    assert "mounting_pitch_deg" in names


def test_a_mounting_moves_the_poses_of_a_sequence_but_not_those_given_of_the_camera(scene_folder, tmp_path):
    D = np.eye(4)
    D[:3, :3], D[:3, 3] = Rotation.from_rotvec([0.02, -0.01, 0.03]).as_matrix(), [0.1, 0.2, -0.3]
    path = tmp_path / "mounted.yaml"
    write_camera_yaml(path, read_camera_yaml(scene_folder / "camera.yaml"), D)
    own = open_sequence(scene_folder, ReadOptions(calibration=path)).T_world_camera
    np.testing.assert_allclose(own, open_sequence(scene_folder).T_world_camera @ D, atol=1e-12)
    given = open_sequence(scene_folder, ReadOptions(calibration=path, poses=scene_folder / "poses.tum"))
    np.testing.assert_allclose(given.T_world_camera, open_sequence(scene_folder).T_world_camera, atol=1e-12)


def test_calibrations_are_written_as_they_are_read(tmp_path):
    rig = make_stereo_rig(
        K_left=[[400, 0, 320], [0, 401, 240], [0, 0, 1]],
        distortion_left=[-0.3, 0.1, 0.001, 0],
        K_right=[[402, 0, 321], [0, 403, 241], [0, 0, 1]],
        distortion_right=[-0.29, 0.1, 0, 0],
        R_right_left=Rotation.from_rotvec([0.001, 0.002, 0.003]).as_matrix(),
        t_right_left_m=[-0.12, 0.001, 0],
        size_px=(640, 480),
        doffs_px=0.25,
    )
    write_camera_yaml(tmp_path / "rig.yaml", rig)
    again = read_camera_yaml(tmp_path / "rig.yaml")
    for name in ("K_left", "K_right", "distortion_left", "R_right_left", "t_right_left_m", "doffs_px", "width_px"):
        np.testing.assert_allclose(getattr(again, name), getattr(rig, name), atol=1e-15)
    assert np.array_equal(read_mounting(tmp_path / "rig.yaml"), np.eye(4))
    assert float(make_rectifier(again).camera.doffs_px) == pytest.approx(0.25)


@pytest.mark.parametrize(
    "mounting", [3, {"translation_m": [0, 0, 0]}, {"translation_m": [0, 0], "rotation_vector_rad": [0, 0, 0]}]
)
def test_a_mounting_of_another_form_is_refused(cli, scene_copy_with, mounting):
    outcome = cli("map", *scene_copy_with({"mounting": mounting}))
    assert outcome.status == 1
    assert "mounting" in outcome.error


@pytest.fixture
def scene_copy_with(scene_folder, tmp_path):
    def words(changes):
        path = tmp_path / "camera.yaml"
        path.write_text(yaml.safe_dump({**CAMERA, **changes}))
        return map_words(scene_folder, tmp_path / "run", "--calibration", path)[1:]

    return words


def fault(cli, scene, out, *words):
    outcome = cli("refine", scene, "--out", out, *words)
    return outcome.status, outcome.error


def test_bad_input_is_told_in_one_line(cli, scene_folder, tmp_path):
    out = tmp_path / "out"
    status, error = fault(cli, scene_folder, out, "--stop", 1)
    assert (status, "1 of 1 frames can be used" in error) == (1, True)
    dem = write_dem(tmp_path / "far.tif", origin=(5000.0, 5000.0))
    status, error = fault(cli, scene_folder, out, "--dem", dem, "--stop", 2)
    assert (status, "does not lie over the map" in error) == (1, True)
    dem = write_dem(tmp_path / "high.tif", offset_m=40.0)
    status, error = fault(cli, scene_folder, out, "--dem", dem, "--stop", 2)
    assert (status, "height system" in error) == (1, True)
    dem.write_bytes(dem.read_bytes()[:300])
    status, error = fault(cli, scene_folder, out, "--dem", dem, "--stop", 2)
    assert (status, str(dem) in error) == (1, True)
    status, error = fault(cli, scene_folder, out, "--sigma-position-m", -1)
    assert (status, "--sigma-position-m" in error) == (2, True)
    status, error = fault(cli, scene_folder, scene_folder)
    assert (status, "the sequence's own" in error) == (2, True)
    assert fault(cli, scene_folder, scene_folder, "--poses", scene_folder / "poses.tum")[0] == 2


def test_what_an_orthomosaic_means_can_be_said(cli, scene_folder, tmp_path):
    codes = np.array([0, 40, 200], np.uint8)[labels_from_above()]
    truth = write_truth(tmp_path / "truth.tif", codes)
    words = ("--ground-truth", truth, "--stop", 2, "--max-depth-m", 5)
    status, error = fault(cli, scene_folder, tmp_path / "out", *words)
    assert (status, "mean nothing" in error, "--remap" in error) == (1, True, True)
    (tmp_path / "palette.yaml").write_text("0: unlabelled\n40: sand\n200: rock\n")
    for more in (("--remap", "0=unlabelled", "40=sand", "200=rock"), ("--palette", tmp_path / "palette.yaml")):
        assert cli("refine", scene_folder, "--out", tmp_path / more[0], *words, *more).status == 0


def test_files_of_others_are_not_replaced(cli, scene_folder, tmp_path):
    page = tmp_path / "report.html"
    page.write_text("of a map")
    status, error = fault(cli, scene_folder, tmp_path, "--stop", 2)
    assert (status, "no refinement has written" in error) == (1, True)
    assert page.read_text() == "of a map"
    assert [path.name for path in tmp_path.iterdir()] == ["report.html"]


def test_results_that_are_no_refinement_s_are_those_of_others(cli, scene_folder, tmp_path):
    for text in ("{}", "[1]", "mine", "[" * 100_000):
        (tmp_path / "refine.json").write_text(text)
        status, error = fault(cli, scene_folder, tmp_path, "--stop", 2, "--overwrite")
        assert (status, "no refinement has written" in error) == (1, True)
        assert (tmp_path / "refine.json").read_text() == text


def test_an_earlier_refinement_is_replaced_only_on_demand(cli, refined, scene_folder, tmp_path):
    out = Path(shutil.copytree(refined, tmp_path / "out"))
    # What an earlier refinement may have left, and what is the user's.
    for name in ("calibration.yaml", "holiday.png"):
        (out / name).write_text("{}")
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    words = ("--stop", 2, "--max-depth-m", 5)
    status, error = fault(cli, scene_folder, out, *words)
    assert (status, "holds a refinement already" in error, "--overwrite" in error) == (1, True, True)
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before
    assert cli("refine", scene_folder, "--out", out, *words, "--overwrite").status == 0
    assert json.loads((out / "refine.json").read_text())["frames"] == ["f000", "f001"]
    assert len(read_poses(out / "poses.tum").T) == 2
    assert {path.name for path in out.iterdir()} == before.keys() - {"calibration.yaml"}


def test_a_refinement_that_fails_leaves_the_earlier_one(cli, refined, scene_folder, tmp_path):
    out = Path(shutil.copytree(refined, tmp_path / "out"))
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    assert fault(cli, scene_folder, out, "--stop", 1, "--overwrite")[0] == 1
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before


def test_two_runs_do_not_share_a_folder(cli, scene_folder, tmp_path):
    out = tmp_path / "out"
    with locked(out):
        status, error = fault(cli, scene_folder, out, "--stop", 2)
    assert (status, "another run is writing here" in error) == (1, True)
    assert not out.exists(), "what was made for nothing is gone"


def test_what_cannot_be_written_is_told_before_the_work(cli, scene_folder, tmp_path, monkeypatch):
    monkeypatch.setattr(jaxmap.runs.refinement, "read_inputs", lambda *_: pytest.fail("it reads first"))
    (tmp_path / "file").write_text("")
    status, error = fault(cli, scene_folder, tmp_path / "file", "--stop", 2)
    assert (status, "cannot be made: it is a file" in error) == (1, True)


@pytest.mark.parametrize(
    ("option", "name"),
    [
        ("--poses", "poses.tum"),
        ("--calibration", "calibration.yaml"),
        ("--palette", "calibration.yaml"),
        ("--dem", "trajectory.png"),
        ("--ground-truth", "consistency.png"),
    ],
)
def test_an_input_is_not_overwritten(option, name, cli, scene_folder, tmp_path):
    (tmp_path / name).write_text("mine")
    status, error = fault(cli, scene_folder, tmp_path, option, tmp_path / name, "--overwrite")
    assert (status, "an input would be overwritten" in error) == (2, True)
    assert [path.name for path in tmp_path.iterdir()] == [name] and (tmp_path / name).read_text() == "mine"


@pytest.mark.parametrize("name", ["refine.json", "poses.tum", "trajectory.png"])
def test_a_full_disk_is_one_line_and_leaves_nothing_half_written(name, cli, scene_folder, tmp_path, monkeypatch):
    out, words = tmp_path / "out", ("--stop", 2, "--max-depth-m", 5)
    with monkeypatch.context() as patch:
        fill_disk(patch, name)
        status, error = fault(cli, scene_folder, out, *words)
    assert (status, "disk full" in error) == (1, True)
    order = ["refine.json", "poses.tum", "consistency.png", "trajectory.png", "report.html"]
    left = sorted(path.name for path in out.iterdir()) if out.exists() else []
    assert left == sorted(order[: order.index(name)])
    if "poses.tum" in left:
        assert len(read_poses(out / "poses.tum").T) == 2
    assert cli("refine", scene_folder, "--out", out, *words, "--overwrite").status == 0
    assert {path.name for path in out.iterdir()} == set(order), "no leftovers"


def test_a_killed_process_leaves_nothing_half_written_and_is_begun_anew(cli, refined, scene_folder, tmp_path):
    out = Path(shutil.copytree(refined, tmp_path / "out"))
    words = ("refine", scene_folder, "--out", out, "--stop", 2, "--max-depth-m", 5)
    kill_when(lambda: list(out.glob(".poses.tmp-*")), SLOW_DISK, (*words, "--overwrite"))
    assert json.loads((out / "refine.json").read_text())["frames"] == ["f000", "f001"]
    left = {path.name for path in out.iterdir() if not path.name.startswith(".")}
    assert left == {"refine.json"}, "nothing of the earlier refinement lies beside the results of this one"
    assert cli(*words).status == 1, "it is not replaced unasked"
    assert cli(*words, "--overwrite").status == 0
    names = {"refine.json", "poses.tum", "consistency.png", "trajectory.png", "report.html"}
    assert {path.name for path in out.iterdir()} == names, "no leftovers"


def test_frames_that_share_nothing_are_told(cli, scene_folder, tmp_path):
    scene = Path(shutil.copytree(scene_folder, tmp_path / "scene"))
    T = T_TRUE[:2].copy()
    # The second camera is held to look the other way.
    T[1, :3, :3] = Rotation.from_euler("z", 180, degrees=True).as_matrix() @ T[1, :3, :3]
    write_tum(tmp_path / "apart.tum", TIMES_S[:2], T)
    status, error = fault(cli, scene, tmp_path / "out", "--poses", tmp_path / "apart.tum", "--stop", 2)
    assert (status, "show the same ground" in error) == (1, True)


def test_a_damaged_frame_is_left_out(cli, scene_folder, tmp_path):
    scene = Path(shutil.copytree(scene_folder, tmp_path / "scene"))
    image = scene / "left" / "f001.png"
    image.write_bytes(image.read_bytes()[:3000])
    assert cli("refine", scene, "--out", tmp_path / "out", *WORDS).status == 0
    content = json.loads((tmp_path / "out" / "refine.json").read_text())
    assert [one["frame"] for one in content["skipped"]] == ["f001"]
    assert len(read_poses(tmp_path / "out" / "poses.tum").T) == FRAMES - 1

"""`jaxmap refine` on the small scene: disturbed poses are recovered, files are safe, bad input is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
import yaml
from compiling import compiled_in_full
from fixtures import cli, scene_copy, scene_folder, shared_cache  # noqa: F401
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
from jaxmap.datasets.label_raster import choose_coding
from jaxmap.datasets.poses import read_poses, write_tum
from jaxmap.errors import JaxmapError, UsageError
from jaxmap.host.output_folder import locked
from jaxmap.refinement.consistency import Consistency
from jaxmap.refinement.refine import GroundReference, Refinement, refine
from jaxmap.refinement.rig import PER_FRAME, SHARED, make_rig
from jaxmap.refinement.solver import Prior, Solution
from jaxmap.runs.evaluation import TruthOptions
from jaxmap.runs.refinement import (
    GroundFiles,
    RefineInputs,
    check_inputs_apart,
    check_replaceable,
    read_ground,
    read_inputs,
    run_refine,
)
from jaxmap.stereo.rectify import make_rectifier, make_stereo_rig
from jaxmap.types import make_grid, pinhole

in_full = pytest.fixture(scope="module", autouse=True)(compiled_in_full)

FRAMES = 4
T_TRUE = np.stack([pose(index) for index in range(FRAMES)])
TIMES_S = np.array([timestamp_s(index) for index in range(FRAMES)])
WORDS = ("--stop", FRAMES, "--max-depth-m", 5)
ORDER = ["refine.json", "poses.tum", "consistency.png", "trajectory.png", "report.html"]
"""The files of a refinement, as they are written."""


def write_dem(path: Path, offset_m: float = 0.0, origin: tuple[float, float] = (-6.0, 10.0)) -> Path:
    """An elevation model of the scene, in cells of 0.05 m."""
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


@pytest.fixture(scope="module")
def inputs(scene_folder) -> RefineInputs:
    """Two frames, read and matched."""
    return read_inputs(str(scene_folder), ReadOptions(stop=2))


D = np.eye(4)
D[:3, :3], D[:3, 3] = Rotation.from_rotvec([0.02, -0.01, 0.03]).as_matrix(), [0.1, 0.2, -0.3]


@pytest.fixture(scope="module")
def state(inputs) -> Refinement:
    """What a refinement of two frames may come to: a displaced mounting, a longer baseline, a disparity offset."""
    given = make_rig(inputs.T_world_camera)
    numbers = PER_FRAME * len(inputs.frames) + SHARED
    rig = replace(given, T_nominal_camera=D, log_baseline_scale=float(np.log(1.01)), offset_px=0.25)
    solution = Solution(rig, 0.01 * np.eye(numbers), np.ones(numbers), [2.0, 0.5], [1.0])
    columns = Consistency(0.03, 5.0, np.full((4, 4), 0.03), make_grid([0, 0, 0], [0.4, 0.4, 0.1], 0.1))
    return Refinement(given, solution, columns, columns, [2.0, 0.5], [(0, "neighbours")], pairs=1, matches=20)


@pytest.fixture
def run(inputs, state, scene_folder, monkeypatch):
    """`run_refine` with that state: what is tested is its dealings with files."""

    def refined(*_: object, on_round, **__: object) -> Refinement:
        on_round(state)
        return state

    monkeypatch.setattr(jaxmap.runs.refinement, "read_inputs", lambda *_, **__: inputs)
    monkeypatch.setattr(jaxmap.runs.refinement, "refine", refined)

    def run(out: Path, prior: Prior | None = None, **more: object) -> dict:
        return run_refine(str(scene_folder), out, ReadOptions(), prior or Prior(), GroundFiles(), **more)

    return run


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


@pytest.mark.slow
def test_wrong_poses_come_back(refined, wrong, scene_folder):
    before, after = (pose_errors(read_poses(path).T, T_TRUE) for path in (wrong, refined / "poses.tum"))
    assert before.position_m.max() == pytest.approx(0.06)
    assert after.position_m.max() < 0.025
    assert after.angle_deg.max() < 0.25
    again = open_sequence(scene_folder, ReadOptions(poses=refined / "poses.tum", stop=FRAMES))
    np.testing.assert_allclose(again.T_world_camera, read_poses(refined / "poses.tum").T, atol=1e-9)


def test_the_results_state_what_was_found(refined):
    content = json.loads((refined / "refine.json").read_text())
    assert content["frames"] == ["f000", "f001", "f002", "f003"]
    assert content["skipped"] == []
    assert content["matches"]["pairs"] == 6
    assert content["match_residual_px"]["after"] < 0.3 * content["match_residual_px"]["before"]
    assert content["map_height_spread_m"]["after"] < 0.75 * content["map_height_spread_m"]["before"]
    assert content["poses"]["prior_estimated"] == {"position": True, "angle": True}
    whole = {row["name"]: row for row in content["whole_map"]}
    assert whole["up_m"]["observable"]
    assert content["parameters"] == []
    page = (refined / "report.html").read_text()
    assert "<html" in page
    assert "heading deg" in page
    assert page.count("<svg") == 1 and "match residual, px" in page, "the curve"
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


@pytest.mark.slow
def test_what_was_adjusted_of_the_calibration_is_written(run, inputs, tmp_path):
    run(tmp_path / "out", Prior(mounting_m=0.1, mounting_rad=0.1, baseline_scale=0.01, offset_px=0.5))
    path = tmp_path / "out" / "calibration.yaml"
    before, after = inputs.sequence.camera, read_camera_yaml(path)
    np.testing.assert_allclose(read_mounting(path), D, atol=1e-9)
    assert float(after.baseline_m) == pytest.approx(1.01 * float(before.baseline_m), rel=1e-6)
    assert float(after.doffs_px) == pytest.approx(float(before.doffs_px) + 0.25)
    np.testing.assert_allclose(read_poses(tmp_path / "out" / "poses.tum").T, inputs.T_world_camera @ D, atol=1e-6)
    run(tmp_path / "fixed", Prior(mounting_m=0.1))
    assert (tmp_path / "fixed" / "calibration.yaml").exists()
    run(tmp_path / "poses")
    assert not (tmp_path / "poses" / "calibration.yaml").exists()


@pytest.mark.slow
def test_mounting_and_offset_go_into_a_calibration(cli, scene_folder, tmp_path):
    pitched = np.eye(4)
    pitched[:3, :3] = Rotation.from_rotvec([np.radians(2), 0, 0]).as_matrix()
    write_tum(tmp_path / "wrong.tum", TIMES_S, T_TRUE @ pitched)
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
def test_a_mounting_of_another_form_is_refused(scene_folder, tmp_path, mounting):
    path = tmp_path / "camera.yaml"
    path.write_text(yaml.safe_dump({**CAMERA, "mounting": mounting}))
    with pytest.raises(JaxmapError, match="mounting"):
        open_sequence(scene_folder, ReadOptions(calibration=path))


def test_an_elevation_model_of_another_place_or_height_system_is_refused(inputs, tmp_path):
    def refused(dem: Path) -> str:
        with pytest.raises(JaxmapError) as caught:
            read_ground(GroundFiles(heights=dem), inputs, 5.0)
        return str(caught.value)

    assert "does not lie over the map" in refused(write_dem(tmp_path / "far.tif", origin=(5000.0, 5000.0)))
    dem = write_dem(tmp_path / "high.tif", offset_m=40.0)
    assert "height system" in refused(dem)
    dem.write_bytes(dem.read_bytes()[:300])
    assert str(dem) in refused(dem)


def test_the_coding_of_an_orthomosaic_can_be_given(inputs, tmp_path):
    codes = np.array([0, 40, 200], np.uint8)[labels_from_above()]
    truth = write_truth(tmp_path / "truth.tif", codes)
    with pytest.raises(JaxmapError, match=r"without a class.*--remap"):
        read_ground(GroundFiles((truth,)), inputs, 5.0)
    (tmp_path / "palette.yaml").write_text("0: unlabelled\n40: sand\n200: rock\n")
    for coding in (
        choose_coding(("0=unlabelled", "40=sand", "200=rock"), None),
        choose_coding((), tmp_path / "palette.yaml"),
    ):
        ground, _ = read_ground(GroundFiles((truth,), TruthOptions(coding=coding)), inputs, 5.0)
        assert set(np.unique(ground.is_rock.values[np.isfinite(ground.is_rock.values)])) == {0.0, 1.0}


def test_every_option_out_of_bounds_is_named(cli, tmp_path):
    words = ("--sigma-position-m", -1, "--max-depth-m", "inf")
    outcome = cli("refine", "scene", "--out", tmp_path / "out", *words)
    assert outcome.status == 2
    assert all(f"{option} is" in outcome.error for option in words[::2])
    outcome = cli("refine", "scene", "--out", tmp_path / "out", "--max-pose-gap-s", "nan")
    assert outcome.status == 2 and "max_pose_gap_s is nan" in outcome.error


def test_files_of_others_are_not_replaced(tmp_path):
    """Neither a page without results, nor results that are not a refinement's."""
    for name, text in [("report.html", "of a map"), *(("refine.json", text) for text in ("{}", "[1]", "[" * 100_000))]:
        (tmp_path / name).write_text(text)
        for overwrite in (False, True):
            with pytest.raises(JaxmapError, match="no refinement has written"):
                check_replaceable(tmp_path, overwrite=overwrite)
        assert contents(tmp_path) == {name: text.encode()}
        (tmp_path / name).unlink()


@pytest.mark.slow
def test_an_earlier_refinement_is_replaced_only_on_demand(run, tmp_path):
    out = tmp_path / "out"
    assert run(out)["frames"] == ["f000", "f001"]
    assert len(read_poses(out / "poses.tum").T) == 2
    # What an earlier refinement may have left, and what is the user's.
    for name in ("calibration.yaml", "holiday.png"):
        (out / name).write_text("{}")
    before = contents(out)
    with pytest.raises(JaxmapError, match=r"holds a refinement already.*--overwrite"):
        run(out)
    assert contents(out) == before
    run(out, overwrite=True)
    assert contents(out).keys() == before.keys() - {"calibration.yaml"}


@pytest.mark.slow
def test_a_refinement_that_fails_leaves_the_earlier_one(run, tmp_path, monkeypatch):
    def fail(*_: object, **__: object) -> None:
        raise JaxmapError("no two frames")

    out = tmp_path / "out"
    run(out)
    before = contents(out)
    monkeypatch.setattr(jaxmap.runs.refinement, "refine", fail)
    with pytest.raises(JaxmapError, match="no two frames"):
        run(out, overwrite=True)
    assert contents(out) == before


def test_what_cannot_be_written_is_refused_before_the_work(scene_folder, tmp_path, monkeypatch):
    monkeypatch.setattr(jaxmap.runs.refinement, "read_inputs", lambda *_, **__: pytest.fail("it reads first"))

    def refused(out: Path) -> str:
        with pytest.raises(JaxmapError) as caught:
            run_refine(str(scene_folder), out, ReadOptions(), Prior(), GroundFiles())
        return str(caught.value)

    (tmp_path / "file").write_text("")
    assert "cannot be made: it is a file" in refused(tmp_path / "file")
    with locked(tmp_path / "out"):
        assert "another run is writing here" in refused(tmp_path / "out")
    assert not (tmp_path / "out").exists(), "a folder that was made for nothing is removed"


def test_outputs_never_replace_inputs(scene_folder, tmp_path):
    with pytest.raises(UsageError, match="the sequence's own"):
        check_inputs_apart(str(scene_folder), scene_folder, ())
    for name in (*ORDER, "calibration.yaml"):
        with pytest.raises(UsageError, match="an input would be overwritten"):
            check_inputs_apart(str(scene_folder), tmp_path, (None, tmp_path / name))


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
def test_every_input_of_the_command_is_kept(option, name, cli, scene_folder, tmp_path):
    (tmp_path / name).write_text("mine")
    outcome = cli("refine", scene_folder, "--out", tmp_path, option, tmp_path / name, "--overwrite")
    assert (outcome.status, "an input would be overwritten" in outcome.error) == (2, True)
    assert contents(tmp_path) == {name: b"mine"}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["refine.json", "poses.tum", "trajectory.png"])
def test_a_full_disk_leaves_nothing_half_written(name, run, tmp_path, monkeypatch):
    out = tmp_path / "out"
    with monkeypatch.context() as patch:
        fill_disk(patch, name)
        with pytest.raises(JaxmapError, match="disk full"):
            run(out)
    left = set(contents(out)) if out.exists() else set()
    assert left == set(ORDER[: ORDER.index(name)])
    if "poses.tum" in left:
        assert len(read_poses(out / "poses.tum").T) == 2
    run(out, overwrite=True)
    assert set(contents(out)) == set(ORDER), "no leftovers"


@pytest.mark.slow
def test_a_killed_process_leaves_nothing_half_written_and_is_begun_anew(cli, run, scene_folder, tmp_path):
    out = tmp_path / "out"
    run(out)
    words = ("refine", scene_folder, "--out", out, "--stop", 3, "--max-depth-m", 5)
    before = contents(out)
    kill_when(lambda: list(out.glob(".new/.poses.tmp-*")), SLOW_DISK, (*words, "--overwrite"))
    assert before.items() <= contents(out).items(), "the earlier refinement is whole"
    assert cli(*words).status == 1, "it is not replaced unasked"
    run(out, overwrite=True)
    assert set(contents(out)) == set(ORDER), "no leftovers"


def test_frames_that_share_nothing_are_refused(inputs):
    T = inputs.T_world_camera.copy()
    # The second camera is taken to look the other way.
    T[1, :3, :3] = Rotation.from_euler("z", 180, degrees=True).as_matrix() @ T[1, :3, :3]
    with pytest.raises(JaxmapError, match="show the same ground"):
        refine(inputs.frames, T, pinhole(inputs.front_end.camera), Prior(), GroundReference(), (0.3, 5.0))


def test_a_damaged_frame_is_left_out(scene_copy):
    image = scene_copy / "left" / "f001.png"
    image.write_bytes(image.read_bytes()[:3000])
    read = read_inputs(str(scene_copy), ReadOptions(stop=FRAMES))
    assert [one["frame"] for one in read.skipped] == ["f001"]
    assert [frame.name for frame in read.sequence.frames] == ["f000", "f002", "f003"]
    assert len(read.frames) == len(read.T_world_camera) == FRAMES - 1

"""A mapping run from a folder of images to its outputs."""

from __future__ import annotations

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
import rasterio
import yaml
from fixtures import FRAMES, cli, finished_run, map_words, scene_copy, scene_folder, shared_cache  # noqa: F401
from PIL import Image
from planned_runs import config_of, log_odds, metrics_of, planned, ran, voxels_of
from scenes import BASELINE_M, BOXES_M, ROCK, SAND, frame_name, pose, scene_frame, timestamp_s, write_folder_sequence

from jaxmap.datasets.poses import read_poses, write_tum
from jaxmap.errors import FrameError, JaxmapError
from jaxmap.export.voxels import OccupiedVoxels
from jaxmap.mapping.sequence import prepare_frames
from jaxmap.mapping.store import load_map
from jaxmap.runs.config import MapConfig, check_config, config_tree, load_config
from jaxmap.runs.folder import RunFolder
from jaxmap.runs.mapping import run_plan
from jaxmap.runs.mapping_plan import DEFAULT_VOXEL_M, plan_run

OUTPUTS = ("map.zarr", "map.ply", "bev.tif", "bev.png", "metrics.json", "config.yaml", "poses.tum", "report.html")


def read_ply(path: Path) -> np.ndarray:
    header, _, body = path.read_bytes().partition(b"end_header\n")
    kinds = {"double": "<f8", "float": "<f4", "uchar": "u1"}
    fields = [line.split()[1:] for line in header.decode().splitlines() if line.startswith("property")]
    return np.frombuffer(body, [(name, kinds[kind]) for kind, name in fields])


def test_all_outputs_are_there_and_readable(finished_run):
    assert all((finished_run / name).exists() for name in OUTPUTS)
    assert not [path for path in finished_run.iterdir() if path.name.startswith(".")], "no leftovers"
    voxel_map, attributes = load_map(finished_run / "map.zarr")
    assert voxel_map.classes == ("background", "sand", "rock")
    assert voxel_map.log_odds.shape == (4, 80, 104, 8)
    assert int(voxel_map.frames_fused) == FRAMES
    assert attributes.crs is None
    assert attributes.progress["complete"]
    assert len(read_ply(finished_run / "map.ply")) == len(voxels_of(finished_run).label) > 500
    with rasterio.open(finished_run / "bev.tif") as raster:
        assert (raster.height, raster.width) == (104, 80)
        np.testing.assert_allclose((raster.transform[2], raster.transform[5]), (-2.0, 5.2), atol=1e-6)
    for picture in [finished_run / "bev.png", *(finished_run / "pictures").iterdir()]:
        with Image.open(picture) as image:
            image.load()
    assert "<html" in (finished_run / "report.html").read_text()
    track = read_poses(finished_run / "poses.tum")
    np.testing.assert_allclose(track.T, [pose(index) for index in range(FRAMES)], atol=1e-9)
    np.testing.assert_allclose(track.timestamps_s, [timestamp_s(index) for index in range(FRAMES)])


def test_the_metrics_tell_the_run(finished_run):
    metrics = metrics_of(finished_run)
    assert metrics["sequence"]["frames"] == metrics["sequence"]["fused"] == FRAMES
    assert metrics["sequence"]["skipped"] == []
    assert metrics["sequence"]["path_length_m"] == 1.25
    assert metrics["camera"]["baseline_m"] == BASELINE_M
    assert metrics["labeller"] == "plane"
    assert set(metrics["times"]["stages"]) == {"read", "rectify", "match", "wait", "step"}
    voxels = metrics["voxels"]
    assert voxels["observed"] == voxels["occupied"] + voxels["free"]
    assert voxels["occupied"] == len(voxels_of(finished_run).label)
    assert voxels["by_class"]["sand"] > 0 and voxels["by_class"]["rock"] > 0


@pytest.mark.slow
def test_the_config_of_a_run_maps_again_to_the_same(finished_run, scene_folder, cli, tmp_path):
    tree = yaml.safe_load((finished_run / "config.yaml").read_text())
    assert tree.pop("sequence") == str(scene_folder)
    (tmp_path / "again.yaml").write_text(yaml.safe_dump(tree))
    words = ["map", scene_folder, "--out", tmp_path / "run", "--config", tmp_path / "again.yaml"]
    assert cli(*words).status == 0
    np.testing.assert_array_equal(log_odds(tmp_path / "run"), log_odds(finished_run))


def near(voxels: OccupiedVoxels) -> np.ndarray:
    """Voxels seen well: from less than 2.5 m, where depth noise is below the voxel, and more than once."""
    return (voxels.centres_world[:, 1] < 3.3) & (voxels.probability > 0.6)


def in_a_box(points: np.ndarray, margin_m: float) -> np.ndarray:
    lower, upper = BOXES_M[:, 0] - margin_m, BOXES_M[:, 1] + margin_m
    return ((points[:, None] >= lower) & (points[:, None] <= upper)).all(axis=2).any(axis=1)


def test_the_ground_is_sand_and_the_boxes_are_rock(finished_run):
    voxels = voxels_of(finished_run)
    z = voxels.centres_world[:, 2]
    ground = near(voxels) & (np.abs(z) < 0.11) & ~in_a_box(voxels.centres_world, 0.15)
    assert ground.sum() > 400
    assert (voxels.label[ground] == SAND).mean() > 0.97
    box = near(voxels) & (z > 0.2) & in_a_box(voxels.centres_world, 0.08)
    assert box.sum() > 50
    assert (voxels.label[box] == ROCK).mean() > 0.97
    surface = near(voxels) & ((np.abs(z) < 0.11) | in_a_box(voxels.centres_world, 0.15))
    assert surface.sum() > 0.95 * near(voxels).sum()


@pytest.mark.slow
def test_files_of_true_labels_label_the_map(cli, scene_folder, tmp_path):
    words = ["--labeller", "files", "--labels", scene_folder / "labels"]
    assert cli(*map_words(scene_folder, tmp_path / "run", *words)).status == 0
    voxels = voxels_of(tmp_path / "run")
    z = voxels.centres_world[:, 2]
    far_from_boxes = near(voxels) & ~in_a_box(voxels.centres_world, 0.25)
    assert (voxels.label[far_from_boxes & (np.abs(z) < 0.11)] == SAND).mean() > 0.99
    tops = near(voxels) & (z > 0.2) & in_a_box(voxels.centres_world, 0.08)
    assert (voxels.label[tops] == ROCK).mean() > 0.97


@pytest.mark.slow
def test_one_hot_probabilities_and_indices_give_one_map(scene_copy, tmp_path):
    soft = tmp_path / "soft"
    soft.mkdir()
    for file in (scene_copy / "labels").iterdir():
        np.save(soft / f"{file.stem}.npy", np.eye(3, dtype=np.float32)[np.array(Image.open(file))])
    ran(scene_copy, tmp_path / "hard_run", labeller="files", labels=scene_copy / "labels")
    ran(scene_copy, tmp_path / "soft_run", labeller="files", labels=soft)
    np.testing.assert_allclose(log_odds(tmp_path / "soft_run"), log_odds(tmp_path / "hard_run"), atol=1e-4)


@pytest.mark.slow
def test_an_ignored_pixel_says_that_something_is_there_and_no_class(scene_copy, tmp_path):
    for file in (scene_copy / "labels").iterdir():
        Image.fromarray(np.full((120, 160), 255, np.uint8)).save(file)
    ran(scene_copy, tmp_path / "run", labeller="files", labels=scene_copy / "labels")
    evidence = log_odds(tmp_path / "run")
    assert (evidence[0] > 0).any()
    assert not evidence[1:].any()


@pytest.mark.slow
def test_raw_and_rectified_labels_are_one_where_the_images_are_rectified(scene_folder, tmp_path):
    for kind in ("raw", "rectified"):
        ran(scene_folder, tmp_path / kind, labeller="files", labels=scene_folder / "labels", labels_are=kind, stop=2)
    np.testing.assert_array_equal(log_odds(tmp_path / "raw"), log_odds(tmp_path / "rectified"))


@pytest.mark.slow
def test_without_a_labeller_there_is_geometry_alone(cli, scene_folder, finished_run, tmp_path):
    assert cli(*map_words(scene_folder, tmp_path / "run", "--labeller", "none")).status == 0
    evidence = log_odds(tmp_path / "run")
    assert evidence.shape == (1, 80, 104, 8)
    # The plane labeller leaves out what lies more than 2 m from the plane: nothing within these bounds.
    np.testing.assert_allclose(evidence[0], log_odds(finished_run)[0], atol=1e-4)
    assert all((tmp_path / "run" / name).exists() for name in OUTPUTS)
    assert metrics_of(tmp_path / "run")["voxels"]["by_class"] == {}


def test_a_slice_of_the_frames_is_mapped(scene_folder, finished_run):
    plan = planned(scene_folder, start=1, stop=6, stride=2)
    assert [frame.name for frame in plan.sequence.frames] == ["f001", "f003", "f005"]
    np.testing.assert_allclose(plan.sequence.T_world_camera, [pose(index) for index in (1, 3, 5)], atol=1e-9)


def test_automatic_bounds_hold_the_scene_and_lie_on_whole_voxels(scene_folder):
    config = config_tree(MapConfig())
    plan = plan_run(str(scene_folder), check_config(config), lambda line: None)
    origin = np.asarray(plan.grid.origin_m, np.float64)
    voxel_size_m = np.array(DEFAULT_VOXEL_M)
    np.testing.assert_allclose(plan.grid.voxel_size_m, voxel_size_m, atol=1e-6)
    np.testing.assert_allclose(origin / voxel_size_m, np.rint(origin / voxel_size_m), atol=1e-4)
    upper = origin + np.array(plan.grid.shape) * voxel_size_m
    assert (origin <= BOXES_M[:, 0].min(axis=0)).all() and (upper >= BOXES_M[:, 1].max(axis=0)).all()
    assert plan.depth_range_m == (0.3, 4.0)


@pytest.mark.slow
def test_the_paper_preset_and_an_override(cli, scene_folder, tmp_path):
    words = ["--config", "chiodini2020", "--grid.voxel-size-m", "0.1", "--fusion.class-hit", "1.5"]
    assert cli(*map_words(scene_folder, tmp_path / "run", *words)).status == 0
    tree = yaml.safe_load((tmp_path / "run" / "config.yaml").read_text())
    paper = config_tree(load_config("chiodini2020"))
    assert tree["grid"]["voxel_size_m"] == 0.1
    assert tree["fusion"] == {**paper["fusion"], "class_hit": 1.5}
    evidence = log_odds(tmp_path / "run")
    hits = evidence[0] / 0.9
    # Each frame counts once, and nothing takes evidence away.
    np.testing.assert_allclose(hits, np.rint(hits), atol=1e-4)
    assert hits.min() == 0 and hits.max() <= FRAMES + 1e-3
    # Each frame is a vote for a class or against it.
    votes = [1.5 * hit - 0.9 * miss for hit in range(FRAMES + 1) for miss in range(FRAMES + 1 - hit)]
    assert np.abs(evidence[1:][..., None] - votes).min(axis=-1).max() < 1e-4


@pytest.mark.slow
def test_georeferenced_poses_come_out_absolute(finished_run, tmp_path):
    # Whole voxels away, so that the maps are equal cell by cell.
    offset_m = (458074.0, 5429380.0, 162.0)
    sequence = write_folder_sequence(tmp_path / "utm", FRAMES, offset_m=offset_m)
    # The site origin is the first position in whole metres: 1 m above the ground here.
    settings = {"grid": {"lower_m": [-2.0, 0.0, -1.5], "upper_m": [2.0, 5.2, 0.0]}}
    metrics = ran(sequence, tmp_path / "run", **settings)
    assert metrics["sequence"]["site_origin"] == [458074.0, 5429380.0, 163.0]
    near_run = voxels_of(finished_run)
    ply = read_ply(tmp_path / "run" / "map.ply")
    assert ply["x"].dtype == np.float64
    points = np.stack([ply["x"], ply["y"], ply["z"]], axis=1)
    assert abs(len(points) - len(near_run.label)) < 0.01 * len(points)
    np.testing.assert_allclose(
        np.median(points, axis=0) - offset_m, np.median(near_run.centres_world, axis=0), atol=0.051
    )
    with rasterio.open(tmp_path / "run" / "bev.tif") as raster:
        np.testing.assert_allclose((raster.transform[2], raster.transform[5]), (458072.0, 5429385.2), atol=1e-3)
    track = read_poses(tmp_path / "run" / "poses.tum")
    expected = np.stack([pose(index)[:3, 3] for index in range(FRAMES)]) + offset_m
    np.testing.assert_allclose(track.T[:, :3, 3], expected, atol=1e-6)


@pytest.mark.slow
def test_an_unreadable_frame_is_passed_over_and_counted(scene_copy, tmp_path):
    image = scene_copy / "left" / "f002.png"
    image.write_bytes(image.read_bytes()[:3000])
    metrics = ran(scene_copy, tmp_path / "run")
    assert metrics["sequence"]["fused"] == FRAMES - 1
    (skipped,) = metrics_of(tmp_path / "run")["sequence"]["skipped"]
    assert skipped["frame"] == "f002"
    assert str(image) in skipped["reason"]
    track = read_poses(tmp_path / "run" / "poses.tum")
    np.testing.assert_allclose(track.timestamps_s, [timestamp_s(index) for index in (0, 1, 3, 4, 5)])
    rest = write_folder_sequence(tmp_path / "rest", (0, 1, 3, 4, 5))
    ran(rest, tmp_path / "rest_run")
    np.testing.assert_array_equal(log_odds(tmp_path / "run"), log_odds(tmp_path / "rest_run"))


@pytest.mark.slow
def test_the_first_frame_may_be_the_unreadable_one(scene_copy, tmp_path):
    (scene_copy / "left" / "f000.png").write_bytes(b"")
    metrics = ran(scene_copy, tmp_path / "run")
    assert metrics["sequence"]["fused"] == FRAMES - 1
    assert all((tmp_path / "run" / name).exists() for name in OUTPUTS)


@pytest.mark.slow
def test_strict_stops_at_the_first_unusable_frame(scene_copy, tmp_path):
    (scene_copy / "right" / "f003.png").unlink()
    with pytest.raises(FrameError, match="right/f003.png"):
        ran(scene_copy, tmp_path / "run", strict=True)


def test_a_priority_class_that_is_none_is_refused(scene_folder):
    with pytest.raises(JaxmapError, match="stone"):
        planned(scene_folder, fusion={"priority_classes": ["stone"]})


def test_a_class_named_twice_is_refused(scene_folder):
    with pytest.raises(JaxmapError, match="rock"):
        planned(scene_folder, classes=["sand", "rock", "rock"])


def test_no_usable_frame_at_all_is_an_error(scene_copy, tmp_path):
    for image in (scene_copy / "right").iterdir():
        image.write_bytes(b"")
    with pytest.raises(JaxmapError, match="none of 6 frames could be fused; the first: .*right/f000.png"):
        ran(scene_copy, tmp_path / "run")


@pytest.mark.slow
def test_a_missing_or_broken_label_costs_its_frame_alone(scene_copy, tmp_path):
    (scene_copy / "labels" / "f001.png").unlink()
    Image.fromarray(np.full((120, 160), 9, np.uint8)).save(scene_copy / "labels" / "f004.png")
    metrics = ran(scene_copy, tmp_path / "run", labeller="files", labels=scene_copy / "labels")
    assert [skipped["frame"] for skipped in metrics["sequence"]["skipped"]] == ["f001", "f004"]


def test_the_step_is_compiled_once_and_every_frame_told(scene_folder, tmp_path):
    plan = planned(scene_folder)
    folder = RunFolder(tmp_path / "run")
    folder.begin(plan.settings(config_of()), resume=False, overwrite=False)
    frames = []
    run_plan(plan, folder, strict=True, checkpoint_every_s=60.0, notify=lambda line: None, on_frame=frames.append)
    assert [fused.prepared.index for fused in frames] == list(range(FRAMES))
    assert [fused.cost is not None for fused in frames] == [True] + [False] * (FRAMES - 1)
    # The run's step was compiled ahead of time; neither it nor the jitted one compiled again.
    assert plan.mapper.compilations() == 0


def test_the_front_end_of_a_plan_sees_the_true_depth(scene_folder):
    plan = planned(scene_folder, stop=1)
    (prepared,) = prepare_frames(plan.sequence, plan.front_end)
    truth = scene_frame(0)
    disparity_px = np.asarray(prepared.frame.disparity_px)
    solid = truth.labels != 0
    assert np.nanmedian(np.abs(disparity_px - truth.disparity_px)[solid]) < 0.3
    assert prepared.ref.name == frame_name(0)
    np.testing.assert_allclose(prepared.frame.T_world_camera.as_matrix(), pose(0), atol=1e-6)
    assert prepared.frame.disparity_px.dtype == jnp.float32


@pytest.mark.slow
@pytest.mark.parametrize("z_up", [True, False], ids=["z up", "z down"])
def test_a_run_says_in_how_many_frames_it_found_no_ground(z_up, scene_copy, tmp_path):
    if not z_up:
        track = read_poses(scene_copy / "poses.tum")
        write_tum(scene_copy / "poses.tum", track.timestamps_s, np.diag([1.0, -1.0, -1.0, 1.0]) @ track.T)
    config, lines = config_of(labeller="relief", stop=2), []
    plan = plan_run(str(scene_copy), config, lines.append)
    folder = RunFolder(tmp_path / "run")
    folder.begin(plan.settings(config), resume=False, overwrite=False)
    metrics = run_plan(plan, folder, strict=False, checkpoint_every_s=60.0, notify=lines.append)
    assert metrics["sequence"]["without_ground"] == (0 if z_up else 2)
    assert any("no ground below the camera in 2 of 2 frames" in line for line in lines) == (not z_up)
    assert metrics_of(tmp_path / "run")["sequence"]["without_ground"] == metrics["sequence"]["without_ground"]


@pytest.mark.slow
def test_labels_of_files_go_with_relief(scene_folder, tmp_path):
    labels = {"labeller": "files", "labels": scene_folder / "labels"}
    with_relief = ran(scene_folder, tmp_path / "run", **labels, relief={"combine": True}, stop=2)
    assert with_relief["voxels"]["occupied"] and with_relief["sequence"]["without_ground"] == 0

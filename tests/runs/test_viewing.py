"""`jaxmap view` and `jaxmap map --view`: recordings, read back by rerun's own reader."""

from __future__ import annotations

import importlib.util
import io
import json
from pathlib import Path

import numpy as np
import pytest
from fixtures import cli, map_words, scene_folder, shared_cache  # noqa: F401
from hypothesis import given, settings
from hypothesis import strategies as st
from made_runs import SITE, add_cameras, make_run
from PIL import Image

from jaxmap.datasets.base import FrameRef
from jaxmap.datasets.poses import read_poses, write_tum
from jaxmap.errors import JaxmapError
from jaxmap.labels import class_colours
from jaxmap.mapping.observations import Observation, ObservationAttributes, write_attributes, write_observation
from jaxmap.report.first_seen import first_seen
from jaxmap.report.recording import check_viewer, recording
from jaxmap.report.run_contents import read_run
from jaxmap.runs.folder import RunFolder
from jaxmap.runs.run_frames import read_run_frames, rows_of, write_frame_table
from jaxmap.types import Pinhole

SMALL = dict(fx_px=30.0, fy_px=30.0, cx_px=19.5, cy_px=14.5, baseline_m=0.3, width_px=40.0, height_px=30.0)
CAMERA, SIZE_PX = Pinhole(50.0, 50.0, 31.5, 23.5, 0.1, 0.0), (64, 48)


def frame_names(count: int) -> list[FrameRef]:
    return [FrameRef(f"left, {i}", 100.0 + i, Path(f"{i}.png"), Path("r.png")) for i in range(count)]


@pytest.fixture
def run(tmp_path) -> Path:
    """A run of 21 frames, of which the last but one was skipped."""
    run = make_run(tmp_path / "run")
    add_cameras(run)
    # Looking east and down.
    T = np.tile(np.array([[0.0, -0.3, 0.95, 0], [-1, 0, 0, 0], [0, -0.95, -0.3, 0], [0, 0, 0, 1]]), (20, 1, 1))
    T[:, :3, :3] /= np.linalg.norm(T[:, :3, :3], axis=1, keepdims=True)
    T[:, :3, 3] = read_poses(run / "poses.tum").T[:, :3, 3]
    write_tum(run / "poses.tum", 100.0 + np.array([*range(19), 20]), T)
    metrics = json.loads((run / "metrics.json").read_text())
    metrics["camera"] |= {"baseline_m": 0.12, "doffs_px": 0.0, "T_raw_rectified": np.eye(4).tolist()}
    local = T - np.pad(SITE[:, None], ((0, 1), (3, 0)))
    metrics["camera"]["key_frames"] = {"000000": local[0].tolist(), "000020": local[-1].tolist()}
    (run / "metrics.json").write_text(json.dumps(metrics))
    write_frame_table(run / "frames.csv", rows_of(frame_names(21), {"left, 19": 'it is "black"'}))
    return run


def logged(path: Path) -> dict[str, list[dict]]:
    """The rows of each entity of a recording, as rerun reads them."""
    reader = pytest.importorskip("rerun.chunk").RrdReader(path)
    assert len(reader.recordings()) == 1 and len(reader.blueprints()) == 1
    rows: dict[str, list[dict]] = {}
    for chunk in reader.stream():
        batch = chunk.to_record_batch()
        # When a row was logged, in nanoseconds, makes no Python time without pandas.
        kept = [field.name for field in batch.schema if not str(field.type).startswith("timestamp")]
        rows.setdefault(chunk.entity_path, []).extend(batch.select(kept).to_pylist())
    return rows


@settings(max_examples=25)
@given(st.integers(0, 2**31), st.integers(1, 5))
def test_points_are_first_seen_when_they_come_into_view(seed, count) -> None:
    rng = np.random.default_rng(seed)
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, 3] = rng.uniform(-2, 2, (count, 3))
    # Far apart, so that none hides another for good.
    points = rng.uniform([-4, -4, 1], [4, 4, 12], (12, 3)).astype(np.float32)
    first = first_seen(points, T, CAMERA, SIZE_PX, 8.0)
    for point, frame in zip(points.astype(float), first, strict=True):
        local = [point - pose[:3, 3] for pose in T]
        in_view = [
            0.05 < z <= 8 and -0.5 <= 50 * x / z + 31.5 < 63.5 and -0.5 <= 50 * y / z + 23.5 < 47.5 for x, y, z in local
        ]
        assert (frame == -1) == (not any(in_view))
        assert frame == -1 or in_view[frame]


def test_a_wall_hides_what_is_behind_it() -> None:
    y, z = np.meshgrid(np.linspace(-2, 2, 60), [3.0])
    wall = np.stack(np.broadcast_arrays(np.linspace(-2, 2, 60)[:, None], y, z), axis=-1).reshape(-1, 3)
    behind = np.array([[0.0, 0.0, 6.0]])
    T = np.tile(np.eye(4), (2, 1, 1))
    T[1, :3, 3] = 0, 0, 4
    assert first_seen(np.concatenate([wall, behind]), T, CAMERA, SIZE_PX, 8.0)[-1] == 1


def test_frames_come_back(run) -> None:
    frames = read_run_frames(RunFolder(run), SITE)
    assert frames.index.tolist() == [*range(19), 20] and frames.names[-1] == "left, 20" and not frames.notes
    assert frames.size_px == (1024, 768) and frames.camera is not None and frames.camera.fx_px == 800
    np.testing.assert_allclose(frames.T_world_camera[0, :3, 3], [-3, 0, 1.2], atol=1e-6)
    (run / "frames.csv").write_text("frame,name\n1,2\n")
    (run / "metrics.json").write_text("{}")
    frames = read_run_frames(RunFolder(run), SITE)
    assert frames.names == () and frames.camera is None and len(frames.notes) == 2


@pytest.mark.slow
def test_a_run_becomes_a_recording(cli, run, tmp_path) -> None:
    pytest.importorskip("rerun")
    outcome = cli("view", run, "--save", tmp_path / "f.rrd")
    assert outcome.status == 0, outcome.err
    assert "20 poses; pictures (left, labels, disparity) of 2 key frames" in outcome.err
    rows = logged(tmp_path / "f.rrd")
    poses = sorted((row["frame"], row["Transform3D:translation"][0]) for row in rows["/world/camera"])
    assert [frame for frame, _ in poses] == [*range(19), 20]
    np.testing.assert_allclose(poses[0][1], [-3, 0, 1.2], atol=1e-5)
    expected = read_run_frames(RunFolder(run), SITE).T_world_camera[0, :3, :3]
    turned = next(row["Transform3D:mat3x3"][0] for row in rows["/world/camera"] if row["frame"] == 0)
    np.testing.assert_allclose(np.reshape(turned, (3, 3), order="F"), expected, atol=1e-6)
    for entity in ("/world/camera/left", "/labels", "/disparity"):
        assert sorted({row["frame"] for row in rows[entity] if row.get("EncodedImage:blob")}) == [0, 20]
    pinhole = next(row for row in rows["/world/camera/left"] if row.get("Pinhole:resolution"))
    assert pinhole["Pinhole:resolution"] == [[640, 480]]
    assert pinhole["Pinhole:image_from_camera"][0][:1] == [800 * 640 / 1024]
    voxels = read_run(run).voxels
    parts = {name: row for name, [row] in ((n, r) for n, r in rows.items() if n.startswith("/world/voxels/"))}
    assert len(parts) > 1 and all(int(name.rsplit("/")[-1]) == row["frame"] for name, row in parts.items())
    centres = np.concatenate([row["Boxes3D:centers"] for row in parts.values()])
    labels = np.concatenate([row["Boxes3D:class_ids"] for row in parts.values()])
    order, expected = np.lexsort(centres.T), np.lexsort(voxels.centres_world.T)
    np.testing.assert_array_equal(centres[order], voxels.centres_world[expected])
    np.testing.assert_array_equal(labels[order], voxels.label[expected])
    assert "AnnotationContext:context" in {key for row in rows["/world"] for key in row}


@pytest.mark.slow
def test_frames_between_key_frames_show_what_was_perceived(cli, run, tmp_path) -> None:
    pytest.importorskip("rerun")
    # In the order of the classes that are kept, which is not the map's.
    kept = ObservationAttributes(
        "s", "s", "folder", dict(SMALL), {}, "files", "labels", (30, 40), ("rock", "other", "sand")
    )
    write_attributes(run / "observations.zarr", kept)
    disparity_px, labels = np.full((30, 40), 5.0, np.float32), np.zeros((30, 40), np.uint8)
    labels[:, 20:] = 255
    for name, time_s in (("left, 0", 100.0), ("left, 7", 107.0), ("left, 9", 109.0)):
        seen = Observation(name, time_s, np.eye(4), disparity_px, labels)
        write_observation(run / "observations.zarr", seen, "labels")
    outcome = cli("view", run, "--save", tmp_path / "f.rrd")
    assert outcome.status == 0, outcome.err
    assert "disparity and likeliest classes of 2 other frames" in outcome.err
    rows = logged(tmp_path / "f.rrd")
    for entity in ("/labels", "/disparity"):
        assert sorted({row["frame"] for row in rows[entity] if row.get("EncodedImage:blob")}) == [0, 7, 9, 20]
    assert {row["frame"] for row in rows["/world/camera/left"] if "Clear:is_recursive" in row} == {7, 9}
    [blob] = next(row["EncodedImage:blob"] for row in rows["/labels"] if row["frame"] == 7)
    picture = np.asarray(Image.open(io.BytesIO(bytes(blob))).convert("RGB"), int)
    rock = class_colours(read_run(run).classes)[read_run(run).classes.index("rock")]
    assert np.abs(picture[10, 5] - rock).max() < 12 and picture[10, 35].max() < 12


@pytest.mark.slow
def test_a_run_from_before_says_what_it_shows(cli, run, tmp_path) -> None:
    pytest.importorskip("rerun")
    (run / "frames.csv").unlink()
    assert cli("view", run, "--save", tmp_path / "f.rrd").status == 0
    pictures = logged(tmp_path / "f.rrd")["/labels"]
    assert sorted({row["frame"] for row in pictures}) == [0, 19], "by where they were taken"
    metrics = json.loads((run / "metrics.json").read_text())
    del metrics["camera"]
    (run / "metrics.json").write_text(json.dumps(metrics))
    outcome = cli("view", run, "--save", tmp_path / "f.rrd")
    assert outcome.status == 0, outcome.err
    for remark in ("no frames.csv", "metrics.json does not tell the camera", "all from the first frame on"):
        assert remark in outcome.err
    assert [name for name in logged(tmp_path / "f.rrd") if name.startswith("/world/voxels/")] == [
        "/world/voxels/000000"
    ]


def test_what_a_viewer_needs(cli, run, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert "rerun is not installed" in cli("view", run, "--save", tmp_path / "f.rrd").error
    assert "pip install 'jaxmap[view]'" in cli("map", run, "--out", tmp_path / "out", "--view").error
    assert not (tmp_path / "f.rrd").exists() and not (tmp_path / "out").exists()
    monkeypatch.undo()
    pytest.importorskip("rerun")
    assert cli("view", run, "--save", tmp_path / "f.txt").status == 2
    monkeypatch.setattr("sys.platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(JaxmapError, match=r"no display .* rerun F.rrd"):
        check_viewer(None)
    assert "no such run folder" in cli("view", tmp_path / "nowhere", "--save", tmp_path / "f.rrd").error


@pytest.mark.slow
def test_what_is_interrupted_leaves_a_file_and_what_fails_none(tmp_path) -> None:
    pytest.importorskip("rerun")

    def record(path: Path, fault: BaseException) -> None:
        with pytest.raises(type(fault)), recording("name", ("sand",), np.eye(4)[None], path) as log:
            log.at(3, 2.0)
            log.pose(np.eye(4))
            raise fault

    record(tmp_path / "stopped.rrd", KeyboardInterrupt())
    assert logged(tmp_path / "stopped.rrd")["/world/camera"][0]["frame"] == 3
    record(tmp_path / "failed.rrd", ValueError())
    assert [path.name for path in tmp_path.iterdir()] == ["stopped.rrd"]


@pytest.mark.slow
def test_a_run_is_recorded_while_it_goes_on(cli, scene_folder, tmp_path) -> None:
    pytest.importorskip("rerun")
    outcome = cli(*map_words(scene_folder, tmp_path / "run", "--view-save", tmp_path / "live.rrd"))
    assert outcome.status == 0, outcome.err
    rows = logged(tmp_path / "live.rrd")
    assert sorted(row["frame"] for row in rows["/world/camera"]) == [*range(6)]
    assert len(rows["/disparity"]) == len(rows["/labels"]) == 6
    last = max(rows["/world/voxels/map"], key=lambda row: row["frame"])
    assert len(last["Boxes3D:centers"]) == len(read_run(tmp_path / "run").voxels.label)

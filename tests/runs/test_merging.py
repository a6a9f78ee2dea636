"""`jaxmap merge`: runs in, one run out, which is that of mapping all frames at once."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from fixtures import cli, map_words, scene_folder, shared_cache  # noqa: F401
from PIL import Image
from truth_files import SITE, write_map

from jaxmap.commands.main import main
from jaxmap.datasets.poses import read_poses
from jaxmap.fusion.surface import over_layers
from jaxmap.mapping.store import load_map, open_map, save_map
from jaxmap.planning.options import RoverOptions
from jaxmap.runs.folder import RunFolder
from jaxmap.runs.merging import open_sessions
from jaxmap.runs.planning import read_costs
from jaxmap.runs.run_frames import read_frame_table, read_run_frames

SEEN = np.ones((20, 12), bool)
CAMERA = {"fx_px": 60, "fy_px": 60, "cx_px": 39.5, "cy_px": 29.5, "width_px": 80, "height_px": 60}


def write_run(run: Path, first_s: float, rock: np.ndarray | None = None, site: np.ndarray = SITE) -> Path:
    """A run of two frames with a picture, made by hand; its corner lies 1 m from its site's origin."""
    write_map(run, np.zeros_like(SEEN) if rock is None else rock, SEEN, origin_m=(1.0, 1.0))
    voxel_map, attributes = load_map(run / "map.zarr")
    attributes.progress.update(digest=f"{run.name}", complete=True)
    attributes.site_origin[:] = site
    save_map(run / "map.zarr", voxel_map, attributes)
    rows = [f"{first_s + i} {site[0] + i} {site[1]} {site[2]} 0 0 0 1" for i in range(2)]
    (run / "poses.tum").write_text("\n".join(rows))
    pose = np.eye(4).tolist()
    sequence = {"name": run.name, "frames": 2, "path_length_m": 1.0, "skipped": [], "notes": ["dull"]}
    metrics = {"camera": CAMERA | {"key_frames": {"000001": pose}}, "grid": {"depth_range_m": [0.5, 6.0]}}
    (run / "metrics.json").write_text(json.dumps(metrics | {"sequence": sequence, "labeller": "plane"}))
    (run / "pictures").mkdir()
    Image.new("RGB", (8, 6), (90, 90, 90)).save(run / "pictures" / "000001_left.png")
    return run


@pytest.fixture
def runs(tmp_path):
    return [write_run(tmp_path / "a", 100.0), write_run(tmp_path / "b", 50.0, ~SEEN, SITE + np.array([2.0, 0.4, 0.0]))]


@pytest.mark.slow
def test_the_merged_run_is_a_run(cli, runs, tmp_path):
    out = tmp_path / "out"
    outcome = cli("merge", *runs, "--out", out)
    assert outcome.status == 0, outcome.err
    assert "2 frames of 2 runs in one map" in outcome.err and f"wrote {out}/" in outcome.out
    a, b, both = (np.asarray(load_map(run / "map.zarr")[0].log_odds) for run in (*runs, out))
    expected = np.zeros((4, 30, 14, 1), np.float32)
    expected[:, :20, :12] += a
    expected[:, 10:, 2:] += b
    np.testing.assert_array_equal(both[:, :30, :14, :1], expected)
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["sequence"]["name"] == "a + b" and metrics["sequence"]["frames"] == 4
    assert metrics["camera"]["key_frames"]["000003"][0][3] == 2.0 and metrics["camera"]["fx_px"] == 60
    assert sorted(path.name for path in (out / "pictures").iterdir()) == ["000001_left.png", "000003_left.png"]
    assert read_poses(out / "poses.tum").timestamps_s.tolist() == [50.0, 51.0, 100.0, 101.0]
    assert "a + b" in (out / "report.html").read_text()
    assert f"frames of {out} would count twice" in cli("merge", out, runs[0], "--out", tmp_path / "again").error
    refused = cli("merge", *runs, "--out", out)
    assert refused.status == 1 and "--overwrite" in refused.error
    assert cli("merge", *runs, "--out", out, "--overwrite").status == 0
    assert cli("export", out, "--format", "ply").status == 0


@pytest.mark.slow
def test_halves_of_a_sequence_merged_are_the_whole(cli, scene_folder, tmp_path):
    words = ("--labeller", "none")
    parts = {"whole": (), "early": ("--stop", 3), "late": ("--start", 3)}
    for name, cut in parts.items():
        assert main(map_words(scene_folder, tmp_path / name, *words, *cut)) == 0
    outcome = cli("merge", tmp_path / "early", tmp_path / "late", "--out", tmp_path / "merged")
    assert outcome.status == 0, outcome.err
    whole, merged, early, late = (
        load_map(tmp_path / name / "map.zarr")[0] for name in ("whole", "merged", "early", "late")
    )
    low = np.asarray(whole.grid.first) - np.asarray(merged.grid.first)
    part = tuple(slice(a, a + n) for a, n in zip(low, whole.grid.shape, strict=True))
    sums = np.asarray(merged.log_odds)[(slice(None), *part)]
    np.testing.assert_allclose(sums, whole.log_odds, atol=1e-5)
    once = (np.asarray(early.log_odds) == 0) | (np.asarray(late.log_odds) == 0)
    np.testing.assert_array_equal(sums[once], np.asarray(whole.log_odds)[once])
    assert int(merged.frames_fused) == 6 and once.mean() > 0.5
    heights, others = (np.asarray(over_layers(one.surface)) for one in (whole, merged))
    np.testing.assert_allclose(others[(slice(None), *part[:2])][:3], heights[:3], rtol=1e-4, atol=1e-4)
    merged_run = RunFolder(tmp_path / "merged")
    assert read_run_frames(merged_run, np.zeros(3)).index.tolist() == list(range(6))
    assert_same_hazards(tmp_path / "merged" / "map.zarr", tmp_path / "whole" / "map.zarr")
    ours, theirs = (read_costs(tmp_path / name, RoverOptions()) for name in ("merged", "whole"))
    assert ours.site.fine and np.isfinite(theirs.hazards.slope_deg).any()
    np.testing.assert_allclose(ours.hazards.slope_deg[part[:2]], theirs.hazards.slope_deg, rtol=1e-2, atol=1e-2)
    for words in (("report",), ("view", "--save", tmp_path / "f.rrd")):
        outcome = cli(words[0], tmp_path / "merged", *words[1:])
        assert outcome.status == 0, outcome.err


def assert_same_hazards(found: Path, expected: Path) -> None:
    """Whatever order their heights were added up in."""
    (_, theirs), reader = load_map(expected), open_map(found)
    ours = reader.layers(reader.whole)
    assert ours.keys() == theirs.layers.keys() and len(ours)
    for name, values in theirs.layers.items():
        known, other = values[np.isfinite(values)], ours[name][np.isfinite(ours[name])]
        assert len(known) == len(other) and len(known)
        np.testing.assert_allclose(np.sort(other), np.sort(known), rtol=1e-2, atol=1e-2)


def test_times_that_overlap_are_told(runs, tmp_path):
    from jaxmap.runs.merging import _write_poses

    write_run(tmp_path / "c", 100.5)
    (tmp_path / "out").mkdir()
    notes = _write_poses(open_sessions([*runs, tmp_path / "c"]), [0, 2, 4], RunFolder(tmp_path / "out"))
    assert len(notes) == 1 and "the times of" in notes[0] and "1.500 s later" in notes[0]
    assert read_poses(tmp_path / "out" / "poses.tum").timestamps_s.tolist() == [50, 51, 100, 101, 102, 103]
    rows = read_frame_table(RunFolder(tmp_path / "out"), 6)
    assert [(row.frame, row.timestamp_s) for row in rows][::3] == [(2, 50.0), (1, 101.0)]
    assert rows[-1] == (5, "c/000001", 103.0, "")


def test_what_cannot_be_merged_is_one_line(cli, runs, tmp_path):
    out = tmp_path / "out"
    assert "a merge needs two runs or more" in cli("merge", runs[0], "--out", out).error
    assert "would be replaced" in cli("merge", *runs, "--out", runs[1]).error
    assert "would count twice" in cli("merge", runs[0], runs[0], "--out", out).error
    assert "no such run folder" in cli("merge", runs[0], tmp_path / "nowhere", "--out", out).error
    voxel_map, attributes = load_map(runs[1] / "map.zarr")
    attributes.progress["complete"] = False
    save_map(runs[1] / "map.zarr", voxel_map, attributes)
    assert "the run is not complete" in cli("merge", *runs, "--out", out).error
    attributes.progress["complete"] = True
    attributes.fusion["ensemble"] = {"members": 2}
    save_map(runs[1] / "map.zarr", voxel_map, attributes)
    assert "the map has an ensemble" in cli("merge", *runs, "--out", out).error
    assert not out.exists()

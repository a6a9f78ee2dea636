"""`jaxmap evaluate`: from files to scores, picture and report, and every fault in one line."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from fixtures import cli, finished_run, scene_folder, shared_cache  # noqa: F401
from PIL import Image
from scenes import BOXES_M
from scipy.spatial.transform import Rotation
from truth_files import SITE, write_map, write_raster

from jaxmap.commands.evaluate import COLUMNS
from jaxmap.report.error_map import error_colours
from jaxmap.report.run_page import write_report

ROCK = np.zeros((10, 8), bool)
ROCK[2:6, 1:3] = True
OBSERVED = np.ones((10, 8), bool)
OBSERVED[0, :] = OBSERVED[1, 1] = False
LABELS = np.ones((10, 8), np.uint8)
LABELS[1:4, 1:3] = 2
LABELS[9, :] = 0


@pytest.fixture
def run(tmp_path):
    return write_map(tmp_path / "run", ROCK, OBSERVED)


def truth_file(folder: Path, labels: np.ndarray = LABELS, **more) -> Path:
    """Labels (x first) as a GeoTIFF over the map's own cells."""
    rows = np.ascontiguousarray(labels.T[::-1])
    return write_raster(folder / "truth.tif", rows, SITE[0], SITE[1] + 0.2 * len(rows), 0.2, **more)


def test_a_run_is_scored(cli, run, tmp_path):
    outcome = cli("evaluate", run, truth_file(tmp_path))
    assert outcome.status == 0, outcome.err
    scores = json.loads((run / "scores.json").read_text())
    assert {key: scores[key] for key in ("tp", "fp", "fn", "tn")} == dict(tp=4, fp=4, fn=1, tn=54)
    assert scores["in_view"]["fn"] == 2 and scores["coverage"] == 63 / 72
    assert list(scores)[: len(COLUMNS) - 1] == [key for key in COLUMNS if key != "over"]
    assert scores["crs"] == "EPSG:32631" and scores["frames"] is None
    assert "the cameras' view is not known" in scores["notes"][0] and "note: the cameras' view" in outcome.err
    assert all(word in outcome.out for word in ("IoU", "0.444", "all cells in view", "rocks in view"))
    assert Image.open(run / "errors.png").size[0] >= 1000
    assert not (run / "report.html").exists()


def test_out_names_the_files_and_the_run_stays_as_it_was(cli, run, tmp_path):
    before = sorted(path.name for path in run.iterdir())
    out = tmp_path / "deep" / "mine.json"
    words = ("--cell-size-m", "0.4", "--rock-fraction", "0.3", "--register")
    outcome = cli("evaluate", run, truth_file(tmp_path), "--out", out, *words)
    assert outcome.status == 0, outcome.err
    assert sorted(path.name for path in out.parent.iterdir()) == ["mine.json", "mine_errors.png"]
    assert sorted(path.name for path in run.iterdir()) == before
    scores = json.loads(out.read_text())
    assert scores["cell_size_m"] == 0.4 and scores["registration"]["before"]["tp"] >= 0
    assert "before registration" in outcome.out and "registered: truth shifted" in outcome.err


def test_a_backdrop_is_drawn(cli, run, tmp_path):
    picture = np.full((3, 40, 50), 90, np.uint8)
    backdrop = write_raster(tmp_path / "rgb.tif", picture, SITE[0], SITE[1] + 1.6, 0.04)
    assert cli("evaluate", run, truth_file(tmp_path), "--backdrop", backdrop).status == 0
    with Image.open(run / "errors.png") as image:
        assert (np.asarray(image.convert("RGB")) == 90).all(axis=-1).any()


def test_another_class_and_a_list_of_rocks(cli, run, tmp_path):
    assert cli("evaluate", run, truth_file(tmp_path), "--class", "sand").status == 0
    sand = json.loads((run / "scores.json").read_text())
    assert (sand["tp"], sand["fp"], sand["fn"], sand["tn"]) == (54, 1, 4, 4)
    (tmp_path / "rocks.csv").write_text(f"x,y,size\n{SITE[0] + 0.5},{SITE[1] + 0.4},0.6\n")
    outcome = cli("evaluate", run, tmp_path / "rocks.csv", "--rock-diameters-m", "0.2", "0.4", "0.8")
    assert outcome.status == 0, outcome.err
    assert "taken for sand" in outcome.err
    assert json.loads((run / "scores.json").read_text())["rocks"]["count"] == 1


def test_cells_in_range_of_a_camera_are_scored_in_the_report(cli, run, tmp_path):
    # A camera 1 m above the ground in the south of the map, looking north and 0.4 rad down.
    R = [[1, 0, 0], [0, -np.sin(0.4), np.cos(0.4)], [0, -np.cos(0.4), -np.sin(0.4)]]
    quaternion = " ".join(map(str, Rotation.from_matrix(R).as_quat()))
    (run / "poses.tum").write_text(f"0 {SITE[0] + 1} {SITE[1] - 1} {SITE[2] + 1} {quaternion}\n")
    camera = {"fx_px": 60, "fy_px": 60, "cx_px": 39.5, "cy_px": 29.5, "width_px": 80, "height_px": 60}
    (run / "metrics.json").write_text(json.dumps({"camera": camera, "grid": {"depth_range_m": [0.5, 6.0]}}))
    outcome = cli("evaluate", run, truth_file(tmp_path), "--max-range-m", "2.2")
    assert outcome.status == 0, outcome.err
    scores = json.loads((run / "scores.json").read_text())
    assert scores["frames"] == 1 and scores["max_range_m"] == 2.2 and scores["notes"] == []
    assert 0 < scores["cells"] < 63
    page = (run / "report.html").read_text()
    assert "Against ground truth" in page and "errors.png" in page and "scores.json" in page
    (run / "scores.json").write_text("[1, 2]")
    write_report(run)
    assert "scores.json could not be read" in (run / "report.html").read_text()


@pytest.mark.slow
def test_a_real_run_is_scored(cli, finished_run, tmp_path):
    run = Path(shutil.copytree(finished_run, tmp_path / "run"))
    labels = np.ones((160, 260), np.uint8)
    for lower, upper in BOXES_M[:, :, :2]:
        x, y = (slice(*np.round(np.array([a, b]) / 0.025).astype(int)) for a, b in zip(lower, upper, strict=True))
        labels[x.start + 80 : x.stop + 80, y] = 2
    rows = np.ascontiguousarray(labels.T[::-1])
    truth = write_raster(tmp_path / "truth.tif", rows, -2.0, 6.5, 0.025, crs=None)
    outcome = cli("evaluate", run, truth, "--max-range-m", "4")
    assert outcome.status == 0, outcome.err
    scores = json.loads((run / "scores.json").read_text())
    assert scores["frames"] == 6 and scores["max_range_m"] == 4.0
    assert scores["accuracy"] > 0.85 and scores["recall"] > 0.5
    assert 0.3 < scores["coverage"] <= 1.0
    assert scores["rocks"]["count"] == 3 and scores["notes"] == []


def test_inputs_are_not_overwritten(cli, run, tmp_path):
    truth, picture = truth_file(tmp_path), tmp_path / "mine_errors.png"
    for path in (picture, run / "metrics.json"):
        path.write_text("mine")
    for words in (("--out", tmp_path / "mine.json", "--backdrop", picture), ("--out", run / "metrics.json")):
        outcome = cli("evaluate", run, truth, *words)
        assert (outcome.status, "an input would be overwritten" in outcome.error) == (2, True)
    assert picture.read_text() == (run / "metrics.json").read_text() == "mine"
    assert not (tmp_path / "mine.json").exists()


def test_a_map_without_a_system_is_an_error_that_says_where_it_gets_one(cli, tmp_path):
    rock = np.zeros((4, 4), bool)
    run = write_map(tmp_path / "run", rock, ~rock, crs=None)
    outcome = cli("evaluate", run, truth_file(tmp_path))
    assert (outcome.status, "the map has no CRS: name it with jaxmap map --crs" in outcome.error) == (1, True)


def test_the_error_map_shows_each_verdict_in_its_place(run, tmp_path):
    from jaxmap.evaluation.options import ScoringOptions
    from jaxmap.runs.evaluation import TruthOptions, evaluate_run

    evaluation, _ = evaluate_run(run, [truth_file(tmp_path)], TruthOptions(), ScoringOptions())
    colours = error_colours(evaluation)
    per_cell = len(colours) // evaluation.cells.shape[0]

    def shown(i: int, j: int) -> tuple[int, ...]:
        return tuple(colours[i * per_cell + per_cell // 2, j * per_cell + per_cell // 2])

    found, imagined, missed, unseen, sand = (shown(*cell) for cell in ((2, 1), (5, 2), (1, 2), (1, 1), (7, 6)))
    assert len({found, imagined, missed, unseen, sand}) == 5
    assert found[1] == max(found) and imagined[0] == max(imagined) and missed[2] == max(missed)


def damaged_map(run: Path) -> None:
    chunk = next(path for path in (run / "map.zarr").rglob("*") if path.is_file() and "c" in path.parts)
    chunk.write_bytes(b"junk")


@pytest.mark.parametrize(
    ("words", "status", "said"),
    [
        (("--class", "bush"), 2, "the map has no class 'bush': its classes are background sand rock"),
        (("--cell-size-m", "0"), 2, "cell_size_m is 0.0"),
        (("--max-range-m", "5"), 1, "--max-range-m needs poses.tum and metrics.json"),
        (("--remap", "5=rock"), 1, "label values without a class"),
        (("--remap", "rock"), 2, "is not CODE=CLASS"),
        (("--remap", "1=sand", "--palette", "p.yaml"), 2, "exclude each other"),
        (("--truth-crs", "EPSG:1"), 1, "unknown coordinate reference system"),
        (("--truth-crs", "EPSG:32632"), 1, "does not lie over the map"),
        (("--backdrop", "nowhere.tif"), 1, "no such file"),
        (("--out", "scores.txt"), 2, "not a .json file"),
        (("--rock-diameters-m", "1", "0", "1"), 2, "--rock-diameters-m is 0.0"),
    ],
)
def test_faults_are_one_line_and_write_nothing(cli, run, tmp_path, words, status, said):
    outcome = cli("evaluate", run, truth_file(tmp_path), *words)
    assert outcome.status == status, outcome
    assert said in outcome.error and ";" in outcome.error
    assert "fault of jaxmap" not in outcome.error
    assert not (run / "scores.json").exists() and not (run / "errors.png").exists()


def test_damaged_inputs_are_one_line(cli, run, tmp_path):
    truth = truth_file(tmp_path)
    assert "no such run folder" in cli("evaluate", tmp_path / "nowhere", truth).error
    assert "no such map" in cli("evaluate", tmp_path, truth).error
    assert "no ground truth" in cli("evaluate", run).error
    assert "several ground truths" in cli("evaluate", run, truth, truth).error
    (tmp_path / "empty").mkdir()
    assert "no ground truth" in cli("evaluate", run, tmp_path / "empty").error
    (run / "metrics.json").write_text("{")
    (run / "poses.tum").write_text("1 2 3")
    assert cli("evaluate", run, truth).status == 0, "the view is reported as unknown"
    damaged_map(run)
    outcome = cli("evaluate", run, truth)
    assert outcome.status == 1 and "damaged" in outcome.error
    truth.write_bytes(truth.read_bytes()[:300])
    assert "not a readable raster" in cli("evaluate", run, truth).error

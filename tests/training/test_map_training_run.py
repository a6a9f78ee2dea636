"""`jaxmap train --supervision map`: what it writes, that it goes on exactly, and what it refuses."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
import scenes
from fixtures import cli, shared_cache  # noqa: F401
from killed import kill_when
from tiny_training import ARCHITECTURE as TINY
from tiny_training import network_is_tiny  # noqa: F401
from truth_files import write_raster

from jaxmap.labels import IGNORE, ROVER_CLASSES
from jaxmap.models.checkpoint import load_network, save_model
from jaxmap.models.deeplab import initial_weights

CONFIG = """\
supervision: map
epochs: 2
batch_size: 2
validate_every: 1
augmentation: {crop_px: [48, 64], scale: [0.5, 0.75]}
optimiser: {learning_rate: 0.005, warmup_steps: 1}
loss: {soft_iou: 1.0, class_weights: balanced}
mapping:
  depth: {max_m: 4.5}
  grid: {voxel_size_m: [0.1, 0.1, 0.2], lower_m: [-2, 0, -0.5], upper_m: [2, 5.2, 1]}
"""
PIXEL_M = 0.05
WEST, NORTH = -3.0, 7.0


def orthomosaic() -> np.ndarray:
    """The scene from above, rows from the north: 1 sand, 2 rock."""
    north = NORTH - (np.arange(200) + 0.5) * PIXEL_M
    east = WEST + (np.arange(120) + 0.5) * PIXEL_M
    labels = np.ones((200, 120), np.uint8)
    for lower, upper in scenes.BOXES_M:
        rows = (north > lower[1]) & (north < upper[1])
        labels[rows[:, None] & ((east > lower[0]) & (east < upper[0]))[None]] = 2
    return labels


def write_truth(path: Path, labels: np.ndarray | None = None, *, west: float = WEST) -> Path:
    return write_raster(path, orthomosaic() if labels is None else labels, west, NORTH, PIXEL_M, crs=None)


@pytest.fixture(scope="module")
def place(tmp_path_factory, network_is_tiny) -> Path:
    """A sequence, its orthomosaic, a network and a configuration; only to be read."""
    folder = tmp_path_factory.mktemp("site")
    scenes.write_folder_sequence(folder / "sequence", 5)
    write_truth(folder / "truth.tif")
    architecture = replace(TINY, classes=ROVER_CLASSES)
    save_model(folder / "first.safetensors", architecture, initial_weights(architecture, jax.random.key(1)))
    (folder / "map.yaml").write_text(CONFIG)
    return folder


def words(place: Path, out: Path, *more: object) -> list[object]:
    given = [*("train", place / "sequence", "--out", out, "--config", place / "map.yaml"), *more]
    for option, name in (("--ground-truth", "truth.tif"), ("--init", "first.safetensors")):
        given += [] if option in more else [option, place / name]
    return given


@pytest.fixture(scope="module")
def finished(place, tmp_path_factory) -> Path:
    """The folder of an uninterrupted run; only to be read."""
    from jaxmap.commands.main import main

    out = tmp_path_factory.mktemp("map_run") / "run"
    assert main([str(word) for word in words(place, out)]) == 0
    return out


def history_of(run: Path) -> list[dict[str, str]]:
    with (run / "history.csv").open() as file:
        return [{k: v for k, v in row.items() if k not in ("seconds", "images_per_s")} for row in csv.DictReader(file)]


def test_a_run_writes_what_a_run_on_images_writes(finished, place):
    written = {path.name for path in finished.iterdir()}
    assert written == {"model.safetensors", "history.csv", "metrics.json", "config.yaml", "report.html", "checkpoints"}
    metrics = json.loads((finished / "metrics.json").read_text())
    assert metrics["complete"] and metrics["images"] == {"train": 4, "validation": 1}
    assert metrics["class_pixels"].keys() == {"sand", "rock"}
    assert metrics["class_pixels"]["sand"]["train"] > metrics["class_pixels"]["rock"]["train"] > 0
    rows = history_of(finished)
    assert [row["epoch"] for row in rows] == ["1", "2"]
    assert {"val_loss", "mean_iou", "iou_sand", "iou_rock"} <= rows[0].keys()
    model = load_network(finished / "model.safetensors")
    before = load_network(place / "first.safetensors")
    assert model.architecture == before.architecture
    moved = [name for name in before.weights if not np.array_equal(model.weights[name], before.weights[name])]
    assert moved and not any(name.endswith((".mean", ".var")) for name in moved)
    page = (finished / "report.html").read_text()
    assert "no image is labelled" in page and "true cells" in page


def test_an_interrupted_run_goes_on_exactly(cli, finished, place, tmp_path, monkeypatch):
    from jaxmap.runs.training import TrainingRun

    def cut(self, epoch, state, meter):
        kept(self, epoch, state, meter)
        if epoch == 1:
            raise KeyboardInterrupt

    kept = TrainingRun._end_epoch
    monkeypatch.setattr(TrainingRun, "_end_epoch", cut)
    run = tmp_path / "run"
    assert cli(*words(place, run)).status != 0
    monkeypatch.setattr(TrainingRun, "_end_epoch", kept)
    assert cli(*words(place, run, "--resume")).status == 0
    assert (run / "model.safetensors").read_bytes() == (finished / "model.safetensors").read_bytes()
    assert history_of(run) == history_of(finished)


SLOWLY = """\
import sys, time
from jaxmap.runs.training import EpochMeter
from tiny_training import main, tiny_network

add = EpochMeter.add
def slowly(*words):
    time.sleep(0.5)
    return add(*words)
EpochMeter.add = slowly
with tiny_network():
    sys.exit(main(sys.argv[1:]))
"""
"""Each step takes a while, so that the process dies in the middle of the run."""


def test_a_killed_process_is_gone_on_with(cli, finished, place, tmp_path):
    run = tmp_path / "run"
    kill_when(lambda: [path for path in run.glob("checkpoints/*") if path.name.isdecimal()], SLOWLY, words(place, run))
    assert len(history_of(run)) < len(history_of(finished))
    assert cli(*words(place, run)).status == 1, "it is not replaced unasked"
    assert cli(*words(place, run, "--resume")).status == 0
    assert (run / "model.safetensors").read_bytes() == (finished / "model.safetensors").read_bytes()
    assert history_of(run) == history_of(finished)
    assert {path.name for path in run.iterdir()} == {path.name for path in finished.iterdir()}, "no leftovers"


def test_the_truth_of_a_pixel_is_that_of_the_cell_it_lies_in(place):
    from jaxmap.runs.map_training import plan_map_training
    from jaxmap.runs.training_plan import TRAIN_SETTINGS

    config = replace(TRAIN_SETTINGS.load(str(place / "map.yaml")), ground_truth=place / "truth.tif")
    plan = plan_map_training(str(place / "sequence"), config, place / "first.safetensors", notify=lambda line: None)
    for index, kept in enumerate(plan.data.train):
        seen = scenes.scene_frame(index)
        known = kept.cells != IGNORE
        assert 0.3 < known.mean() < 1
        # Cells of 0.2 m are coarse beside the boxes, and the disparity is measured.
        assert (kept.cells == seen.labels)[known].mean() > 0.85
        sky = seen.labels == scenes.BACKGROUND
        assert not known[sky].any() or known[sky].mean() < 0.1


FAULTS = {
    "no orthomosaic": (2, ("--ground-truth", "None"), "needs an orthomosaic"),
    "a range of none": (2, ("--augmentation.scale", "2", "1"), "least factor"),
    "a loss of pixels": (2, ("--loss.lovasz", "1"), "are of pixels"),
    "no loss": (2, ("--loss.cross-entropy", "0", "--loss.soft-iou", "0"), "weight of 0"),
    "fixed copies": (2, ("--augmentation.copies", "3"), "is for images"),
    "an ensemble": (2, ("--mapping.ensemble.members", "2"), "mapping.ensemble.members has no effect"),
    "another labeller": (2, ("--mapping.labeller", "plane"), "mapping.labeller has no effect"),
    "labels of others": (2, ("--mapping.labels", "there"), "mapping.labels has no effect"),
    "classes that the network has not": (2, ("--classes", "background", "mud", "rock"), "would be random"),
    "a truth of one known class": (2, ("--map-truth.remap", "1=mud", "2=rock"), "fewer than two classes"),
    "codes without a meaning": (1, ("--map-truth.remap", "1=sand", "3=rock"), "mean nothing"),
    "no such orthomosaic": (1, ("--ground-truth", "gone.tif"), "no such file"),
    "codes that are told": (1, ("--map-truth.remap", "1=sand", "3=rock"), "name them all (--map-truth.remap "),
    "a truth of another system": (
        1,
        ("--mapping.crs", "EPSG:32631", "--map-truth.crs", "EPSG:32633"),
        "does not lie over the map",
    ),
    "no depth": (2, ("--mapping.depth.min-m", "9"), "set --mapping.depth.max-m"),
    "too large a map": (
        1,
        ("--mapping.grid.max-memory-gib", "1e-5"),
        "or raise --mapping.grid.max-memory-gib",
    ),
    "no poses": (1, ("--mapping.poses", "gone.tum"), "there is no file gone.tum"),
    "no frame to teach": (1, ("--data.validation-share", "0.95"), "held out"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_what_does_not_serve_is_refused_in_one_line(name, cli, place, tmp_path):
    status, more, told = FAULTS[name]
    outcome = cli(*words(place, tmp_path / "run", *more))
    assert (outcome.status, told in outcome.error) == (status, True), outcome.error


@pytest.mark.parametrize(
    ("change", "west", "told"),
    [
        (lambda labels: np.ones_like(labels), WEST, "one class teaches nothing"),
        (lambda labels: np.zeros_like(labels), WEST, "no cell of the map is labelled"),
        (lambda labels: labels, 500.0, "does not lie over the map"),
        # A strip behind the first camera, which no frame sees.
        (lambda labels: np.where(np.arange(200)[:, None] > 125, labels, 0), WEST, "no cell that the frames see"),
    ],
    ids=["one class", "nothing labelled", "elsewhere", "not seen"],
)
def test_an_orthomosaic_that_teaches_nothing_is_refused(change, west, told, cli, place, tmp_path):
    truth = write_truth(tmp_path / "other.tif", change(orthomosaic()), west=west)
    outcome = cli(*words(place, tmp_path / "run", "--ground-truth", truth))
    assert (outcome.status, told in outcome.error) == (1, True), outcome.error
    assert not (tmp_path / "run" / "model.safetensors").exists()


def test_an_orthomosaic_without_map_supervision_is_refused(cli, place, tmp_path):
    outcome = cli(*words(place, tmp_path / "run", "--supervision", "pixels"))
    assert outcome.status == 2 and "pixels supervise" in outcome.error

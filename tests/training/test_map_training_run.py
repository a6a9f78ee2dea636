"""Map supervision: what a run writes, that it is resumed exactly, and what is refused."""

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

from jaxmap.errors import JaxmapError
from jaxmap.labels import IGNORE, ROVER_CLASSES
from jaxmap.models.checkpoint import load_network, save_model
from jaxmap.models.network import initial_weights
from jaxmap.runs.map_training import plan_map_training
from jaxmap.runs.training import TrainingFolder, TrainingRun
from jaxmap.runs.training_plan import TRAIN_SETTINGS, TrainConfig, TrainingPlan

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


def config_of(place: Path, **changes: object) -> TrainConfig:
    """The configuration, with changes by key, in which __ stands for the dot."""
    config = replace(TRAIN_SETTINGS.load(str(place / "map.yaml")), ground_truth=place / "truth.tif")
    for key, value in changes.items():
        section, _, name = key.partition("__")
        if "__" in name:
            inner, _, name = name.partition("__")
            part = getattr(config, section)
            value = replace(part, **{inner: replace(getattr(part, inner), **{name: value})})
        elif name:
            value = replace(getattr(config, section), **{name: value})
        config = replace(config, **{section: value})
    return config


def planned(place: Path, config: TrainConfig) -> TrainingPlan:
    return plan_map_training(str(place / "sequence"), config, place / "first.safetensors", notify=lambda line: None)


@pytest.fixture(scope="module")
def plan(place, shared_cache) -> TrainingPlan:
    """The plan of all runs, whose step is compiled once."""
    return planned(place, config_of(place))


def go(plan: TrainingPlan, out: Path, *, resume: bool = False) -> None:
    out.mkdir(exist_ok=True)
    folder = TrainingFolder(out)
    folder.begin(plan, resume=resume, overwrite=False)
    TrainingRun(plan, folder, notify=lambda line: None).run()


@pytest.fixture(scope="module")
def finished(plan, tmp_path_factory) -> Path:
    """The folder of an uninterrupted run; only to be read."""
    out = tmp_path_factory.mktemp("map_run") / "run"
    go(plan, out)
    return out


def history_of(run: Path) -> list[dict[str, str]]:
    with (run / "history.csv").open() as file:
        return [{k: v for k, v in row.items() if k not in ("seconds", "images_per_s")} for row in csv.DictReader(file)]


@pytest.mark.slow
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


@pytest.mark.slow
def test_an_interrupted_run_is_resumed_exactly(plan, finished, tmp_path, monkeypatch):
    def cut(self, epoch, state, meter):
        whole(self, epoch, state, meter)
        if epoch == 1:
            raise KeyboardInterrupt

    run, whole = tmp_path / "run", TrainingRun._end_epoch
    with monkeypatch.context() as patched:
        patched.setattr(TrainingRun, "_end_epoch", cut)
        with pytest.raises(KeyboardInterrupt):
            go(plan, run)
    go(plan, run, resume=True)
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


@pytest.mark.slow
def test_a_killed_process_is_resumed(cli, finished, place, tmp_path):
    run = tmp_path / "run"
    kill_when(lambda: [path for path in run.glob("checkpoints/*") if path.name.isdecimal()], SLOWLY, words(place, run))
    assert len(history_of(run)) < len(history_of(finished))
    assert cli(*words(place, run)).status == 1, "it is not replaced unasked"
    assert cli(*words(place, run, "--resume")).status == 0
    assert (run / "model.safetensors").read_bytes() == (finished / "model.safetensors").read_bytes()
    assert history_of(run) == history_of(finished)
    assert {path.name for path in run.iterdir()} == {path.name for path in finished.iterdir()}, "no leftovers"


def test_the_truth_of_a_pixel_is_that_of_the_cell_it_lies_in(plan):
    for index, kept in enumerate(plan.data.train):
        seen = scenes.scene_frame(index)
        known = kept.cells != IGNORE
        assert 0.3 < known.mean() < 1
        # Cells of 0.2 m are coarse beside the boxes, and the disparity is measured.
        assert (kept.cells == seen.labels)[known].mean() > 0.85
        sky = seen.labels == scenes.BACKGROUND
        assert not known[sky].any() or known[sky].mean() < 0.1


FAULTS = {
    "no orthomosaic": (2, dict(ground_truth=None), "needs an orthomosaic"),
    "a loss of pixels": (2, dict(loss__lovasz=1), "are of pixels"),
    "fixed copies": (2, dict(augmentation__copies=3), "is for images"),
    "an ensemble": (2, dict(mapping__ensemble__members=2), "mapping.ensemble.members has no effect"),
    "another labeller": (2, dict(mapping__labeller="plane"), "mapping.labeller has no effect"),
    "labels of others": (2, dict(mapping__labels=Path("there")), "mapping.labels has no effect"),
    "classes that the network has not": (2, dict(classes=("background", "mud", "rock")), "would be random"),
    "a truth of one known class": (2, dict(map_truth__remap=("1=mud", "2=rock")), "fewer than two classes"),
    "no such orthomosaic": (1, dict(ground_truth=Path("gone.tif")), "no such file"),
    "codes without a meaning": (
        1,
        dict(map_truth__remap=("1=sand", "3=rock")),
        "jaxmap evaluate (options below map_truth): label values without a class",
    ),
    "a truth of another system": (
        1,
        dict(mapping__crs="EPSG:32631", map_truth__crs="EPSG:32633"),
        "does not lie over the map",
    ),
    "too large a map": (
        1,
        dict(mapping__grid__max_memory_gib=1e-5),
        "jaxmap map (options below mapping): ",
    ),
    "no poses": (1, dict(mapping__poses=Path("gone.tum")), "there is no file gone.tum"),
    "no frame to train on": (1, dict(data__validation_share=0.95), "held out"),
}


def fault_of(place: Path, config: TrainConfig) -> tuple[int, str]:
    with pytest.raises(JaxmapError) as caught:
        planned(place, config)
    return caught.value.exit_code, str(caught.value)


@pytest.mark.parametrize("name", FAULTS)
def test_unusable_settings_are_refused(name, place):
    status, changes, part = FAULTS[name]
    found = fault_of(place, config_of(place, **changes))
    assert (found[0], part in found[1]) == (status, True), found


@pytest.mark.parametrize(
    ("change", "west", "part"),
    [
        (lambda labels: np.ones_like(labels), WEST, "one class teaches nothing"),
        (lambda labels: np.zeros_like(labels), WEST, "no cell of the map is labelled"),
        (lambda labels: labels, 500.0, "does not lie over the map"),
        # A strip behind the first camera, which no frame sees.
        (lambda labels: np.where(np.arange(200)[:, None] > 125, labels, 0), WEST, "no cell that the frames see"),
    ],
    ids=["one class", "nothing labelled", "elsewhere", "not seen"],
)
def test_an_orthomosaic_without_information_is_refused(change, west, part, place, tmp_path):
    truth = write_truth(tmp_path / "other.tif", change(orthomosaic()), west=west)
    found = fault_of(place, config_of(place, ground_truth=truth))
    assert (found[0], part in found[1]) == (1, True), found


def test_the_command_plans_by_supervision_and_its_errors_name_options_that_exist(cli, place, tmp_path):
    outcome = cli(*words(place, tmp_path / "run", "--mapping.depth.min-m", "9"))
    assert outcome.status == 2 and "jaxmap map (options below mapping): " in outcome.error
    assert "set --depth.max-m" in outcome.error
    outcome = cli(*words(place, tmp_path / "run", "--supervision", "pixels"))
    assert outcome.status == 2 and "pixels supervise" in outcome.error
    outcome = cli(*words(place, tmp_path / "run", "--mapping.grid.voxel-size-m", "-1"))
    assert outcome.status == 2 and "voxel_size_m is -1.0" in outcome.error
    assert not (tmp_path / "run" / "model.safetensors").exists()


@pytest.mark.slow
def test_observations_give_the_frames_of_their_sequence(cli, place, plan, tmp_path):
    seen = tmp_path / "seen"
    assert cli("perceive", place / "sequence", "--out", seen, "--labeller", "none").status == 0
    config, first = config_of(place), place / "first.safetensors"
    again = plan_map_training(str(seen), config, first, notify=lambda line: None)
    assert again.data.digest() == plan.data.digest()
    for one, other in zip(again.data.train, plan.data.train, strict=True):
        assert one.name == other.name
        jax.tree.map(np.testing.assert_array_equal, (one.frame, one.anchors), (other.frame, other.anchors))
    attributes = json.loads((seen / "observations.zarr" / "zarr.json").read_text())
    attributes["attributes"]["sequence"] = str(tmp_path / "gone")
    (seen / "observations.zarr" / "zarr.json").write_text(json.dumps(attributes))
    with pytest.raises(JaxmapError, match="there is no folder .*gone"):
        plan_map_training(str(seen), config, first, notify=lambda line: None)

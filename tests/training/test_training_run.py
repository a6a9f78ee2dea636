"""Training runs: what they write, and that interrupted, refused or spoilt ones lose nothing."""

from __future__ import annotations

import csv
import ctypes
import json
import math
import os
import shutil
import signal
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
from fixtures import cli, shared_cache  # noqa: F401
from killed import kill_when
from tiny_training import (  # noqa: F401
    CONFIG,
    EPOCHS,
    STEPS,
    contents,
    network_is_tiny,
    tiny_data,
    train_words,
    whole_run,
)
from training_data import CLASSES, change_mask, scene, write_pair

from jaxmap.errors import JaxmapError, UsageError
from jaxmap.models.checkpoint import load_network
from jaxmap.runs import training
from jaxmap.runs.training import EpochMeter, TrainingFolder, TrainingRun
from jaxmap.runs.training_plan import TRAIN_SETTINGS, TrainingPlan, plan_image_training
from jaxmap.training.checkpoints import Checkpoints
from jaxmap.training.options import DataOptions
from jaxmap.training.step import StepMetrics, TrainState

OUTPUTS = {"model.safetensors", "history.csv", "metrics.json", "config.yaml", "report.html", "checkpoints"}
TIMES = ("seconds", "images_per_s")
MS_REMOUNT, MNT_DETACH = 32, 2


class Cut(Exception):
    """Stands for whatever ends a run early."""


def history_of(run: Path) -> list[dict[str, str]]:
    with (run / "history.csv").open() as file:
        return list(csv.DictReader(file))


def metrics_of(run: Path) -> dict:
    return json.loads((run / "metrics.json").read_text())


def saved_steps(run: Path) -> list[int]:
    folder = run / "checkpoints"
    return sorted(int(path.name) for path in folder.iterdir() if path.name.isdecimal()) if folder.is_dir() else []


def assert_same_run(run: Path, whole: Path) -> None:
    """Everything is bit-identical, apart from the times."""
    assert (run / "model.safetensors").read_bytes() == (whole / "model.safetensors").read_bytes()
    ours, expected = ([{k: v for k, v in row.items() if k not in TIMES} for row in history_of(f)] for f in (run, whole))
    assert ours == expected
    ours, expected = ({k: v for k, v in metrics_of(folder).items() if k not in TIMES} for folder in (run, whole))
    assert ours == expected
    assert saved_steps(run) == saved_steps(whole)


def planned(folder: Path, init: Path | None = None, **changes: object) -> TrainingPlan:
    config = replace(TRAIN_SETTINGS.load(str(folder / "tiny.yaml")), **changes)
    return plan_image_training(folder, config, init, notify=lambda line: None)


@pytest.fixture(scope="module")
def plan(tiny_data, shared_cache, network_is_tiny) -> TrainingPlan:
    """The plan of the whole run, whose step is compiled once for all that take it."""
    return planned(tiny_data)


@pytest.fixture(autouse=True)
def page_is_bare(monkeypatch):
    """Pages take longer than tiny runs; that of `whole_run`, which is made before, is a real one."""
    monkeypatch.setattr(training, "training_page", lambda record: f"{record.title}: {record.status}")


@pytest.fixture
def data_copy(tiny_data, tmp_path) -> Path:
    """A copy of the data, to be changed."""
    return Path(shutil.copytree(tiny_data, tmp_path / "data"))


@pytest.fixture
def run_copy(whole_run, tmp_path) -> Path:
    """A copy of the whole run, to be changed."""
    return Path(shutil.copytree(whole_run, tmp_path / "run"))


def nothing(steps: int, note: str) -> None:
    """Is done on a step."""


def go(
    plan: TrainingPlan,
    out: Path,
    on_step: Callable[[int, str], None] = nothing,
    *,
    resume: bool = False,
    overwrite: bool = False,
) -> list[str]:
    """Trains into `out`, as the command does; returns the lines for the user."""
    out.mkdir(exist_ok=True)
    lines: list[str] = []
    with TrainingFolder(out).writing(plan, resume=resume, overwrite=overwrite) as work:
        TrainingRun(plan, work, notify=lines.append, on_step=on_step).run()
    return lines


def refused(plan: TrainingPlan, out: Path, kind: type[JaxmapError] = JaxmapError, **options: bool) -> str:
    """The error of a run that may not begin or resume, which changes nothing."""
    before = contents(out)
    with pytest.raises(JaxmapError) as caught:
        go(plan, out, **options)
    assert type(caught.value) is kind and contents(out) == before
    return str(caught.value)


def run_until(plan: TrainingPlan, out: Path, step: int, **options: bool) -> None:
    """Trains until a step is done, and is cut off before an epoch that ends with it is saved."""

    def on_step(steps: int, note: str) -> None:
        if steps == step:
            raise Cut

    with pytest.raises(Cut):
        go(plan, out, on_step, **options)


# --- the whole run


def test_a_run_writes_what_it_says(whole_run):
    assert {path.name for path in whole_run.iterdir()} == OUTPUTS
    network = load_network(whole_run / "model.safetensors")
    assert network.architecture.classes == CLASSES
    metrics = metrics_of(whole_run)
    assert metrics["complete"] and metrics["epochs"] == EPOCHS and metrics["steps"] == STEPS
    assert metrics["examples_seen"] == 2 * STEPS and metrics["images"] == {"train": 5, "validation": 2}
    assert metrics["class_pixels"]["rock"]["train"] > 0
    assert metrics["kept_epoch"] == metrics["best"]["epoch"]
    assert TRAIN_SETTINGS.load(str(whole_run / "config.yaml")).batch_size == 2


def test_the_history_is_complete(whole_run):
    history = history_of(whole_run)
    assert [int(row["epoch"]) for row in history] == [1, 2, 3]
    assert [int(row["step"]) for row in history] == [3, 5, 8]
    for row in history:
        assert all(math.isfinite(float(row[name])) for name in ("learning_rate", "train_loss", *TIMES))
        assert 0 <= float(row["train_accuracy"]) <= 1
    # Every second epoch, and the last.
    assert [row["mean_iou"] != "" for row in history] == [False, True, True]
    assert all(0 <= float(row[f"iou_{name}"]) <= 1 for row in history[1:] for name in CLASSES)
    assert float(history[-1]["val_loss"]) > 0


def test_the_page_shows_the_run(whole_run):
    page = (whole_run / "report.html").read_text()
    assert page.lower().startswith("<!doctype html>")
    assert "tiny_data" in page and "Initial weights" in page and "data:image" in page
    assert "Stopped" not in page and "Interrupted" not in page


def test_the_scores_are_those_of_the_model_that_was_kept(cli, whole_run, tiny_data, tmp_path):
    images = [tiny_data / "images" / f"{name}.png" for name in ("i1", "i3")]
    words = ("--model", whole_run / "model.safetensors", "--masks", tiny_data / "masks")
    outcome = cli("segment", *images, *words, "--out", tmp_path / "out", "--scores", tmp_path / "scores.json")
    assert outcome.status == 0, outcome.err
    scores, best = json.loads((tmp_path / "scores.json").read_text()), metrics_of(whole_run)["best"]
    assert scores["confusion"] == best["confusion"]


@pytest.mark.slow
def test_no_time_is_counted_twice(plan, tmp_path):
    started_s = time.perf_counter()
    go(plan, tmp_path / "run")
    passed_s = time.perf_counter() - started_s
    spent_s = [float(row["seconds"]) for row in history_of(tmp_path / "run")]
    assert 0 < sum(spent_s) <= passed_s + 0.01
    assert metrics_of(tmp_path / "run")["seconds"] == pytest.approx(sum(spent_s), abs=0.1)


# --- interrupted and resumed


@pytest.mark.slow
@pytest.mark.parametrize("step", [1, 4, STEPS])
def test_a_cut_run_ends_as_if_it_had_not_been_cut(step, plan, whole_run, tmp_path):
    run = tmp_path / "run"
    run_until(plan, run, step)
    assert saved_steps(run) == {1: [], 4: [3], STEPS: [3, 5]}[step]
    lines = go(plan, run, resume=True)
    assert (f"resuming after epoch 1 of {EPOCHS}" in lines) == (step == 4)
    assert_same_run(run, whole_run)


@pytest.mark.slow
def test_a_run_may_be_cut_again_and_again(plan, whole_run, tmp_path):
    run_until(plan, tmp_path / "run", 4)
    run_until(plan, tmp_path / "run", 6, resume=True)
    run_until(plan, tmp_path / "run", 8, resume=True)
    go(plan, tmp_path / "run", resume=True)
    assert_same_run(tmp_path / "run", whole_run)


SLOWLY = """
import sys, time
from jaxmap.runs.training import EpochMeter
from tiny_training import main, tiny_network

add = EpochMeter.add
def slowly(*words):
    time.sleep(0.3)
    return add(*words)
EpochMeter.add = slowly
with tiny_network():
    sys.exit(main(sys.argv[1:]))
"""
"""Each step takes a while, so that the process dies in the middle of the run."""


@pytest.mark.slow
def test_a_killed_process_is_resumed(plan, tiny_data, whole_run, tmp_path):
    run = tmp_path / "run"
    kill_when(lambda: saved_steps(run), SLOWLY, train_words(tiny_data, run))
    assert saved_steps(run)[-1] < STEPS
    go(plan, run, resume=True)
    assert_same_run(run, whole_run)
    assert {path.name for path in run.iterdir()} == OUTPUTS, "no leftovers"
    assert all(path.name.isdecimal() for path in (run / "checkpoints").iterdir())


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)])
def test_an_interrupt_is_one_line_and_says_how_to_resume(
    number, cli, plan, tiny_data, whole_run, tmp_path, monkeypatch
):
    steps, add = [], EpochMeter.add

    def interrupted(self: EpochMeter, step: StepMetrics, images: int) -> str:
        steps.append(step)
        if len(steps) == 5:
            os.kill(os.getpid(), number)
        return add(self, step, images)

    run = tmp_path / "run"
    # A shell in the background starts its children with interrupts ignored.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with monkeypatch.context() as patched:
            patched.setattr(EpochMeter, "add", interrupted)
            outcome = cli(*train_words(tiny_data, run))
    finally:
        signal.signal(signal.SIGINT, before)
    assert outcome.status == 130 and outcome.error == "interrupted"
    assert "interrupted in epoch 2 of 3, which --resume begins again" in outcome.err
    assert "Interrupted in epoch 2 of 3." in (run / "report.html").read_text()
    assert [row["epoch"] for row in history_of(run)] == ["1"]
    go(plan, run, resume=True)
    assert_same_run(run, whole_run)
    assert "Interrupted" not in (run / "report.html").read_text()


def test_a_complete_run_has_nothing_left_to_do(cli, tiny_data, run_copy):
    before = contents(run_copy)
    outcome = cli(*train_words(tiny_data, run_copy, "--resume"))
    assert outcome.status == 0 and "the run is complete; nothing is left to do" in outcome.err
    assert contents(run_copy) == before


def test_resuming_in_an_empty_folder_starts(plan, whole_run, tmp_path):
    (tmp_path / "run").mkdir()
    go(plan, tmp_path / "run", resume=True)
    assert_same_run(tmp_path / "run", whole_run)


# --- refused


def test_other_settings_are_refused_by_name(plan, run_copy):
    config = plan.config
    for changed, named in (
        (replace(config, epochs=4), "epochs"),
        (
            replace(config, seed=1, optimiser=replace(config.optimiser, learning_rate=0.01)),
            "optimiser.learning_rate, seed",
        ),
        (replace(config, augmentation=replace(config.augmentation, mirror=False)), "augmentation.mirror"),
    ):
        error = refused(plan._replace(config=changed), run_copy, UsageError, resume=True)
        assert f"begun with another {named} " in error


def test_other_data_are_refused(data_copy, tiny_data, run_copy):
    settings = run_copy / "config.yaml"
    settings.write_text(settings.read_text().replace(str(tiny_data), str(data_copy)))
    go(planned(data_copy), run_copy, resume=True)  # The same data in another place.
    change_mask(data_copy, "i2", lambda mask: np.where(mask == 1, 1, 0).astype(np.uint8))
    assert "the training data have changed" in refused(planned(data_copy), run_copy, resume=True)


def test_a_run_is_replaced_only_where_that_is_asked_for(plan, whole_run, run_copy):
    (run_copy / "mine.txt").write_text("not the run's")
    (run_copy / "checkpoints" / "7").mkdir()
    error = refused(plan, run_copy)
    assert "--resume" in error and "--overwrite" in error
    go(plan, run_copy, overwrite=True)
    assert_same_run(run_copy, whole_run)
    assert (run_copy / "mine.txt").read_text() == "not the run's"


def test_a_run_that_has_lost_its_checkpoints_keeps_its_model(plan, run_copy):
    """They are large, and a finished run is a run without them, too."""
    shutil.rmtree(run_copy / "checkpoints")
    assert "--overwrite" in refused(plan, run_copy)
    error = refused(plan, run_copy, resume=True)
    assert "--overwrite" in error and "lost its checkpoints" in error


@pytest.mark.parametrize("options", [{}, {"overwrite": True}, {"resume": True}])
def test_files_that_no_training_has_written_are_never_replaced(options, plan, tmp_path):
    """A folder of another trainer's: it has settings and checkpoints as well."""
    run = tmp_path / "run"
    (run / "checkpoints").mkdir(parents=True)
    (run / "checkpoints" / "epoch7.pt").write_text("another's")
    (run / "config.yaml").write_text("model: unet\n")
    assert "config.yaml, checkpoints would be replaced" in refused(plan, run, **options)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "history.csv").write_text("another's")
    assert "history.csv would be replaced" in refused(plan, tmp_path / "other", **options)


def test_the_model_started_from_is_not_overwritten(plan, run_copy):
    changed = plan._replace(init=run_copy / "model.safetensors")
    assert "an input would be overwritten" in refused(changed, run_copy, UsageError, overwrite=True)


def test_a_run_that_is_replaced_stays_until_the_new_one_is_whole(plan, whole_run, run_copy):
    (run_copy / "report.html").write_text("of the earlier run")
    before = contents(run_copy)
    run_until(plan, run_copy, 2, overwrite=True)
    assert contents(run_copy) == before, "before the first checkpoint there is nothing to resume"
    run_until(plan, run_copy, 5, overwrite=True)
    assert before.items() <= contents(run_copy).items()
    assert refused(plan._replace(config=replace(plan.config, seed=1)), run_copy, UsageError, resume=True)
    lines = go(plan, run_copy, resume=True)
    assert lines[0].startswith("resuming after epoch")
    assert_same_run(run_copy, whole_run)
    assert not (run_copy / ".new").exists()


# --- other data and other initial weights


def test_a_run_starts_from_a_model(tiny_data, whole_run):
    plan = planned(tiny_data, whole_run / "model.safetensors")
    assert plan.network.fresh == () and plan.network.batch_norms == ()
    validator, best = plan.data.validator(plan.network.architecture), metrics_of(whole_run)["best"]
    assert validator is not None
    assert validator.score(plan.network.weights).summary["confusion"] == best["confusion"]


def test_masks_of_validation_that_hold_nothing(plan, data_copy, tmp_path):
    """Nothing can be scored: the last weights are kept."""
    for name in ("i1", "i3"):
        change_mask(data_copy, name, lambda mask: np.full_like(mask, 255))
    go(plan._replace(data=planned(data_copy).data), tmp_path / "run")
    metrics = metrics_of(tmp_path / "run")
    assert metrics["kept_epoch"] == 3 and metrics["best"]["mean_iou"] is None


def test_no_validation_at_all(plan, data_copy, tmp_path):
    for name in ("i1", "i3"):
        (data_copy / "images" / f"{name}.png").unlink()
        (data_copy / "masks" / f"{name}.png").unlink()
    (data_copy / "val.txt").unlink()
    write_pair(data_copy, "i2", *scene((36, 44), 2))
    data = planned(data_copy, data=DataOptions(validation_share=0)).data
    assert len(data.names) == len(plan.data.names), "the order is the same"
    go(plan._replace(data=data), tmp_path / "run")
    load_network(tmp_path / "run" / "model.safetensors")
    assert metrics_of(tmp_path / "run")["kept_epoch"] is None


@pytest.mark.slow
def test_fewer_examples_than_a_batch_holds(plan, data_copy, tmp_path):
    """Several epochs end in one step; each has its row, and the run is complete."""
    write_pair(data_copy, "only", *scene((40, 44), 0))
    (data_copy / "train.txt").write_text("only\n")
    other = planned(data_copy, epochs=16, validate_every=16)
    assert other.order.steps == plan.order.steps, "the schedule is the same"
    plan = other._replace(trainer=plan.trainer)
    go(plan, tmp_path / "run")
    history = history_of(tmp_path / "run")
    assert [int(row["step"]) for row in history] == [step for step in range(1, 9) for _ in range(2)]
    assert all(float(row["train_loss"]) > 0 for row in history)
    assert go(plan, tmp_path / "run", resume=True)[-1] == "the run is complete; nothing is left to do"


# --- what is not finite


def test_a_loss_that_is_not_finite_stops_the_run_and_names_its_images(plan, whole_run, tmp_path):
    trained = plan.trainer.step

    def spoilt(state: TrainState, batch: object, key: jax.Array) -> tuple[TrainState, StepMetrics]:
        if int(state.step) != 6:
            return trained(state, batch, key)
        weights = {**state.weights, "classifier.bias": state.weights["classifier.bias"] * np.nan}
        return trained(TrainState(weights, state.average, state.optimiser, state.step), batch, key)

    run = tmp_path / "run"
    with pytest.raises(JaxmapError) as caught:
        go(plan._replace(trainer=plan.trainer._replace(step=spoilt)), run)
    images = {plan.data.names[index] for index in plan.order.draws(6)[:, 1]}
    assert "loss nan" in caught.value.what and "step 7, epoch 3" in caught.value.what
    assert all(name in caught.value.what for name in images)
    assert "optimiser.learning-rate" in caught.value.fix
    assert saved_steps(run) == [3, 5]
    load_network(run / "model.safetensors")
    assert [row["epoch"] for row in history_of(run)] == ["1", "2"]
    assert "Stopped: loss nan" in (run / "report.html").read_text()
    assert not metrics_of(run)["complete"]
    # What was kept is good: the run can resume from there.
    go(plan, run, resume=True)
    assert_same_run(run, whole_run)


@pytest.mark.slow
def test_a_rate_far_too_high_is_one_line(cli, tiny_data, tmp_path):
    words = ("--optimiser.learning-rate", "1e6", "--norm.head", "frozen", "--norm.backbone", "frozen")
    outcome = cli(*train_words(tiny_data, tmp_path / "run", *words, "--validate-every", "1"))
    assert outcome.status == 1
    assert "finite" in outcome.error or "loss " in outcome.error
    assert "fault of jaxmap" not in outcome.error and "learning-rate" in outcome.error
    assert "Stopped: " in (tmp_path / "run" / "report.html").read_text()


def test_an_output_that_is_not_finite_in_validation_is_reported(plan, tmp_path):
    """Weights may be finite and still run over on an image that was not trained on."""
    trained = plan.trainer.step

    def spoilt(state: TrainState, batch: object, key: jax.Array) -> tuple[TrainState, StepMetrics]:
        after, info = trained(state, batch, key)
        if int(after.step) != plan.order.epoch_end(min(plan.config.validate_every, plan.config.epochs) - 1):
            return after, info
        weights = {**after.weights, "classifier.kernel": after.weights["classifier.kernel"] * 1e38 * 1e3}
        return TrainState(weights, after.average, after.optimiser, after.step), info

    with pytest.raises(JaxmapError, match="validation image is not finite"):
        go(plan._replace(trainer=plan.trainer._replace(step=spoilt)), tmp_path / "run")


# --- damaged and full


def halve(folder: Path) -> None:
    """Cuts every file in half."""
    for path in folder.rglob("*"):
        if path.is_file():
            path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def test_a_damaged_checkpoint_gives_way_to_the_one_before(plan, whole_run, run_copy):
    halve(run_copy / "checkpoints" / str(STEPS))
    assert f"resuming after epoch 2 of {EPOCHS}" in go(plan, run_copy, resume=True)
    assert_same_run(run_copy, whole_run)
    # The damaged one has been replaced.
    assert go(plan, run_copy, resume=True)[-1] == "the run is complete; nothing is left to do"


@pytest.mark.slow
@pytest.mark.parametrize("fate", ["gone", "halved", "empty", "junk"])
def test_no_damage_to_a_file_of_a_checkpoint_goes_unnoticed(fate, plan, whole_run, tmp_path):
    """The checkpoint before is read instead, or the very same values."""
    like = plan.trainer.init(plan.network.weights)
    newest = whole_run / "checkpoints" / str(STEPS)
    whole = Checkpoints(whole_run / "checkpoints").restore(like)
    assert whole is not None and int(whole.state.step) == STEPS
    expected = jax.tree.leaves(whole.state)
    for index, path in enumerate(sorted(path for path in newest.rglob("*") if path.is_file())):
        copy = Path(shutil.copytree(whole_run / "checkpoints", tmp_path / str(index)))
        victim = copy / str(STEPS) / path.relative_to(newest)
        held = victim.read_bytes()
        if fate == "gone":
            victim.unlink()
        else:
            junk = held[: len(held) // 2] + bytes(byte ^ 0xFF for byte in held[len(held) // 2 :])
            victim.write_bytes({"halved": held[: len(held) // 2], "empty": b"", "junk": junk}[fate])
        found = Checkpoints(copy).restore(like)
        assert found is not None, path
        if int(found.state.step) == STEPS:
            assert all(np.array_equal(*pair) for pair in zip(jax.tree.leaves(found.state), expected, strict=True)), path
            assert found.record == whole.record, path
        else:
            assert int(found.state.step) == 5, path


def test_where_all_are_damaged_it_is_reported(plan, run_copy):
    halve(run_copy / "checkpoints")
    error = refused(plan, run_copy, resume=True)
    assert "no checkpoint can be read" in error and "--overwrite" in error and len(error) < 400


def test_checkpoints_of_another_version_are_refused(plan, tmp_path):
    run_until(plan, tmp_path / "run", 4)
    record = next((tmp_path / "run" / "checkpoints").rglob("record/*"))
    tree = json.loads(record.read_text())
    record.write_text(json.dumps({**tree, "colour": "blue"}))
    with pytest.raises(JaxmapError, match="another version"):
        go(plan, tmp_path / "run", resume=True)


class SmallDisk:
    """A disk in memory; its size can be changed."""

    def __init__(self, folder: Path) -> None:
        self.folder, self._libc = folder, ctypes.CDLL(None, use_errno=True)
        self.folder.mkdir()

    def mount(self, kibibytes: int, flags: int = 0) -> bool:
        name, size = b"tmpfs", f"size={kibibytes}k".encode()
        return self._libc.mount(name, os.fsencode(self.folder), name, flags, size) == 0

    def unmount(self) -> None:
        self._libc.umount2(os.fsencode(self.folder), MNT_DETACH)


@pytest.fixture
def small_disk(tmp_path):
    disk = SmallDisk(tmp_path / "disk")
    if not hasattr(disk._libc, "umount2") or not disk.mount(64):
        pytest.skip("only root can mount a small disk")
    yield disk
    disk.unmount()


@pytest.mark.slow
@pytest.mark.parametrize("share", [pytest.param(0.2, marks=pytest.mark.slow), 0.5])
def test_a_full_disk_is_one_line_and_the_run_is_resumed_after_it(share, plan, whole_run, small_disk):
    needed = sum(path.stat().st_blocks for path in whole_run.rglob("*")) // 2
    small_disk.mount(int(share * needed), MS_REMOUNT)
    run = small_disk.folder / "run"
    with pytest.raises(JaxmapError) as caught:
        go(plan, run)
    assert "disk full" in caught.value.what or "could not be written" in caught.value.what
    assert caught.value.fix and len(str(caught.value)) < 400
    if (run / "model.safetensors").exists():
        load_network(run / "model.safetensors")
    if (run / "metrics.json").exists():
        assert not metrics_of(run)["complete"]
    small_disk.mount(20 * needed, MS_REMOUNT)
    go(plan, run, resume=True)
    assert_same_run(run, whole_run)

"""A training run: steps, validations, checkpoints."""

from __future__ import annotations

import csv
import io
import math
import shutil
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jaxmap.errors import JaxmapError
from jaxmap.host.files import atomic_path
from jaxmap.host.output_folder import check_same_settings, write_json, write_yaml
from jaxmap.models.checkpoint import save_model
from jaxmap.models.deeplab import Weights
from jaxmap.report.training_page import TrainingRecord, training_page
from jaxmap.runs.training_plan import TrainingPlan, train_config_tree
from jaxmap.training.checkpoints import Checkpoints
from jaxmap.training.step import StepInfo, TrainState
from jaxmap.training.validation import Shown, Validation


@dataclass
class TrainingLog:
    """What a run has done so far; saved with every checkpoint, so that a resumed run goes on counting.

    Attributes:
        history: one row for each complete epoch.
        best: epoch, mean IoU and scores of the best validation.
        last: the same of the last one.
        seconds: time spent on steps and validations.
        digest: of the training data.
        complete: whether the run has come to its end.
    """

    history: list[dict[str, Any]] = field(default_factory=list)
    best: dict[str, Any] = field(default_factory=dict)
    last: dict[str, Any] = field(default_factory=dict)
    seconds: float = 0.0
    digest: str = ""
    complete: bool = False

    def kept(self, keep: str) -> dict[str, Any]:
        """The validation of the weights that were written; empty where none was."""
        return self.last if keep == "last" else self.best

    def history_csv(self) -> str:
        """The history as text; what an epoch has not is left empty."""
        columns = list(dict.fromkeys(key for row in self.history for key in row))
        text = io.StringIO()
        writer = csv.DictWriter(text, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(self.history)
        return text.getvalue()


class Meter:
    """Means over the steps of an epoch."""

    def __init__(self) -> None:
        self._started_s, self._infos, self._images = time.perf_counter(), [], 0
        self._lap_s = self._started_s

    def add(self, info: StepInfo, images: int) -> str:
        """Takes note of a step; returns a line on how it goes."""
        self._infos.append(info)
        self._images += images
        rate = self._images / max(self.seconds, 1e-9)
        return f"loss {float(info.loss):.3f}, accuracy {float(info.accuracy):.1%}, {rate:.1f} images/s"

    @property
    def seconds(self) -> float:
        """Since the epoch began."""
        return time.perf_counter() - self._started_s

    def lap_s(self) -> float:
        """Seconds since the last call, or since the epoch began."""
        before, self._lap_s = self._lap_s, time.perf_counter()
        return round(self._lap_s - before, 3)

    def means(self) -> dict[str, float]:
        """Of the epoch."""
        count = max(len(self._infos), 1)
        return {
            "learning_rate": float(self._infos[-1].learning_rate) if self._infos else 0.0,
            "train_loss": sum(float(info.loss) for info in self._infos) / count,
            "train_accuracy": sum(float(info.accuracy) for info in self._infos) / count,
            "images_per_s": round(self._images / max(self.seconds, 1e-9), 3),
        }


class TrainingFolder:
    """Paths of the folder of one training run.

    Args:
        path: the folder.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.model = path / "model.safetensors"
        self.history = path / "history.csv"
        self.metrics = path / "metrics.json"
        self.report = path / "report.html"
        self.config = path / "config.yaml"
        self.checkpoints = path / "checkpoints"

    def begin(self, plan: TrainingPlan, *, resume: bool, overwrite: bool) -> None:
        """Writes the resolved settings, or checks that a run can go on.

        Raises:
            JaxmapError: the folder holds a run already, or other files of the same names.
            UsageError: the run to be resumed had other settings.
        """
        tree = {
            "training_data": plan.data.source,
            "init": None if plan.init is None else str(plan.init.resolve()),
            **train_config_tree(plan.config),
        }
        outputs = (self.model, self.history, self.metrics, self.report, self.config)
        there = [path.name for path in (*outputs, self.checkpoints) if path.exists()]
        if there and not self._begun():
            raise JaxmapError(
                f"{', '.join(there)} would be replaced, but no training has written them",
                where=self.path,
                fix="choose another --out",
            )
        if resume and self.checkpoints.is_dir():
            check_same_settings(self.config, tree)
            return
        worth_keeping = (self.model, self.history, self.checkpoints)
        if not overwrite and any(path.exists() for path in worth_keeping):
            what, fix = "the folder holds a training run already", "go on with it (--resume), "
            if resume:
                what, fix = "the training run in the folder has lost its checkpoints", ""
            fix += "replace it (--overwrite), or choose another folder"
            raise JaxmapError(what, where=self.path, fix=fix)
        inputs = {path.resolve() for path in (plan.init,) if path is not None}
        for path in outputs:
            if path.resolve() in inputs:
                raise JaxmapError("an input would be overwritten", where=path, fix="choose another --out")
            path.unlink(missing_ok=True)
        shutil.rmtree(self.checkpoints, ignore_errors=True)
        write_yaml(self.config, tree)

    def _begun(self) -> bool:
        """Whether it was a training run that wrote the settings here."""
        try:
            return self.config.read_text(encoding="utf8").startswith("training_data:")
        except (OSError, UnicodeDecodeError):
            return False

    def write_history(self, log: TrainingLog) -> None:
        """Writes history.csv."""
        with atomic_path(self.history) as temporary:
            temporary.write_text(log.history_csv(), encoding="utf8")

    def write_report(self, plan: TrainingPlan, log: TrainingLog, shown: Sequence[Shown], status: str) -> None:
        """Writes report.html and metrics.json; `status` says why the run has stopped, if it has."""
        record = TrainingRecord(
            title=plan.data.title,
            classes=plan.start.architecture.classes,
            history=log.history,
            summary={name: scores for name, scores in (("best", log.best), ("last", log.last)) if scores},
            facts=_facts(plan),
            overlays=[(example.name, example.image, example.truth, example.prediction) for example in shown],
            status=status,
        )
        with atomic_path(self.report) as temporary:
            temporary.write_text(training_page(record), encoding="utf8")
        write_json(self.metrics, metrics_of(plan, log))


def _facts(plan: TrainingPlan) -> dict[str, str]:
    config, record = plan.config, plan.start.architecture
    fixed = f"{plan.order.examples} fixed ones" if plan.order.variants > 1 else "drawn anew each time"
    size, scale, optimiser = config.augmentation.crop_px, config.augmentation.scale, config.optimiser
    return {
        **plan.data.facts(),
        "Examples": fixed,
        "Network": f"DeepLabv3{'+' * record.decoder}, {record.backbone}, output stride {record.output_stride}",
        "Started from": "random weights" if plan.init is None else plan.init.name,
        "Fresh weights": ", ".join(plan.start.fresh) or "none",
        "Batch norm learns in": ", ".join(plan.start.batch_norms) or "no block",
        "Crops": f"{size[0]} x {size[1]} px at {scale[0]:g} to {scale[1]:g} of the image's scale",
        "Optimiser": f"{optimiser.kind}, learning rate {optimiser.learning_rate:g}, poly {optimiser.power:g}",
        "Batch": f"{config.batch_size} on {jax.local_device_count()} {jax.default_backend().upper()} device(s)",
    }


def metrics_of(plan: TrainingPlan, log: TrainingLog) -> dict[str, Any]:
    """What metrics.json holds."""
    steps = log.history[-1]["step"] if log.history else 0
    return {
        "epochs": len(log.history),
        "steps": steps,
        "complete": log.complete,
        "seconds": round(log.seconds, 1),
        "examples_seen": steps * plan.config.batch_size,
        **plan.data.counts(),
        "fresh": list(plan.start.fresh),
        "kept_epoch": log.kept(plan.config.keep).get("epoch"),
        "best": log.best,
        "last": log.last,
    }


REPORT_EVERY_S = 30.0
"""The page is rewritten no more often, but at the end."""


class TrainingRun:
    """Goes through the steps of a plan and keeps its folder up to date.

    Args:
        plan: the run.
        folder: where it is written.
        notify: takes lines for the user.
        on_step: is called with the steps taken and a line on how it goes.
    """

    def __init__(
        self,
        plan: TrainingPlan,
        folder: TrainingFolder,
        *,
        notify: Callable[[str], None],
        on_step: Callable[[int, str], None] = lambda steps, note: None,
    ) -> None:
        self._plan, self._folder, self._notify, self._on_step = plan, folder, notify, on_step
        self._checkpoints = Checkpoints(folder.checkpoints)
        self._validator = plan.data.validator(plan.start.architecture)
        self._log = TrainingLog(digest=plan.data.digest())
        self._shown: tuple[Shown, ...] = ()
        self._reported_s = 0.0
        self._status = ""

    def run(self) -> dict[str, Any]:
        """Trains to the end, and returns what it writes into metrics.json.

        Raises:
            JaxmapError: the loss is no longer finite, the data or the checkpoints cannot be read, or writing
                failed. The model and the checkpoints written so far stay.
        """
        plan = self._plan
        share = _Sharing()
        state = self._restored(plan.trainer.init(plan.start.weights))
        state = jax.device_put(state, share.replicated)
        if self._log.complete:
            self._notify("the run is complete; nothing is left to do")
            return metrics_of(self._plan, self._log)
        key = jax.device_put(jax.random.key(plan.config.seed), share.replicated)
        epoch = len(self._log.history)
        meter, first_step = Meter(), int(state.step)
        try:
            for step, batch in enumerate(plan.data.batches(plan.order, first_step), first_step):
                state, info = plan.trainer.step(state, jax.device_put(batch, share.split), key)
                self._check_finite(info, step, epoch)
                self._on_step(step + 1, meter.add(info, plan.config.batch_size))
                if step + 1 < plan.order.epoch_end(epoch):
                    continue
                # A batch of more examples than there are ends several epochs.
                while epoch < plan.config.epochs and step + 1 >= plan.order.epoch_end(epoch):
                    self._end_epoch(epoch, state, meter)
                    epoch += 1
                self._keep(state)
                meter = Meter()
        except JaxmapError as error:
            self._stop(f"Stopped: {error.what}.")
            raise
        except KeyboardInterrupt:
            place = f"epoch {min(epoch + 1, plan.config.epochs)} of {plan.config.epochs}"
            self._stop(f"Interrupted in {place}.")
            self._notify(f"interrupted in {place}, which --resume begins again")
            raise
        return metrics_of(self._plan, self._log)

    def _stop(self, status: str) -> None:
        self._status = status
        # What stopped the run is told, and not that the page could not be written either.
        with suppress(JaxmapError):
            self._write_report()

    def _restored(self, state: TrainState) -> TrainState:
        saved = self._checkpoints.restore(state)
        if saved is None:
            return state
        try:
            log = TrainingLog(**saved.record)
        except TypeError as error:
            raise JaxmapError(
                "the checkpoints were written by another version of jaxmap",
                where=self._folder.checkpoints,
                fix="start anew with --overwrite",
            ) from error
        if log.digest != self._log.digest:
            raise JaxmapError(
                "the training data have changed since the run was begun",
                where=self._plan.data.source,
                fix="restore them, or start anew with --overwrite",
            )
        self._log = log
        self._notify(f"going on after epoch {len(log.history)} of {self._plan.config.epochs}")
        return saved.state

    def _check_finite(self, info: StepInfo, step: int, epoch: int) -> None:
        if bool(info.finite):
            return
        order = self._plan.order
        images = [self._plan.data.names[int(place) // order.variants] for place in order.draws(step)[:, 1]]
        loss, norm = float(info.loss), float(info.gradient_norm)
        numbers = f"loss {loss:g}, gradient norm {norm:g}"
        raise JaxmapError(
            f"{'new weights that are not finite' if math.isfinite(loss + norm) else numbers} in step {step + 1}, "
            f"epoch {epoch + 1}, with the images {', '.join(dict.fromkeys(images))}; what was kept before is there",
            where=self._folder.path,
            fix="look at these images, or take a lower optimiser.learning-rate and start anew from the model",
        )

    def _end_epoch(self, epoch: int, state: TrainState, meter: Meter) -> None:
        config, last = self._plan.config, epoch + 1 == self._plan.config.epochs
        weights = state.average or state.weights
        row: dict[str, Any] = {"epoch": epoch + 1, "step": int(state.step), **meter.means()}
        if self._validator is not None and ((epoch + 1) % config.validate_every == 0 or last):
            row |= self._validate(epoch, weights)
        elif self._validator is None and last:
            self._save_model(weights)
        row["seconds"] = meter.lap_s()
        self._log.history.append(row)
        self._log.seconds += row["seconds"]
        self._log.complete = last

    def _keep(self, state: TrainState) -> None:
        """Writes everything; the checkpoint last, so that what a resumed run need not do again is there."""
        self._folder.write_history(self._log)
        if self._log.complete or time.monotonic() - self._reported_s > REPORT_EVERY_S:
            self._write_report()
        self._checkpoints.save(state, dict(vars(self._log)))

    def _validate(self, epoch: int, weights: Weights) -> dict[str, Any]:
        assert self._validator is not None
        validation = self._validator.score(weights)
        self._shown = validation.shown
        self._log.last = {"epoch": epoch + 1, **validation.summary}
        iou = validation.summary["mean_iou"]
        # Where nothing can be scored, the last weights are as good as any.
        better = not self._log.best or iou is None or iou > self._log.best["mean_iou"]
        if better:
            self._log.best = self._log.last
        if better or self._plan.config.keep == "last":
            self._save_model(weights)
        self._notify(_told(epoch + 1, validation))
        ious = {f"iou_{name}": values["iou"] for name, values in validation.summary["classes"].items()}
        return {
            "val_loss": validation.loss,
            "mean_iou": validation.summary["mean_iou"],
            "accuracy": validation.summary["accuracy"],
            **ious,
        }

    def _save_model(self, weights: Weights) -> None:
        save_model(self._folder.model, self._plan.start.architecture, weights)

    def _write_report(self) -> None:
        self._folder.write_report(self._plan, self._log, self._shown, self._status)
        self._reported_s = time.monotonic()


class _Sharing:
    """Where arrays lie when all devices share a batch."""

    def __init__(self) -> None:
        mesh = Mesh(jax.local_devices(), ("data",))
        self.replicated = NamedSharding(mesh, PartitionSpec())
        self.split = NamedSharding(mesh, PartitionSpec("data"))


def _told(epoch: int, validation: Validation) -> str:
    ious = ", ".join(
        f"{name} {values['iou']:.3f}"
        for name, values in validation.summary["classes"].items()
        if values["iou"] is not None
    )
    return f"epoch {epoch}: validation loss {validation.loss or 0:.3f}, IoU: {ious}"

"""A training run: its folder, its log, and the loop of steps, validations and checkpoints."""

from __future__ import annotations

import csv
import io
import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import jax
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jaxmap.errors import JaxmapError
from jaxmap.host.bounded_text import read_text
from jaxmap.host.files import atomic_path, real_path
from jaxmap.host.output_folder import check_inputs_stay, check_same_settings, write_json, write_yaml
from jaxmap.host.replacement import Replacement
from jaxmap.models.checkpoint import save_model
from jaxmap.models.network import Weights
from jaxmap.report.training_page import TrainingRecord, training_page
from jaxmap.runs.training_plan import TRAIN_SETTINGS, TrainingPlan
from jaxmap.training.checkpoints import Checkpoints
from jaxmap.training.step import StepMetrics, TrainState
from jaxmap.training.validation import ValidationExample

REPORT_EVERY_S = 30.0
"""The page is not rewritten more often, except at the end."""


@dataclass
class TrainingLog:
    """The progress of a run; saved with every checkpoint, so that a resumed run continues it.

    Attributes:
        history: one row for each complete epoch.
        best: epoch, mean IoU and scores of the best validation.
        last: the same of the last one.
        seconds: time spent on steps and validations.
        digest: of the training data.
        complete: whether the run has ended.
    """

    history: list[dict[str, Any]] = field(default_factory=list)
    best: dict[str, Any] = field(default_factory=dict)
    last: dict[str, Any] = field(default_factory=dict)
    seconds: float = 0.0
    digest: str = ""
    complete: bool = False

    def metrics(self, plan: TrainingPlan) -> dict[str, Any]:
        """The contents of metrics.json."""
        steps = self.history[-1]["step"] if self.history else 0
        kept = self.last if plan.config.keep == "last" else self.best
        return {
            "epochs": len(self.history),
            "steps": steps,
            "complete": self.complete,
            "seconds": round(self.seconds, 1),
            "examples_seen": steps * plan.config.batch_size,
            **plan.data.counts(),
            "fresh": list(plan.network.fresh),
            "kept_epoch": kept.get("epoch"),
            "best": self.best,
            "last": self.last,
        }


class EpochMeter:
    """Means over the steps of an epoch, and its time."""

    def __init__(self) -> None:
        self._started_s, self._steps, self._images = time.perf_counter(), [], 0
        self._lap_s = self._started_s

    def add(self, step: StepMetrics, images: int) -> str:
        """Adds a step; returns a line on the progress."""
        self._steps.append(step)
        self._images += images
        return f"loss {float(step.loss):.3f}, accuracy {float(step.accuracy):.1%}, {self._images_per_s():.1f} images/s"

    def _images_per_s(self) -> float:
        return self._images / max(time.perf_counter() - self._started_s, 1e-9)

    def lap_s(self) -> float:
        """Seconds since the last call, or since the epoch began."""
        before, self._lap_s = self._lap_s, time.perf_counter()
        return round(self._lap_s - before, 3)

    def means(self) -> dict[str, float]:
        """The columns of the history that the steps give."""
        count = max(len(self._steps), 1)
        return {
            "learning_rate": float(self._steps[-1].learning_rate) if self._steps else 0.0,
            "train_loss": sum(float(step.loss) for step in self._steps) / count,
            "train_accuracy": sum(float(step.accuracy) for step in self._steps) / count,
            "images_per_s": round(self._images_per_s(), 3),
        }


class TrainingFolder:
    """The folder of a training run, and the files in it.

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
        self._replacement = Replacement(path, self._outputs)

    @contextmanager
    def writing(self, plan: TrainingPlan, *, resume: bool, overwrite: bool) -> Iterator[TrainingFolder]:
        """Begins a run and yields the folder it is to write into, see `begin`.

        A run that is replaced stays until the block has ended without an error.
        """
        work = self.begin(plan, resume=resume, overwrite=overwrite)
        if work is self:
            yield self
            return
        with self._replacement.written(keep=work.checkpoints.is_dir):
            yield work

    def begin(self, plan: TrainingPlan, *, resume: bool, overwrite: bool) -> TrainingFolder:
        """Writes the resolved settings, or checks that a run can be resumed.

        Returns:
            Where to write: here, or where a run is replaced, a folder within.

        Raises:
            JaxmapError: the folder already holds a run, or other files of the same names.
            UsageError: the run to be resumed had other settings.
        """
        self._replacement.settle()
        tree = {
            "training_data": plan.data.source,
            "init": None if plan.init is None else str(real_path(plan.init)),
            **TRAIN_SETTINGS.tree(plan.config),
        }
        there = [path.name for path in self._outputs() if path.exists()]
        if there and not self._is_of_training():
            what = f"{', '.join(there)} would be replaced, but no training has written them"
            raise JaxmapError(what, where=self.path, fix="choose another --out")
        replacing = TrainingFolder(self._replacement.new)
        if resume and (replacing.config.exists() or self.checkpoints.is_dir()):
            work = replacing if replacing.config.exists() else self
            check_same_settings(work.config, tree)
            return work
        used = any(path.exists() for path in (self.model, self.history, self.checkpoints))
        if not overwrite and (used or replacing.checkpoints.is_dir()):
            what, fix = "the folder holds a training run already", "resume it (--resume), "
            if resume:
                what, fix = "the training run in the folder has lost its checkpoints", ""
            fix += "replace it (--overwrite), or choose another folder"
            raise JaxmapError(what, where=self.path, fix=fix)
        if plan.init is not None:
            check_inputs_stay(self._outputs(), [plan.init])
        self._replacement.discard()
        if not used:
            for path in self._outputs():
                path.unlink(missing_ok=True)
        work = replacing if used else self
        write_yaml(work.config, tree)
        return work

    def _outputs(self) -> tuple[Path, ...]:
        """What a training writes."""
        return (self.model, self.history, self.metrics, self.report, self.config, self.checkpoints)

    def _is_of_training(self) -> bool:
        try:
            return read_text(self.config).startswith("training_data:")
        except JaxmapError:
            return False

    def write_history(self, log: TrainingLog) -> None:
        """Writes history.csv; cells without a value are left empty."""
        columns = list(dict.fromkeys(key for row in log.history for key in row))
        text = io.StringIO()
        writer = csv.DictWriter(text, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(log.history)
        with atomic_path(self.history) as temporary:
            temporary.write_text(text.getvalue(), encoding="utf8", errors="backslashreplace")

    def write_report(
        self, plan: TrainingPlan, log: TrainingLog, examples: Sequence[ValidationExample], status: str
    ) -> None:
        """Writes report.html and metrics.json; `status` says why the run has stopped, if it has."""
        config, network = plan.config, plan.network
        crop_px, scale, optimiser = config.augmentation.crop_px, config.augmentation.scale, config.optimiser
        record, fixed = network.architecture, plan.order.variants > 1
        facts = {
            **plan.data.facts(),
            "Examples": f"{plan.order.examples} fixed ones" if fixed else "drawn anew in each epoch",
            "Network": f"{record.name}, {record.backbone}, output stride {record.output_stride}"
            + ", sees relief" * bool(record.relief_channels),
            "Initial weights": "random" if plan.init is None else plan.init.name,
            "Random parts": ", ".join(network.fresh) or "none",
            "Batch norm trained in": ", ".join(network.batch_norms) or "no part",
            "Crops": f"{crop_px[0]} x {crop_px[1]} px at {scale[0]:g} to {scale[1]:g} of the image's scale",
            "Optimiser": f"{optimiser.kind}, learning rate {optimiser.learning_rate:g}, poly {optimiser.power:g}",
            "Batch": f"{config.batch_size} on {jax.local_device_count()} {jax.default_backend().upper()} device(s)",
        }
        page = training_page(
            TrainingRecord(
                title=plan.data.title,
                classes=record.classes,
                history=log.history,
                summary={name: scores for name, scores in (("best", log.best), ("last", log.last)) if scores},
                facts=facts,
                examples=examples,
                status=status,
            )
        )
        with atomic_path(self.report) as temporary:
            temporary.write_text(page, encoding="utf8", errors="backslashreplace")
        write_json(self.metrics, log.metrics(plan))


class TrainingRun:
    """Trains as planned, and keeps the folder up to date.

    Args:
        plan: of the run.
        folder: where it is written.
        notify: takes lines for the user.
        on_step: is called with the number of steps done and a line on the progress.
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
        self._validator = plan.data.validator(plan.network.architecture)
        self._log = TrainingLog(digest=plan.data.digest())
        self._examples: tuple[ValidationExample, ...] = ()
        self._reported_s = 0.0

    def run(self) -> dict[str, Any]:
        """Trains to the end, and returns the contents of metrics.json.

        Raises:
            JaxmapError: the loss is no longer finite, data or checkpoints cannot be read, or writing failed. The
                model and the checkpoints written so far stay.
        """
        plan = self._plan
        mesh = Mesh(jax.local_devices(), ("data",))
        replicated, split = NamedSharding(mesh, PartitionSpec()), NamedSharding(mesh, PartitionSpec("data"))
        state = jax.device_put(self._restored(plan.trainer.init(plan.network.weights)), replicated)
        if self._log.complete:
            self._notify("the run is complete; nothing is left to do")
            return self._log.metrics(plan)
        key = jax.device_put(jax.random.key(plan.config.seed), replicated)
        epoch, first_step, meter = len(self._log.history), int(state.step), EpochMeter()
        try:
            for step, batch in enumerate(plan.data.batches(plan.order, first_step), first_step):
                state, metrics = plan.trainer.step(state, jax.device_put(batch, split), key)
                if not bool(metrics.finite):
                    raise self._not_finite(metrics, step, epoch)
                self._on_step(step + 1, meter.add(metrics, plan.config.batch_size))
                if step + 1 < plan.order.epoch_end(epoch):
                    continue
                # A batch that is larger than an epoch ends several of them.
                while epoch < plan.config.epochs and step + 1 >= plan.order.epoch_end(epoch):
                    self._end_epoch(epoch, state, meter)
                    epoch += 1
                self._save(state)
                meter = EpochMeter()
        except JaxmapError as error:
            self._report_stop(f"Stopped: {error.what}.")
            raise
        except KeyboardInterrupt:
            place = f"epoch {min(epoch + 1, plan.config.epochs)} of {plan.config.epochs}"
            self._report_stop(f"Interrupted in {place}.")
            self._notify(f"interrupted in {place}, which --resume begins again")
            raise
        return self._log.metrics(plan)

    def _restored(self, state: TrainState) -> TrainState:
        """The state of the newest checkpoint, and the log with it; `state` where there is none."""
        saved = self._checkpoints.restore(state)
        if saved is None:
            return state
        try:
            log = TrainingLog(**saved.record)
        except TypeError as error:
            what = "the checkpoints were written by another version of jaxmap"
            raise JaxmapError(what, where=self._folder.checkpoints, fix="start anew with --overwrite") from error
        if log.digest != self._log.digest:
            raise JaxmapError(
                "the training data have changed since the run was begun",
                where=self._plan.data.source,
                fix="restore them, or start anew with --overwrite",
            )
        self._log = log
        self._notify(f"resuming after epoch {len(log.history)} of {self._plan.config.epochs}")
        return saved.state

    def _not_finite(self, metrics: StepMetrics, step: int, epoch: int) -> JaxmapError:
        order = self._plan.order
        images = [self._plan.data.names[int(place) // order.variants] for place in order.draws(step)[:, 1]]
        loss, norm = float(metrics.loss), float(metrics.gradient_norm)
        what = f"loss {loss:g}, gradient norm {norm:g}"
        if math.isfinite(loss + norm):
            what = "new weights that are not finite"
        return JaxmapError(
            f"{what} in step {step + 1}, epoch {epoch + 1}, with the images {', '.join(dict.fromkeys(images))}; "
            "earlier checkpoints are kept",
            where=self._folder.path,
            fix="look at these images, or take a lower optimiser.learning-rate and start anew from the model",
        )

    def _end_epoch(self, epoch: int, state: TrainState, meter: EpochMeter) -> None:
        """Validates where it is due, and adds the row of the epoch to the history."""
        config, last = self._plan.config, epoch + 1 == self._plan.config.epochs
        weights = state.average or state.weights
        row: dict[str, Any] = {"epoch": epoch + 1, "step": int(state.step), **meter.means()}
        if self._validator is not None and ((epoch + 1) % config.validate_every == 0 or last):
            row |= self._validate(epoch, weights)
        elif self._validator is None and last:
            save_model(self._folder.model, self._plan.network.architecture, weights)
        row["seconds"] = meter.lap_s()
        self._log.history.append(row)
        self._log.seconds += row["seconds"]
        self._log.complete = last

    def _validate(self, epoch: int, weights: Weights) -> dict[str, Any]:
        """Validates, writes the model if it is to be kept, and returns the columns of the history."""
        assert self._validator is not None
        summary, loss, self._examples = self._validator.score(weights)
        self._log.last = {"epoch": epoch + 1, **summary}
        # Where nothing can be scored, the last weights are as good as any.
        mean_iou = summary["mean_iou"]
        better = not self._log.best or mean_iou is None or mean_iou > self._log.best["mean_iou"]
        if better:
            self._log.best = self._log.last
        if better or self._plan.config.keep == "last":
            save_model(self._folder.model, self._plan.network.architecture, weights)
        ious = {name: scores["iou"] for name, scores in summary["classes"].items()}
        listed = ", ".join(f"{name} {iou:.3f}" for name, iou in ious.items() if iou is not None)
        self._notify(f"epoch {epoch + 1}: validation loss {loss or 0:.3f}, IoU: {listed}")
        columns = {"val_loss": loss, "mean_iou": mean_iou, "accuracy": summary["accuracy"]}
        return columns | {f"iou_{name}": iou for name, iou in ious.items()}

    def _save(self, state: TrainState) -> None:
        """Writes everything; the checkpoint last, so that a resumed run finds all that precedes it."""
        self._folder.write_history(self._log)
        if self._log.complete or time.monotonic() - self._reported_s > REPORT_EVERY_S:
            self._folder.write_report(self._plan, self._log, self._examples, "")
            self._reported_s = time.monotonic()
        self._checkpoints.save(state, asdict(self._log))

    def _report_stop(self, status: str) -> None:
        # If the page cannot be written either, the error that stopped the run is the one to report.
        with suppress(JaxmapError):
            self._folder.write_report(self._plan, self._log, self._examples, status)

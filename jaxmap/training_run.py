"""A training run: steps, validations, checkpoints."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import jax
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jaxmap.errors import JaxmapError
from jaxmap.models.checkpoint import save_model
from jaxmap.models.deeplab import Weights
from jaxmap.training.checkpoints import Checkpoints
from jaxmap.training.step import StepInfo, TrainState
from jaxmap.training.validation import Shown, Validation
from jaxmap.training_folder import TrainingFolder, metrics_of
from jaxmap.training_log import Meter, TrainingLog
from jaxmap.training_plan import TrainingPlan

REPORT_EVERY_S = 30.0
"""The page is rewritten no more often, but at the end."""


class TrainingRun:
    """Goes through the steps of a plan and keeps its folder up to date.

    Args:
        plan: the run.
        folder: where it is written.
        tell: takes lines for the user.
        on_step: is called with the steps taken and a line on how it goes.
    """

    def __init__(
        self,
        plan: TrainingPlan,
        folder: TrainingFolder,
        *,
        tell: Callable[[str], None],
        on_step: Callable[[int, str], None] = lambda steps, note: None,
    ) -> None:
        self._plan, self._folder, self._tell, self._on_step = plan, folder, tell, on_step
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
            self._tell("the run is complete; nothing is left to do")
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
            self._tell(f"interrupted in {place}, which --resume begins again")
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
        self._tell(f"going on after epoch {len(log.history)} of {self._plan.config.epochs}")
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
        self._tell(_told(epoch + 1, validation))
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

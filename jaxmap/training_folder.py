"""The folder of one training run: what lies in it, and the pages that tell how it goes."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax

from jaxmap.errors import JaxmapError
from jaxmap.files import atomic_path
from jaxmap.output_folder import check_same_settings, write_json, write_yaml
from jaxmap.report.training_page import TrainingRecord, training_page
from jaxmap.training.validation import Shown
from jaxmap.training_config import train_config_tree
from jaxmap.training_log import TrainingLog
from jaxmap.training_plan import TrainingPlan


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

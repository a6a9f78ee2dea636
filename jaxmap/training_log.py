"""What a training run has done so far: history, scores, times."""

from __future__ import annotations

import csv
import io
import time
from dataclasses import dataclass, field
from typing import Any

from jaxmap.training.step import StepInfo


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

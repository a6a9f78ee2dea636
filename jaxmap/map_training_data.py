"""What map supervision learns from: the frames of a sequence, prepared once, and the cells of an orthomosaic."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, UInt8

from jaxmap.datasets.label_raster import LabelRaster
from jaxmap.deeplab_labeller import DeeplabParams
from jaxmap.errors import JaxmapError
from jaxmap.evaluation.cells import CellGrid
from jaxmap.evaluation.evaluate import ScoringOptions, evaluate_map
from jaxmap.labels import IGNORE
from jaxmap.map_evaluation import class_map_of
from jaxmap.mapper import MapperParams
from jaxmap.mapping_plan import Plan
from jaxmap.models.architecture import Architecture
from jaxmap.models.deeplab import Weights, fold_batch_norm
from jaxmap.prefetch import prefetch
from jaxmap.training.batches import BATCHES_AHEAD, Order
from jaxmap.training.validation import SHOWN as MOST_SHOWN
from jaxmap.training.validation import Shown, Validation
from jaxmap.tuning.frame_crops import FrameBatch
from jaxmap.types import Frame, VoxelMap


class KeptFrame(NamedTuple):
    """A frame as the step takes it, what its pixels are held to, and the class of the cell that each pixel lies in."""

    name: str
    frame: Frame
    anchors: UInt8[np.ndarray, "H W"]
    cells: UInt8[np.ndarray, "H W"]


class CellTruth(NamedTuple):
    """An orthomosaic over the cells of a map.

    Attributes:
        rasters: by the index of each class that it shows.
        cells: their grid.
        labels: the class of each cell, `IGNORE` where there is none.
    """

    rasters: Mapping[int, LabelRaster]
    cells: CellGrid
    labels: UInt8[np.ndarray, "I J"]

    def of_points(self, points_world: Float[np.ndarray, "*s 3"]) -> UInt8[np.ndarray, "*s"]:
        """The class of the cells that points lie in, world; `IGNORE` where there is none."""
        rows, columns = (
            np.floor((points_world[..., axis] - self.cells.origin_m[axis]) / self.cells.size_m) for axis in (0, 1)
        )
        # Tested on floats: a NaN cast to an integer would be a valid index.
        inside = (rows >= 0) & (rows < self.cells.shape[0]) & (columns >= 0) & (columns < self.cells.shape[1])
        at = np.where(inside, rows, 0).astype(np.int64), np.where(inside, columns, 0).astype(np.int64)
        return np.where(inside, self.labels[at], np.uint8(IGNORE))


@dataclass(frozen=True)
class MapData:
    """A sequence and its orthomosaic, as `TrainingData`.

    Attributes:
        plan: how the sequence is mapped.
        truth: the orthomosaic.
        train: frames that are learnt from.
        validation: frames that are held out, from the end of the sequence.
        truth_name: of the orthomosaic, for the page.
    """

    plan: Plan
    truth: CellTruth
    train: tuple[KeptFrame, ...]
    validation: tuple[KeptFrame, ...]
    truth_name: str

    @property
    def source(self) -> str:
        """The sequence."""
        return self.plan.source

    @property
    def title(self) -> str:
        """The sequence's name."""
        return self.plan.sequence.name

    @property
    def names(self) -> tuple[str, ...]:
        """Of the frames that are learnt from."""
        return tuple(kept.name for kept in self.train)

    def batches(self, order: Order, first_step: int) -> Iterator[FrameBatch]:
        """The batches of a run from a step on."""
        return prefetch(
            lambda step: self._batch(order.draws(step)), range(first_step, order.steps), workers=1, ahead=BATCHES_AHEAD
        )

    def _batch(self, draws: np.ndarray) -> FrameBatch:
        chosen = [self.train[place] for place in draws[:, 1]]
        frames = [kept.frame for kept in chosen]
        return FrameBatch(
            np.stack([np.asarray(frame.image) for frame in frames]),  # type: ignore[arg-type]
            np.stack([np.asarray(frame.disparity_px) for frame in frames]),  # type: ignore[arg-type]
            np.stack([np.asarray(frame.T_world_camera.wxyz_xyz) for frame in frames]),  # type: ignore[arg-type]
            np.stack([kept.anchors for kept in chosen]),  # type: ignore[arg-type]
            draws,  # type: ignore[arg-type]
        )

    def validator(self, architecture: Architecture) -> MapValidator | None:
        """Scores the map of the held-out frames; None where there are none."""
        return MapValidator(self, architecture) if self.validation else None

    def digest(self) -> str:
        """A fingerprint of frames, poses, camera, bounds and truth."""
        grid = self.plan.grid
        text = hashlib.sha256(self.plan.digest(len(self.plan.sequence.frames)).encode())
        text.update(repr((self.names, grid.shape, np.asarray(grid.origin_m).tolist())).encode())
        text.update(self.truth.labels.tobytes())
        return text.hexdigest()

    def counts(self) -> dict[str, Any]:
        """Frames, and pixels in cells of each class."""
        classes = self.plan.labeller.classes
        parts = {"train": self.train, "validation": self.validation}
        pixels = {part: class_pixels(frames, len(classes)) for part, frames in parts.items()}
        return {
            "images": {part: len(frames) for part, frames in parts.items()},
            "class_pixels": {
                classes[index]: {part: int(counted[index]) for part, counted in pixels.items()}
                for index in sorted(self.truth.rasters)
            },
        }

    def facts(self) -> dict[str, str]:
        """Frames and truth."""
        return {
            "Frames mapped": str(len(self.train)),
            "Validation frames": str(len(self.validation)),
            "Supervision": f"{self.truth_name}, cells of {self.truth.cells.size_m:g} m; no image is labelled",
        }


def class_pixels(frames: tuple[KeptFrame, ...], count: int) -> np.ndarray:
    """Pixels that lie in cells of each class."""
    counted = np.zeros(count, np.int64)
    for kept in frames:
        counted += np.bincount(kept.cells[kept.cells != IGNORE], minlength=count)
    return counted


class MapValidator:
    """Scores weights by the map that they make of the held-out frames.

    Args:
        data: the frames and the truth.
        architecture: of the network.
    """

    def __init__(self, data: MapData, architecture: Architecture) -> None:
        self._data = data
        # Two jitted functions: inside one, XLA would fold the batch norms anew for every frame.
        self._fold = jax.jit(lambda weights: fold_batch_norm(architecture, weights)[1])

    def score(self, weights: Weights) -> Validation:
        """Scores weights.

        Raises:
            JaxmapError: the network's answer is not finite.
        """
        data, plan = self._data, self._data.plan
        labelling = plan.params.labeller
        assert isinstance(labelling, DeeplabParams)
        labelling = labelling._replace(weights=self._fold(weights))
        params = MapperParams(plan.params.camera, plan.params.fusion, labelling)
        voxel_map, shown = plan.mapper.init(), []
        for number, kept in enumerate(data.validation):
            if number < MOST_SHOWN:
                said = np.asarray(plan.mapper.label_image(kept.frame, params, plan.key, number))
                shown.append(Shown(kept.name, np.asarray(kept.frame.image), kept.cells, said))
            voxel_map, _ = plan.mapper.step(voxel_map, kept.frame, params, plan.key)
        if not np.isfinite(np.asarray(voxel_map.log_odds)).all():
            raise JaxmapError(
                "the map of the validation frames is not finite",
                where=plan.sequence.name,
                fix="take a lower optimiser.learning-rate and start anew",
            )
        return self._scored(voxel_map, tuple(shown))

    def _scored(self, voxel_map: VoxelMap, shown: tuple[Shown, ...]) -> Validation:
        data, plan = self._data, self._data.plan
        options = ScoringOptions(cell_size_m=data.truth.cells.size_m)
        classes: dict[str, dict[str, Any]] = {}
        for index, raster in data.truth.rasters.items():
            name = plan.labeller.classes[index]
            class_map = class_map_of(
                voxel_map,
                plan.params.fusion,
                plan.rule,
                name,
                site_origin=plan.sequence.site_origin,
                crs=plan.sequence.crs,
            )
            classes[name] = evaluate_map(class_map, raster, None, options).scores
        ious = [scores["iou"] for scores in classes.values() if scores["iou"] is not None]
        summary = {
            "classes": {
                name: {key: scores[key] for key in ("iou", "precision", "recall")}
                | {"pixels": scores["tp"] + scores["fn"]}
                for name, scores in classes.items()
            },
            "mean_iou": float(np.mean(ious)) if ious else None,
            "accuracy": float(np.mean([scores["accuracy"] for scores in classes.values()])),
            "images": len(data.validation),
            "pixels": max(scores["cells"] for scores in classes.values()),
            "unit": "cell",
        }
        return Validation(summary, float(np.mean([scores["nll"] for scores in classes.values()])), shown)

"""The plan of a training run with map supervision: frames, orthomosaic, network and compiled step."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, UInt8

from jaxmap.datasets.crs import read_crs
from jaxmap.datasets.label_raster import LabelRaster, choose_coding, read_label_orthomosaic
from jaxmap.errors import JaxmapError, UsageError
from jaxmap.evaluation.cells import CellGrid
from jaxmap.evaluation.evaluate import evaluate_map, place_of
from jaxmap.evaluation.options import ScoringOptions
from jaxmap.geometry.cloud import project
from jaxmap.host.files import bundled
from jaxmap.host.prefetch import prefetch
from jaxmap.labels import IGNORE
from jaxmap.mapping.step import MapperParams
from jaxmap.models.architecture import Architecture
from jaxmap.models.checkpoint import SavedModel, load_network
from jaxmap.models.network import Weights, fold_batch_norm
from jaxmap.runs.config import observations_in
from jaxmap.runs.evaluation import class_layer_of
from jaxmap.runs.labelling import Notify
from jaxmap.runs.mapping_plan import Plan, plan_run
from jaxmap.runs.perception import settings_taken_over
from jaxmap.runs.segmentation import Segmenter
from jaxmap.runs.training_plan import SupervisedMapConfig, TrainConfig, TrainingPlan, describe_network
from jaxmap.training.batches import BATCHES_AHEAD, ExampleOrder
from jaxmap.training.initial_network import make_initial_network
from jaxmap.training.losses import class_weights
from jaxmap.training.validation import MAX_EXAMPLES, Validation, ValidationExample
from jaxmap.tuning.frame_crops import FrameBatch
from jaxmap.tuning.map_loss import MapTruth, make_map_truth
from jaxmap.tuning.map_step import SHOWN, MapSupervision, make_map_trainer
from jaxmap.tuning.options import MapLossOptions
from jaxmap.types import Frame


class TrainingFrame(NamedTuple):
    """A prepared frame, the anchors of its pixels, and the class of the cell that each pixel's point lies in."""

    name: str
    frame: Frame
    anchors: UInt8[np.ndarray, "H W"]
    cells: UInt8[np.ndarray, "H W"]


class CellTruth(NamedTuple):
    """An orthomosaic, resampled to the cells of a map.

    Attributes:
        rasters: of each class that it shows, by index of the class.
        cells: the grid.
        labels: the class of each cell, or `IGNORE`.
    """

    rasters: Mapping[int, LabelRaster]
    cells: CellGrid
    labels: UInt8[np.ndarray, "I J"]

    def of_points(self, points_world: Float[np.ndarray, "*s 3"]) -> UInt8[np.ndarray, "*s"]:
        """The class of the cells that points (world, metres) lie in, or `IGNORE`."""
        rows, columns = (
            np.floor((points_world[..., axis] - self.cells.origin_m[axis]) / self.cells.size_m) for axis in (0, 1)
        )
        # Tested on floats: a NaN cast to an integer would be a valid index.
        inside = (rows >= 0) & (rows < self.cells.shape[0]) & (columns >= 0) & (columns < self.cells.shape[1])
        at = np.where(inside, rows, 0).astype(np.int64), np.where(inside, columns, 0).astype(np.int64)
        return np.where(inside, self.labels[at], np.uint8(IGNORE))


@dataclass(frozen=True)
class MapTrainingData:
    """A sequence and its orthomosaic, as `TrainingData`.

    Attributes:
        plan: of the mapping.
        truth: the orthomosaic.
        train: training frames.
        validation: held-out frames, from the end of the sequence.
        truth_name: file name of the orthomosaic, for the page.
    """

    plan: Plan
    truth: CellTruth
    train: tuple[TrainingFrame, ...]
    validation: tuple[TrainingFrame, ...]
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
        """Names of the training frames."""
        return tuple(kept.name for kept in self.train)

    def batches(self, order: ExampleOrder, first_step: int) -> Iterator[FrameBatch]:
        """The batches of a run from `first_step` on."""
        return prefetch(
            lambda step: self._batch(order.draws(step)), range(first_step, order.steps), workers=1, ahead=BATCHES_AHEAD
        )

    def _batch(self, draws: np.ndarray) -> FrameBatch:
        chosen = [self.train[place] for place in draws[:, 1]]
        frames = [kept.frame for kept in chosen]
        return FrameBatch(
            np.stack([np.asarray(frame.image) for frame in frames]),  # type: ignore[arg-type]
            np.stack([np.asarray(frame.matched_px) for frame in frames]),  # type: ignore[arg-type]
            np.stack([np.asarray(frame.T_world_camera.wxyz_xyz) for frame in frames]),  # type: ignore[arg-type]
            np.stack([kept.anchors for kept in chosen]),  # type: ignore[arg-type]
            draws,  # type: ignore[arg-type]
        )

    def validator(self, architecture: Architecture) -> MapValidator | None:
        """Scores the map of the held-out frames; None without any."""
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


def class_pixels(frames: tuple[TrainingFrame, ...], count: int) -> np.ndarray:
    """Pixels that lie in cells of each class."""
    counted = np.zeros(count, np.int64)
    for kept in frames:
        counted += np.bincount(kept.cells[kept.cells != IGNORE], minlength=count)
    return counted


class MapValidator:
    """Scores the map that weights make of the held-out frames.

    Args:
        data: the frames and the truth.
        architecture: of the network.
    """

    def __init__(self, data: MapTrainingData, architecture: Architecture) -> None:
        self._data = data
        # Two jitted functions: inside one, XLA would fold the batch norms anew for every frame.
        self._fold = jax.jit(lambda weights: fold_batch_norm(architecture, weights)[1])

    def score(self, weights: Weights) -> Validation:
        """Scores weights.

        Raises:
            JaxmapError: the map is not finite.
        """
        data, plan = self._data, self._data.plan
        labelling = plan.params.labeller._replace(weights=self._fold(weights))
        params = MapperParams(plan.params.camera, plan.params.fusion, labelling)
        voxel_map, examples = plan.mapper.init(), []
        for number, kept in enumerate(data.validation):
            if number < MAX_EXAMPLES:
                labels = np.asarray(plan.mapper.label_image(kept.frame, params, plan.key, number))
                examples.append(ValidationExample(kept.name, np.asarray(kept.frame.image), kept.cells, labels))
            voxel_map, _ = plan.mapper.step(voxel_map, kept.frame, params, plan.key)
        if not np.isfinite(np.asarray(voxel_map.log_odds)).all():
            raise JaxmapError(
                "the map of the validation frames is not finite",
                where=plan.sequence.name,
                fix="take a lower optimiser.learning-rate and start anew",
            )
        options = ScoringOptions(cell_size_m=data.truth.cells.size_m)
        classes: dict[str, dict[str, Any]] = {}
        for index, raster in data.truth.rasters.items():
            name = plan.labeller.classes[index]
            class_map = class_layer_of(
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
        return Validation(summary, float(np.mean([scores["nll"] for scores in classes.values()])), tuple(examples))


MAX_FRAME_BYTES = 4 * 2**30
"""All frames are kept in memory."""

_LABELLER_SETTINGS = ("labeller", "model", "model_sha256", "labels", "labels_are", "classes")
"""Settings of a mapping that choose the labeller, which here is the network in training."""


def plan_map_training(source: str, config: TrainConfig, init: Path | None, *, notify: Notify) -> TrainingPlan:
    """Reads the sequence and the orthomosaic, prepares all frames once, and builds network and step.

    Args:
        source: the folder of one sequence or of observations, or `sample:NAME`.
        config: the settings.
        init: model file of the network to start from; the bundled one by default.
        notify: takes lines for the user.

    Raises:
        JaxmapError: sequence, orthomosaic, settings or network are unusable.
    """
    _check_settings(config)
    assert config.ground_truth is not None
    path = init or bundled("rover.safetensors")
    saved = load_network(path)
    network = make_initial_network(config.network, config.norm, config.classes, saved, seed=config.seed, where=path)
    if network.fresh or network.batch_norms:
        what = f"{', '.join(network.fresh)} would be random" if network.fresh else "batch norm would be trained"
        raise UsageError(
            f"map supervision needs a network that was trained for the classes: {what}",
            where=path,
            fix="train it on images first, and leave --classes, network and norm as they are there",
        )
    mapping = replace(config.mapping, model=path, classes=config.classes)
    if (perceived := observations_in(source)) is not None:
        mapping = settings_taken_over(mapping, perceived)
    with _naming_options_of("map", "mapping") as named:
        plan = plan_run(source, mapping, lambda line: notify(named(line)), images=True)
    truth, truths = read_cells(plan, config)
    frames = prepare_training_frames(plan, truth, saved, config.map_truth.anchor, notify)
    train, validation = _split(frames, config.data.validation_share, plan.sequence.name)
    data = MapTrainingData(plan, truth, train, validation, config.ground_truth.name)
    counts = class_pixels(train, len(config.classes))
    _check_shown(counts, data, config)
    pixels, seen = sum(kept.cells.size for kept in train), int(counts.sum())
    shares = ", ".join(f"{config.classes[index]} {counts[index] / seen:.1%}" for index in truth.rasters)
    notify(
        f"{len(train)} frames to map, {len(validation)} to validate; "
        f"{seen / pixels:.0%} of their pixels lie in labelled cells: {shares}"
    )
    notify(describe_network(network))
    order = ExampleOrder.of(len(train), config)
    supervision = MapSupervision(
        camera=plan.front_end.camera,
        grid=plan.grid,
        depth_range_m=plan.depth_range_m,
        params=plan.params.fusion,
        # What the network calls background may be ground all the same: the orthomosaic must reach it.
        rule=replace(plan.rule, left_out_classes=()),
        truths=truths,
        losses=_losses(config, counts, truths),
        anchor=config.map_truth.anchor,
        temperature=config.map_truth.temperature,
    )
    trainer = make_map_trainer(network.architecture, config, supervision, steps=order.steps)
    return TrainingPlan(config, data, network, path, order, trainer)


def _check_settings(config: TrainConfig) -> None:
    """Refuses settings that have no effect with map supervision."""
    if config.ground_truth is None:
        raise UsageError("map supervision needs an orthomosaic", fix="give --ground-truth F.tif")
    losses = config.loss
    if losses.lovasz or losses.label_smoothing:
        raise UsageError(
            "loss.lovasz and loss.label_smoothing are of pixels", where="--supervision map", fix="leave them out"
        )
    if config.augmentation.copies is not None:
        raise UsageError("augmentation.copies is for images", where="--supervision map", fix="leave it out")
    if jax.local_device_count() > 1:
        raise UsageError("map supervision runs on one device", fix="hide the others (CUDA_VISIBLE_DEVICES=0)")
    plain = SupervisedMapConfig()
    if named := [name for name in _LABELLER_SETTINGS if getattr(config.mapping, name) != getattr(plain, name)]:
        raise UsageError(
            f"mapping.{named[0]} has no effect: the network in training labels",
            where="--supervision map",
            fix="name the network with --init and its classes with --classes",
        )
    if config.mapping.ensemble.members:
        raise UsageError(
            "mapping.ensemble.members has no effect: the network learns from one map",
            where="--supervision map",
            fix="leave it out",
        )


@contextmanager
def _naming_options_of(command: str, section: str) -> Iterator[Callable[[str], str]]:
    """Says of errors that name options of another command, and of lines it is given, where those stand in train."""

    def named(text: str, whole: str = "") -> str:
        return f"jaxmap {command} (options below {section}): {text}" if "--" in text + whole else text

    try:
        yield named
    except JaxmapError as error:
        raise type(error)(named(error.what, error.fix), where=error.where, fix=error.fix) from error


def read_cells(plan: Plan, config: TrainConfig) -> tuple[CellTruth, dict[int, MapTruth]]:
    """The orthomosaic over the map: as rasters and cells, and as arrays of the loss, for each class it shows.

    Raises:
        JaxmapError: it cannot be read, or does not lie over the map.
        UsageError: it shows fewer than two classes of the network.
    """
    options, path = config.map_truth, config.ground_truth
    assert path is not None
    with _naming_options_of("evaluate", "map_truth"):
        coding = choose_coding(options.remap or (), None, "map_truth.remap")
    named = {*coding.names.values(), *([coding.rest] if coding.rest else [])}
    shown = [index for index, name in enumerate(config.classes) if name in named]
    if len(shown) < 2:
        raise UsageError(
            f"the ground truth shows fewer than two classes of the network ({' '.join(config.classes)}): "
            f"{coding.text()}",
            where=path,
            fix="say what its values mean: --map-truth.remap 0=unlabelled 1=sand 2=rock",
        )
    if options.crs is not None:
        read_crs(options.crs, "map_truth.crs")
    place = place_of(plan.grid, plan.sequence.site_origin, plan.sequence.crs)
    rasters, truths, labels, cells = {}, {}, None, None
    for index in shown:
        with _naming_options_of("evaluate", "map_truth"):
            raster = read_label_orthomosaic(path, place, coding=coding, target=config.classes[index], crs=options.crs)
        rasters[index] = raster
        truths[index], found, cells = make_map_truth(
            plan.grid, raster, plan.sequence.site_origin, plan.sequence.crs, cell_size_m=options.cell_size_m
        )
        labels = np.full(found.labelled.shape, IGNORE, np.uint8) if labels is None else labels
        labels[found.truly()] = index
    assert labels is not None and cells is not None
    return CellTruth(rasters, cells, labels), truths


def prepare_training_frames(
    plan: Plan, truth: CellTruth, first: SavedModel, anchor: float, notify: Notify
) -> tuple[TrainingFrame, ...]:
    """Prepares all usable frames; the others are reported.

    Raises:
        JaxmapError: they take too much memory.
    """
    camera = plan.front_end.camera
    needed = len(plan.sequence.frames) * camera.width_px * camera.height_px * (3 + 4 + 1 + 1)
    if needed > MAX_FRAME_BYTES:
        raise JaxmapError(
            f"{len(plan.sequence.frames)} frames would take {needed / 2**30:.1f} GiB of memory",
            where=plan.sequence.name,
            fix="take fewer: --mapping.stride, --mapping.stop",
        )
    hidden = [index for index in range(len(plan.labeller.classes)) if index not in truth.rasters]
    network = Segmenter(first) if hidden and anchor > 0 else None
    kept = []
    for prepared in plan.prepare():
        if prepared.frame is None or prepared.rectified is None:
            notify(f"skipped: {prepared.fault}")
            continue
        anchors = np.full(prepared.frame.matched_px.shape, IGNORE, np.uint8)
        if network is not None:
            labels = network.logits(prepared.rectified.left).argmax(axis=-1)
            anchors = np.where(np.isin(labels, hidden), labels, SHOWN).astype(np.uint8)
        cells = cells_of_pixels(prepared.frame, plan, truth)
        kept.append(TrainingFrame(prepared.ref.name, prepared.frame, anchors, cells))
    return tuple(kept)


def cells_of_pixels(frame: Frame, plan: Plan, truth: CellTruth) -> UInt8[np.ndarray, "H W"]:
    """The class of the cell that each pixel's point lies in, or `IGNORE`."""
    sigma_px = plan.params.fusion.disparity_sigma_px
    cloud = project(plan.front_end.camera, frame.T_world_camera, frame.matched_px, plan.depth_range_m, sigma_px)
    points_world = np.asarray(cloud.points_world).reshape(*frame.matched_px.shape, 3)
    return np.where(np.asarray(cloud.in_range), truth.of_points(points_world), np.uint8(IGNORE))


def _split(
    frames: tuple[TrainingFrame, ...], share: float, name: str
) -> tuple[tuple[TrainingFrame, ...], tuple[TrainingFrame, ...]]:
    """Training frames, and validation frames from the end, because neighbouring frames look alike."""
    held_out = round(len(frames) * share)
    if len(frames) - held_out < 1:
        raise JaxmapError(
            f"{len(frames)} frames can be used, and {held_out} of them are held out",
            where=name,
            fix="give a longer sequence, or a smaller --data.validation-share",
        )
    return frames[: len(frames) - held_out], frames[len(frames) - held_out :]


def _check_shown(counts: np.ndarray, data: MapTrainingData, config: TrainConfig) -> None:
    """Refuses a ground truth without information.

    Raises:
        JaxmapError: no cell that the frames see is labelled, or all are of one class.
    """
    shown = [index for index in data.truth.rasters if counts[index]]
    if len(shown) > 1:
        return
    what = "no cell that the frames see is labelled"
    if shown:
        what = f"all labelled cells that the frames see are {config.classes[shown[0]]}: one class teaches nothing"
    raise JaxmapError(
        what,
        where=config.ground_truth,
        fix="check that both are of one site and the poses true, or take a longer sequence",
    )


def _losses(config: TrainConfig, counts: np.ndarray, shown: Iterable[int]) -> dict[int, MapLossOptions]:
    """The loss of each class against the rest, from the options of pixel losses."""
    weights = class_weights(config.loss, counts)
    losses = {}
    for index in shown:
        others = [weights[other] for other in shown if other != index]
        losses[index] = MapLossOptions(
            nll_weight=config.loss.cross_entropy,
            iou_weight=config.loss.soft_iou,
            class_weight=float(weights[index] / np.mean(others)),
        )
    return losses

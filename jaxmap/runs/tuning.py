"""`jaxmap tune` from plans to files: caches evidence, descends, and writes a configuration, scores and a page."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxmap
from jaxmap.errors import UsageError
from jaxmap.fusion.params import fusion_numbers
from jaxmap.host.files import atomic_path
from jaxmap.host.output_folder import write_json, write_yaml
from jaxmap.mapping.sequence import PreparedFrame
from jaxmap.report.tuning_page import tuning_page
from jaxmap.runs.checking import finding_line
from jaxmap.runs.config import MapConfig, config_tree
from jaxmap.runs.evaluation import TruthOptions, class_layer_of, read_truth
from jaxmap.runs.labelling import Notify
from jaxmap.runs.mapping_plan import Plan, plan_run
from jaxmap.tuning.cell_scores import ScoredCells, calibration_rows, joined, score_with_intervals
from jaxmap.tuning.descent import Step, descend
from jaxmap.tuning.evidence_cache import CacheRecipe, build_cache, tunable_numbers
from jaxmap.tuning.options import TuneOptions
from jaxmap.tuning.parametrisation import TunedParams, constrained, unconstrained
from jaxmap.tuning.traverse_loss import (
    Traverse,
    TraverseArrays,
    check_classes,
    make_traverse,
    score_cells,
    traverse_losses,
)
from jaxmap.types import Frame

SOFT_START_M = 0.03
"""Where the width of the plane's threshold starts when the settings have a sharp one, which nothing can move."""

_DATA = (
    *("labels", "labels_are", "calibration", "baseline_unit", "start", "stop", "stride", "poses", "poses_world"),
    *("poses_up", "pose_convention", "poses_are", "poses_unit", "poses_time_unit", "quaternion"),
)
"""Settings that are of the data tuned on, and not of how they are mapped."""


def tuned_config(config: MapConfig, params: TunedParams) -> MapConfig:
    """The settings with the tuned parameters in them.

    Args:
        config: how the traverses were mapped.
        params: what came out.

    Raises:
        UsageError: the settings refuse a parameter; the bijectors rule that out.
    """
    fusion = {name: _rounded(value) for name, value in fusion_numbers(params.fusion).items()}
    config = replace(config, fusion=replace(config.fusion, **fusion))
    numbers = {name: _rounded(value) for name, value in params.labeller.items()}
    # Relief may stand beside another labeller, whose numbers then come first.
    for section in (config.labeller, "relief"):
        options: Any = getattr(config, section, None)
        own = {name: numbers.pop(name) for name in list(numbers) if hasattr(options, name)}
        if own:
            config = replace(config, **{section: replace(options, **own)})
    return config


def mapping_tree(config: MapConfig) -> dict[str, Any]:
    """The settings as plain values, without what is of the data alone."""
    return {name: value for name, value in config_tree(config).items() if name not in _DATA and value is not None}


def _rounded(value: Any) -> Any:
    """Numbers to six digits, as lists where there are several."""
    array = np.asarray(value, np.float64)
    rounded = np.array([float(f"{number:.6g}") for number in array.ravel()]).reshape(array.shape)
    return rounded.tolist()


@dataclass(frozen=True)
class Source:
    """A sequence and its ground truth; labels and poses where they are its own."""

    sequence: str
    truth: Path
    labels: Path | None = None
    poses: Path | None = None


class TuningPlan(NamedTuple):
    """What is tuned, and on what.

    Attributes:
        config: the settings, with what the first sequence has decided.
        mappings: how each sequence is mapped.
        target: index of the class that is scored.
        before: the parameters of the settings.
        start: those that tuning starts from: of a sharp plane, a soft one.
    """

    config: MapConfig
    mappings: tuple[Plan, ...]
    target: int
    before: TunedParams
    start: TunedParams


def plan_tuning(
    sources: Sequence[Source], config: MapConfig, target: str, options: TuneOptions, notify: Notify
) -> TuningPlan:
    """Opens the sequences and decides what is tuned.

    Args:
        sources: the traverses.
        config: how they are mapped; the start of what is tuned.
        target: name of the class that is scored.
        options: of tuning.
        notify: takes lines for the user.

    Raises:
        JaxmapError: a sequence cannot be opened, or the settings do not serve.
        UsageError: the map has no such class, or no such parameter that is to be frozen.
    """
    sharp = config.labeller == "plane" and config.plane.softness_m == 0
    if sharp:
        # A sharp threshold passes no gradient.
        config = replace(config, plane=replace(config.plane, softness_m=SOFT_START_M))
    mappings: list[Plan] = []
    for source in sources:
        mine = replace(config, labels=source.labels or config.labels, poses=source.poses or config.poses)
        mappings.append(plan_run(source.sequence, mine, notify))
        if len(mappings) == 1:
            # What a sequence leaves open is decided once: the numbers hold for these voxels and this range.
            config = decided(config, mappings[0])
    scored = target_of(mappings[0], target)
    start = TunedParams(mappings[0].params.fusion, tunable_numbers(mappings[0].labeller, mappings[0].rule))
    check_frozen(options.frozen, tuple(plain(start)))
    before = start
    if sharp and start.labeller:
        before = start._replace(labeller=start.labeller | {"softness_m": jnp.zeros(())})
    return TuningPlan(config, tuple(mappings), scored, before, start)


def target_of(plan: Plan, name: str) -> int:
    """The index of the class that is scored.

    Raises:
        UsageError: the map has none of that name.
    """
    classes = plan.labeller.classes
    if name not in classes:
        raise UsageError(
            f"the map has no class {name!r}: its classes are {' '.join(classes) or 'none'}",
            where="--class",
            fix="name one of them, or choose another --labeller",
        )
    return classes.index(name)


def check_frozen(frozen: Sequence[str], names: Sequence[str]) -> None:
    """Refuses parameters to keep as they are that are none of those tuned.

    Raises:
        UsageError: there are some.
    """
    if unknown := [name for name in frozen if name not in names]:
        raise UsageError(f"no parameter {', '.join(unknown)}", where="--frozen", fix=f"name some of {' '.join(names)}")


def decided(config: MapConfig, plan: Plan) -> MapConfig:
    """The settings with voxels and range as the first sequence has them."""
    size_m = tuple(float(edge) for edge in np.asarray(plan.grid.voxel_size_m, np.float64).round(6))
    return replace(
        config,
        classes=plan.labeller.classes or None,
        grid=replace(config.grid, voxel_size_m=size_m),
        depth=replace(config.depth, min_m=plan.depth_range_m[0], max_m=plan.depth_range_m[1]),
    )


def plain(params: TunedParams) -> dict[str, Any]:
    """Parameters as plain numbers by name; priors are log-odds, as the filter holds them."""
    values = {**asdict(params.fusion), **params.labeller}
    return {
        name: np.asarray(value, np.float64).round(6).tolist() for name, value in values.items() if value is not None
    }


def usable_frames(
    frames: Iterable[PreparedFrame], *, strict: bool, notify: Notify, on_frame: Callable[[PreparedFrame], None]
) -> Iterator[Frame]:
    """The frames that are ready; of the others it is told, or they stop it.

    Args:
        frames: as `Plan.prepare` makes them.
        strict: stop at the first that cannot be used.
        notify: takes a line on each that is left out.
        on_frame: is called with every frame.

    Raises:
        FrameError: a frame cannot be used, and `strict` is set.
    """
    for prepared in frames:
        if prepared.frame is not None:
            yield prepared.frame
        elif prepared.fault is not None and strict:
            raise prepared.fault
        else:
            notify(f"skipped {prepared.ref.name}: {prepared.fault}")
        on_frame(prepared)


def read_traverse(
    source: Source, plan: Plan, frames: Iterable[Frame], truth: TruthOptions, options: TuneOptions, *, notify: Notify
) -> Traverse:
    """What tuning keeps of the frames of a traverse, and its truth.

    Raises:
        JaxmapError: data that do not serve.
    """
    recipe = CacheRecipe(plan.front_end.camera, plan.grid, plan.labeller, plan.rule, plan.depth_range_m)
    class_map = class_layer_of(
        plan.mapper.init(),
        plan.params.fusion,
        plan.rule,
        truth.target,
        site_origin=plan.sequence.site_origin,
        crs=plan.sequence.crs,
    )
    raster = read_truth([source.truth], class_map.place, truth)
    for note in raster.notes:
        notify(f"note: {note}")
    return make_traverse(
        plan.sequence.name,
        recipe,
        build_cache(recipe, frames, plan.params, plan.key, block_px=options.block_px),
        raster,
        plan.sequence.site_origin,
        plan.sequence.crs,
        cell_size_m=options.cell_size_m,
        rock_fraction=options.loss.rock_fraction,
        held_out_share=options.held_out_share,
        seed=options.seed,
    )


def scores_of_parts(
    traverses: Sequence[Traverse], old: Sequence[ScoredCells], new: Sequence[ScoredCells], seed: int
) -> dict[str, Any]:
    """`scores` and `calibration` before and after, of the ground that is held out and of that tuned on.

    Args:
        traverses: which cells are held out.
        old: the cells of each traverse before.
        new: the same cells after.
        seed: of the bootstrap.
    """
    scores: dict[str, Any] = {}
    calibration: dict[str, Any] = {}
    for part, wanted in (("held_out", True), ("tuned_on", False)):
        one, other = (_part(traverses, cells, held_out=wanted) for cells in (old, new))
        scores[part] = score_with_intervals(one, other, seed=seed)
        calibration[part] = {"before": calibration_rows(one), "after": calibration_rows(other)}
    return {"scores": scores, "calibration": calibration}


def _part(traverses: Sequence[Traverse], cells: Sequence[ScoredCells], *, held_out: bool) -> ScoredCells:
    """Of the cells of all traverses, those that are held out, or those tuned on."""
    parts = []
    for one, mine in zip(traverses, cells, strict=True):
        mask = np.asarray(one.arrays.held_out)[np.asarray(one.arrays.truth.counted)] == held_out
        parts.append(ScoredCells(*(column[mask] for column in mine)))
    return joined(parts)


def write_result(
    out: Path,
    read: Sequence[tuple[Source, Plan, Traverse]],
    target: str,
    before: dict[str, Any],
    records: Sequence[dict[str, Any]],
) -> dict[str, Any]:
    """Writes the JSON and the page of a tuning beside its configuration, and returns what the JSON holds.

    Args:
        out: the configuration.
        read: what was tuned on.
        target: name of the class that is scored.
        before: the numbers tuned, as they were.
        records: of each descent.
    """
    findings = [f"{plan.sequence.name}: {finding_line(one)}" for _, plan, _ in read for one in plan.findings]
    result = {
        "jaxmap_version": jaxmap.__version__,
        "class": target,
        "labeller": read[0][1].labeller.name,
        "traverses": [
            {
                "sequence": plan.source,
                "ground_truth": str(source.truth),
                "frames": len(plan.sequence.frames),
                "cells": int(np.asarray(one.arrays.truth.counted).sum()),
                "held_out_cells": int(np.asarray(one.arrays.truth.counted & one.arrays.held_out).sum()),
            }
            for source, plan, one in read
        ],
        "before": before,
        "stages": list(records),
        "notes": [*findings, *(note for record in records for note in descent_notes(record))],
    }
    write_json(out.with_suffix(".json"), result)
    with atomic_path(out.with_suffix(".html")) as temporary:
        temporary.write_text(tuning_page(out.stem, result), encoding="utf-8", errors="backslashreplace")
    return result


class TuningRun:
    """Tunes the fusion of one or more traverses, and keeps the best on disk.

    Args:
        sources: the traverses.
        config: how they are mapped; the start of what is tuned.
        truth: how the ground truth is read.
        options: of tuning.
        out: the YAML file to write; scores and page go beside it.
        notify: takes lines for the user.
    """

    def __init__(
        self,
        sources: Sequence[Source],
        config: MapConfig,
        truth: TruthOptions,
        options: TuneOptions,
        out: Path,
        *,
        notify: Notify,
    ) -> None:
        self._truth, self._options, self._out, self._notify = truth, options, out, notify
        self._sources = sources
        plan = plan_tuning(sources, config, truth.target, options, notify)
        self._config, self._plans, self._target, self._before, self._start = plan
        self.frames = sum(len(plan.sequence.frames) for plan in self._plans)
        self._traverses: list[Traverse] = []

    def cache(self, advance: Callable[[int], None]) -> None:
        """Reads all frames and keeps what tuning needs of them.

        Raises:
            JaxmapError: data that do not serve, or ground truth on which nothing can be tuned.
        """
        done = 0
        for source, plan in zip(self._sources, self._plans, strict=True):

            def on_frame(prepared: PreparedFrame, plan: Plan = plan) -> None:
                nonlocal done
                done += 1
                advance(done)

            strict = self._config.strict
            frames = usable_frames(plan.prepare(), strict=strict, notify=self._notify, on_frame=on_frame)
            self._traverses.append(read_traverse(source, plan, frames, self._truth, self._options, notify=self._notify))
        check_classes(self._traverses, self._truth.target)

    def tune(self, advance: Callable[[int, str], None]) -> dict[str, Any]:
        """Descends, writing the best so far at every step, and returns what is written into the JSON.

        Raises:
            JaxmapError: the loss diverges, or writing failed; what was best before is kept.
        """
        before = self._before
        stages = [self._stage("tuned", before, self._start, advance)]
        if self._options.kernel:
            start = stages[-1].params
            middle = np.zeros((self._options.kernel,) * 2)
            middle[self._options.kernel // 2, self._options.kernel // 2] = 1.0
            kernel = jnp.asarray(np.broadcast_to(middle, (len(self._plans[0].labeller.classes), *middle.shape)))
            start = start._replace(fusion=replace(start.fusion, class_kernel=kernel.astype(jnp.float32)))

            def further(step: int, note: str) -> None:
                advance(self._options.descent.steps + step, note)

            stages.append(self._stage("with kernel", before, start, further))
        self._write_config(stages[-1].params)
        read = list(zip(self._sources, self._plans, self._traverses, strict=True))
        records = [stage.record for stage in stages]
        return write_result(self._out, read, self._truth.target, plain(before), records)

    def _stage(self, name: str, before: TunedParams, start: TunedParams, advance: Callable[[int, str], None]) -> _Stage:
        """One descent from `start`, the best so far written at every step; reported beside `before`."""
        bijectors = self._plans[0].labeller.bijectors
        free = unconstrained(start, bijectors)
        history: list[dict[str, float]] = []

        def loss(free: TunedParams, arrays: list[TraverseArrays]) -> tuple[jax.Array, jax.Array]:
            params = constrained(free, bijectors)
            traverses = [replace(one, arrays=mine) for one, mine in zip(self._traverses, arrays, strict=True)]
            both = [traverse_losses(one, params, self._target, self._options.loss) for one in traverses]
            tuned = jnp.stack([tuned for (tuned, _), _ in both]).mean()
            return tuned, jnp.stack([held for _, (held, _) in both]).mean()

        def on_step(step: Step) -> None:
            history.append({"step": step.number, "loss": step.losses.tuned, "held_out": step.losses.held_out})
            if step.best:
                self._write_config(constrained(step.free, bijectors))
            advance(step.number, f"loss {step.losses.tuned:.4f}, held out {step.losses.held_out:.4f}")

        data = ([one.arrays for one in self._traverses],)
        best = descend(loss, free, self._options.descent, data=data, moves=self._moves(free), on_step=on_step)
        after = constrained(best.free, bijectors)
        record: dict[str, Any] = {
            "name": name,
            "best_step": best.number,
            "parameters": plain(after),
            "history": history,
        }
        old, new = ([score_cells(one, params, self._target) for one in self._traverses] for params in (before, after))
        return _Stage(after, record | scores_of_parts(self._traverses, old, new, self._options.seed))

    def _moves(self, free: TunedParams) -> TunedParams:
        """1 for what moves, 0 for what is frozen or acts on nothing under the rule."""

        def of(name: str, leaf: Any) -> Any:
            return None if leaf is None else jnp.full_like(leaf, name not in self._options.frozen)

        fusion = {name: of(name, value) for name, value in asdict(free.fusion).items()}
        labeller = {name: of(name, value) for name, value in free.labeller.items()}
        return TunedParams(replace(free.fusion, **fusion), labeller)

    def _write_config(self, params: TunedParams) -> None:
        write_yaml(self._out, mapping_tree(tuned_config(self._config, params)))


class _Stage(NamedTuple):
    """The parameters that a descent reached, and its record."""

    params: TunedParams
    record: dict[str, Any]


def descent_notes(stage: Mapping[str, Any]) -> list[str]:
    """What is to be said of a descent that led nowhere; of one that led somewhere, nothing.

    Args:
        stage: as the JSON of `jaxmap tune` has it.
    """
    first, last = stage["history"][0], stage["history"][-1]
    if first is last:
        tried = f"{stage['tried']} steps tried, from --learning-rate down"
        return [f"{stage['name']}: the loss falls nowhere around the start, whose numbers are kept ({tried})"]
    grown = last["loss"] > first["loss"]
    if stage["best_step"] and not grown:
        return []
    course = f"the loss went from {first['loss']:.3f} to {last['loss']:.3f} in {last['step']} steps"
    advice = ": take a lower --learning-rate" if grown else ""
    if stage["best_step"]:
        return [f"{stage['name']}: {course}, and what is kept is of step {stage['best_step']}{advice}"]
    return [
        f"{stage['name']}: nothing better than the start was found on the held-out ground, whose numbers are kept; "
        f"{course}{advice}"
    ]

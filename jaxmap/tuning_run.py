"""`jaxmap tune` from plans to files: caches evidence, descends, and writes a configuration, scores and a page."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxmap
from jaxmap.config import MapConfig
from jaxmap.files import atomic_path, remove
from jaxmap.map_evaluation import TruthOptions, class_map_of, read_truth
from jaxmap.mapping_plan import Plan, Tell
from jaxmap.output_folder import write_json, write_yaml
from jaxmap.report.tuning_page import tuning_page
from jaxmap.sequence import prepare_frames
from jaxmap.tuning.cell_scores import ScoredCells, calibration_rows, joined, score_with_intervals
from jaxmap.tuning.descent import Step, descend
from jaxmap.tuning.evidence_cache import CacheRecipe, build_cache, tunable_labels
from jaxmap.tuning.parametrisation import TunedParams, to_free, to_legal
from jaxmap.tuning.traverse_loss import (
    Traverse,
    TraverseArrays,
    check_classes,
    make_traverse,
    score_cells,
    traverse_losses,
)
from jaxmap.tuning_config import tuned_tree
from jaxmap.tuning_plan import Source, TuneOptions, plain, plan_tuning

SOFT_START_M = 0.03
"""Where the width of the plane's threshold starts when the settings have a sharp one, which nothing can move."""


class TuningRun:
    """Tunes the fusion of one or more traverses, and keeps the best on disk.

    Args:
        sources: the traverses.
        config: how they are mapped; the start of what is tuned.
        truth: how the ground truth is read.
        options: of tuning.
        out: the YAML file to write; scores and page go beside it.
        tell: takes lines for the user.
    """

    def __init__(
        self,
        sources: Sequence[Source],
        config: MapConfig,
        truth: TruthOptions,
        options: TuneOptions,
        out: Path,
        *,
        tell: Tell,
    ) -> None:
        self._truth, self._options, self._out, self._tell = truth, options, out, tell
        self._sources = sources
        plan = plan_tuning(sources, config, truth.target, options, tell)
        self._config, self._plans, self._target, self._start = plan
        self.frames = sum(len(plan.sequence.frames) for plan in self._plans)
        self._traverses: list[Traverse] = []

    def cache(self, advance: Callable[[int], None]) -> None:
        """Reads all frames and keeps what tuning needs of them.

        Raises:
            JaxmapError: data that do not serve, or ground truth on which nothing can be tuned.
        """
        done = 0
        for source, plan in zip(self._sources, self._plans, strict=True):
            recipe = CacheRecipe(plan.front_end.camera, plan.grid, plan.labeller, plan.rule, plan.depth_range_m)
            class_map = class_map_of(
                plan.mapper.init(),
                plan.params.fusion,
                plan.rule,
                self._truth.target,
                site_origin=plan.sequence.site_origin,
                crs=plan.sequence.crs,
            )
            raster = read_truth([source.truth], class_map.place, self._truth)
            for note in raster.notes:
                self._tell(f"note: {note}")

            def frames(plan: Plan = plan) -> Any:
                nonlocal done
                needs = plan.labeller.needs
                for prepared in prepare_frames(plan.sequence, plan.front_end, plan.label_folder, needs=needs):
                    if prepared.frame is not None:
                        yield prepared.frame
                    elif prepared.fault is not None and self._config.strict:
                        raise prepared.fault
                    else:
                        self._tell(f"skipped {prepared.ref.name}: {prepared.fault}")
                    done += 1
                    advance(done)

            cache = build_cache(recipe, frames(), plan.params, plan.key, block_px=self._options.block_px)
            options = self._options
            self._traverses.append(
                make_traverse(
                    plan.sequence.name,
                    recipe,
                    cache,
                    raster,
                    plan.sequence.site_origin,
                    plan.sequence.crs,
                    cell_size_m=options.cell_size_m,
                    rock_fraction=options.loss.rock_fraction,
                    held_out_share=options.held_out_share,
                    seed=options.seed,
                )
            )
        check_classes(self._traverses, self._truth.target)

    def tune(self, advance: Callable[[int, str], None]) -> dict[str, Any]:
        """Descends, writing the best so far at every step, and returns what is written into the JSON.

        Raises:
            JaxmapError: the loss diverges, or writing failed; what was best before is kept.
        """
        before = start = self._start
        if start.labeller.get("softness_m") == 0.0:
            start = start._replace(labeller=start.labeller | {"softness_m": jnp.asarray(SOFT_START_M)})
        stages = [self._stage("tuned", before, start, advance)]
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
        result = {
            "jaxmap_version": jaxmap.__version__,
            "class": self._truth.target,
            "labeller": self._plans[0].labeller.name,
            "traverses": self._told_traverses(),
            "before": plain(before),
            "stages": [stage.told for stage in stages],
            "notes": [note for stage in stages for note in descent_notes(stage.told)],
        }
        write_json(self._out.with_suffix(".json"), result)
        with atomic_path(self._out.with_suffix(".html")) as temporary:
            temporary.write_text(tuning_page(self._out.stem, result), encoding="utf-8")
        return result

    def _stage(self, name: str, before: TunedParams, start: TunedParams, advance: Callable[[int, str], None]) -> _Stage:
        """One descent from `start`, the best so far written at every step; told beside `before`."""
        limits = tunable_labels(self._plans[0].labeller, self._plans[0].rule).limits
        free = to_free(start, limits)
        history: list[dict[str, float]] = []

        def loss(free: TunedParams, arrays: list[TraverseArrays]) -> tuple[jax.Array, jax.Array]:
            legal = to_legal(free, limits)
            traverses = [replace(one, arrays=mine) for one, mine in zip(self._traverses, arrays, strict=True)]
            both = [traverse_losses(one, legal, self._target, self._options.loss) for one in traverses]
            tuned = jnp.stack([tuned for (tuned, _), _ in both]).mean()
            return tuned, jnp.stack([held for _, (held, _) in both]).mean()

        def on_step(step: Step) -> None:
            history.append({"step": step.number, "loss": step.losses.tuned, "held_out": step.losses.held_out})
            if step.best:
                self._write_config(to_legal(step.free, limits))
            advance(step.number, f"loss {step.losses.tuned:.4f}, held out {step.losses.held_out:.4f}")

        data = ([one.arrays for one in self._traverses],)
        best = descend(loss, free, self._options.descent, data=data, moves=self._moves(free), on_step=on_step)
        after = to_legal(best.free, limits)
        told: dict[str, Any] = {"name": name, "best_step": best.number, "parameters": plain(after), "history": history}
        told |= {"scores": {}, "calibration": {}}
        old, new = (
            [score_cells(one, params, self._target) for one in self._traverses] for params in (_hard(before), after)
        )
        for part, wanted in (("held_out", True), ("tuned_on", False)):
            one, other = (self._part(cells, wanted) for cells in (old, new))
            told["scores"][part] = score_with_intervals(one, other, seed=self._options.seed)
            told["calibration"][part] = {"before": calibration_rows(one), "after": calibration_rows(other)}
        return _Stage(after, told)

    def _told_traverses(self) -> list[dict[str, Any]]:
        return [
            {
                "sequence": plan.source,
                "ground_truth": str(source.truth),
                "frames": len(plan.sequence.frames),
                "cells": int(np.asarray(one.arrays.truth.counted).sum()),
                "held_out_cells": int(np.asarray(one.arrays.truth.counted & one.arrays.held_out).sum()),
            }
            for plan, source, one in zip(self._plans, self._sources, self._traverses, strict=True)
        ]

    def _moves(self, free: TunedParams) -> TunedParams:
        """1 for what moves, 0 for what is frozen or acts on nothing under the rule."""

        def of(name: str, leaf: Any) -> Any:
            return None if leaf is None else jnp.full_like(leaf, name not in self._options.frozen)

        fusion = {name: of(name, value) for name, value in asdict(free.fusion).items()}
        labeller = {name: of(name, value) for name, value in free.labeller.items()}
        return TunedParams(replace(free.fusion, **fusion), labeller)

    def _write_config(self, params: TunedParams) -> None:
        # Scores and page of an earlier run are of other numbers; those of this one come at its end.
        for suffix in (".json", ".html"):
            remove(self._out.with_suffix(suffix))
        write_yaml(self._out, tuned_tree(self._config, params))

    def _part(self, cells: list[ScoredCells], held_out: bool) -> ScoredCells:
        """Of the cells of all traverses, those that are held out, or those tuned on."""
        parts = []
        for one, mine in zip(self._traverses, cells, strict=True):
            mask = np.asarray(one.arrays.held_out)[np.asarray(one.arrays.truth.counted)] == held_out
            parts.append(ScoredCells(*(column[mask] for column in mine)))
        return joined(parts)


class _Stage(NamedTuple):
    """What a descent came to, and what is told of it."""

    params: TunedParams
    told: dict[str, Any]


def descent_notes(stage: Mapping[str, Any]) -> list[str]:
    """What is to be said of a descent that led nowhere; of one that led somewhere, nothing.

    Args:
        stage: as the JSON of `jaxmap tune` has it.
    """
    first, last = stage["history"][0], stage["history"][-1]
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


def _hard(params: TunedParams) -> TunedParams:
    """A sharp threshold as one so narrow that it makes no difference: widths are divided by."""
    if params.labeller.get("softness_m") == 0.0:
        return params._replace(labeller=params.labeller | {"softness_m": jnp.asarray(1e-5)})
    return params

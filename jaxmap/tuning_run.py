"""`jaxmap tune` from plans to files: caches evidence, descends, and writes a configuration, scores and a page."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxmap
from jaxmap.config import MapConfig
from jaxmap.errors import UsageError
from jaxmap.map_evaluation import TruthOptions, class_map_of, read_truth
from jaxmap.mapping_plan import Plan, Tell, plan_run
from jaxmap.output_folder import write_json, write_yaml
from jaxmap.sequence import prepare_frames
from jaxmap.tuning.cell_scores import ScoredCells, calibration_rows, joined, score_with_intervals
from jaxmap.tuning.descent import DescentOptions, Step, descend
from jaxmap.tuning.evidence_cache import BLOCK_PX, CacheRecipe, build_cache, tunable_labels
from jaxmap.tuning.map_loss import LossOptions
from jaxmap.tuning.parametrisation import TunedParams, to_free, to_legal
from jaxmap.tuning.traverse_loss import Traverse, check_classes, make_traverse, score_cells, traverse_losses
from jaxmap.tuning_config import tuned_tree

SOFT_START_M = 0.03
"""Where the width of the plane's threshold starts when the settings have a sharp one, which nothing can move."""


@dataclass(frozen=True)
class TuneOptions:
    """How fusion is tuned.

    Attributes:
        descent: of the gradient.
        loss: what is descended.
        frozen: names of parameters that stay as they are.
        cell_size_m: edge of the cells that are scored.
        held_out_share: of the ground, kept from the descent and used to stop it.
        block_px: see `evidence_cache.BLOCK_PX`.
        seed: of what is held out, and of the bootstrap.
    """

    descent: DescentOptions = field(default_factory=DescentOptions)
    loss: LossOptions = field(default_factory=LossOptions)
    frozen: tuple[str, ...] = ()
    cell_size_m: float = 0.2
    held_out_share: float = 0.25
    block_px: int = BLOCK_PX
    seed: int = 0


@dataclass(frozen=True)
class Source:
    """A sequence and its ground truth; labels and poses where they are its own."""

    sequence: str
    truth: Path
    labels: Path | None = None
    poses: Path | None = None


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
        self._plans: list[Plan] = []
        for source in sources:
            mine = replace(config, labels=source.labels or config.labels, poses=source.poses or config.poses)
            plan = plan_run(source.sequence, mine, tell)
            if not self._plans:
                # What a sequence leaves open is decided once: the numbers hold for these voxels and this range.
                config = _decided(config, plan)
            self._plans.append(plan)
        self._config = config
        classes = self._plans[0].labeller.classes
        if truth.target not in classes:
            raise UsageError(
                f"the map has no class {truth.target!r}: its classes are {' '.join(classes) or 'none'}",
                where="--class",
                fix="name one of them, or choose another --labeller",
            )
        self._target = classes.index(truth.target)
        self.frames = sum(len(plan.sequence.frames) for plan in self._plans)
        self.history: list[dict[str, float]] = []
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
        tunable = tunable_labels(self._traverses[0].recipe)
        before = self._start()
        start = before
        if start.labeller.get("softness_m") == 0.0:
            start = start._replace(labeller=start.labeller | {"softness_m": jnp.asarray(SOFT_START_M)})
        limits = tunable.limits
        free = to_free(start, limits)

        @jax.jit
        def loss(free: TunedParams) -> tuple[jax.Array, jax.Array]:
            legal = to_legal(free, limits)
            both = [traverse_losses(one, legal, self._target, self._options.loss) for one in self._traverses]
            tuned = jnp.stack([tuned for (tuned, _), _ in both]).mean()
            return tuned, jnp.stack([held for _, (held, _) in both]).mean()

        def on_step(step: Step) -> None:
            self.history.append({"step": step.number, "loss": step.losses.tuned, "held_out": step.losses.held_out})
            if step.best:
                self._write_config(to_legal(step.free, limits))
            advance(step.number, f"loss {step.losses.tuned:.4f}, held out {step.losses.held_out:.4f}")

        best = descend(loss, free, self._options.descent, moves=self._moves(free), on_step=on_step)
        after = to_legal(best.free, limits)
        return self._finish(before, after, best)

    def _start(self) -> TunedParams:
        numbers = tunable_labels(self._traverses[0].recipe).numbers
        return TunedParams(
            self._plans[0].params.fusion, {name: jnp.asarray(value, jnp.float32) for name, value in numbers.items()}
        )

    def _moves(self, free: TunedParams) -> TunedParams:
        """1 for what moves, 0 for what is frozen or acts on nothing under the rule."""
        names = {**asdict(free.fusion), **free.labeller}
        if unknown := [name for name in self._options.frozen if name not in names]:
            raise UsageError(
                f"no parameter {', '.join(unknown)}", where="--frozen", fix=f"name some of {' '.join(names)}"
            )

        def of(name: str, leaf: Any) -> Any:
            return None if leaf is None else jnp.full_like(leaf, name not in self._options.frozen)

        fusion = {name: of(name, value) for name, value in asdict(free.fusion).items()}
        labeller = {name: of(name, value) for name, value in free.labeller.items()}
        return TunedParams(replace(free.fusion, **fusion), labeller)

    def _write_config(self, params: TunedParams) -> None:
        write_yaml(self._out, tuned_tree(self._config, params))

    def _scored(self, params: TunedParams, wanted: bool | None) -> ScoredCells:
        """The cells of all traverses; only those held out, or tuned on, where asked."""
        parts = []
        for one in self._traverses:
            cells = score_cells(one, params, self._target)
            if wanted is not None:
                mask = one.held_out[np.asarray(one.truth.counted)] == wanted
                cells = ScoredCells(*(column[mask] for column in cells))
            parts.append(cells)
        return joined(parts)

    def _finish(self, before: TunedParams, after: TunedParams, best: Step) -> dict[str, Any]:
        self._write_config(after)
        result = {
            "jaxmap_version": jaxmap.__version__,
            "class": self._truth.target,
            "labeller": self._plans[0].labeller.name,
            "traverses": [
                {
                    "sequence": plan.source,
                    "ground_truth": str(source.truth),
                    "frames": len(plan.sequence.frames),
                    "cells": int(np.asarray(one.truth.counted).sum()),
                    "held_out_cells": int((np.asarray(one.truth.counted) & one.held_out).sum()),
                }
                for plan, source, one in zip(self._plans, self._sources, self._traverses, strict=True)
            ],
            "best_step": best.number,
            "history": self.history,
            "scores": {},
            "calibration": {},
            "parameters": {"before": plain(before), "after": plain(after)},
        }
        for part, wanted in (("held_out", True), ("tuned_on", False)):
            old, new = (self._scored(params, wanted) for params in (_hard(before), after))
            result["scores"][part] = score_with_intervals(old, new, seed=self._options.seed)
            result["calibration"][part] = {"before": calibration_rows(old), "after": calibration_rows(new)}
        write_json(self._out.with_suffix(".json"), result)
        return result


def plain(params: TunedParams) -> dict[str, Any]:
    """Parameters as plain numbers by name; priors are log-odds, as the filter holds them."""
    values = {**asdict(params.fusion), **params.labeller}
    return {
        name: np.asarray(value, np.float64).round(6).tolist() for name, value in values.items() if value is not None
    }


def _hard(params: TunedParams) -> TunedParams:
    """A sharp threshold as one so narrow that it makes no difference: widths are divided by."""
    if params.labeller.get("softness_m") == 0.0:
        return params._replace(labeller=params.labeller | {"softness_m": jnp.asarray(1e-5)})
    return params


def _decided(config: MapConfig, plan: Plan) -> MapConfig:
    """The settings with voxels and range as the first sequence has them."""
    size_m = tuple(float(edge) for edge in np.asarray(plan.grid.voxel_size_m, np.float64).round(6))
    return replace(
        config,
        classes=plan.labeller.classes or None,
        grid=replace(config.grid, voxel_size_m=size_m),
        depth=replace(config.depth, min_m=plan.depth_range_m[0], max_m=plan.depth_range_m[1]),
    )

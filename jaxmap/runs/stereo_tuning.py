"""`jaxmap tune --through stereo`: tunes how pairs are matched by the score of the map that comes out.

Frames are matched softly, smaller than they are, at every step, and mapped at full size (`tuning.stereo_evidence`).
What is scored, before and after, is the map as `jaxmap map` makes it: matched with hard minima, at full size.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxmap.errors import UsageError
from jaxmap.host.files import atomic_path
from jaxmap.host.output_folder import write_yaml
from jaxmap.mapping.sequence import PreparedFrame
from jaxmap.mapping.step import make_mapper
from jaxmap.matching.design import MatchParams
from jaxmap.matching.mccnn import save_cost_network
from jaxmap.runs.config import MapConfig
from jaxmap.runs.evaluation import TruthOptions
from jaxmap.runs.labelling import Notify
from jaxmap.runs.mapping_plan import Plan, plan_run
from jaxmap.runs.tuning import (
    Source,
    check_frozen,
    decided,
    mapping_tree,
    read_traverse,
    scores_of_parts,
    target_of,
    usable_frames,
    write_result,
)
from jaxmap.stereo.front_end import RectifiedFrame
from jaxmap.stereo.jax_matcher import JaxMatcher
from jaxmap.tuning.cell_scores import ScoredCells
from jaxmap.tuning.descent import Slope, Step, go_down
from jaxmap.tuning.options import TuneOptions
from jaxmap.tuning.parametrisation import TunedParams
from jaxmap.tuning.small_frames import SmallPair, small_design, small_pair
from jaxmap.tuning.stereo_evidence import StereoGradient, StereoTraverse, make_stereo_gradient
from jaxmap.tuning.stereo_params import FreeMatch, free_match, matched_by
from jaxmap.tuning.traverse_loss import Traverse, check_classes, score_cells
from jaxmap.types import Frame, to_device

_WHERE = "--through stereo"


class StereoTuningRun:
    """Tunes the matching of one or more traverses, and keeps the best on disk.

    Args:
        sources: the traverses.
        config: how they are mapped; its stereo options are the start of what is tuned.
        truth: how the ground truth is read.
        options: of tuning.
        out: the YAML file to write; scores, page and the weights of a cost network go beside it.
        final: where that file will be in the end.
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
        final: Path,
        notify: Notify,
    ) -> None:
        _refuse(config, options)
        self._sources, self._truth, self._options, self._notify = sources, truth, options, notify
        self._out, self._final = out, final
        self._plans: list[Plan] = []
        for source in sources:
            self._plans.append(self._plan(source, config))
            if len(self._plans) == 1:
                config = decided(config, self._plans[0])
        self._config = config
        self._start = _matcher(self._plans[0]).params
        self._target = target_of(self._plans[0], truth.target)
        check_frozen(options.frozen, tuple(free_match(self._start)))
        # Read twice: before, and matched anew in the end.
        self.frames = sum(len(plan.sequence.frames) for plan in self._plans)
        self._traverses: list[Traverse] = []
        self._gradients: list[StereoGradient] = []

    def _plan(self, source: Source, config: MapConfig) -> Plan:
        mine = replace(config, labels=source.labels or config.labels, poses=source.poses or config.poses)
        plan = plan_run(source.sequence, mine, self._notify)
        if plan.observations is not None:
            raise UsageError(
                "observations hold no images to be matched anew", where=source.sequence, fix="give the sequence itself"
            )
        return plan

    def cache(self, advance: Callable[[int], None]) -> None:
        """Reads all frames, scores the map that they make before, and keeps them small.

        Raises:
            JaxmapError: data that do not serve, or ground truth on which nothing can be tuned.
        """
        times, done = self._options.smaller, 0
        for source, plan in zip(self._sources, self._plans, strict=True):
            seen: list[tuple[Frame, SmallPair]] = []

            def on_frame(prepared: PreparedFrame, seen: list[tuple[Frame, SmallPair]] = seen) -> None:
                nonlocal done
                if prepared.frame is not None and prepared.rectified is not None:
                    frame = replace(prepared.frame, disparity_px=None, blind=_blind(prepared.rectified))
                    seen.append((frame, small_pair(prepared.rectified, times)))
                done += 1
                advance(done)

            self._traverses.append(self._read(source, plan, on_frame))
            traverse = _small_traverse(plan, self._traverses[-1], seen, times)
            self._gradients.append(make_stereo_gradient(traverse, self._target, self._options.loss))
        check_classes(self._traverses, self._truth.target)

    def _read(self, source: Source, plan: Plan, on_frame: Callable[[PreparedFrame], None]) -> Traverse:
        frames = usable_frames(plan.prepare(), strict=self._config.strict, notify=self._notify, on_frame=on_frame)
        return read_traverse(source, plan, frames, self._truth, self._options, notify=self._notify)

    def tune(self, advance: Callable[[int, str], None]) -> dict[str, Any]:
        """Descends, writing the best so far at every step, and returns what is written into the JSON.

        Raises:
            JaxmapError: the loss diverges, or writing failed; what was best before is kept.
        """
        history: list[dict[str, float]] = []
        tried = 0

        def losses(free: FreeMatch) -> tuple[tuple[jax.Array, jax.Array], list[jax.Array]]:
            every = [gradient.losses(matched_by(free, self._start)) for gradient in self._gradients]
            tuned, held_out = (jnp.stack(values).mean() for values in zip(*(both for both, _ in every), strict=True))
            return (tuned, held_out), [cotangent for _, cotangent in every]

        def pull(free: FreeMatch, cotangents: list[jax.Array]) -> FreeMatch:
            match, back = jax.vjp(lambda free: matched_by(free, self._start), free)
            every = [one.pull(match, mine) for one, mine in zip(self._gradients, cotangents, strict=True)]
            return back(jax.tree.map(lambda *leaves: jnp.stack(leaves).mean(0), *every))[0]

        def on_step(step: Step) -> None:
            nonlocal tried
            tried = step.number
            if step.taken:
                history.append({"step": step.number, "loss": step.losses.tuned, "held_out": step.losses.held_out})
            if step.best:
                self._write_config(matched_by(step.free, self._start))
            note = "" if step.taken else ": taken back"
            advance(step.number, f"loss {step.losses.tuned:.4f}, held out {step.losses.held_out:.4f}{note}")

        start = free_match(self._start)
        frozen = self._options.frozen
        moves = {
            name: jax.tree.map(lambda leaf, name=name: jnp.full_like(leaf, name not in frozen), leaves)
            for name, leaves in start.items()
        }
        best = go_down(Slope(losses, pull), start, self._options.descent, moves=moves, on_step=on_step)
        after = matched_by(best.free, self._start)
        self._write_config(after)
        record = {"name": "tuned", "best_step": best.number, "tried": tried, "history": history}
        record |= {"parameters": _plain(after)}
        old = [self._score(one, one, plan) for one, plan in zip(self._traverses, self._plans, strict=True)]
        record |= scores_of_parts(self._traverses, old, self._scores_after(after), self._options.seed)
        read = list(zip(self._sources, self._plans, self._traverses, strict=True))
        return write_result(self._out, read, self._truth.target, _plain(self._start), [record])

    def _scores_after(self, match: MatchParams) -> list[ScoredCells]:
        """The cells that counted before, in the maps that the tuned numbers make, at full size."""
        config = replace(self._config, stereo=replace(self._config.stereo, **self._numbers(match, self._out)))
        scores = []
        for source, before in zip(self._sources, self._traverses, strict=True):
            plan = self._plan(source, config)
            scores.append(self._score(self._read(source, plan, lambda prepared: None), before, plan))
        return scores

    def _score(self, now: Traverse, before: Traverse, plan: Plan) -> ScoredCells:
        arrays = now.arrays._replace(truth=before.arrays.truth, held_out=before.arrays.held_out)
        params = TunedParams(plan.params.fusion, plan.params.labeller.numbers)
        return score_cells(replace(now, arrays=arrays, groups=before.groups), params, self._target)

    def _numbers(self, match: MatchParams, out: Path) -> dict[str, Any]:
        """The stereo options that are tuned, with the weights in a file beside `out`; they are written already."""
        numbers = {
            "step_penalty": float(f"{float(match.p1):.6g}"),
            "jump_penalty": float(f"{float(match.p2):.6g}"),
            "uniqueness_ratio": round(100 * float(match.uniqueness)),
        }
        if not match.cost:
            return numbers
        sha256 = hashlib.sha256(self._out.with_suffix(".safetensors").read_bytes()).hexdigest()
        return numbers | {
            "cost_network": out.with_suffix(".safetensors").absolute(),
            "cost_network_sha256": sha256,
        }

    def _write_config(self, match: MatchParams) -> None:
        if match.cost:
            with atomic_path(self._out.with_suffix(".safetensors")) as temporary:
                save_cost_network(match.cost, temporary)
        stereo = replace(self._config.stereo, **self._numbers(match, self._final))
        write_yaml(self._out, mapping_tree(replace(self._config, stereo=stereo)))


def _refuse(config: MapConfig, options: TuneOptions) -> None:
    if config.stereo.matcher == "opencv":
        raise UsageError("OpenCV's matcher passes no gradient", where=_WHERE, fix="add --stereo.matcher sgm, or mccnn")
    if config.stereo.soft:
        raise UsageError("a map is matched with hard minima", where="stereo.soft", fix="leave it out")
    if config.fusion.hard_labels:
        raise UsageError(
            f"fusion.per_frame {config.fusion.per_frame} counts points whole, and passes no gradient",
            where=_WHERE,
            fix="take mean or sum",
        )
    if options.kernel:
        raise UsageError("--kernel is of the fusion", where=_WHERE, fix="tune it apart, from the configuration written")


def _matcher(plan: Plan) -> JaxMatcher:
    assert isinstance(plan.front_end.matcher, JaxMatcher)
    return plan.front_end.matcher


def _blind(rectified: RectifiedFrame) -> jax.Array:
    """The pixels that have no disparity, whatever is matched; of the same form for every frame."""
    return to_device(np.zeros(rectified.left.shape[:2], bool) if rectified.blind is None else rectified.blind)


def _small_traverse(plan: Plan, scored: Traverse, frames: list[tuple[Frame, SmallPair]], times: int) -> StereoTraverse:
    """The traverse with small pairs, and a step that matches them softly."""
    camera, matcher = plan.front_end.camera, _matcher(plan)
    mapper = make_mapper(
        camera,
        plan.grid,
        plan.labeller,
        plan.rule,
        plan.depth_range_m,
        match=small_design(matcher.design, camera.width_px * camera.height_px, times),
        T_world_camera=plan.sequence.T_world_camera @ plan.front_end.T_raw_rectified,
    )
    return StereoTraverse(scored, mapper, frames, replace(plan.params, match=matcher.params), plan.key, times)


def _plain(match: MatchParams) -> dict[str, float]:
    """The numbers by the names of their options."""
    numbers = {"step_penalty": match.p1, "jump_penalty": match.p2, "uniqueness_ratio": 100 * match.uniqueness}
    return {name: float(np.asarray(value, np.float64).round(6)) for name, value in numbers.items()}

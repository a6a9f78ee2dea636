"""What `jaxmap tune` is about to do, decided in full before the first frame is read."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxmap.config import MapConfig
from jaxmap.errors import UsageError
from jaxmap.mapping_plan import Plan, Tell, plan_run
from jaxmap.tuning.descent import DescentOptions
from jaxmap.tuning.evidence_cache import BLOCK_PX, tunable_labels
from jaxmap.tuning.map_loss import LossOptions
from jaxmap.tuning.parametrisation import TunedParams

MAX_KERNEL = 9


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
        kernel: size of a kernel over neighbouring columns, learnt in a second descent; 0 for none.
    """

    descent: DescentOptions = field(default_factory=DescentOptions)
    loss: LossOptions = field(default_factory=LossOptions)
    frozen: tuple[str, ...] = ()
    cell_size_m: float = 0.2
    held_out_share: float = 0.25
    block_px: int = BLOCK_PX
    seed: int = 0
    kernel: int = 0

    def __post_init__(self) -> None:
        """Refuses what makes no sense."""
        if self.kernel and (self.kernel % 2 == 0 or not 3 <= self.kernel <= MAX_KERNEL):
            raise UsageError(f"kernel is {self.kernel}", where="tuning", fix=f"give an odd size from 3 to {MAX_KERNEL}")
        if not 0 < self.held_out_share < 1:
            raise UsageError(
                f"held_out_share is {self.held_out_share}", where="tuning", fix="give a share between 0 and 1"
            )
        if not 0 < self.loss.rock_fraction <= 1:
            raise UsageError(
                f"rock_fraction is {self.loss.rock_fraction}", where="tuning", fix="give a share above 0, at most 1"
            )
        for name, value in (("class_weight", self.loss.class_weight), ("cell_size_m", self.cell_size_m)):
            if not 0 < value < math.inf:
                raise UsageError(f"{name} is {value}", where="tuning", fix="give a number above 0")
        if not 0 <= self.loss.soft_iou < math.inf:
            raise UsageError(f"iou_weight is {self.loss.soft_iou}", where="tuning", fix="give a number from 0 on")


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
        start: the parameters that tuning starts from.
    """

    config: MapConfig
    mappings: tuple[Plan, ...]
    target: int
    start: TunedParams


def plan_tuning(
    sources: Sequence[Source], config: MapConfig, target: str, options: TuneOptions, tell: Tell
) -> TuningPlan:
    """Opens the sequences and decides what is tuned.

    Args:
        sources: the traverses.
        config: how they are mapped; the start of what is tuned.
        target: name of the class that is scored.
        options: of tuning.
        tell: takes lines for the user.

    Raises:
        JaxmapError: a sequence cannot be opened, or the settings do not serve.
        UsageError: the map has no such class, or no such parameter that is to be frozen.
    """
    mappings: list[Plan] = []
    for source in sources:
        mine = replace(config, labels=source.labels or config.labels, poses=source.poses or config.poses)
        mappings.append(plan_run(source.sequence, mine, tell))
        if len(mappings) == 1:
            # What a sequence leaves open is decided once: the numbers hold for these voxels and this range.
            config = _decided(config, mappings[0])
    classes = mappings[0].labeller.classes
    if target not in classes:
        raise UsageError(
            f"the map has no class {target!r}: its classes are {' '.join(classes) or 'none'}",
            where="--class",
            fix="name one of them, or choose another --labeller",
        )
    start = _start(mappings[0])
    names = plain(start)
    if unknown := [name for name in options.frozen if name not in names]:
        raise UsageError(f"no parameter {', '.join(unknown)}", where="--frozen", fix=f"name some of {' '.join(names)}")
    return TuningPlan(config, tuple(mappings), classes.index(target), start)


def _start(plan: Plan) -> TunedParams:
    numbers = tunable_labels(plan.labeller, plan.rule).numbers
    return TunedParams(plan.params.fusion, {name: jnp.asarray(value, jnp.float32) for name, value in numbers.items()})


def _decided(config: MapConfig, plan: Plan) -> MapConfig:
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

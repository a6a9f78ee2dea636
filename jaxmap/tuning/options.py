"""The options of tuning: the descent, the loss, and the ground that is scored."""

from __future__ import annotations

from dataclasses import field
from typing import Annotated, Literal, NamedTuple

import tyro
from annotated_types import Interval

from jaxmap.host.settings import CellSize, NotNegative, Positive, Seed, count, options

BLOCK_PX = 4
"""Points this near in the image, and in one voxel, are kept as one; 1 keeps every point."""


@options("tuning")
class DescentOptions:
    """The optimiser: Adam, its learning rate falling to zero along a half cosine; through stereo see `go_down`."""

    steps: Annotated[int, count(1_000_000)] = 150
    """Steps of descent, at most."""
    learning_rate: Annotated[float, Positive] = 0.05
    """Of the descent, in units of the unconstrained numbers; the least, if the loss diverges. Through stereo only steps
    are taken under which the loss falls, and this is the first one."""
    patience: Annotated[int, count(1_000_000)] = 40
    """Stop after so many steps without a better held-out loss."""
    max_norm: Annotated[float, Positive, tyro.conf.Suppress] = 10.0
    """Gradients are clipped to this norm."""


class Softness(NamedTuple):
    """Widths of the decisions: those of voxels and columns in log-odds, that of cells as a share of their area."""

    occupied: Annotated[float, Positive] = 0.1
    called: Annotated[float, Positive] = 0.5
    cell: Annotated[float, Positive] = 0.1


@options("tuning")
class MapLossOptions:
    """The terms of the loss of a map."""

    class_weight: Annotated[float, Positive] = 1.0
    """Weight of rock cells in the likelihood. Above 1 more rocks are found, and probabilities come out too high."""
    iou_weight: Annotated[float, NotNegative] = 1.0
    """Weight of 1 - soft IoU, beside the negative log-likelihood."""
    driving_weight: Annotated[float, NotNegative] = 0.0
    """Weight of what the map costs a rover that goes round the cells it calls rock and drives over the others, metres
    for each cell."""
    missed_rock_m: Annotated[float, NotNegative] = 10.0
    """What driving over a missed rock costs, in metres of driving."""
    detour_m: Annotated[float, NotNegative] = 1.0
    """What going round a cell costs."""
    rock_fraction: Annotated[float, Interval(gt=0, le=1)] = 0.5
    """A cell is rock where rock covers this share of it."""
    nll_weight: Annotated[float, NotNegative, tyro.conf.Suppress] = 1.0
    """Weight of the negative log-likelihood."""
    softness: Annotated[Softness, tyro.conf.Suppress] = Softness()
    """Widths of the decisions."""


@options("tuning")
class TuneOptions:
    """How fusion is tuned."""

    descent: Annotated[DescentOptions, tyro.conf.arg(name="")] = field(default_factory=DescentOptions)
    """The optimiser."""
    loss: Annotated[MapLossOptions, tyro.conf.arg(name="")] = field(default_factory=MapLossOptions)
    """The terms of the loss."""
    through: Literal["fusion", "stereo"] = "fusion"
    """What is tuned: the numbers of fusion and labels, or those of stereo matching (penalties, uniqueness, the weights
    of a cost network) by the map that comes out; --stereo.matcher then is sgm or mccnn."""
    smaller: Literal[1, 2, 4] = 2
    """Through stereo: match images so many times smaller while tuning; they are mapped and scored at full size. 1
    resembles the map most and is for a GPU."""
    held_out_share: Annotated[float, Interval(gt=0, lt=1)] = 0.25
    """Share of the ground that is held out, in blocks of 2 m and whole rocks."""
    kernel: Literal[0, 3, 5, 7, 9] = 0
    """Learn a kernel of so many columns a side for each class in a second descent, and write it too; 0 for none."""
    frozen: tuple[str, ...] = ()
    """Names of parameters that stay as they are, such as disparity_sigma_px."""
    cell_size_m: Annotated[float, CellSize] = 0.2
    """Edge of the cells that are scored."""
    block_px: Annotated[int, count(4096), tyro.conf.Suppress] = BLOCK_PX
    """Points this near in the image, and in one voxel, are kept as one."""
    seed: Annotated[int, Seed, tyro.conf.Suppress] = 0
    """Of what is held out, and of the bootstrap."""

"""The error map: rock that was found, imagined and missed, drawn from above over the ground."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import UInt8

from jaxmap.datasets.label_raster import OTHER, TARGET, UNLABELLED
from jaxmap.evaluation.evaluate import Evaluation
from jaxmap.evaluation.truth_cells import samples_of
from jaxmap.host.files import atomic_path
from jaxmap.report.plan_sheet import INK, Entries, draw_footer, lay_out, map_axes, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MAX_SAMPLES = 8
_TINT = 0.72
_UNOBSERVED_DIM = 0.55
_PAPER = (250, 250, 248)


class _Verdict(NamedTuple):
    """How a kind of cell is shown."""

    name: str
    colour: tuple[int, int, int]


# Okabe and Ito's colours, which those who do not see red or green tell apart too.
_FOUND = _Verdict("rock, found (TP)", (0, 158, 115))
_IMAGINED = _Verdict("no rock, called rock (FP)", (213, 94, 0))
_MISSED = _Verdict("rock, missed (FN)", (0, 114, 178))
_UNSEEN = _Verdict("rock, never observed", (204, 121, 167))
_SHADES = {UNLABELLED: _PAPER, OTHER: (226, 219, 205), TARGET: (168, 160, 150)}


def write_error_map(
    path: str | os.PathLike[str], evaluation: Evaluation, backdrop: UInt8[np.ndarray, "BI BJ 3"] | None = None
) -> None:
    """Draws an evaluation into a PNG, north up: cells in colours, the outlines of the true rocks, a scale.

    Args:
        path: the picture.
        evaluation: what `evaluate_map` gave.
        backdrop: an orthomosaic on its cells, several samples for each; without it the truth itself in shades.

    Raises:
        JaxmapError: the disk is full or refuses.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    cells = evaluation.cells
    colours = error_colours(evaluation, backdrop)
    low_m = np.array(cells.origin_m)
    high_m = low_m + cells.size_m * np.array(cells.shape)
    entries = _legend(evaluation, backdrop is not None)
    layout = lay_out(low_m, high_m, np.full(2, cells.size_m), entries, titled=True)
    figure = new_figure(layout)
    axes = map_axes(figure, layout, ("east, m", "north, m"))
    extent_m = (low_m[0], high_m[0], low_m[1], high_m[1])
    axes.imshow(colours.transpose(1, 0, 2), origin="lower", extent=extent_m, interpolation="nearest", aspect="auto")
    _outline_truth(axes, evaluation)
    axes.set_xlim(*layout.extent_m[:2])
    axes.set_ylim(*layout.extent_m[2:])
    axes.set_title(_title(evaluation), size=10, color=INK, loc="left", pad=10)
    draw_footer(figure, layout, entries, georeferenced=True)
    with atomic_path(path) as temporary:
        FigureCanvasAgg(figure).print_png(temporary)


def error_colours(
    evaluation: Evaluation, backdrop: UInt8[np.ndarray, "BI BJ 3"] | None = None
) -> UInt8[np.ndarray, "FI FJ 3"]:
    """The picture itself, several samples for each cell: x first, then y.

    Ground that nobody observed is pale; cells that count and are, or are called, rock are tinted by their verdict.
    """
    if backdrop is None:
        fine, per_cell = _thinned(evaluation)
        ground = np.zeros((*fine.shape, 3))
        for code, shade in _SHADES.items():
            ground[fine == code] = shade
    else:
        ground = backdrop.astype(np.float64)
        per_cell = len(ground) // evaluation.cells.shape[0]
    shown = evaluation.counted
    pale = samples_of(~shown, per_cell)[..., None] * _UNOBSERVED_DIM
    ground = (1 - pale) * ground + pale * np.array(_PAPER)
    for verdict, where in _verdicts(evaluation).items():
        tint = samples_of(where, per_cell)[..., None] * _TINT
        ground = (1 - tint) * ground + tint * np.array(verdict.colour)
    return np.rint(ground).astype(np.uint8)


def _verdicts(evaluation: Evaluation) -> dict[_Verdict, np.ndarray]:
    called, truly, counted = evaluation.called, evaluation.truly, evaluation.counted
    return {
        _FOUND: counted & called & truly,
        _IMAGINED: counted & called & ~truly,
        _MISSED: counted & ~called & truly,
        _UNSEEN: evaluation.domain & ~evaluation.observed & truly,
    }


def _thinned(evaluation: Evaluation) -> tuple[np.ndarray, int]:
    """The samples of the truth, not more for each cell than a picture can show."""
    fine, per_cell = evaluation.truth.fine, evaluation.truth.per_cell
    count = min(per_cell, _MAX_SAMPLES)
    inside = ((np.arange(count) + 0.5) * per_cell / count).astype(int)
    rows, columns = ((np.arange(cells)[:, None] * per_cell + inside).ravel() for cells in evaluation.cells.shape)
    return fine[np.ix_(rows, columns)], count


def _outline_truth(axes: Axes, evaluation: Evaluation) -> None:
    fine, per_cell = _thinned(evaluation)
    rock = fine == TARGET
    if rock.all() or not rock.any():
        return
    step_m = evaluation.cells.size_m / per_cell
    x, y = (o + (np.arange(n) + 0.5) * step_m for o, n in zip(evaluation.cells.origin_m, rock.shape, strict=True))
    axes.contour(x, y, rock.T.astype(np.float32), levels=[0.5], colors=[INK], linewidths=0.7, alpha=0.8)


def _legend(evaluation: Evaluation, with_picture: bool) -> Entries:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    verdicts = _verdicts(evaluation)
    shown = [verdict for verdict in verdicts if verdict is not _UNSEEN or verdicts[verdict].any()]
    swatches = [(verdict.name, verdict.colour) for verdict in shown]
    if not with_picture:
        swatches += [("other ground", _SHADES[OTHER]), ("not counted", _PAPER)]
    entries: Entries = [
        (Patch(facecolor=tuple(np.array(colour) / 255), edgecolor="#00000030", linewidth=0.6), name)
        for name, colour in swatches
    ]
    return [*entries, (Line2D([], [], color=INK, linewidth=0.7), "true outline")]


def _title(evaluation: Evaluation) -> str:
    scores = evaluation.scores
    figures = [("accuracy", scores["accuracy"]), ("IoU", scores["iou"])]
    told = ", ".join(f"{name} {value:.3f}" for name, value in figures if value is not None)
    return f"{told} over {scores['cells']:,} cells of {scores['cell_size_m']:g} m"

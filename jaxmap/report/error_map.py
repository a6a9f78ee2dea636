"""The error map: rock that was found, falsely called and missed, over the ground."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import UInt8

from jaxmap.datasets.label_raster import OTHER, TARGET, UNLABELLED
from jaxmap.evaluation.evaluate import Evaluation
from jaxmap.evaluation.truth_cells import samples_of
from jaxmap.labels import class_colours
from jaxmap.report.top_down import INK, WHOLE, Layout, Sheet, draw

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MAX_SAMPLES = 8
_TINT, _UNOBSERVED_DIM = 0.72, 0.55
_PAPER = (250, 250, 248)
_SHADES = {UNLABELLED: _PAPER, OTHER: (226, 219, 205), TARGET: (168, 160, 150)}

# Okabe and Ito's colours, which colour-blind people can distinguish.
_VERDICTS = {
    "rock, found (TP)": (0, 158, 115),
    "no rock, called rock (FP)": (213, 94, 0),
    "rock, missed (FN)": (0, 114, 178),
    "rock, never observed": (204, 121, 167),
}


Box = tuple[np.ndarray, np.ndarray]
"""South-west and north-east corner, metres in the world."""


def write_error_map(
    path: str | os.PathLike[str],
    evaluation: Evaluation,
    backdrop: UInt8[np.ndarray, "BI BJ 3"] | None = None,
    *,
    box_m: Box | None = None,
    layout: Layout = WHOLE,
) -> None:
    """Draws an evaluation into a PNG, north up: cells by verdict, the outlines of the true rocks, a scale.

    Args:
        path: the picture.
        evaluation: result of `evaluate_map`.
        backdrop: an orthomosaic on its cells, several samples for each; without it the truth itself in shades.
        box_m: what is shown; by default all that was evaluated.
        layout: its size, and whether it has a legend.

    Raises:
        JaxmapError: the disk is full or refuses.
    """
    scores = evaluation.scores
    legend: list[tuple[str, Any]] = list(verdict_colours(evaluation).items())
    if backdrop is None:
        legend += [("other ground", _SHADES[OTHER]), ("not counted", _PAPER)]
    figures = [("accuracy", scores["accuracy"]), ("IoU", scores["iou"])]
    shown = ", ".join(f"{name} {value:.2f}" for name, value in figures if value is not None)
    _draw(
        path,
        evaluation,
        error_colours(evaluation, backdrop),
        (box_m, layout),
        legend=[*legend, ("true outline", dict(color=INK, linewidth=0.7))],
        title=f"{shown} over {scores['cells']:,} cells of {scores['cell_size_m']:g} m",
    )


def write_truth_map(
    path: str | os.PathLike[str],
    evaluation: Evaluation,
    backdrop: UInt8[np.ndarray, "BI BJ 3"],
    *,
    box_m: Box | None = None,
    layout: Layout = WHOLE,
) -> None:
    """Draws an orthomosaic with the outlines of the true rocks into a PNG; arguments as for `write_error_map`.

    Raises:
        JaxmapError: the disk is full or refuses.
    """
    colour = tuple(np.array(class_colours(["rock"])[0]) / 255)
    ground = np.where(backdrop.any(axis=-1, keepdims=True), backdrop, np.array(_PAPER, np.uint8))
    legend = [("true rock", dict(color=colour, linewidth=1.6))]
    _draw(path, evaluation, ground, (box_m, layout), outline=(colour, 1.6), legend=legend)


def _draw(
    path: str | os.PathLike[str],
    evaluation: Evaluation,
    colours: np.ndarray,
    frame: tuple[Box | None, Layout],
    outline: tuple[Any, float] = (INK, 0.7),
    **more: Any,
) -> None:
    """Draws colours on the cells of an evaluation, under the outlines of the true rocks."""
    cells, (box_m, layout) = evaluation.cells, frame
    sheet = Sheet(
        colours,
        np.array(cells.origin_m),
        np.full(2, cells.size_m),
        per_cell=len(colours) // cells.shape[0],
        box_m=box_m,
        **more,
    )
    fine, per_cell = _thinned(evaluation)
    x, y = (o + (np.arange(n) + 0.5) * cells.size_m / per_cell for o, n in zip(cells.origin_m, fine.shape, strict=True))
    rock = (fine == TARGET).T

    def outlines(axes: Axes) -> None:
        if rock.any() and not rock.all():
            colour, width = outline
            axes.contour(x, y, rock.astype(np.float32), levels=[0.5], colors=[colour], linewidths=width, alpha=0.8)

    draw(sheet, path, outlines, layout)


def error_colours(
    evaluation: Evaluation, backdrop: UInt8[np.ndarray, "BI BJ 3"] | None = None
) -> UInt8[np.ndarray, "FI FJ 3"]:
    """The picture itself, several samples for each cell: x first, then y.

    Ground that is not counted is pale; cells that count and are, or are called, rock are tinted by their verdict.
    """
    if backdrop is None:
        fine, per_cell = _thinned(evaluation)
        ground = np.zeros((*fine.shape, 3))
        for code, shade in _SHADES.items():
            ground[fine == code] = shade
    else:
        # Samples outside the orthomosaic are black.
        ground = np.where(backdrop.any(axis=-1, keepdims=True), backdrop, np.array(_PAPER)).astype(np.float64)
        per_cell = len(ground) // evaluation.cells.shape[0]
    pale = samples_of(~evaluation.counted, per_cell)[..., None] * _UNOBSERVED_DIM
    ground = (1 - pale) * ground + pale * np.array(_PAPER)
    for name, where in _verdicts(evaluation).items():
        tint = samples_of(where, per_cell)[..., None] * _TINT
        ground = (1 - tint) * ground + tint * np.array(_VERDICTS[name])
    return np.rint(ground).astype(np.uint8)


def verdict_colours(evaluation: Evaluation) -> dict[str, tuple[int, int, int]]:
    """The colours of an error map by what they mean."""
    shown = _verdicts(evaluation).items()
    return {name: _VERDICTS[name] for name, where in shown if "never" not in name or where.any()}


def _verdicts(evaluation: Evaluation) -> dict[str, np.ndarray]:
    called, truly, counted = evaluation.called, evaluation.truly, evaluation.counted
    unseen = evaluation.domain & ~evaluation.observed & truly
    return dict(
        zip(
            _VERDICTS,
            (counted & called & truly, counted & called & ~truly, counted & ~called & truly, unseen),
            strict=True,
        )
    )


def _thinned(evaluation: Evaluation) -> tuple[np.ndarray, int]:
    """The samples of the truth, no more for each cell than a picture can show."""
    fine, per_cell = evaluation.truth.fine, evaluation.truth.per_cell
    count = min(per_cell, _MAX_SAMPLES)
    inside = ((np.arange(count) + 0.5) * per_cell / count).astype(int)
    rows, columns = ((np.arange(cells)[:, None] * per_cell + inside).ravel() for cells in evaluation.cells.shape)
    return fine[np.ix_(rows, columns)], count

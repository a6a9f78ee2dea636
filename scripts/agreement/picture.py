"""Where two maps agree and where they do not, as a picture: from above, and in two upright slices."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Int8, UInt8

from agreement.causes import CAUSES, Differences, agreement_of
from agreement.maps import FREE, OCCUPIED, TwoMaps
from jaxmap.geometry.grid import exact_corner
from jaxmap.host.files import atomic_path
from jaxmap.report.top_down import DPI, FAINT, INK, UNOBSERVED_COLOUR
from jaxmap.types import GridSpec

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_SIZE_INCHES = (11.6, 7.6)
_AGREED_FREE, _AGREED_OCCUPIED, _CONFLICT = (214, 225, 233), (74, 78, 88), (178, 40, 46)
_CAUSE_COLOURS = {
    "grazing": (224, 122, 60),
    "noise": (238, 178, 72),
    "behind": (46, 134, 124),
    "stray": (120, 84, 160),
    "hole": (176, 130, 196),
    "far": (206, 192, 226),
    "view": (92, 146, 206),
    "range": (176, 176, 120),
    "no_ray": (20, 20, 20),
    "rounding": (220, 90, 170),
}
_EMPTY, _FREE, _OCCUPIED, _BOTH = 0, 1, 2, 3
_FIRST_CAUSE = 4


class _Slice(NamedTuple):
    """An upright cut through the map: the axis that it stands on, and the index there."""

    axis: int
    index: int
    letter: str


def draw_agreement(maps: TwoMaps, differences: Differences, grid: GridSpec, title: str, path: Path) -> None:
    """Draws one comparison into a PNG.

    Raises:
        JaxmapError: the disk is full or refuses.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    kinds = kinds_of_voxels(maps, differences)
    box = _observed_box(kinds)
    slices = [_fullest(kinds, 1, "A"), _fullest(kinds, 0, "B")]
    figure = Figure(figsize=_SIZE_INCHES, dpi=DPI, facecolor="white")
    figure.text(0.055, 0.955, title, size=13, weight="bold", color=INK, va="center")
    figure.text(0.055, 0.918, _summary(maps), size=9.5, color=INK, va="center")
    _draw(figure.add_axes((0.055, 0.09, 0.44, 0.775)), from_above(kinds), grid, (0, 1), box, "seen from above")
    _mark(figure.axes[0], slices, grid)
    for cut, bottom in zip(slices, (0.67, 0.385), strict=True):
        along = 1 - cut.axis
        place_m = exact_corner(grid)[0][cut.axis] + (cut.index + 0.5) * exact_corner(grid)[1][cut.axis]
        name = f"slice {cut.letter}, at {'xy'[cut.axis]} = {place_m:.2f} m"
        colours = _palette()[kinds.take(cut.index, axis=cut.axis)]
        _draw(figure.add_axes((0.575, bottom, 0.41, 0.195)), colours, grid, (along, 2), box, name)
    _draw_legend(figure, differences)
    with atomic_path(path) as temporary:
        FigureCanvasAgg(figure).print_png(temporary)


def kinds_of_voxels(maps: TwoMaps, differences: Differences) -> Int8[np.ndarray, "X Y Z"]:
    """What is drawn of each voxel: agreed class, a conflict of two observations, or the cause that one map lacks it."""
    kinds = np.full(maps.ours.shape, _EMPTY, np.int8)
    for name, kind in ((FREE, _FREE), (OCCUPIED, _OCCUPIED)):
        kinds[(maps.ours == name) & (maps.theirs == name)] = kind
    kinds[tuple(differences.voxels.T)] = np.where(differences.both, _BOTH, _FIRST_CAUSE + differences.cause)
    return kinds


def from_above(kinds: Int8[np.ndarray, "X Y Z"]) -> UInt8[np.ndarray, "X Y 3"]:
    """One colour for each column: that of its most frequent difference, as strong as its share of what was observed."""
    palette, count = _palette().astype(np.float64), _FIRST_CAUSE + len(CAUSES)
    amounts = np.stack([(kinds == kind).sum(axis=2) for kind in range(count)], axis=-1)
    observed, differing = amounts[..., 1:].sum(axis=-1), amounts[..., _BOTH:]
    share = (differing.sum(axis=-1) / np.maximum(observed, 1))[..., None]
    colours = (1 - share) * palette[_FREE] + share * palette[_BOTH + differing.argmax(axis=-1)]
    colours[amounts[..., _BOTH] > 0] = palette[_BOTH]
    colours[observed == 0] = palette[_EMPTY]
    return np.rint(colours).astype(np.uint8)


def _palette() -> UInt8[np.ndarray, "K 3"]:
    causes = [_CAUSE_COLOURS[name] for name in CAUSES]
    return np.array([UNOBSERVED_COLOUR, _AGREED_FREE, _AGREED_OCCUPIED, _CONFLICT, *causes], np.uint8)


def _observed_box(kinds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First and last index along each axis of what was observed, with a voxel of margin."""
    seen = np.argwhere(kinds != _EMPTY)
    if not len(seen):
        return np.zeros(3, int), np.array(kinds.shape)
    return seen.min(axis=0) - 1, seen.max(axis=0) + 2


def _fullest(kinds: np.ndarray, axis: int, letter: str) -> _Slice:
    """The slice with the most conflicts; where there is none, with the most occupied voxels."""
    others = tuple(other for other in range(3) if other != axis)
    conflicts, solid = ((kinds == kind).sum(axis=others) for kind in (_BOTH, _OCCUPIED))
    return _Slice(axis, int((conflicts if conflicts.any() else solid).argmax()), letter)


def _draw(
    axes: Axes,
    colours: UInt8[np.ndarray, "A B 3"],
    grid: GridSpec,
    shown: tuple[int, int],
    box: tuple[np.ndarray, np.ndarray],
    name: str,
) -> None:
    """Draws cells to scale, with metres along two axes of the world."""
    origin_m, size_m = exact_corner(grid)
    low_m, high_m = (origin_m + index * size_m for index in box)
    upper_m = origin_m + size_m * grid.shape
    first, second = shown
    axes.imshow(
        colours.transpose(1, 0, 2),
        origin="lower",
        extent=(origin_m[first], upper_m[first], origin_m[second], upper_m[second]),
        interpolation="nearest",
    )
    axes.set(xlim=(low_m[first], high_m[first]), ylim=(low_m[second], high_m[second]))
    axes.set_facecolor(np.array(UNOBSERVED_COLOUR) / 255)
    axes.set_anchor("NW")
    axes.set_title(name, size=9.5, color=INK, loc="left", pad=5)
    axes.set_xlabel(f"{'xyz'[first]}, m", size=8, color=INK, labelpad=2)
    axes.set_ylabel(f"{'xyz'[second]}, m", size=8, color=INK, labelpad=2)
    axes.tick_params(colors=FAINT, labelcolor=INK, labelsize=7.5, length=3, width=0.8)
    for spine in axes.spines.values():
        spine.set(color=FAINT, linewidth=0.8)


def _mark(axes: Axes, slices: list[_Slice], grid: GridSpec) -> None:
    """Where the slices lie, on the view from above."""
    origin_m, size_m = exact_corner(grid)
    for cut in slices:
        place_m = origin_m[cut.axis] + (cut.index + 0.5) * size_m[cut.axis]
        line, at, align = (
            (axes.axvline, (place_m, 1.01), {"ha": "center", "va": "bottom"})
            if cut.axis == 0
            else (axes.axhline, (1.01, place_m), {"ha": "left", "va": "center"})
        )
        line(place_m, color=INK, linewidth=0.9, linestyle=(0, (5, 3)))
        transform = axes.get_xaxis_transform() if cut.axis == 0 else axes.get_yaxis_transform()
        axes.text(*at, cut.letter, transform=transform, size=9, weight="bold", color=INK, **align)


def _summary(maps: TwoMaps) -> str:
    agreement = agreement_of(maps)
    return (
        f"one class in {agreement.both:.2%} of the {agreement.confusion[1:, 1:].sum():,} voxels that both observed, "
        f"in {agreement.either:.1%} of those that either did"
    )


def _draw_legend(figure: Figure, differences: Differences) -> None:
    """Names of what occurs, with the number of voxels."""
    from matplotlib.patches import Patch

    swatches = [("both: free", _AGREED_FREE), ("both: occupied", _AGREED_OCCUPIED)]
    swatches.append((f"observed by both, as different classes ({int(differences.both.sum()):,})", _CONFLICT))
    counts = sorted(differences.counts(both=False).items(), key=lambda item: -item[1])
    swatches += [(f"{CAUSES[name]} ({count:,})", _CAUSE_COLOURS[name]) for name, count in counts if count]
    handles = [
        Patch(facecolor=np.array(colour) / 255, edgecolor="#00000030", linewidth=0.6, label=name)
        for name, colour in swatches
    ]
    legend = figure.legend(
        handles=handles,
        loc="upper left",
        bbox_to_anchor=(0.565, 0.325),
        fontsize=8,
        frameon=False,
        labelcolor=INK,
        alignment="left",
        title="Voxels; those with a cause were observed by one map only.\n"
        "From above: the column's main difference, as strong as its share.",
    )
    legend.get_title().set(size=8, color=INK)

"""Ground truth as lists of rocks: text files of x, y and, where known, a diameter."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from jaxmap.datasets.crs import Extent, crs_text, transform_between
from jaxmap.datasets.label_raster import OTHER, TARGET, UNLABELLED, LabelRaster
from jaxmap.datasets.text_files import data_lines
from jaxmap.errors import JaxmapError

SUFFIXES = (".txt", ".csv")
SIZE_CLASSES = ("small", "medium", "large")
DEFAULT_DIAMETERS_M: Mapping[str, float] = {"small": 0.3, "medium": 0.6, "large": 1.0}
"""Assumed for lists without diameters; Katwijk's files of positions have the size class in their names."""

HULL_MARGIN_M = 1.0
PIXEL_M = 0.02
_MAX_PIXELS = 2**29
_FARTHEST, _NARROWEST_M, _WIDEST_M = 1e9, 1e-3, 1e3
_CIRCLE_POINTS = 16
_SIZE_NAMES = ("diameter", "diameter_m", "size", "size_m", "footprint_m")


class RockList(NamedTuple):
    """Discs on the ground: centres in some coordinate reference system, diameters in metres, and assumptions made."""

    centres: Float64[np.ndarray, "N 2"]
    diameters_m: Float64[np.ndarray, "N"]
    notes: tuple[str, ...]


def find_rock_lists(source: Path) -> list[Path]:
    """The lists at a path: the file itself, or the text files of a folder."""
    if source.is_dir():
        return sorted(path for path in source.iterdir() if path.suffix.lower() in SUFFIXES)
    return [source] if source.suffix.lower() in SUFFIXES else []


def read_rock_lists(paths: Sequence[Path], diameters_m: Mapping[str, float] = DEFAULT_DIAMETERS_M) -> RockList:
    """Reads lists of rocks, one rock per line: `x y` or `x y diameter`, separated by spaces, commas or semicolons.

    A header line names the columns (`x`, `y`, and `diameter` or `size`). Without a diameter, that of the size class
    in the file name (`small-rocks-...txt`) is taken, and that of the medium class where the name has none.

    Raises:
        JaxmapError: a missing file, a line of another length, a word that is not a number, or no rocks; with the line.
    """
    tables, notes = [], []
    for path in paths:
        rows, sized = _read_table(path)
        if not sized:
            size_class = next((name for name in SIZE_CLASSES if name in path.name.lower()), None)
            diameter_m = diameters_m[size_class or "medium"]
            rows = np.column_stack([rows, np.full(len(rows), diameter_m)])
            notes.append(f"{path.name}: {len(rows)} rocks taken for discs of {diameter_m:g} m")
        tables.append(rows)
    table = np.concatenate(tables)
    return RockList(table[:, :2], table[:, 2], tuple(notes))


def draw_rocks(rocks: RockList, place: Extent, crs: str | None = None, name: str = "rocks") -> LabelRaster:
    """Rasterises a list of rocks as ground truth over a map.

    Each rock is a disc; everything else within 1 m of the convex hull of the rocks is assumed to be sand; beyond it
    pixels are unlabelled.

    Args:
        rocks: the list.
        place: the extent of the map in metres; pixels have an edge of `PIXEL_M`.
        crs: the coordinate reference system of the list; by default that of the map.
        name: of the list, for messages.

    Raises:
        JaxmapError: no rock lies near the map; the error names the two extents.
    """
    x, y = transform_between(crs, place.crs, name)(rocks.centres[:, 0], rocks.centres[:, 1])
    centres, radii_m = np.stack([x, y], axis=-1), rocks.diameters_m / 2
    outline = _outline(centres, radii_m + HULL_MARGIN_M)
    (west, south), (east, north) = outline.min(axis=0), outline.max(axis=0)
    covered = Extent(float(west), float(south), float(east), float(north), place.crs)
    if not covered.overlaps(place):
        raise JaxmapError(
            f"the rocks do not lie over the map: they reach from {covered.text()}, the map from {place.text()} "
            f"({crs_text(place.crs)})",
            where=name,
            fix="name the system of the list with --truth-crs",
        )
    area = np.maximum([west, south], place[:2]), np.minimum([east, north], place[2:4])
    size = np.ceil((area[1] - area[0]) / PIXEL_M).astype(int)
    if np.prod(size, dtype=float) > _MAX_PIXELS:
        raise JaxmapError(f"{size[0]} x {size[1]} pixels of truth", where=name, fix="map a smaller area")
    labels = _draw(centres, radii_m, outline, area[0], (int(size[0]), int(size[1])))
    T_crs_pixel = np.array([[PIXEL_M, 0, area[0][0]], [0, PIXEL_M, area[0][1]], [0, 0, 1.0]])
    notes = (*rocks.notes, f"{name}: all else within {HULL_MARGIN_M:g} m of the hull of the rocks taken for sand")
    if crs is None and place.crs is not None:
        notes += (f"{name}: taken to be in the map's system, {crs_text(place.crs)}",)
    return LabelRaster(labels, T_crs_pixel, place.crs, name, notes)


def _read_table(path: Path) -> tuple[np.ndarray, bool]:
    """x, y and, where the second value is true, the diameter."""
    lines = [(line, re.split(r"[\s,;]+", text.strip(" \t\r,;"))) for line, text in data_lines(path)]
    columns = [0, 1, 2]
    if lines and not any(map(_is_number, lines[0][1])):
        columns = _columns([word.lower().strip('"') for word in lines[0][1]], path)
        lines = lines[1:]
    if not lines:
        raise JaxmapError("no rocks", where=path, fix="write a line x y [diameter] for each rock")
    sized = len(columns) == 3 and len(lines[0][1]) > columns[2]
    wanted = columns[: 3 if sized else 2]
    rows = np.empty((len(lines), len(wanted)))
    for row, (line, words) in enumerate(lines):
        if len(words) != len(lines[0][1]) or len(words) <= max(wanted):
            raise JaxmapError(f"{len(words)} columns", where=f"{path} line {line}", fix="write x y [diameter]")
        try:
            rows[row] = [float(words[column]) for column in wanted]
        except ValueError as error:
            raise JaxmapError(f"{error}"[:80], where=f"{path} line {line}", fix="write x y [diameter]") from error
        far, wide = np.abs(rows[row, :2]).max(), rows[row, 2] if sized else 1.0
        if not far < _FARTHEST or not _NARROWEST_M <= wide < _WIDEST_M:
            raise JaxmapError(
                "a number that is not finite or beyond the earth, or a diameter that is not positive",
                where=f"{path} line {line}",
                fix="correct the line",
            )
    return rows, sized


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _columns(names: list[str], path: Path) -> list[int]:
    """The columns of x, y and, if there is one, the diameter."""
    wanted = (("x",), ("y",), _SIZE_NAMES)
    found = [next((i for i, name in enumerate(names) if name in known), None) for known in wanted]
    if found[0] is None or found[1] is None:
        raise JaxmapError(f"the columns are {' '.join(names)}"[:80], where=path, fix="name them x y diameter")
    return [column for column in found if column is not None]


def _outline(centres: np.ndarray, radii_m: np.ndarray) -> np.ndarray:
    """The convex hull of circles, counter-clockwise."""
    from scipy.spatial import ConvexHull

    angles = np.linspace(0, 2 * np.pi, _CIRCLE_POINTS, endpoint=False)
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    points = (centres[:, None] + radii_m[:, None, None] * circle).reshape(-1, 2)
    # Relative to their mean: on UTM coordinates the hull loses digits.
    middle = points.mean(axis=0)
    return points[ConvexHull(points - middle).vertices]


def _draw(
    centres: np.ndarray, radii_m: np.ndarray, outline: np.ndarray, corner: np.ndarray, size: tuple[int, int]
) -> np.ndarray:
    """uint8 (rows from the south, columns)."""
    x, y = ((np.arange(count) + 0.5) * PIXEL_M for count in size)
    labels = np.full((size[1], size[0]), OTHER, np.uint8)
    edges = np.roll(outline, -1, axis=0) - outline
    for (edge_x, edge_y), (start_x, start_y) in zip(edges, outline - corner, strict=True):
        outside = edge_x * (y[:, None] - start_y) - edge_y * (x[None, :] - start_x) < 0
        labels[outside] = UNLABELLED
    for centre, radius_m in zip(centres - corner, radii_m, strict=True):
        first = np.clip(np.floor((centre - radius_m) / PIXEL_M), 0, size).astype(int)
        last = np.clip(np.ceil((centre + radius_m) / PIXEL_M), 0, size).astype(int)
        here = (slice(first[1], last[1]), slice(first[0], last[0]))
        disc = (x[None, here[1]] - centre[0]) ** 2 + (y[here[0], None] - centre[1]) ** 2 <= radius_m**2
        labels[here][disc] = TARGET
    return labels

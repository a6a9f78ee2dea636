"""Labelled orthomosaics: ground truth on a raster, and the coding of its numbers or colours as classes."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64, Int, UInt8

from jaxmap.datasets.crs import Extent
from jaxmap.datasets.rasters import RasterWindow, read_window
from jaxmap.datasets.text_files import load_yaml
from jaxmap.errors import JaxmapError, UsageError

UNLABELLED, OTHER, TARGET = 0, 1, 2
"""Values of ground-truth pixels. They are the codes of a labelled orthomosaic whose target class is rock."""

UNLABELLED_NAME = "unlabelled"
_REST = "*"
_MAX_LISTED = 8


@dataclass(frozen=True, eq=False)
class LabelRaster:
    """Georeferenced labels.

    Attributes:
        labels: `UNLABELLED`, `OTHER` or `TARGET`, (rows, columns).
        T_crs_pixel: affine, takes (column, row, 1) to coordinates of `crs`; pixel `i` spans `[i, i + 1)`.
        crs: the coordinate reference system, None where it is unknown.
        name: the file name, for messages.
        notes: assumptions made in reading it.
    """

    labels: UInt8[np.ndarray, "H W"]
    T_crs_pixel: Float64[np.ndarray, "3 3"]
    crs: str | None = None
    name: str = "ground truth"
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class LabelCoding:
    """Class names by code; a colour is the code `red << 16 | green << 8 | blue`.

    Attributes:
        names: class by code; `unlabelled` pixels are not ground truth.
        colours: whether the codes are colours.
        rest: the class of all other codes; if None they are refused.
    """

    names: Mapping[int, str]
    colours: bool = False
    rest: str | None = None

    def text(self) -> str:
        """The coding as `CODE=CLASS` words."""
        words = [f"{self.code_text(code)}={name}" for code, name in self.names.items()]
        return " ".join(words + ([f"{_REST}={self.rest}"] if self.rest else []))

    def code_text(self, code: int) -> str:
        """A code as a user writes it."""
        return f"#{code:06x}" if self.colours else str(code)


DEFAULT_CODING = LabelCoding({0: UNLABELLED_NAME, 1: "sand", 2: "rock"})
"""0 unlabelled, 1 sand, 2 rock."""


def read_label_orthomosaic(
    path: Path,
    place: Extent,
    *,
    coding: LabelCoding = DEFAULT_CODING,
    target: str = "rock",
    crs: str | None = None,
    margin: float = 0.0,
) -> LabelRaster:
    """Reads the part of a labelled orthomosaic that lies over a map.

    The raster has one band of whole numbers (a palette image: its indices) or, if the coding is of colours, is a
    palette or RGB image. Nodata and transparent pixels are unlabelled.

    Args:
        path: the raster.
        place: the extent of the map.
        coding: the classes of its values.
        target: the class that is scored.
        crs: the raster's coordinate reference system, in place of the file's own.
        margin: added on each side of the map, in its units.

    Raises:
        JaxmapError: what `read_window` refuses, another number of bands, or values without a class.
        UsageError: the coding does not name the target.
    """
    window = read_window(path, place, crs, margin)
    codes = _colours(window, path) if coding.colours else _indices(window, path)
    labels = decode(codes, window.valid, coding, target, path)
    return LabelRaster(labels, window.T_crs_pixel, window.crs, path.name, window.notes)


def sample_nearest(
    image: UInt8[np.ndarray, "H W *c"], column: Float64[np.ndarray, "*s"], row: Float64[np.ndarray, "*s"]
) -> UInt8[np.ndarray, "*s"]:
    """The values of the pixels that contain the points, 0 outside the image and for coordinates that are not finite."""
    height, width = image.shape[:2]
    # Tested on floats: a NaN or a huge number cast to an integer would be a valid index.
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    at = np.where(inside, row, 0).astype(np.int64), np.where(inside, column, 0).astype(np.int64)
    return np.where(inside.reshape(inside.shape + (1,) * (image.ndim - 2)), image[at], 0).astype(np.uint8)


def make_coding(pairs: Mapping[object, object], where: object) -> LabelCoding:
    """A coding from pairs of code (a number, `#rrggbb`, or `*` for all others) and class name.

    Raises:
        UsageError: an invalid code or name, numbers and colours mixed, or no code at all.
    """
    names: dict[int, str] = {}
    rest, colours = None, set()
    for key, value in pairs.items():
        word, name = str(key).strip(), str(value).strip()
        if not name or not isinstance(value, str | int):
            raise UsageError(
                f"{word}={value} does not name a class", where=where, fix="write CODE=CLASS, such as 3=rock"
            )
        if word == _REST:
            rest = name
        elif re.fullmatch(r"#[0-9a-fA-F]{6}", word):
            names[int(word[1:], 16)] = name
            colours.add(True)
        elif re.fullmatch(r"-?[0-9]{1,9}", word):
            names[int(word)] = name
            colours.add(False)
        else:
            raise UsageError(
                f"{word[:40]!r} is not a code",
                where=where,
                fix="write a number, a colour as #rrggbb, or * for the rest",
            )
    if len(colours) != 1:
        what = "numbers and colours are mixed" if colours else "no code is given"
        raise UsageError(what, where=where, fix="write CODE=CLASS for every code, such as 0=unlabelled 1=sand 2=rock")
    return LabelCoding(names, colours.pop(), rest)


def parse_coding(words: Sequence[str], where: object = "--remap") -> LabelCoding:
    """A coding from words such as `3=rock`.

    Raises:
        UsageError: a word that is not `CODE=CLASS`, or what `make_coding` refuses.
    """
    pairs: dict[object, object] = {}
    for word in words:
        code, separator, name = word.rpartition("=")
        if not separator:
            raise UsageError(f"{word[:40]!r} is not CODE=CLASS", where=where, fix="write such as 3=rock 0=unlabelled")
        pairs[code] = name
    return make_coding(pairs, where)


def read_coding(path: Path) -> LabelCoding:
    """A coding from a YAML file of `CODE: CLASS`.

    Raises:
        UsageError: the file is missing or malformed, or what `make_coding` refuses.
    """
    try:
        return make_coding(load_yaml(path), path)
    except JaxmapError as error:
        raise UsageError(error.what, where=error.where, fix=error.fix) from error


def choose_coding(remap: Sequence[str], palette: Path | None, where: object = "--remap") -> LabelCoding:
    """The coding of `--remap` (`parse_coding`) or of the file `--palette` (`read_coding`), else the default.

    Raises:
        UsageError: both are given, or what the two functions refuse.
    """
    if remap and palette is not None:
        raise UsageError("--remap and --palette exclude each other", fix="give one of them")
    if palette is not None:
        return read_coding(palette)
    return parse_coding(remap, where) if remap else DEFAULT_CODING


def decode(
    codes: Int[np.ndarray, "H W"], valid: Bool[np.ndarray, "H W"], coding: LabelCoding, target: str, where: object
) -> UInt8[np.ndarray, "H W"]:
    """Labels of the pixels: `TARGET` for the class `target`, `OTHER` for other classes, else `UNLABELLED`.

    Raises:
        UsageError: the coding does not name the target.
        JaxmapError: codes that the coding does not name; they are listed with their counts.
    """
    named = {*coding.names.values(), *([coding.rest] if coding.rest else [])}
    if target not in named:
        raise UsageError(
            f"the ground truth has no class {target!r}: {coding.text()}", where=where, fix="name its code: --remap"
        )
    meaning = {UNLABELLED_NAME: UNLABELLED, target: TARGET}
    labels = np.full(codes.shape, UNLABELLED if coding.rest is None else meaning.get(coding.rest, OTHER), np.uint8)
    known = np.full(codes.shape, coding.rest is not None)
    for code, name in coding.names.items():
        here = codes == code
        labels[here] = meaning.get(name, OTHER)
        known |= here
    if (unknown := valid & ~known).any():
        values, counts = np.unique(codes[unknown], return_counts=True)
        pairs = list(zip(values.tolist(), counts.tolist(), strict=True))
        listed = ", ".join(f"{coding.code_text(value)} ({count} px)" for value, count in pairs[:_MAX_LISTED])
        more = f" and {len(pairs) - _MAX_LISTED} more" if len(pairs) > _MAX_LISTED else ""
        raise JaxmapError(
            f"label values without a class: {listed}{more}; the coding is {coding.text()}",
            where=where,
            fix="name them all (--remap 0=unlabelled 1=sand 2=rock ...), or *=unlabelled for the rest",
        )
    return np.where(valid, labels, np.uint8(UNLABELLED))


def _indices(window: RasterWindow, path: Path) -> np.ndarray:
    if len(window.bands) != 1:
        raise JaxmapError(
            f"{len(window.bands)} bands, one band of labels is expected",
            where=path,
            fix="give the labelled orthomosaic, or name the classes of its colours: --remap '#b23c2e=rock' '*=sand'",
        )
    values = np.where(window.valid, window.bands[0], 0)
    codes = values.astype(np.int64)
    if values.dtype.kind not in "ui" and (codes != values).any():
        raise JaxmapError("the band holds fractions, not labels", where=path, fix="give the labelled orthomosaic")
    return codes


def _colours(window: RasterWindow, path: Path) -> np.ndarray:
    if window.palette is not None and len(window.bands) == 1:
        table = {value: red << 16 | green << 8 | blue for value, (red, green, blue) in window.palette.items()}
        lookup = np.array([table.get(value, 0) for value in range(max(table, default=0) + 1)])
        return lookup[np.clip(window.bands[0].astype(np.int64), 0, len(lookup) - 1)]
    if len(window.bands) != 3 or window.bands.dtype != np.uint8:
        raise JaxmapError(
            f"{len(window.bands)} bands of {window.bands.dtype} are not colours",
            where=path,
            fix="give an RGB or palette image of 8 bits, or numbers as the codes of --remap",
        )
    red, green, blue = window.bands.astype(np.int64)
    return red << 16 | green << 8 | blue

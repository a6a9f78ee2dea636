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
from jaxmap.errors import JaxmapError, UsageError

UNLABELLED, OTHER, TARGET = 0, 1, 2
"""What a pixel of the truth is: the codes of a labelled orthomosaic, with rock as the target."""

UNLABELLED_NAME = "unlabelled"
_REST = "*"
_TOLD = 8


@dataclass(frozen=True, eq=False)
class LabelRaster:
    """Labels with a place.

    Attributes:
        labels: `UNLABELLED`, `OTHER` or `TARGET`, (rows, columns).
        T_crs_pixel: affine, takes (column, row, 1) to coordinates of `crs`; pixel `i` spans `[i, i + 1)`.
        crs: the coordinate reference system, None where it is unknown.
        name: the file, for texts.
        notes: what was assumed in reading it, in words.
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
        names: class by code; `unlabelled` for what is no ground truth.
        colours: whether the codes are colours.
        rest: the class of all other codes; without it they are refused.
    """

    names: Mapping[int, str]
    colours: bool = False
    rest: str | None = None

    def text(self) -> str:
        """The coding in words."""
        told = [f"{self.code_text(code)}={name}" for code, name in self.names.items()]
        return " ".join(told + ([f"{_REST}={self.rest}"] if self.rest else []))

    def code_text(self, code: int) -> str:
        """A code as it is written."""
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

    One band of whole numbers (a palette image: its indices), or, where the coding is of colours, a palette or RGB
    image. Nodata and transparent pixels are unlabelled.

    Args:
        path: the raster.
        place: the extent of the map.
        coding: what its values mean.
        target: the class that is scored.
        crs: the raster's system, in place of what the file says.
        margin: how much more is read on each side of the map, in its units.

    Raises:
        JaxmapError: what `read_window` refuses, another number of bands, or values without a meaning.
        UsageError: the coding does not name the target.
    """
    window = read_window(path, place, crs, margin)
    codes = _colours(window, path) if coding.colours else _indices(window, path)
    labels = decode(codes, window.valid, coding, target, path)
    return LabelRaster(labels, window.T_crs_pixel, window.crs, path.name, window.notes)


def sample_nearest(
    image: UInt8[np.ndarray, "H W *c"], column: Float64[np.ndarray, "*s"], row: Float64[np.ndarray, "*s"]
) -> UInt8[np.ndarray, "*s"]:
    """The pixels that hold given points, 0 outside the image (and where a coordinate is not finite)."""
    height, width = image.shape[:2]
    # Tested on floats: a NaN or a huge number cast to an integer would be a valid index.
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    at = np.where(inside, row, 0).astype(np.int64), np.where(inside, column, 0).astype(np.int64)
    return np.where(inside.reshape(inside.shape + (1,) * (image.ndim - 2)), image[at], 0).astype(np.uint8)


def make_coding(pairs: Mapping[object, object], where: object) -> LabelCoding:
    """A coding from what a user wrote: numbers, `#rrggbb`, or `*` for the rest; to class names.

    Raises:
        UsageError: a key that is no code, a value that is no name, numbers and colours mixed, or no code at all.
    """
    names: dict[int, str] = {}
    rest, colours = None, set()
    for key, value in pairs.items():
        word, name = str(key).strip(), str(value).strip()
        if not name or not isinstance(value, str | int):
            raise UsageError(f"{word}={value} names no class", where=where, fix="write CODE=CLASS, such as 3=rock")
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
                f"{word[:40]!r} is no code", where=where, fix="write a number, a colour as #rrggbb, or * for the rest"
            )
    if len(colours) != 1:
        what = "numbers and colours are mixed" if colours else "no code is named"
        raise UsageError(what, where=where, fix="write CODE=CLASS for every code, such as 0=unlabelled 1=sand 2=rock")
    return LabelCoding(names, colours.pop(), rest)


def parse_coding(words: Sequence[str], where: object = "--remap") -> LabelCoding:
    """A coding from words such as `3=rock`.

    Raises:
        UsageError: a word of another form, or what `make_coding` refuses.
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
        UsageError: no such file, not YAML, or what `make_coding` refuses.
    """
    import yaml

    try:
        tree = yaml.safe_load(path.read_text(encoding="utf8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise UsageError("not YAML", where=path, fix="write lines such as 2: rock") from error
    except OSError as error:
        raise UsageError(f"cannot be read: {error.strerror}", where=path, fix="check --palette") from error
    if not isinstance(tree, dict):
        raise UsageError("holds no codes", where=path, fix="write lines such as 2: rock")
    return make_coding(tree, path)


def choose_coding(remap: Sequence[str], palette: Path | None, where: object = "--remap") -> LabelCoding:
    """The coding that words (`parse_coding`) or a file (`read_coding`) give; the usual one where neither is given.

    Raises:
        UsageError: both are given, or what the two refuse.
    """
    if remap and palette is not None:
        raise UsageError("--remap and --palette exclude each other", fix="give one of them")
    if palette is not None:
        return read_coding(palette)
    return parse_coding(remap, where) if remap else DEFAULT_CODING


def decode(
    codes: Int[np.ndarray, "H W"], valid: Bool[np.ndarray, "H W"], coding: LabelCoding, target: str, where: object
) -> UInt8[np.ndarray, "H W"]:
    """What each pixel is: `TARGET` where its class is `target`, `OTHER` of another class, else `UNLABELLED`.

    Raises:
        UsageError: the coding does not name the target.
        JaxmapError: codes that the coding does not name; they are listed with their counts.
    """
    named = {*coding.names.values(), *([coding.rest] if coding.rest else [])}
    if target not in named:
        raise UsageError(
            f"the ground truth knows no class {target!r}: {coding.text()}", where=where, fix="name its code: --remap"
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
        told = ", ".join(f"{coding.code_text(value)} ({count} px)" for value, count in pairs[:_TOLD])
        more = f" and {len(pairs) - _TOLD} more" if len(pairs) > _TOLD else ""
        raise JaxmapError(
            f"label values that mean nothing: {told}{more}; known are {coding.text()}",
            where=where,
            fix="name them all (--remap 0=unlabelled 1=sand 2=rock ...), or *=unlabelled for the rest",
        )
    return np.where(valid, labels, np.uint8(UNLABELLED))


def _indices(window: RasterWindow, path: Path) -> np.ndarray:
    if len(window.bands) != 1:
        raise JaxmapError(
            f"{len(window.bands)} bands, one of labels is expected",
            where=path,
            fix="give the labelled orthomosaic, or say what its colours mean: --remap '#b23c2e=rock' '*=sand'",
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
            f"{len(window.bands)} bands of {window.bands.dtype} are no colours",
            where=path,
            fix="give an RGB or palette image of 8 bits, or numbers as the codes of --remap",
        )
    red, green, blue = window.bands.astype(np.int64)
    return red << 16 | green << 8 | blue

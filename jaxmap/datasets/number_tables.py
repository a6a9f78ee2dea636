"""Tables of numbers as people and spreadsheets write them: any separator, decimal commas, units in headers."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from jaxmap.datasets.text_files import data_lines
from jaxmap.errors import JaxmapError

UNITS_M = {"": 1.0, "m": 1.0, "metre": 1.0, "meter": 1.0, "metres": 1.0, "meters": 1.0, "cm": 0.01, "mm": 0.001}
UNITS_M |= {"dm": 0.1, "km": 1000.0, "ft": 0.3048, "feet": 0.3048, "in": 0.0254, "inch": 0.0254}
DEGREES = ("deg", "degree", "degrees", "°")

_COMMA_NUMBER = re.compile(r"[+-]?\d+,\d+([eE][+-]?\d+)?")
_SPACES = "\u00a0\u202f\u2009"
_UNIT = re.compile(r"^(.*?)[ _]*[\[(]\s*([^\])]*?)\s*[\])]$")


class Column(NamedTuple):
    """A name of the header in small letters, and the unit behind it ("" where there is none)."""

    name: str
    unit: str


class NumberTable(NamedTuple):
    """The cells of a file as text, numbers in them with decimal points.

    Attributes:
        columns: of the header; None without one.
        rows: line number and cells, as many in each row.
        decimal_comma: whether the file has decimal commas.
    """

    columns: tuple[Column, ...] | None
    rows: list[tuple[int, list[str]]]
    decimal_comma: bool


def read_number_table(path: Path) -> NumberTable:
    """Reads a table whose columns are separated by tabs, semicolons, bars, commas or spaces.

    Commas within numbers are decimal, if they are not the separator and no number has a decimal point. A first line
    without any number is the header; `Diameter [cm]`, `diameter (cm)` and `diameter_cm` name a unit. Lines that begin
    with # are left out.

    Raises:
        JaxmapError: the file is missing or no text, rows differ in length, or points and commas are mixed.
    """
    lines = data_lines(path)
    separator = None
    if lines and (named := re.fullmatch(r"sep=(.)", lines[0][1].strip('"'))):
        # The first line of Excel's files.
        separator, lines = named[1], lines[1:]
    separator = separator or _separator([text for _, text in lines])
    split = [(number, _cells(text, separator)) for number, text in lines]
    if split:
        _cut(split, len(_without_end(split[0][1])))
    columns = None
    if split and not any(_is_number(cell) for cell in split[0][1]):
        columns = tuple(map(_column, split[0][1]))
        split = split[1:]
    _check_lengths(split, columns, path)
    comma = _has_decimal_commas(split, path)
    return NumberTable(columns, [(line, [_plain(cell, comma) for cell in cells]) for line, cells in split], comma)


def _separator(texts: Sequence[str]) -> str | None:
    """The one character between columns; None for spaces, with or without a comma."""
    for mark in "\t;|":
        if texts and all(mark in text for text in texts[:3]):
            return mark
    if any("," in text for text in texts) and not _commas_are_decimal(texts):
        return ","
    return None


def _commas_are_decimal(texts: Sequence[str]) -> bool:
    """Whether commas stand only within the numbers of words that are separated by spaces."""
    words = [text.split() for text in texts]
    numbers = [row for row in words if any(map(_is_number, row))]
    return bool(numbers) and all(
        len(row) > 1 and all("," not in word or _COMMA_NUMBER.fullmatch(word) for word in row) for row in numbers
    )


def _cells(text: str, separator: str | None) -> list[str]:
    if separator is None or (separator == "," and "," not in text):
        # A unit belongs to the name before it.
        return re.sub(r"\s+(?=[\[(])", "", text.strip()).split()
    if separator == ",":
        # Lists that people type: `1, 2 3`.
        if re.fullmatch(r"[-+0-9.eE,\s]+", text):
            return re.split(r"[\s,]+", text.strip(" \t\r,"))
        text = text.strip()
    cells = next(csv.reader([text.rstrip("\r\n")], delimiter=separator, skipinitialspace=True))
    return [cell.strip() for cell in cells]


def _without_end(cells: list[str]) -> list[str]:
    """The cells up to the last that is not empty."""
    return cells[: max((index + 1 for index, cell in enumerate(cells) if cell), default=0)]


def _cut(rows: list[tuple[int, list[str]]], count: int) -> None:
    """Cuts empty cells off that are beyond a number of columns."""
    for _, cells in rows:
        del cells[max(count, len(_without_end(cells))) :]


def _check_lengths(rows: list[tuple[int, list[str]]], columns: tuple[Column, ...] | None, path: Path) -> None:
    if not rows:
        return
    wanted = len(rows[0][1] if columns is None else columns)
    for line, cells in rows:
        if len(cells) != wanted:
            there = f"{wanted} names" if columns else f"{wanted} in the first line"
            fix = "write as many in each line"
            if len(cells) > wanted and columns:
                fix += "; if the numbers have decimal commas, separate them by semicolons"
            raise JaxmapError(f"{len(cells)} columns, and {there}", where=f"{path} line {line}", fix=fix)


def _has_decimal_commas(rows: list[tuple[int, list[str]]], path: Path) -> bool:
    """Whether the numbers have decimal commas.

    Raises:
        JaxmapError: some have, others have decimal points.
    """
    commas = points = None
    for line, cells in rows:
        for cell in cells:
            if not _is_number(cell):
                continue
            # Of two kinds the last one is decimal: 1.234,5 and 1,234.5.
            last = max(cell.rfind(","), cell.rfind("."))
            if last >= 0 and cell.count(cell[last]) == 1:
                if cell[last] == ",":
                    commas = commas or (line, cell)
                else:
                    points = points or (line, cell)
    if commas and points:
        raise JaxmapError(
            f"decimal points and decimal commas: {points[1][:20]} in line {points[0]}, {commas[1][:20]}",
            where=f"{path} line {commas[0]}",
            fix="write all numbers alike",
        )
    return commas is not None


def _plain(cell: str, decimal_comma: bool) -> str:
    """A number without separators of thousands and with a decimal point; other text as it is."""
    if not _is_number(cell):
        return cell
    cell = re.sub(f"[{_SPACES}' ]", "", cell)
    return cell.replace(".", "").replace(",", ".") if decimal_comma else cell.replace(",", "")


def _is_number(cell: str) -> bool:
    """Whether a cell is a number, in any spelling."""
    bare = re.sub(f"(?<=\\d)[{_SPACES}' ](?=\\d{{3}})", "", cell.strip())
    if re.fullmatch(r"[+-]?\d{1,3}(\.\d{3})+(,\d+)?|[+-]?\d{1,3}(,\d{3})+(\.\d+)?", bare):
        return True
    try:
        float(bare.replace(",", ".", 1))
    except ValueError:
        return False
    return "_" not in bare


def _column(cell: str) -> Column:
    name = cell.strip().lower()
    if found := _UNIT.match(name):
        return Column(found[1].strip(), found[2])
    stem, _, last = name.rpartition("_")
    return Column(stem, last) if stem and last in UNITS_M else Column(name, "")

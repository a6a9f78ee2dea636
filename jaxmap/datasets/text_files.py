"""Safe reading of text and YAML files; every error names the file and, where it can, the line or the key."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from jaxmap.errors import JaxmapError
from jaxmap.host.bounded_text import read_text, read_yaml


def data_lines(path: Path) -> list[tuple[int, str]]:
    """The lines of a text file that are neither empty nor `#` comments, with their numbers from 1.

    Raises:
        JaxmapError: the file is missing or is not text.
    """
    lines = ((number, line.strip()) for number, line in enumerate(read_text(path).split("\n"), start=1))
    return [(number, line) for number, line in lines if line and not line.startswith("#")]


def load_yaml(path: Path) -> dict:
    """Reads a YAML file (`read_yaml`) whose top level is a mapping.

    Raises:
        JaxmapError: what `read_yaml` refuses, or it is not a mapping.
    """
    content = read_yaml(path)
    if not isinstance(content, dict):
        raise JaxmapError("no keys and values", where=path, fix="the file must hold `key: value` lines; restore it")
    return content


def number(value: object, key: str, path: Path) -> float:
    """A number of a YAML file; numeric text is accepted, since YAML 1.1 reads `1e-3` as text.

    Raises:
        JaxmapError: it is not a number; the error names the key.
    """
    if isinstance(value, int | float | str) and not isinstance(value, bool):
        try:
            return float(value)
        except (ValueError, OverflowError):
            pass
    raise JaxmapError(f"{key} is {value!r:.60}, not a number", where=path, fix=f"give {key} a number")


def number_list(value: object, key: str, path: Path, count: int | None = None) -> np.ndarray:
    """A list of numbers of a YAML file as float64 (count,).

    Raises:
        JaxmapError: it is not a list of that many numbers; the error names the key.
    """
    if not isinstance(value, list) or (count is not None and len(value) != count):
        raise JaxmapError(
            f"{key} is not a list of {'numbers' if count is None else f'{count} numbers'}",
            where=path,
            fix="write it as [a, b, ...]",
        )
    return np.array([number(item, key, path) for item in value], np.float64)


def image_size(value: object, key: str, path: Path) -> tuple[int, int]:
    """A `[width, height]` of a YAML file, in pixels.

    Raises:
        JaxmapError: it is not one; the error names the key.
    """
    width, height = number_list(value, key, path, count=2)
    if not (1 <= width < 2**20 and 1 <= height < 2**20) or width % 1 or height % 1:
        raise JaxmapError(f"{key} is {value}", where=path, fix="give [width, height] in whole pixels")
    return int(width), int(height)

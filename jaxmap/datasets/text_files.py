"""Safe reading of text and YAML files; every error names the file and, where it can, the line or the key."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import yaml

from jaxmap.errors import JaxmapError


def read_text(path: Path) -> str:
    """The text of a UTF-8 file (a byte order mark is dropped).

    Raises:
        JaxmapError: the file is missing, cannot be read, or is not text.
    """
    try:
        with open(path, "rb") as file:
            data = file.read(4096)
            # A bag or an image given by mistake is refused before gigabytes are read.
            if b"\0" not in data:
                data += file.read()
    except FileNotFoundError as fault:
        raise JaxmapError(f"there is no file {path}", fix="check the path") from fault
    except (OSError, ValueError) as fault:
        raise JaxmapError(f"the file cannot be read ({fault})", where=path, fix="check the path") from fault
    try:
        if b"\0" in data:
            raise ValueError("it holds zero bytes")
        return data.decode("utf-8-sig")
    except ValueError as fault:
        raise JaxmapError("not a text file", where=path, fix="give a UTF-8 text file") from fault


def data_lines(path: Path) -> list[tuple[int, str]]:
    """The lines of a text file that are neither empty nor `#` comments, with their numbers from 1.

    Raises:
        JaxmapError: the file is missing or is not text.
    """
    lines = ((number, line.strip()) for number, line in enumerate(read_text(path).split("\n"), start=1))
    return [(number, line) for number, line in lines if line and not line.startswith("#")]


def load_yaml(path: Path) -> dict:
    """Safe-loads a YAML file whose top level is a mapping.

    OpenCV's header `%YAML:1.0`, invalid in YAML but present in EuRoC's files, is accepted.

    Raises:
        JaxmapError: the file is missing, is not text, is malformed (with the line), or is not a mapping.
    """
    text = read_text(path)
    if text.startswith("%YAML:"):
        # The line break is kept, so that errors name the right line.
        text = "".join(text.partition("\n")[1:])
    try:
        content = yaml.safe_load(text)
    except yaml.MarkedYAMLError as fault:
        mark = fault.problem_mark or fault.context_mark
        place = f"{path} line {mark.line + 1}" if mark else path
        raise JaxmapError(
            f"malformed YAML ({fault.problem or fault.context})", where=place, fix="correct or restore the file"
        ) from fault
    except Exception as fault:
        # PyYAML's constructors raise ValueError, KeyError, RecursionError and others.
        raise JaxmapError(f"malformed YAML ({fault})", where=path, fix="correct or restore the file") from fault
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

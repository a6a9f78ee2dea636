"""The folder a run writes: locked against other runs, with the settings it was started with."""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

from jaxmap.errors import JaxmapError, UsageError
from jaxmap.host.files import atomic_path, real_path, write_error


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Locks a folder against other runs; it is created where it is missing.

    A folder that was created for a run that then wrote nothing is removed.

    Raises:
        JaxmapError: another run is writing into it, or it cannot be made or written.
    """
    made = not folder.exists()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # The folder itself is locked: no lock file can be left behind.
        handle = os.open(folder, os.O_RDONLY)
    except OSError as error:
        reason = "it is a file" if folder.is_file() else error.strerror
        raise JaxmapError(f"cannot be made: {reason}", where=folder, fix="choose another --out") from error
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise JaxmapError(
                "another run is writing here", where=folder, fix="wait for it, or choose another --out"
            ) from error
        # A folder that cannot be written is refused before the work, not after it.
        try:
            with TemporaryFile(dir=folder):
                pass
        except OSError as error:
            raise write_error(error, folder) from error
        yield
    finally:
        if made:
            # Fails where the folder is not empty.
            with suppress(OSError):
                folder.rmdir()
        os.close(handle)


def check_inputs_stay(outputs: Iterable[Path], inputs: Iterable[Path | None]) -> None:
    """Refuses outputs that would overwrite an input.

    Raises:
        UsageError: an output has the path of an input.
    """
    read = {real_path(path) for path in inputs if path is not None}
    for path in outputs:
        if real_path(path) in read:
            raise UsageError("an input would be overwritten", where=path, fix="choose another --out")


def check_same_settings(path: Path, tree: dict[str, Any], free: Collection[str] = ()) -> None:
    """Compares the current settings with those that a run was started with.

    Args:
        path: the file of those.
        tree: the current ones.
        free: the names of those that may differ.

    Raises:
        JaxmapError: the file cannot be read.
        UsageError: settings differ; all of them are named.
    """
    from jaxmap.host.bounded_text import read_yaml

    try:
        before = read_yaml(path)
    except JaxmapError as error:
        raise JaxmapError(error.what, where=error.where, fix="start anew with --overwrite") from error
    before = before if isinstance(before, dict) else {}
    before, tree = dotted(before), dotted(tree)
    differing = sorted(
        key for key in before.keys() | tree.keys() if key not in free and before.get(key) != tree.get(key)
    )
    if differing:
        raise UsageError(
            f"the run was begun with another {', '.join(differing)}",
            where=path,
            fix="resume with the same settings, or start anew with --overwrite",
        )


def dotted(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """A tree of settings flattened to dotted keys."""
    flat: dict[str, Any] = {}
    for key, value in tree.items():
        flat |= dotted(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return flat


def write_yaml(path: Path, tree: dict[str, Any]) -> None:
    """Writes plain values as YAML, atomically."""
    import yaml

    with atomic_path(path) as temporary:
        temporary.write_text(yaml.safe_dump(tree, sort_keys=False, allow_unicode=True), encoding="utf8")


def write_json(path: Path, tree: Any) -> None:
    """Writes plain values as JSON, atomically."""
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(tree, indent=1, allow_nan=False) + "\n", encoding="utf8")

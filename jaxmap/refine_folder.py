"""The folder of one refinement: what lies in it, and whose it is."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path

from jaxmap.errors import JaxmapError, UsageError
from jaxmap.files import remove
from jaxmap.output_folder import check_inputs_stay

RESULTS = "refine.json"
"""Written first: where it lies, the other files are a refinement's."""

PAGE = ("report.html", "consistency.png", "trajectory.png")
"""Written last."""

OUTPUTS = ("poses.tum", RESULTS, *PAGE)
CALIBRATION = "calibration.yaml"


def check_apart(source: str, out: Path, inputs: Iterable[Path | None]) -> None:
    """Refuses to write where inputs lie; to be called before anything is made.

    Raises:
        UsageError: the folder is the sequence's own, or an output would overwrite an input.
    """
    if out.resolve() == Path(source).resolve():
        raise UsageError("the folder is the sequence's own", where=out, fix="choose another --out")
    check_inputs_stay((out / name for name in (*OUTPUTS, CALIBRATION)), inputs)


def begin(out: Path, *, overwrite: bool) -> None:
    """Checks that what lies in the folder may be replaced; nothing is removed yet.

    Raises:
        JaxmapError: it holds a refinement already, or files of the same names that no refinement has written.
    """
    there = [name for name in (*OUTPUTS, CALIBRATION) if (out / name).exists()]
    if not there:
        return
    if not _is_refinement(out):
        raise JaxmapError(
            f"{', '.join(there)} would be replaced, but no refinement has written them",
            where=out,
            fix="choose another --out",
        )
    if not overwrite:
        raise JaxmapError(
            "the folder holds a refinement already",
            where=out,
            fix="replace it (--overwrite), or choose another folder",
        )


def _is_refinement(out: Path) -> bool:
    """Whether what lies here was written by a refinement."""
    try:
        content = json.loads((out / RESULTS).read_text(encoding="utf8"))
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(content, dict) and content.keys() >= {"matches", "map_height_spread_m", "whole_map"}


def forget_earlier(out: Path) -> None:
    """Removes what an earlier refinement has written beside its results; to be called once there are new ones.

    The results themselves go last, by being replaced: they tell whose the folder is.

    Raises:
        JaxmapError: a file cannot be removed.
    """
    for name in (*OUTPUTS, CALIBRATION):
        if name != RESULTS:
            remove(out / name)

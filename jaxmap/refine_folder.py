"""The folder of one refinement: what lies in it, and whose it is."""

from __future__ import annotations

from pathlib import Path

from jaxmap.datasets import ReadOptions
from jaxmap.errors import JaxmapError, UsageError
from jaxmap.files import remove

RESULTS = "refine.json"
"""Written first: where it lies, the other files are a refinement's."""

PAGE = ("report.html", "consistency.png", "trajectory.png")
"""Written last."""

OUTPUTS = ("poses.tum", RESULTS, *PAGE)
CALIBRATION = "calibration.yaml"


def check_apart(source: str, out: Path, options: ReadOptions) -> None:
    """Refuses to write where inputs or the files of others lie; to be called before anything is made.

    Raises:
        UsageError: the folder is the sequence's own, or an output would overwrite an input.
        JaxmapError: files of the same names lie there that no refinement has written.
    """
    if out.resolve() == Path(source).resolve():
        raise UsageError("the folder is the sequence's own", where=out, fix="choose another --out")
    inputs = {path.resolve() for path in (options.poses, options.calibration) if path is not None}
    for name in (*OUTPUTS, CALIBRATION):
        if (out / name).resolve() in inputs:
            raise UsageError("an input would be overwritten", where=out / name, fix="choose another --out")
    foreign = [name for name in (*OUTPUTS, CALIBRATION) if (out / name).exists()]
    if foreign and not (out / RESULTS).is_file():
        raise JaxmapError(
            f"{', '.join(foreign)} would be replaced, but no refinement has written them",
            where=out,
            fix="choose another --out",
        )


def forget_earlier(out: Path, *, calibrated: bool) -> None:
    """Removes what an earlier refinement has written beside the poses; to be called once they are new.

    Args:
        out: the folder.
        calibrated: whether the calibration is new, too.

    Raises:
        JaxmapError: a file cannot be removed.
    """
    for name in (*PAGE, *(() if calibrated else (CALIBRATION,))):
        remove(out / name)

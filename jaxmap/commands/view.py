"""`jaxmap view`: a run in the viewer of rerun."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from jaxmap.commands.console import Console, parse


@dataclass(frozen=True)
class ViewArguments:
    """Show a run in the viewer of rerun, frame by frame.

    Poses, images, labels and disparity of the key frames, and the voxels of the map, each from the first frame that
    sees it, on a time line. Needs rerun (pip install 'jaxmap[view]').
    """

    run: tyro.conf.Positional[Path]
    """A run folder, as jaxmap map has written it."""
    save: Path | None = None
    """Write this .rrd file and open no window; `rerun F.rrd` shows it, on any machine."""


def main(words: Sequence[str]) -> int:
    """Runs the command."""
    arguments = parse(ViewArguments, "view", words)

    from jaxmap.runs.folder import RunFolder
    from jaxmap.runs.viewing import view_run

    RunFolder(arguments.run).settle_for_reading()
    console = Console()
    for note in view_run(arguments.run, arguments.save):
        console.notify(note)
    if arguments.save is not None:
        console.result(arguments.save.parent, [arguments.save.name])
    return 0

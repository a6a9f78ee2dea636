"""`jaxmap merge`: one map of several sessions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from jaxmap.commands.console import Console, parse
from jaxmap.errors import UsageError

OUTPUTS = (
    *("report.html", "map.zarr", "map.ply", "bev.tif", "bev.png", "metrics.json"),
    *("config.yaml", "poses.tum", "frames.csv"),
)


@dataclass(frozen=True)
class MergeArguments:
    """Add the maps of several sessions up: fusion is a sum, so the sum is the map of all of them.

    The runs need one CRS, voxel size, set of classes and set of fusion numbers; each may have a site origin of its own,
    since maps of one CRS share their voxels. Writes a run folder that can be scored, exported and merged again.
    """

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Run folders, as jaxmap map has written them."""
    out: Path
    """The run folder to write; none of those that are merged."""
    rover: str = "katwijk"
    """YAML file of the rover whose hazards are layers of the map, or the name of one in configs/rovers (katwijk)."""
    overwrite: bool = False
    """Replace a run that lies in the folder; it stays until the new one is whole."""


def main(words: Sequence[str]) -> int:
    """Runs the command."""
    arguments = parse(MergeArguments, "merge", words)

    from jaxmap.host.cache import keep_compiled_programs
    from jaxmap.host.files import real_path
    from jaxmap.planning.options import ROVER_SETTINGS
    from jaxmap.runs.folder import RunFolder
    from jaxmap.runs.merging import merge_sessions, open_sessions, settings_of

    if real_path(arguments.out) in map(real_path, arguments.runs):
        raise UsageError("a run to be merged would be replaced", where=arguments.out, fix="choose another --out")
    keep_compiled_programs()
    console, rover = Console(), ROVER_SETTINGS.load(arguments.rover)
    sessions = open_sessions(arguments.runs)
    folder, blocks = RunFolder(arguments.out), sum(len(session.reader.places) for session in sessions)
    with (
        folder.locked(),
        folder.writing(settings_of(sessions), resume=None, overwrite=arguments.overwrite) as work,
        console.steps("merging", "blocks", blocks) as advance,
    ):
        notes = merge_sessions(sessions, work, rover, advance)
    for note in notes:
        console.notify(f"note: {note}")
    console.notify(
        f"{sum(session.reader.frames_fused for session in sessions)} frames of {len(sessions)} runs in one map"
    )
    console.result(arguments.out, OUTPUTS)
    return 0

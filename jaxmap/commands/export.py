"""`jaxmap export`: a map in another form."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from jaxmap.commands.console import Console, parse


@dataclass(frozen=True)
class ExportArguments:
    """Write the map of a run as PLY (occupied voxels), GeoTIFF (top-down map) or PNG.

    Where the run has an ensemble, the GeoTIFF holds its layers, and a second PNG shows what the map may have missed.
    """

    run: tyro.conf.Positional[Path]
    """A run folder, as jaxmap map has written it."""
    format: Literal["ply", "geotiff", "png", "all"] = "all"
    """What to write."""


def main(words: Sequence[str]) -> int:
    """Runs the command."""
    arguments = parse(ExportArguments, "export", words)

    from jaxmap.mapping.store import open_map
    from jaxmap.runs.folder import EXPORTS, RunFolder, write_exports

    folder = RunFolder(arguments.run)
    folder.settle_for_reading()
    formats = tuple(EXPORTS) if arguments.format == "all" else (arguments.format,)
    Console().result(arguments.run, write_exports(folder, open_map(folder.map), formats))
    return 0

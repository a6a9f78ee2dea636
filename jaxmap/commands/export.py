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
    """Write the map of a run as PLY (occupied voxels), GeoTIFF (top-down map) or PNG, or the run for COLMAP.

    Where the run has an ensemble, the GeoTIFF holds its layers, and a second PNG shows what the map may have missed.
    For COLMAP and what reads its models, colmap/ holds cameras.txt, images.txt, points3D.txt and the rectified images.
    """

    run: tyro.conf.Positional[Path]
    """A run folder, as jaxmap map has written it."""
    format: Literal["ply", "geotiff", "png", "colmap", "all"] = "all"
    """What to write; all are the first three."""


def main(words: Sequence[str]) -> int:
    """Runs the command."""
    arguments = parse(ExportArguments, "export", words)

    from jaxmap.mapping.store import open_map
    from jaxmap.runs.folder import EXPORTS, RunFolder, write_exports

    folder = RunFolder(arguments.run)
    folder.settle_for_reading()
    console = Console()
    if arguments.format == "colmap":
        from jaxmap.runs.colmap import export_colmap

        with console.counted("images", "images") as count:
            written = export_colmap(folder, console.notify, count)
        console.result(arguments.run, written)
        return 0
    formats = tuple(EXPORTS) if arguments.format == "all" else (arguments.format,)
    console.result(arguments.run, write_exports(folder, open_map(folder.map), formats))
    return 0

"""`jaxmap export`: a map in other forms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from jaxmap.commands.console import Console, parse
from jaxmap.export.formats import FORMATS, OF_EACH_RUN


@dataclass(frozen=True)
class ExportArguments:
    """Write the map of a run in forms that other programs read, as docs/formats.md describes them.

    Maps of any size are gone through tile by tile. Without --format: PLY (occupied voxels), GeoTIFF (top-down map) and
    PNG. Where the run has an ensemble, the GeoTIFF holds its layers, and a second PNG shows what the map may have
    missed. For COLMAP and what reads its models, colmap/ holds cameras.txt, images.txt, points3D.txt and the rectified
    images.
    """

    run: tyro.conf.Positional[Path]
    """A run folder, as jaxmap map has written it."""
    format: tuple[Literal[tuple(FORMATS)], ...] = OF_EACH_RUN  # pyright: ignore[reportInvalidTypeForm]
    """What to write; several at once are separated by spaces."""
    colours: Literal["classes", "images"] = "classes"
    """Colours of points and surfaces: of their classes, or of the run's key frames."""


def main(words: Sequence[str]) -> int:
    """Runs the command."""
    arguments = parse(ExportArguments, "export", words)

    from jaxmap.mapping.store import open_map
    from jaxmap.runs.exports import write_exports
    from jaxmap.runs.folder import RunFolder

    folder, console = RunFolder(arguments.run), Console()
    folder.settle_for_reading()
    with console.steps("exporting", "forms", len(arguments.format)) as advance:
        written = write_exports(
            folder,
            open_map(folder.map),
            arguments.format,
            colours=arguments.colours,
            notify=console.notify,
            advance=advance,
        )
    console.result(arguments.run, written)
    return 0

"""The map of the Lunar Autonomy Challenge: height and rock flag of each cell of a square, as a NumPy array.

Its form is that of the challenge's `GeometricMap`: 27 m x 27 m about the origin in cells of 0.15 m, float64
(180, 180, 4) of `[x, y, height, rock]`, x along the first axis, minus infinity where nothing is known. Its truth is
taken at sixteen points a cell: the height is their mean, and the cell is rock where one of them is.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from jaxmap.errors import JaxmapError
from jaxmap.export.source import Source
from jaxmap.host.files import atomic_path

SIDE_M, CELL_M, POINTS = 27.0, 0.15, 4
"""Side of the square, edge of a cell, and points along it."""


def write_lunar_challenge(source: Source, path: Path) -> None:
    """Writes the array; the origin of the map's world (its site origin) is the middle of the square.

    Raises:
        JaxmapError: the map has no class of rocks, nothing was observed within the square, or the disk refuses.
    """
    if source.target is None:
        raise JaxmapError(
            f"the map has no rocks: its classes are {', '.join(source.classes) or 'none'}",
            where=source.where,
            fix="map with a labeller that knows rocks",
        )
    cells = round(SIDE_M / CELL_M)
    samples = cells * POINTS
    along_m = (np.arange(samples) + 0.5) * (CELL_M / POINTS) - SIDE_M / 2
    height_m = np.full((samples, samples), np.nan)
    rock = np.zeros((samples, samples), bool)
    seen = 0
    for part in source.parts():
        # The columns that the sample points lie in.
        picked, at = [], []
        for axis, (start, size) in enumerate(zip(part.corner, part.top.observed.shape, strict=True)):
            index = np.floor((along_m - source.corner_m[axis]) / source.size_m[axis] + 1e-9).astype(int) - start
            within = np.flatnonzero((index >= 0) & (index < size))
            picked.append(index[within])
            at.append(within)
        observed = np.asarray(part.top.observed)
        inner, place = np.ix_(*picked), np.ix_(*at)
        height_m[place] = np.where(observed, part.height_m, np.nan)[inner]
        label = np.asarray(part.top.label)
        rock[place] = label[inner] == source.target
        seen += int(observed.sum())
    known = ~np.isnan(height_m)
    if not known.any():
        raise JaxmapError(
            f"nothing was observed within the {SIDE_M:g} m x {SIDE_M:g} m about the origin",
            where=source.where,
            fix="give poses relative to the middle of the area",
        )
    area_m2 = seen * float(np.prod(source.size_m[:2]))
    if (share := known.sum() * (CELL_M / POINTS) ** 2 / area_m2) < 0.98:
        source.notify(f"note: {path.name} holds the {SIDE_M:g} m about the origin alone, {share:.0%} of the map")
    grouped = (cells, POINTS, cells, POINTS)
    counts = known.reshape(grouped).sum(axis=(1, 3))
    total_m = np.where(known, height_m, 0.0).reshape(grouped).sum(axis=(1, 3))
    table = np.full((cells, cells, 4), -np.inf)
    centre_m = along_m.reshape(cells, POINTS).mean(axis=1)
    table[..., 0], table[..., 1] = centre_m[:, None], centre_m[None, :]
    table[counts > 0, 2] = total_m[counts > 0] / counts[counts > 0]
    table[counts > 0, 3] = (rock.reshape(grouped).sum(axis=(1, 3)) > 0)[counts > 0]
    with atomic_path(path) as temporary, temporary.open("wb") as stream:
        np.save(stream, table, allow_pickle=False)

"""The tiles of a map in the arrays of a Zarr group: what a tile holds, and the files that it is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float32, Int

from jaxmap.mapping.arrays import (
    AXES,
    LOG_ODDS,
    SURFACE,
    SURFACE_AXES,
    TILE,
    array_folder,
    check_finite,
    create_array,
    read_part,
    stored_chunks,
)
from jaxmap.types import GridSpec, layer_count

if TYPE_CHECKING:
    import zarr

Tile = tuple[int, int, int]
"""The place of a tile in the grid, counted in tiles."""

Place = Sequence[int] | Int[np.ndarray, "3"]


class TileValues(NamedTuple):
    """What a map holds in one tile: its arrays, by their names.

    `surface` are the statistics of heights of its points, None where the map keeps none.
    """

    log_odds: Float32[np.ndarray, "K X Y Z"]
    surface: Float32[np.ndarray, "4 X Y 1"] | None = None


class TileArrays:
    """The arrays of a group of which each chunk is a tile; chunks of nothing but zeros are no files.

    Attributes:
        arrays: by name: `LOG_ODDS`, and `SURFACE` where heights are kept.
    """

    def __init__(self, arrays: Mapping[str, zarr.Array], where: Path) -> None:
        """Those of a group; `where` is named in errors."""
        self.arrays = {name: arrays[name] for name in (LOG_ODDS, SURFACE) if name in arrays}
        self._where = where

    @classmethod
    def open(cls, folder: Path, where: Path, mode: Literal["r", "r+"]) -> TileArrays:
        """Those of a group that `create` has made; what else lies in its folder is left aside."""
        import zarr

        there = [name for name in (LOG_ODDS, SURFACE) if (folder / name).exists()]
        return cls({name: zarr.open_array(folder / name, mode=mode, zarr_format=3) for name in there}, where)

    @classmethod
    def create(
        cls, folder: Path, grid: GridSpec, channels: int, *, surface: bool, stored: Mapping[str, Any], where: Path
    ) -> TileArrays:
        """Makes the group of a map of which nothing was observed.

        Args:
            folder: of the group.
            grid: in whole tiles.
            channels: of the log-odds.
            surface: with an array of heights.
            stored: attributes of the group.
            where: is named in errors.
        """
        import zarr

        group = zarr.create_group(folder, zarr_format=3, attributes=dict(stored))
        arrays = {LOG_ODDS: create_array(group, LOG_ODDS, (channels, *grid.shape), AXES)}
        if surface:
            shape = (4, *grid.shape[:2], layer_count(grid.shape[2]))
            arrays[SURFACE] = create_array(group, SURFACE, shape, SURFACE_AXES)
        return cls(arrays, where)

    def write(self, tile: Place, values: TileValues) -> None:
        """Writes a tile.

        Raises:
            JaxmapError: a number is not finite.
            OSError: the disk refuses.
        """
        for name, array in self.arrays.items():
            part = np.ascontiguousarray(getattr(values, name))
            check_finite(part, self._where)
            array[_PARTS[name](tile)] = part

    def read(self, name: str, tile: Place) -> Float32[np.ndarray, "..."]:
        """What an array holds of a tile.

        Raises:
            JaxmapError: it is damaged.
        """
        return read_part(self.arrays[name], _PARTS[name](tile), self._where)

    def file(self, name: str, tile: Place) -> Path:
        """Where an array keeps a tile, if it is there."""
        return array_folder(self.arrays[name]).joinpath("c", "0", *(str(int(index)) for index in tile))

    def stored(self) -> dict[str, set[Tile]]:
        """The tiles that each array keeps. They are listed anew: a map of kilometres has tens of thousands."""
        return {
            name: {(x, y, z) for _, x, y, z in stored_chunks(array_folder(array))}
            for name, array in self.arrays.items()
        }


def values_of(
    log_odds: Float32[np.ndarray, "K X Y Z"], surface: Float32[np.ndarray, "4 X Y L"] | None, tile: Place
) -> TileValues:
    """A tile of a dense map that begins with tile 0 0 0; views, no copies."""
    return TileValues(log_odds[tile_part(tile)], None if surface is None else surface[surface_part(tile)])


def tile_part(tile: Place) -> tuple[slice, ...]:
    """Where a tile lies in an array of log-odds that begins with tile 0 0 0."""
    return (slice(None), *(slice(int(i) * edge, (int(i) + 1) * edge) for i, edge in zip(tile, TILE, strict=True)))


def surface_part(tile: Place) -> tuple[slice, ...]:
    """Where a tile lies in an array of heights that begins with tile 0 0 0."""
    return (*tile_part(tile)[:3], slice(int(tile[2]), int(tile[2]) + 1))


_PARTS = {LOG_ODDS: tile_part, SURFACE: surface_part}


def chunk_attributes(counts: Mapping[str, int]) -> dict[str, Any]:
    """What a group says of how many chunks its arrays have: a lost one would read as zeros."""
    others = {name: count for name, count in counts.items() if name != LOG_ODDS}
    return {"chunks_stored": counts[LOG_ODDS], **({"chunks_stored_of": others} if others else {})}

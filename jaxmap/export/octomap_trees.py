"""OctoMap trees: `.ot` with log-odds and colours, `.bt` with nothing but occupied and free."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from jaxmap.errors import JaxmapError
from jaxmap.export.source import Source, optional
from jaxmap.fusion.neighbours import kernel_margin
from jaxmap.fusion.query import occupied, voxel_labels
from jaxmap.host.files import atomic_path

_MOST_INDEX = 2**15
"""Voxels to each side of the origin: a tree has sixteen levels."""
_SURE = 1e-6
_Cubes = tuple[Int[np.ndarray, "N 3"], Float[np.ndarray, "N"], UInt8[np.ndarray, "N"], Bool[np.ndarray, "N"]]


def write_octomap(source: Source, colour_tree: Path, binary_tree: Path) -> None:
    """Writes a `ColorOcTree` (.ot) and an `OcTree` (.bt), relative to the site origin.

    Voxels that are no cubes are divided into cubes, each as occupied as the voxel: what is occupied stays the same
    space. In the `.ot` log-odds are kept (within those of probabilities 1e-6 and 1 - 1e-6), priors included; in the
    `.bt` what is occupied is so by the map's own threshold.

    Raises:
        JaxmapError: octomap-python is missing, nothing was observed, voxels divide into no cubes, the map is larger
            than a tree, or the disk refuses.
    """
    octomap = optional("octomap", "octomap-python", "OctoMap")
    edge_m, parts = _cube(source)
    start, shift_m = _place(source, edge_m)
    colour, binary = octomap.ColorOcTree(edge_m), octomap.OcTree(edge_m)
    for tree in (colour, binary):
        tree.setClampingThresMin(_SURE)
        tree.setClampingThresMax(1 - _SURE)
    for index, log_odds, label, solid in cubes(source, parts):
        index = index + start
        if np.abs(index).max(initial=0) >= _MOST_INDEX:
            raise JaxmapError(
                f"a tree of {edge_m:g} m voxels ends {_MOST_INDEX * edge_m:g} m from the origin, the map does not",
                where=source.where,
                fix="write LAS, or map with larger voxels",
            )
        points = (index + 0.5) * edge_m
        colours = np.zeros((len(points), 3), np.uint8)
        colours[solid] = source.colours_of(points[solid] + shift_m, label[solid])
        for point, value, rgb, is_solid in zip(
            points, log_odds.tolist(), colours.tolist(), solid.tolist(), strict=True
        ):
            colour.updateNode(point, value, True)
            if is_solid:
                colour.setNodeColor(point, *rgb)
        for update in (True, False):
            if len(some := points[solid == update]):
                binary.updateNodes(some, update, True)
    if not colour.size():
        raise JaxmapError("nothing was observed: there is no tree of it", where=source.where, fix="see its report")
    colour.updateInnerOccupancy()
    binary.updateInnerOccupancy()
    for path, content in ((colour_tree, colour.write()), (binary_tree, binary.writeBinary())):
        with atomic_path(path) as temporary:
            temporary.write_bytes(content)
    if shift_m.any():
        text = ", ".join(f"{number:g}" for number in shift_m)
        source.notify(f"note: trees lie on multiples of {edge_m:g} m: add ({text}) m to their coordinates")


def cubes(source: Source, parts: Int[np.ndarray, "3"]) -> Iterator[_Cubes]:
    """The cubes that observed voxels divide into, block by block.

    Yields:
        Index on the lattice of cubes, log-odds of occupancy (prior included), label, and whether it is occupied.
    """
    params, rule = source.fusion
    prior = float(np.asarray(params.occupancy_prior))
    within = np.stack(np.meshgrid(*map(np.arange, parts), indexing="ij"), axis=-1).reshape(-1, 3)
    for voxel_map, own, _ in source.reader.blocks(kernel_margin(params.class_kernel)):
        values = np.asarray(voxel_map.log_odds)[:, *own]
        at = np.argwhere((values != 0).any(axis=0))
        if not len(at):
            continue
        here = tuple(at.T)
        solid = np.asarray(occupied(voxel_map, params))[own][here]
        label = np.asarray(voxel_labels(voxel_map, params, rule))[own][here]
        low = [side.indices(size)[0] for side, size in zip(own, voxel_map.grid.shape[:2], strict=True)]
        index = (at + np.asarray(voxel_map.grid.first) + [*low, 0]) * parts
        log_odds = values[0][here].astype(np.float64) + prior
        log_odds, label, solid = (np.repeat(column, len(within)) for column in (log_odds, label, solid))
        yield (index[:, None] + within).reshape(-1, 3), log_odds, label, solid


def _cube(source: Source) -> tuple[float, Int[np.ndarray, "3"]]:
    """The edge of the cubes that voxels divide into, and how many along each axis.

    Raises:
        JaxmapError: they divide into none.
    """
    size_m = source.size_m
    edge_m = float(size_m.min())
    parts = np.rint(size_m / edge_m).astype(int)
    if not np.allclose(parts * edge_m, size_m, rtol=1e-6):
        x, y, z = size_m
        near = " ".join(f"{number:g}" for number in parts * edge_m)
        raise JaxmapError(
            f"OctoMap has cubes, and voxels of {x:g} x {y:g} x {z:g} m do not divide into any",
            where=source.where,
            fix=f"map with --grid.voxel-size-m {near}, or write LAS or PLY",
        )
    return edge_m, parts


def _place(source: Source, edge_m: float) -> tuple[Int[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Where the lattice of the map begins: whole edges, and the rest in metres, which a tree cannot hold."""
    lattice_m = np.round(source.corner_m - np.asarray(source.reader.grid.first) * source.size_m, 9)
    edges = np.floor(lattice_m / edge_m + 1e-6).astype(int)
    rest_m = lattice_m - edges * edge_m
    return edges, np.where(np.abs(rest_m) < 1e-6 * edge_m, 0.0, rest_m)

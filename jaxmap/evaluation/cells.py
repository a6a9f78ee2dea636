"""The cells that maps are scored in, and what a map predicts for each.

A cell may hold any number of columns of voxels, whole or in part. They are weighted by area, because a rock's steep
face puts many points into a cell that it hardly covers. Ground that was not observed counts as not rock, with the
prior as its probability: a few stray points do not make a cell.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float64

from jaxmap.errors import JaxmapError
from jaxmap.geometry.grid import exact_corner
from jaxmap.types import GridSpec

if TYPE_CHECKING:
    from scipy.sparse import csr_array

MAX_CELLS = 2**26
_MOST_DENSE = 2**24
_SNAP = 1e-6
"""Areas closer than this, in cells, are the same: sums of fractions such as 0.2 / 3 are not exact."""


@dataclass(frozen=True)
class CellGrid:
    """Square cells on the ground: cell `(i, j)` spans `origin_m + (i, j) * size_m` and one size more; x, then y."""

    origin_m: tuple[float, float]
    size_m: float
    shape: tuple[int, int]

    def corners(self) -> tuple[Float64[np.ndarray, "I1"], Float64[np.ndarray, "J1"]]:
        """X and y of the edges between cells, world, metres."""
        x, y = (o + np.arange(n + 1) * self.size_m for o, n in zip(self.origin_m, self.shape, strict=True))
        return x, y

    def centres(self) -> tuple[Float64[np.ndarray, "I"], Float64[np.ndarray, "J"]]:
        """X and y of the centres of cells, world, metres."""
        x, y = self.corners()
        return x[:-1] + self.size_m / 2, y[:-1] + self.size_m / 2


AnyArray = Array | np.ndarray
"""Of JAX or of NumPy."""


class ColumnShares(NamedTuple):
    """How much of each column of voxels lies in each cell, as a share of the column's width along each axis.

    The share of its area is the product of the two. `columns_per_cell` is how many columns fill a cell, whole or in
    part. Of many columns the matrices are sparse: a cell holds but a few.
    """

    x: Float[np.ndarray, "I X"] | csr_array
    y: Float[np.ndarray, "J Y"] | csr_array
    columns_per_cell: float


class MapCells(NamedTuple):
    """What a map predicts for each cell.

    `observed`: a surface was seen in some column of it; `share`: of its area, that of the columns labelled with the
    class; `probability`: that a point of it is of the class, the mean over its area, the class prior where nothing
    was observed.
    """

    observed: Bool[AnyArray, "I J"]
    share: Float[AnyArray, "I J"]
    probability: Float[AnyArray, "I J"]

    def called(self, fraction: float = 0.5) -> Bool[np.ndarray, "I J"]:
        """Cells that the map calls by the class: it covers at least `fraction` of their area."""
        return np.asarray(self.observed) & (np.asarray(self.share) >= fraction - _SNAP)


def make_cells(grid: GridSpec, size_m: float) -> CellGrid:
    """Cells that cover a map.

    They lie on whole multiples of their size where each column then falls into one cell, so that maps of one site
    share their cells whatever their voxels; otherwise they start at the corner of the map.

    Raises:
        JaxmapError: a size that is not positive, or more cells than can be held.
    """
    if not (np.isfinite(size_m) and size_m > 0):
        raise JaxmapError(f"cells of {size_m} m", where="cell size", fix="give a positive size")
    origin_m, voxel_m = (numbers[:2] for numbers in exact_corner(grid))
    upper_m = origin_m + voxel_m * grid.shape[:2]
    if _whole(size_m / voxel_m) and _whole(origin_m / voxel_m):
        origin_m = np.floor(origin_m / size_m + _SNAP) * size_m
    shape = np.ceil((upper_m - origin_m) / size_m - _SNAP).clip(min=1)
    if shape.prod() > MAX_CELLS:
        raise JaxmapError(f"{shape.prod():.3g} cells of {size_m:g} m", where="cell size", fix="take larger cells")
    return CellGrid((float(origin_m[0]), float(origin_m[1])), float(size_m), (int(shape[0]), int(shape[1])))


def column_shares(grid: GridSpec, cells: CellGrid) -> ColumnShares:
    """How the columns of a map fall into cells."""
    if grid.shape[0] * grid.shape[1] > _MOST_DENSE:
        return _sparse_shares(grid, cells)
    origin_m, voxel_m = exact_corner(grid)
    shares = []
    for axis in (0, 1):
        edges = (np.asarray(cells.origin_m[axis]) + np.arange(cells.shape[axis] + 1) * cells.size_m)[:, None]
        low = origin_m[axis] + np.arange(grid.shape[axis]) * voxel_m[axis]
        overlap = np.minimum(edges[1:], low + voxel_m[axis]) - np.maximum(edges[:-1], low)
        shares.append(np.round(overlap.clip(min=0) / voxel_m[axis], 6).astype(np.float32))
    return ColumnShares(*shares, columns_per_cell=float(np.prod(cells.size_m / voxel_m[:2])))


def _sparse_shares(grid: GridSpec, cells: CellGrid) -> ColumnShares:
    """`column_shares`, with only the cells that a column touches; a cell is larger than a column, or the map small."""
    from scipy.sparse import csr_array

    origin_m, voxel_m = exact_corner(grid)
    shares = []
    for axis in (0, 1):
        low = origin_m[axis] + np.arange(grid.shape[axis]) * voxel_m[axis] - cells.origin_m[axis]
        reach = int(np.ceil(voxel_m[axis] / cells.size_m)) + 1
        cell = np.floor(low / cells.size_m - _SNAP).astype(int)[:, None] + np.arange(reach + 1)
        edge = cell * cells.size_m
        within = np.minimum(edge + cells.size_m, low[:, None] + voxel_m[axis]) - np.maximum(edge, low[:, None])
        share = np.round(within.clip(min=0) / voxel_m[axis], 6).astype(np.float32)
        there = (share > 0) & (cell >= 0) & (cell < cells.shape[axis])
        column = np.broadcast_to(np.arange(grid.shape[axis])[:, None], cell.shape)
        shape = (cells.shape[axis], grid.shape[axis])
        shares.append(csr_array((share[there], (cell[there], column[there])), shape=shape))
    return ColumnShares(*shares, columns_per_cell=float(np.prod(cells.size_m / voxel_m[:2])))


def area_in_cells(shares: ColumnShares, columns: Float[AnyArray, "X Y"]) -> Float[Array, "I J"]:
    """The sum over the columns of each cell, weighted by the share of their area that lies in it."""
    x, y = shares.x, shares.y
    # Arrays may be JAX's, also traced ones.
    if not isinstance(x, AnyArray) or not isinstance(y, AnyArray):
        return jnp.asarray(x @ np.asarray(columns, np.float32) @ y.T)
    # The default precision of accelerators would round the counts.
    return jnp.matmul(jnp.matmul(x, columns, precision="highest"), y.T, precision="highest")


def map_cells(
    is_class: Bool[AnyArray, "X Y"] | Float[AnyArray, "X Y"],
    probability: Float[AnyArray, "X Y"],
    observed: Bool[AnyArray, "X Y"],
    shares: ColumnShares,
    prior: float = 0.5,
) -> MapCells:
    """Aggregates the columns of a map into cells; differentiable in `probability` (and in a soft `is_class`).

    Args:
        is_class: whether a column is labelled with the class, or how much.
        probability: of the class, for each column.
        observed: whether a surface was observed in the column.
        shares: `column_shares` of the map.
        prior: probability of the class where nothing was observed.
    """
    weight = jnp.asarray(observed, jnp.float32)
    area = area_in_cells(shares, weight) / shares.columns_per_cell
    share = area_in_cells(shares, weight * is_class) / shares.columns_per_cell
    # Selected, not multiplied: a probability that is not finite where nothing was observed must not spread.
    known = area_in_cells(shares, jnp.where(observed, probability, 0.0)) / shares.columns_per_cell
    return MapCells(area > _SNAP, share, known + (1.0 - area) * prior)


def _whole(numbers: np.ndarray) -> bool:
    return bool((np.abs(numbers - np.round(numbers)) < 1e-4).all())

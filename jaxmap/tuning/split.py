"""Ground held out from tuning: whole blocks and whole rocks, so that no rock is on both sides."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Int

from jaxmap.datasets.label_raster import TARGET
from jaxmap.evaluation.cells import CellGrid
from jaxmap.evaluation.truth_cells import TruthCells, cell_counts

BLOCK_M = 2.0


def ground_groups(truth: TruthCells, cells: CellGrid, block_m: float = BLOCK_M) -> Int[np.ndarray, "I J"]:
    """A group for each cell: its rock, where one lies in it, and else its block of ground.

    A rock is a connected piece of the class at the resolution of the truth; rocks that share a cell are one group.
    """
    from scipy.ndimage import label

    per_block = max(1, round(block_m / cells.size_m))
    i, j = np.indices(cells.shape)
    groups = (i // per_block) * -(-cells.shape[1] // per_block) + j // per_block
    rocky = cell_counts(truth.fine == TARGET, truth.per_cell) > 0
    # Cells that hold parts of one rock touch: pieces of such cells never cut a rock.
    pieces, _ = label(rocky, np.ones((3, 3), int))  # type: ignore[misc]
    return np.where(rocky, groups.max() + pieces, groups).astype(np.int64)


def hold_out(
    groups: Int[np.ndarray, "I J"],
    truly: Bool[np.ndarray, "I J"],
    counted: Bool[np.ndarray, "I J"],
    share: float,
    seed: int,
) -> Bool[np.ndarray, "I J"]:
    """Draws cells to hold out, group by group: that share of the cells of the class, and of the others.

    Args:
        groups: of each cell (`ground_groups`).
        truly: cells of the class.
        counted: cells that can count at all.
        share: of the cells, between 0 and 1.
        seed: of the draw.
    """
    rng = np.random.default_rng(seed)
    held = np.zeros(groups.shape, bool)
    place = np.unique(groups, return_inverse=True)[1]
    place = place.reshape(groups.shape)
    of_class = np.bincount(place.ravel(), (truly & counted).ravel())
    others = np.bincount(place.ravel(), (~truly & counted).ravel())
    with_class = of_class > 0
    for sizes, members in ((of_class, with_class), (others, ~with_class)):
        drawn = rng.permutation(np.flatnonzero(members))
        upto = np.cumsum(sizes[drawn])
        wanted = share * sizes[drawn].sum()
        # A group is taken while what is taken before it falls short by more than half of it.
        taken = drawn[upto - sizes[drawn] / 2 < wanted]
        held |= np.isin(place, taken)
    return held

"""Maps that should be one and the same, in grids of their own."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from jaxmap.mapping.store import load_map, open_map
from jaxmap.types import LAYER, VoxelMap


def assert_same_bits(found: VoxelMap, expected: VoxelMap) -> None:
    """The map, in the place of the grid where it lies, and nothing around it; heights, where one has them, too."""
    low, size = np.asarray(expected.grid.first) - np.asarray(found.grid.first), expected.grid.shape
    there = tuple(slice(a, a + n) for a, n in zip(low, size, strict=True))
    _same(found.log_odds, expected.log_odds, there)
    assert (found.surface is None) == (expected.surface is None)
    if found.surface is not None and expected.surface is not None:
        layer = int(expected.grid.first[2]) // LAYER - int(found.grid.first[2]) // LAYER
        # One layer more than they touch is set aside by each.
        count = min(expected.surface.shape[3], found.surface.shape[3] - layer)
        assert not np.asarray(expected.surface)[..., count:].any()
        _same(found.surface, np.asarray(expected.surface)[..., :count], (*there[:2], slice(layer, layer + count)))


def assert_same_layers(found: Path, expected: Path) -> None:
    """The layers of two stored maps, likewise: one of them read square by square, the other as a whole."""
    (voxel_map, theirs), reader = load_map(expected), open_map(found)
    low = np.asarray(voxel_map.grid.first) - np.asarray(reader.grid.first)
    x, y = (slice(a, a + n) for a, n in zip(low[:2].tolist(), voxel_map.grid.shape[:2], strict=True))
    ours, around = reader.layers((x, y)), reader.layers(reader.whole)
    assert ours.keys() == theirs.layers.keys() and len(ours)
    for name, values in theirs.layers.items():
        np.testing.assert_array_equal(ours[name], values, err_msg=name)
        assert np.isfinite(values).any()
        assert np.isfinite(around[name]).sum() == np.isfinite(values).sum()


def _same(found: object, expected: object, there: tuple[slice, ...]) -> None:
    found = np.array(found)
    np.testing.assert_array_equal(found[(slice(None), *there)], expected)
    found[(slice(None), *there)] = 0
    assert not found.any()

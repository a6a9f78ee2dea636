"""The top-down map in blocks is that of the whole map."""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
import pytest

from jaxmap.errors import JaxmapError
from jaxmap.fusion.options import FusionOptions
from jaxmap.fusion.params import make_fusion_params
from jaxmap.fusion.query import top_down
from jaxmap.labels import IGNORE
from jaxmap.mapping import columns
from jaxmap.mapping.attributes import MapAttributes
from jaxmap.mapping.columns import part_of, top_down_of
from jaxmap.mapping.store import in_memory, load_map, open_map, save_map
from jaxmap.types import make_grid, make_voxel_map

CLASSES = ("sand", "rock")
KERNEL = (((0.1, 0.2, 0.1), (0.2, 1.0, 0.3), (0.1, 0.2, 0.1)),) * 2


def patchy_map(seed: int = 0):
    """130 by 100 columns of random evidence, whose one corner nothing has touched."""
    grid = make_grid([-3, 2, -1], [10, 12, 1], (0.1, 0.1, 0.2), np.zeros(3))
    values = np.random.default_rng(seed).normal(size=(3, *grid.shape)).astype(np.float32)
    values[:, :64, :64] = 0
    values[:, 70:90] *= np.random.default_rng(1).random((20, *grid.shape[1:])) > 0.9
    return replace(make_voxel_map(grid, CLASSES), log_odds=values)


@pytest.mark.slow
@pytest.mark.parametrize("column", ["sum", "max"])
def test_blocks_make_the_whole_top_down_map_bit_for_bit(tmp_path, column):
    options = FusionOptions(column=column)
    params, rule = make_fusion_params(CLASSES, options), options.rule(CLASSES)
    params = replace(params, class_kernel=jax.numpy.asarray(KERNEL))
    voxel_map = patchy_map()
    save_map(tmp_path / "map.zarr", voxel_map, MapAttributes())
    whole = jax.tree.map(np.asarray, top_down(load_map(tmp_path / "map.zarr")[0], params, rule))
    for within in ((slice(0, 130), slice(0, 100)), (slice(60, 71), slice(3, 90))):
        for reader in (open_map(tmp_path / "map.zarr"), in_memory(voxel_map, MapAttributes())):
            part = top_down_of(reader, params, rule, within)
            for name, ours, theirs in zip(part._fields, part, whole, strict=True):
                np.testing.assert_array_equal(ours, theirs[(..., *within)], name)
    assert (whole.label[:63, :63] == IGNORE).all()
    assert (whole.label != IGNORE).any()


def test_what_no_memory_holds_is_refused(monkeypatch):
    monkeypatch.setattr(columns, "available_bytes", lambda: 1 << 20)
    with pytest.raises(JaxmapError, match="the top-down map of 4,000 x 500 columns takes .* GiB"):
        columns.check_columns((4000, 500), 16, "the top-down map")


def test_the_grid_of_a_part_lies_where_it_was():
    grid = patchy_map().grid
    part = part_of(grid, (slice(5, 9), slice(7, 10)))
    assert part.shape == (4, 3, grid.shape[2])
    np.testing.assert_array_equal(part.first, np.add(grid.first, [5, 7, 0]))

"""Maps of any size are scored alike: in one piece, in tiles, and only where the truth lies."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from fixtures import cli  # noqa: F401
from truth_files import CRS, SITE, write_raster

from jaxmap.evaluation import cells
from jaxmap.mapping.attributes import MapAttributes
from jaxmap.mapping.store import load_map, save_map
from jaxmap.mapping.tile_arrays import TileValues
from jaxmap.mapping.tiles import TILE, TileStore, whole_tiles
from jaxmap.runs import evaluation
from jaxmap.types import make_grid

CLASSES = ("sand", "rock")
GRID = whole_tiles(make_grid([0, 0, 0], [25, 25, 1], (0.1, 0.1, 0.2), np.zeros(3)))


def store_map(path: Path) -> None:
    """256 by 256 columns, of which three tiles were seen, with rocks of a few columns."""
    rng, store = np.random.default_rng(0), TileStore(path, GRID, CLASSES)
    for tile in ((0, 0, 0), (1, 0, 0), (1, 2, 0)):
        values = np.zeros((3, *TILE), np.float32)
        seen = rng.random(TILE[:2]) > 0.1
        rock = np.kron(rng.random((16, 16)) > 0.8, np.ones((4, 4))) > 0
        values[0, ..., 2] = 2 * seen
        values[1, ..., 2] = seen * rng.normal(np.where(rock, -2, 2), 1)
        values[2, ..., 2] = seen * rng.normal(np.where(rock, 2, -2), 1)
        store.write(tile, TileValues(values))
    store.commit(1, MapAttributes(crs=CRS, site_origin=SITE))
    store.close()


@pytest.fixture
def run(tmp_path):
    store_map(tmp_path / "run" / "map.zarr")
    return tmp_path / "run"


def scores_of(cli, run: Path, truth: Path, *words: object) -> dict:
    outcome = cli("evaluate", run, truth, *words)
    assert outcome.status == 0, outcome.err
    return json.loads((run / "scores.json").read_text()) | {"run": None, "notes": None}


def truth_over(tmp_path: Path, west_m: float, columns: int) -> Path:
    labels = np.where(np.random.default_rng(3).random((100, columns)) > 0.8, 2, 1).astype(np.uint8)
    return write_raster(tmp_path / "truth.tif", labels, SITE[0] + west_m, SITE[1] + 20, 0.2)


@pytest.mark.slow
def test_a_map_in_one_piece_and_in_tiles_give_the_same_scores(cli, run, tmp_path):
    truth = truth_over(tmp_path, 0.0, 100)
    tiled = scores_of(cli, run, truth)
    save_map(tmp_path / "other" / "map.zarr", *load_map(run / "map.zarr"))
    assert scores_of(cli, tmp_path / "other", truth) == tiled
    assert tiled["cells"] > 2000


@pytest.mark.slow
@pytest.mark.parametrize("cell_size_m", [0.2, 0.25])
def test_of_a_large_map_the_part_under_the_truth_is_scored(cli, run, tmp_path, monkeypatch, cell_size_m):
    truth = truth_over(tmp_path, 6.4, 40)
    words = ("--cell-size-m", cell_size_m)
    whole = scores_of(cli, run, truth, *words)
    monkeypatch.setattr(evaluation, "MOST_WHOLE", 0)
    monkeypatch.setattr(evaluation, "_AROUND_M", 1.0)
    monkeypatch.setattr(cells, "_MOST_DENSE", 0)
    part = scores_of(cli, run, truth, *words)
    if cell_size_m == 0.2:
        assert {key: part[key] for key in ("tp", "fp", "fn", "tn", "rocks")} == {
            key: whole[key] for key in ("tp", "fp", "fn", "tn", "rocks")
        }
        assert part["nll"] == pytest.approx(whole["nll"], rel=1e-5)
    assert part["cells"] == pytest.approx(whole["cells"], rel=0.02)


def test_sparse_shares_are_the_dense_ones(monkeypatch):
    grid = make_grid([0.13, 0.2, 0], [7, 5, 1], (0.07, 0.1, 0.2), np.array([0.03, 0, 0]))
    for size_m in (0.2, 0.25, 0.05):
        scored = cells.make_cells(grid, size_m)
        dense = cells.column_shares(grid, scored)
        with monkeypatch.context() as patch:
            patch.setattr(cells, "_MOST_DENSE", 0)
            sparse = cells.column_shares(grid, scored)
        for ours, theirs in zip(sparse[:2], dense[:2], strict=True):
            np.testing.assert_allclose(ours.toarray(), theirs, atol=1e-6)

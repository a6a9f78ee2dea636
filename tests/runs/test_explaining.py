"""`jaxmap explain`: what the frames added to a cell is what the map holds."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from fixtures import cli, finished_run, map_words, scene_folder, shared_cache  # noqa: F401
from truth_files import SITE, write_map

from jaxmap.commands.main import main
from jaxmap.errors import JaxmapError
from jaxmap.mapping.store import load_map, save_map
from jaxmap.runs.explaining import explain_cell, find_cell, frames_of, plan_again


def quiet(line: str) -> None:
    pass


@pytest.mark.slow
def test_the_parts_add_up_to_the_evidence_of_the_cell(finished_run):
    voxel_map, _ = load_map(finished_run / "map.zarr")
    grid, values = voxel_map.grid, np.asarray(voxel_map.log_odds)
    seen = np.argwhere((values[0] > 1).any(axis=-1) & (values[3] > 0).any(axis=-1))
    size_m, corner_m = (np.asarray(numbers)[:2] for numbers in (grid.voxel_size_m, grid.origin_m))
    for radius_m, column in ((None, seen[len(seen) // 2]), (0.15, seen[len(seen) // 3])):
        east, north = corner_m + (column + 0.5) * size_m
        cell = find_cell(finished_run, (east, north), radius_m)
        assert all(part.start <= at < part.stop for part, at in zip(cell.within, column, strict=True))
        np.testing.assert_array_equal(cell.log_odds, values[(slice(None), *cell.within)])
        plan = plan_again(finished_run, cell, quiet)
        numbers = frames_of(cell, plan)
        explained = explain_cell(finished_run, cell, plan, numbers)
        np.testing.assert_allclose(sum(part.evidence for part in explained.parts), explained.evidence, atol=1e-4)
        assert explained.evidence[0] > 0.5 and sum(part.inside.sum() for part in explained.parts) > 3
        for part in explained.parts:
            assert part.inside.any() == (part.weight > 0).any()
            assert np.isfinite(part.disparity_px[part.inside]).all()
        if radius_m is None:
            total = explained.evidence + explained.priors
            np.testing.assert_allclose(1 / (1 + np.exp(-total[1:])), explained.probability, atol=1e-4)


@pytest.mark.slow
def test_a_page_and_a_table_are_written_and_changes_are_refused(cli, finished_run, tmp_path):
    voxel_map, _ = load_map(finished_run / "map.zarr")
    column = np.argwhere((np.asarray(voxel_map.log_odds)[0] > 1).any(axis=-1))[40]
    at = np.asarray(voxel_map.grid.origin_m)[:2] + (column + 0.5) * np.asarray(voxel_map.grid.voxel_size_m)[:2]
    out = tmp_path / "why.html"
    outcome = cli("explain", finished_run, "--at", *at, "--out", out)
    assert outcome.status == 0, outcome.err
    assert "the map" in outcome.out and "prior" in outcome.out and "why.html" in outcome.out
    page = out.read_text()
    assert page.count("data:image/webp") >= 3 and "https:" not in re.sub("<svg.*?</svg>", "", page, flags=re.S)
    cell = find_cell(finished_run, (float(at[0]), float(at[1])))
    plan = plan_again(finished_run, cell, quiet)
    other = replace(cell, log_odds=cell.log_odds + np.float32(0.01))
    with pytest.raises(JaxmapError, match="the frames add up to other evidence than the map holds, by 0.01"):
        explain_cell(finished_run, other, plan, frames_of(cell, plan))


def test_places_that_cannot_be_explained_name_the_nearest_that_can(cli, tmp_path):
    seen = np.zeros((80, 70), bool)
    seen[3, 65] = True
    run = write_map(tmp_path / "run", ~seen, seen)
    east, north = SITE[:2] + (np.array([3, 65]) + 0.5) * 0.2
    hint = f"the nearest cell that was observed: --at {east:.3f} {north:.3f}"
    outside = cli("explain", run, "--at", SITE[0] - 5, SITE[1])
    assert outside.status == 2 and "lies outside the map" in outside.error and hint in outside.error
    unseen = cli("explain", run, "--at", SITE[0] + 10, SITE[1] + 1)
    assert unseen.status == 2 and "no frame has seen anything at" in unseen.error and hint in unseen.error
    assert "config.yaml" in cli("explain", run, "--at", east, north).error
    (run / "config.yaml").write_text(json.dumps({"sequence": "merged", "merged": ["a", "b"]}))
    assert "explain one of them: a, b" in cli("explain", run, "--at", east, north).error
    voxel_map, attributes = load_map(run / "map.zarr")
    save_map(run / "map.zarr", replace(voxel_map, log_odds=0 * voxel_map.log_odds), attributes)
    assert "nothing was observed in this map at all" in cli("explain", run, "--at", east, north).error


@pytest.mark.slow
def test_what_was_kept_explains_the_map_that_was_fused_from_it(scene_folder, tmp_path):
    run = tmp_path / "run"
    assert main(map_words(scene_folder, run, "--keep-observations", "--start", 1, "--stop", 4)) == 0
    voxel_map, _ = load_map(run / "map.zarr")
    column = np.argwhere((np.asarray(voxel_map.log_odds)[0] > 1).any(axis=-1))[60]
    at = np.asarray(voxel_map.grid.origin_m)[:2] + (column + 0.5) * np.asarray(voxel_map.grid.voxel_size_m)[:2]
    cell = find_cell(run, (float(at[0]), float(at[1])))
    plan = plan_again(run, cell, quiet)
    explained = explain_cell(run, cell, plan, frames_of(cell, plan))
    np.testing.assert_allclose(sum(part.evidence for part in explained.parts), explained.evidence, atol=1e-4)

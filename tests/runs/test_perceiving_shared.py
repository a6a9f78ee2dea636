"""Perceiving on workers: the same frames as in one process; and both stages of a map on workers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from fixtures import FRAMES, cli, map_words, scene_copy, scene_folder, shared_cache  # noqa: F401

from jaxmap.mapping.observations import open_observations
from jaxmap.mapping.store import load_map

PLANE = ("--labeller", "plane")

pytestmark = pytest.mark.slow


def frames_of(out: Path) -> dict[str, tuple]:
    observations = open_observations(out / "observations.zarr")
    assert observations.attributes.complete
    seen = [observations.observation(index) for index in range(len(observations.frames))]
    return {one.name: (one.timestamp_s, one.T_world_camera, one.disparity_px) for one in seen}


def test_two_processes_perceive_what_one_does_and_the_map_is_the_same(cli, scene_folder, tmp_path):
    one, two, run, both = (tmp_path / name for name in ("one", "two", "run", "both"))
    assert cli("perceive", scene_folder, "--out", one, *PLANE).status == 0
    assert cli("perceive", scene_folder, "--out", two, *PLANE, "--workers", "2").status == 0
    expected, found = frames_of(one), frames_of(two)
    assert expected.keys() == found.keys() and len(found) == FRAMES
    for name, frame in expected.items():
        for before, after in zip(frame, found[name], strict=True):
            np.testing.assert_array_equal(before, after)
    assert sorted(path.name for path in (two / "pictures").iterdir()) == sorted(
        path.name for path in (one / "pictures").iterdir()
    )
    bounds = [str(word) for word in map_words(scene_folder, run)[4:]]
    assert cli("map", one, "--out", run, *bounds, "--workers", "1").status == 0
    done = cli("map", scene_folder, "--out", both, *bounds, "--workers", "2")
    assert done.status == 0, done.err
    np.testing.assert_array_equal(load_map(run / "map.zarr")[0].log_odds, load_map(both / "map.zarr")[0].log_odds)
    assert not (both / "observations.zarr").exists() and (both / "report.html").exists()

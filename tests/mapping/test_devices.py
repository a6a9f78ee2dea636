"""Frames shared out over two devices make the map of one; here the devices are virtual ones of the CPU."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from fixtures import scene_copy, scene_folder, shared_cache  # noqa: F401
from planned_runs import log_odds, metrics_of

import jaxmap
from jaxmap.errors import UsageError
from jaxmap.mapping.devices import choose_devices
from jaxmap.mapping.store import open_map

RUNS = """
import sys
from pathlib import Path

import jax
from jaxmap.mapping.devices import choose_devices
from jaxmap.runs.folder import RunFolder
from jaxmap.runs.mapping import run_plan
from jaxmap.runs.mapping_plan import plan_run
from planned_runs import config_of

sequence, out = map(Path, sys.argv[1:])
assert jax.local_device_count() == 2
for devices in (1, 2):
    config = config_of(grid={"voxel_size_m": 0.2})
    plan = plan_run(str(sequence), config, print)
    folder = RunFolder(out / str(devices))
    folder.begin(plan.settings(config), resume=False, overwrite=False)
    # Saved whenever that is allowed: map and log must agree.
    options = dict(checkpoint_every_s=0.0, notify=print, report=False, devices=choose_devices(devices))
    run_plan(plan, folder, strict=False, **options)
"""


@pytest.mark.slow
def test_two_devices_make_the_map_of_one(scene_copy, tmp_path):
    """Of five frames that can be used, so that the last one is alone, and one between them that cannot."""
    (scene_copy / "left" / "f002.png").write_bytes(b"no image")
    folders = [str(Path(jaxmap.__file__).parents[1]), str(Path(__file__).parents[1])]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(folders)}
    # One device would otherwise add up by the C++ kernel, which rounds in another order.
    environment["JAXMAP_NATIVE"] = "0"
    environment["XLA_FLAGS"] = "--xla_force_host_platform_device_count=2"
    subprocess.run([sys.executable, "-c", RUNS, str(scene_copy), str(tmp_path)], env=environment, check=True)
    one, two = tmp_path / "1", tmp_path / "2"
    np.testing.assert_array_equal(log_odds(two), log_odds(one))
    assert np.count_nonzero(log_odds(one))
    for part in ("sequence", "points", "voxels"):
        assert metrics_of(two)[part] == metrics_of(one)[part]
    assert len(metrics_of(two)["sequence"]["skipped"]) == 1
    progress = [open_map(run / "map.zarr").attributes.progress for run in (one, two)]
    assert progress[0]["digest"] == progress[1]["digest"]


def test_devices_that_are_not_there_are_refused():
    assert len(choose_devices(None)) == 1
    with pytest.raises(UsageError, match="1000 devices are asked for"):
        choose_devices(1000)

"""`jaxmap map --poses odometry` on a folder without poses."""

import shutil

import numpy as np
import pytest
from fixtures import cli, map_words, scene_folder, shared_cache  # noqa: F401

from jaxmap.datasets.poses import read_poses


@pytest.mark.slow
def test_a_folder_without_poses_is_mapped(cli, scene_folder, tmp_path):
    folder = tmp_path / "drive"
    shutil.copytree(scene_folder, folder)
    truth = read_poses(folder / "poses.tum").T
    (folder / "poses.tum").unlink()
    assert "--poses odometry" in cli(*map_words(folder, tmp_path / "refused")).error
    outcome = cli(*map_words(folder, tmp_path / "run", "--poses", "odometry"))
    assert outcome.status == 0, outcome.err
    assert "note: the poses are estimated from the images (stereo odometry): 6 of 6 frames" in outcome.err
    found = read_poses(tmp_path / "run" / "poses.tum").T
    np.testing.assert_allclose(found[:, :3, 3], truth[:, :3, 3], atol=0.06)
    again = cli(*map_words(folder, tmp_path / "run", "--poses", "odometry", "--resume"))
    assert again.status == 0, again.err

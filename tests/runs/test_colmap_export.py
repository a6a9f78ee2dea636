"""`jaxmap export RUN --format colmap`: the model and the images of a run."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
from fixtures import cli, finished_run, scene_folder, shared_cache  # noqa: F401
from PIL import Image

from jaxmap.datasets.poses import read_poses
from jaxmap.report.run_contents import read_run

pytestmark = pytest.mark.slow


@pytest.fixture
def run(finished_run, tmp_path):
    return shutil.copytree(finished_run, tmp_path / "run")


def test_a_run_becomes_a_model(cli, run) -> None:
    outcome = cli("export", run, "--format", "colmap")
    assert outcome.status == 0 and "colmap/images/" in outcome.out, outcome.err
    pycolmap = pytest.importorskip("pycolmap")
    model = pycolmap.Reconstruction()
    model.read_text(str(run / "colmap"))
    poses = read_poses(run / "poses.tum").T
    assert len(model.images) == len(poses) == 6
    assert len(model.points3D) == len(read_run(run).voxels.label)
    for image, pose in zip(sorted(model.images.values(), key=lambda image: image.name), poses, strict=True):
        np.testing.assert_allclose(image.projection_center(), pose[:3, 3], atol=1e-6)
        np.testing.assert_allclose(image.viewing_direction(), pose[:3, 2], atol=1e-6)
        with Image.open(run / "colmap" / "images" / image.name) as picture:
            assert picture.size == (model.cameras[1].width, model.cameras[1].height)


def test_without_its_sequence_a_run_has_no_images(cli, run) -> None:
    lines = (run / "config.yaml").read_text().splitlines()
    lines[0] = "sequence: /nowhere/at/all"
    (run / "config.yaml").write_text("\n".join(lines))
    outcome = cli("export", run, "--format", "colmap")
    assert outcome.status == 0 and "no images are written" in outcome.err
    assert (run / "colmap" / "images.txt").is_file() and "colmap/images/" not in outcome.out


def test_without_names_there_is_no_model(cli, run) -> None:
    (run / "frames.csv").unlink()
    assert "map again" in cli("export", run, "--format", "colmap").error

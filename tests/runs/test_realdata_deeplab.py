"""A real network inside the step, on real images: what it names lies where it is."""

from __future__ import annotations

from pathlib import Path

import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
import reference
from fixtures import cli, shared_cache  # noqa: F401
from planned_runs import voxels_of

from jaxmap.datasets import open_sequence
from jaxmap.datasets.samples import motorcycle_disparity
from jaxmap.fusion.params import stored_fusion
from jaxmap.fusion.query import voxel_labels
from jaxmap.labels import IGNORE
from jaxmap.mapping.store import load_map

pytestmark = pytest.mark.slow

SOURCE = "deeplabv3_mnv2_voc_trainval_folded.safetensors"


@pytest.fixture
def voc(cli, realdata, tmp_path) -> Path:
    """The network of 21 classes, as a model file."""
    source = realdata / "weights" / SOURCE
    if not source.exists():
        pytest.skip(f"no {source}")
    assert cli("weights", "import", source, "--out", tmp_path / "voc.safetensors").status == 0
    return tmp_path / "voc.safetensors"


MOTORCYCLE_BOXES = {
    "tank and engine": (True, slice(190, 360), slice(260, 450)),
    "front wheel and fork": (True, slice(300, 420), slice(560, 660)),
    "floor": (False, slice(470, 500), slice(200, 600)),
    "boxes on the shelf": (False, slice(50, 120), slice(530, 690)),
    "back of the bench": (False, slice(110, 150), slice(60, 230)),
}
"""Whether it is the motorcycle, and its rows and columns in the left image, drawn by hand."""


@pytest.mark.realdata
@pytest.mark.slow
def test_the_motorcycle_is_where_it_stands(cli, voc, tmp_path):
    run = tmp_path / "run"
    words = ("--grid.voxel-size-m", "0.05", "--depth.max-m", "6", "--classes", "background", "motorbike")
    outcome = cli("map", "sample:motorcycle", "--out", run, "--labeller", "deeplab", "--model", voc, *words)
    assert outcome.status == 0, outcome.err
    voxel_map, attributes = load_map(run / "map.zarr")
    labels = np.asarray(voxel_labels(voxel_map, *stored_fusion(attributes.fusion, voxel_map.classes, "map")))
    sequence = open_sequence("sample:motorcycle")
    pose = jaxlie.SE3.from_matrix(jnp.asarray(sequence.T_world_camera[0], jnp.float32))
    points, valid = reference.disparity_to_points(sequence.camera, motorcycle_disparity())
    for name, (is_motorcycle, rows, columns) in MOTORCYCLE_BOXES.items():
        world = reference.transform_points(pose, points[rows, columns][valid[rows, columns]])
        index, inside = reference.world_to_voxel(voxel_map.grid, world)
        found = labels[tuple(index[inside].T)]
        found = found[found != IGNORE]
        assert len(found) > 1000, name
        share = (found == voxel_map.classes.index("motorbike")).mean()
        assert share > 0.85 if is_motorcycle else share < 0.1, (name, share)


CAR_M = ((1.5, 12.0), (6.0, 24.0))
"""Where the first parked car stands: lower and upper x (right of the path) and y (ahead), by eye from the disparity."""


@pytest.mark.realdata
def test_the_parked_car_of_kitti_is_in_the_map(cli, realdata, voc, tmp_path):
    sequence, run = realdata / "kitti_odometry" / "sequences" / "01", tmp_path / "run"
    words = ("--stop", "3", "--grid.voxel-size-m", "0.2", "--classes", "background", "car", "person", "--strict")
    outcome = cli("map", sequence, "--out", run, "--labeller", "deeplab", "--model", voc, *words)
    assert outcome.status == 0, outcome.err
    voxels = voxels_of(run)
    centres = voxels.centres_world
    cars = centres[voxels.label == 1][:, :2]
    assert len(cars) > 200
    assert ((cars > CAR_M[0]) & (cars < CAR_M[1])).all(axis=1).mean() > 0.9
    # Nothing but the car stands there: most of what is above the ground is labelled so.
    there = ((centres[:, :2] > (2.5, 14.0)) & (centres[:, :2] < (4.5, 16.0))).all(axis=1) & (centres[:, 2] > -1.0)
    assert (voxels.label[there] == 1).mean() > 0.8

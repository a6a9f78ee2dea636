"""The reader of Ames Stereo Pipeline pairs."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import planetary_scenes as scenes
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from jaxmap.datasets import ReadOptions, open_sequence
from jaxmap.datasets.asp import read_tsai
from jaxmap.datasets.calibration import read_camera_yaml
from jaxmap.datasets.planetary import T_ENU_SITE
from jaxmap.errors import JaxmapError
from jaxmap.geometry.tsai import TsaiCamera

LENSES = {
    "null": "pitch = 1\nNULL\n",
    "tsai": "pitch = 1\nTSAI\nk1 = -0.1\nk2 = 0.02\np1 = 0.001\np2 = -0.001\n",
    "version 1": "k1 = -0.1\nk2 = 0.02\np1 = 0.001\np2 = -0.001\n",
    "brown": "pitch = 1\nBrownConrady\nxp = 0.5\nyp = -0.4\nk1 = 1e-6\nk2 = 0\nk3 = 0\np1 = 1e-6\np2 = 0\nphi = 0.1\n",
}


def tsai_text(turn: tuple[float, float, float], side_m: float, lens: str = LENSES["tsai"]) -> str:
    """A camera of the rover frame (z down) 1.2 m above the ground, looking ahead and down."""
    R = scenes.DOWN_TO_CAMERA @ Rotation.from_rotvec(turn).as_matrix()
    head = "" if "pitch" not in lens else "VERSION_4\nPINHOLE\n"
    return head + (
        "fu = 240\nfv = 241\ncu = 161.3\ncv = 117.2\nu_direction = 1 0 0\nv_direction = 0 1 0\nw_direction = 0 0 1\n"
        f"C = 0.5 {side_m} -1.2\nR = {' '.join(map(repr, map(float, R.ravel())))}\n{lens}"
    )


def write_scene(folder: Path, names: tuple[str, str] = ("rock_left", "rock_right"), lens: str = LENSES["tsai"]) -> None:
    for name, turn, side_m in zip(names, ((-0.42, 0.012, 0.004), (-0.41, -0.015, -0.006)), (-0.15, 0.15), strict=True):
        (folder / f"{name}.tsai").write_text(tsai_text(turn, side_m, lens))
        model = read_tsai(folder / f"{name}.tsai")
        Image.fromarray(scenes.render(model, 255, "uint8")).save(folder / f"{name}.png")


@pytest.mark.parametrize("lens", LENSES)
def test_a_scene_is_read_back_in_its_place(tmp_path, lens):
    write_scene(tmp_path, lens=LENSES[lens])
    sequence = open_sequence(tmp_path)
    camera = sequence.camera
    assert (sequence.dataset, float(camera.baseline_m)) == ("asp", pytest.approx(0.3))
    assert "the cameras' world is taken for z down and turned z-up" in sequence.notes
    T_rover_camera = np.linalg.inv(T_ENU_SITE) @ sequence.T_world_camera[0]
    np.testing.assert_allclose(T_rover_camera[:3, 3], [0.5, -0.15, -1.2], atol=1e-9)
    pair = sequence.read_pair(sequence.frames[0])
    v, u = np.mgrid[: camera.height_px, : camera.width_px].astype(np.float32)
    ahead = np.stack([(u - float(camera.cx_px)) / float(camera.fx_px), (v - float(camera.cy_px)) / float(camera.fy_px),
                      np.ones_like(u)], -1)  # fmt: skip
    d = ahead @ T_rover_camera[:3, :3].T
    depth_m = scenes.hits(np.broadcast_to(T_rover_camera[:3, 3], d.shape), d) - T_rover_camera[:3, 3]
    true_px = float(camera.fx_px * camera.baseline_m) / (depth_m @ T_rover_camera[:3, 2])
    moved = cv2.remap(pair.right, (u - true_px).astype(np.float32), v, cv2.INTER_LINEAR)
    patch = (slice(150, 214), slice(120, 184))
    shift, _ = cv2.phaseCorrelate(pair.left[patch].astype(float), moved[patch].astype(float))
    assert np.abs(shift).max() < 0.3


def test_two_folders_share_the_cameras_beside_them(tmp_path):
    write_scene(tmp_path, ("rig_l", "rig_r"))
    for side in ("left", "right"):
        (tmp_path / side).mkdir()
        for index in range(3):
            (tmp_path / side / f"{index}.png").write_bytes((tmp_path / f"rig_{side[0]}.png").read_bytes())
    sequence = open_sequence(tmp_path, ReadOptions(dataset="asp", calibration=tmp_path / "rig_l.tsai"))
    assert [frame.timestamp_s for frame in sequence.frames] == [0, 1, 2]
    assert sequence.read_pair(sequence.frames[2]).right.shape == (240, 320)


def refused(function, *arguments) -> str:
    with pytest.raises(JaxmapError) as caught:
        function(*arguments)
    return str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("fu = 240\n", "", "fu missing"),
        ("cu = 161.3", "cu = wide", "could not convert"),
        ("TSAI", "Photometrix", "PHOTOMETRIX"),
        ("k2 = 0.02\n", "", "k2 missing"),
        ("u_direction = 1 0 0", "u_direction = -1 0 0", "no rotation"),
        ("C = 0.5", "C = 0.5 1", "C is not what it holds"),
        ("pitch = 1", "pitch = 0", "not positive"),
    ],
)
def test_what_makes_no_camera_is_refused(tmp_path, old, new, says):
    path = tmp_path / "a.tsai"
    path.write_text(tsai_text((0, 0, 0), 0.1).replace(old, new))
    assert says in refused(read_tsai, path)


def test_lone_images_and_cameras_of_a_planet_are_refused(tmp_path):
    write_scene(tmp_path, ("one", "two"))
    assert "no pairs of images with cameras" in refused(open_sequence, tmp_path)
    write_scene(tmp_path)
    options = ReadOptions(calibration=tmp_path / "rock_left.tsai")
    assert "leave the option out" in refused(open_sequence, tmp_path, options)
    for file in tmp_path.glob("rock_*.tsai"):
        file.write_text(file.read_text().replace("C = 0.5", "C = 3396190.5"))
    assert "planetocentric" in refused(open_sequence, tmp_path)


@pytest.mark.realdata
def test_the_cameras_of_k10_are_those_of_its_calibration(realdata):
    folder = realdata / "k10"
    left, right = (read_tsai(folder / f"black_{side}.tsai") for side in ("left", "right"))
    rig = read_camera_yaml(folder / "camera.yaml")
    assert isinstance(left, TsaiCamera)
    points = left.C + np.array([[0.3, -0.2, 2.0], [-1.0, 0.5, 4.0]]) @ left.axes.T
    np.testing.assert_allclose(right.axes.T @ left.axes, rig.R_right_left, atol=1e-6)
    seen = cv2.projectPoints((points - left.C) @ left.axes, np.zeros(3), np.zeros(3), rig.K_left, rig.distortion_left)
    np.testing.assert_allclose(left.project(points), seen[0][:, 0], atol=1e-3)

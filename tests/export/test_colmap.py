"""The COLMAP model, read by a parser of its own and by COLMAP's."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jaxmap.errors import JaxmapError
from jaxmap.export.colmap import write_colmap
from jaxmap.types import Pinhole

CAMERA, SIZE_PX = Pinhole(500.25, 501.5, 319.5, 239.0, 0.12, 0.0), (640, 480)
SITE = np.array([588123.456, 5790321.654, 12.5])
NO_POINTS = np.zeros((0, 3)), np.zeros((0, 3), np.uint8)


def written(folder: Path, seed: int, count: int = 5) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Writes a model; its poses, points and colours."""
    rng = np.random.default_rng(seed)
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3] = Rotation.from_quat(rng.normal(size=(count, 4))).as_matrix()
    T[:, :3, 3] = rng.normal(0, 20, (count, 3))
    points, colours = rng.normal(0, 10, (7, 3)), rng.integers(0, 256, (7, 3)).astype(np.uint8)
    write_colmap(folder, CAMERA, SIZE_PX, [f"left_{i}.png" for i in range(count)], T, points, colours, SITE)
    return T, points, colours


def lines_of(path: Path) -> list[str]:
    return [line for line in path.read_text("utf-8").split("\n") if not line.startswith("#")]


def pixel_of(p_camera: np.ndarray) -> np.ndarray:
    """Where a point appears, in COLMAP's pixels."""
    return np.array([500.25, 501.5]) * p_camera[:2] / p_camera[2] + [320.0, 239.5]


@settings(max_examples=20)
@given(st.integers(0, 2**31))
def test_poses_and_points_come_back(tmp_path_factory, seed) -> None:
    folder = tmp_path_factory.mktemp("colmap")
    T, points, colours = written(folder, seed)
    assert lines_of(folder / "cameras.txt")[0].split()[:4] == ["1", "PINHOLE", "640", "480"]
    assert list(map(float, lines_of(folder / "cameras.txt")[0].split()[4:])) == [500.25, 501.5, 320.0, 239.5]
    images = lines_of(folder / "images.txt")
    assert not any(images[1::2]), "each image has a line of features, and it is empty"
    for row, pose in zip(images[:-1:2], T, strict=True):
        _, *numbers, camera, name = row.split()
        w, x, y, z, *t = map(float, numbers)
        # The matrix of a unit quaternion, written out.
        R = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        np.testing.assert_allclose(R @ pose[:3, :3], np.eye(3), atol=1e-12)
        np.testing.assert_allclose(-R.T @ t, pose[:3, 3], atol=1e-9)
        assert camera == "1" and name.startswith("left_")
    cloud = np.array([list(map(float, line.split())) for line in lines_of(folder / "points3D.txt") if line])
    np.testing.assert_allclose(cloud[:, 1:4], points, atol=1e-4)
    assert (cloud[:, 4:7] == colours).all() and (cloud[:, 0] == np.arange(1, 8)).all()
    assert "588123.456 5790321.654 12.5" in (folder / "images.txt").read_text("utf-8")


def test_colmap_sees_points_where_we_see_them(tmp_path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    T, points, colours = written(tmp_path, 3)
    model = pycolmap.Reconstruction()
    model.read_text(str(tmp_path))
    assert (len(model.cameras), len(model.images), len(model.points3D)) == (1, 5, 7)
    seen = 0
    for image in model.images.values():
        pose = T[int(image.name.removeprefix("left_").removesuffix(".png"))]
        np.testing.assert_allclose(image.projection_center(), pose[:3, 3], atol=1e-9)
        for index, point in model.points3D.items():
            p_camera = (np.linalg.inv(pose) @ [*points[index - 1], 1.0])[:3]
            assert (point.color == colours[index - 1]).all()
            if p_camera[2] > 0.1:
                np.testing.assert_allclose(image.project_point(point.xyz), pixel_of(p_camera), rtol=1e-3, atol=0.05)
                seen += 1
    assert seen > 5


def test_names_with_spaces_are_refused(tmp_path) -> None:
    with pytest.raises(JaxmapError, match="no image name with spaces"):
        write_colmap(
            tmp_path, CAMERA, SIZE_PX, ["a b.png"], np.eye(4)[None], np.zeros((0, 3)), np.zeros((0, 3), np.uint8), SITE
        )
    write_colmap(tmp_path, CAMERA, SIZE_PX, [], np.zeros((0, 4, 4)), *NO_POINTS, SITE)
    assert lines_of(tmp_path / "images.txt") == [""]

"""Calibrations of OpenCV, ROS, Kalibr and MATLAB, written by the test, give the camera that they describe."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from PIL import Image
from scipy.io import savemat
from scipy.spatial.transform import Rotation

from jaxmap.datasets import ReadOptions, open_sequence
from jaxmap.datasets.calibration import read_mounting, write_camera_yaml
from jaxmap.datasets.calibration_files import read_calibration
from jaxmap.errors import JaxmapError
from jaxmap.stereo.rectify import StereoRig, make_rectifier, make_stereo_rig
from jaxmap.types import StereoCamera

SIZE = (320, 240)
K = np.array([[250.0, 0, 160.5], [0, 251, 119.25], [0, 0, 1]])
K_RIGHT = np.array([[252.0, 0, 158.5], [0, 253, 121.25], [0, 0, 1]])
D, D_RIGHT = np.array([-0.1, 0.02, 0.001, -0.002, 0.003]), np.array([-0.11, 0.03, 0.002, -0.001, 0.004])
R = Rotation.from_rotvec([0.004, -0.01, 0.006]).as_matrix()
T = np.array([-0.2, 0.003, 0.001])
BETWEEN = {"R": R, "T": T.reshape(3, 1)}
INTRINSICS = {"M1": K, "D1": D.reshape(1, 5), "M2": K_RIGHT, "D2": D_RIGHT.reshape(1, 5)}


def rectified() -> dict[str, np.ndarray]:
    found = cv2.stereoRectify(K, D, K_RIGHT, D_RIGHT, SIZE, R, T.reshape(3, 1), flags=cv2.CALIB_ZERO_DISPARITY, alpha=0)
    return dict(zip(("R1", "R2", "P1", "P2", "Q"), found[:5], strict=True))


def write_opencv(path: Path, values: dict) -> Path:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in values.items():
        storage.write(name, value)
    storage.release()
    return path


def check_raw(camera: object, count: int = 5) -> None:
    assert isinstance(camera, StereoRig)
    np.testing.assert_allclose(camera.K_left, K, atol=1e-9)
    np.testing.assert_allclose(camera.K_right, K_RIGHT, atol=1e-9)
    np.testing.assert_allclose(camera.distortion_left, D[:count], atol=1e-9)
    np.testing.assert_allclose(camera.distortion_right, D_RIGHT[:count], atol=1e-9)
    np.testing.assert_allclose(camera.R_right_left, R, atol=1e-9)
    np.testing.assert_allclose(camera.t_right_left_m, T, atol=1e-9)
    assert (camera.width_px, camera.height_px) == SIZE


def check_rectified(camera: object) -> None:
    assert isinstance(camera, StereoCamera)
    P1, P2 = rectified()["P1"], rectified()["P2"]
    expected = (P1[0, 0], P1[1, 1], P1[0, 2], P1[1, 2], -P2[0, 3] / P2[0, 0], P2[0, 2] - P1[0, 2])
    names = ("fx_px", "fy_px", "cx_px", "cy_px", "baseline_m", "doffs_px")
    np.testing.assert_allclose([float(getattr(camera, name)) for name in names], expected, rtol=1e-6, atol=1e-6)
    assert (camera.width_px, camera.height_px) == SIZE


@pytest.fixture
def images(tmp_path) -> list[Path]:
    path = tmp_path / "left" / "000000.png"
    path.parent.mkdir()
    Image.new("L", SIZE).save(path)
    return [path]


# --- OpenCV


@pytest.mark.parametrize("suffix", ["yml", "yaml", "xml"])
def test_stereo_calibrations_of_opencv(suffix, tmp_path, images):
    path = write_opencv(tmp_path / f"stereo.{suffix}", INTRINSICS | BETWEEN)
    camera, notes = read_calibration(path, images)
    check_raw(camera)
    assert "M1 D1 M2 D2 R T, for raw images" in notes[0]
    sized = write_opencv(
        tmp_path / f"sized.{suffix}", {"image_width": 320, "image_height": 240, **INTRINSICS, **BETWEEN}
    )
    check_raw(read_calibration(sized).camera)
    with pytest.raises(JaxmapError, match="image size is missing"):
        read_calibration(path)
    np.testing.assert_array_equal(read_mounting(path), np.eye(4))


def test_the_old_header_of_opencv(tmp_path, images):
    path = write_opencv(tmp_path / "stereo.yml", INTRINSICS | BETWEEN)
    path.write_text("%YAML:1.0\n" + path.read_text().partition("\n")[2])
    check_raw(read_calibration(path, images).camera)


@pytest.mark.parametrize(
    "names",
    [
        ("K1", "D1", "K2", "D2", "R", "T"),
        ("cameraMatrix1", "distCoeffs1", "cameraMatrix2", "distCoeffs2", "R", "T"),
        (
            "camera_matrix_left",
            "dist_coeffs_left",
            "camera_matrix_right",
            "dist_coeffs_right",
            "rotation",
            "translation",
        ),
        ("left_K", "left_D", "right_K", "right_D", "R", "t"),
        ("KL", "DL", "KR", "DR", "R", "T"),
    ],
)
def test_matrices_under_the_names_of_others(names, tmp_path, images):
    values = zip(names, (*INTRINSICS.values(), *BETWEEN.values()), strict=True)
    check_raw(read_calibration(write_opencv(tmp_path / "a.yml", dict(values)), images).camera)


def test_a_rotation_may_be_a_vector(tmp_path, images):
    values = INTRINSICS | BETWEEN | {"R": Rotation.from_matrix(R).as_rotvec().reshape(3, 1)}
    check_raw(read_calibration(write_opencv(tmp_path / "a.yml", values), images).camera)


def test_intrinsics_may_lie_beside(tmp_path, images):
    write_opencv(tmp_path / "intrinsics.yml", INTRINSICS)
    path = write_opencv(tmp_path / "extrinsics.yml", BETWEEN | rectified())
    check_raw(read_calibration(path, images).camera)
    check_raw(read_calibration(tmp_path, images).camera)


@pytest.mark.parametrize("names", [("P1", "P2"), ("Q",), ("P1", "P2", "Q", "R", "T")])
def test_rectified_projections_of_opencv(names, tmp_path, images):
    found = rectified() | BETWEEN
    camera, notes = read_calibration(write_opencv(tmp_path / "a.yml", {name: found[name] for name in names}), images)
    check_rectified(camera)
    assert "for rectified images" in notes[0]


def test_images_that_are_called_rectified_are(tmp_path, images):
    path = write_opencv(tmp_path / "a.yml", INTRINSICS | BETWEEN | rectified())
    check_raw(read_calibration(path, images).camera)
    check_rectified(read_calibration(path, images, rectified=True).camera)
    images[0].parent.rename(tmp_path / "left_rect")
    check_rectified(read_calibration(path, [tmp_path / "left_rect" / images[0].name]).camera)


def test_rotations_and_projections_say_how_raw_cameras_stand(tmp_path, images):
    """`LEFT.K LEFT.D LEFT.R LEFT.P` of SLAM programs."""
    found = rectified()
    values = {
        f"{side}.{name}": value
        for side, number, K_one, D_one in (("LEFT", 1, K, D), ("RIGHT", 2, K_RIGHT, D_RIGHT))
        for name, value in zip("KDRP", (K_one, D_one, found[f"R{number}"], found[f"P{number}"]), strict=True)
    }
    path = tmp_path / "a.yml"
    entries = (
        f"{key}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data: {np.ravel(value).tolist()}\n"
        for key, value in values.items()
        for rows, columns in [np.atleast_2d(value).shape]
    )
    path.write_text("%YAML:1.0\n---\n" + "".join(entries))
    check_raw(read_calibration(path, images).camera)
    check_rectified(read_calibration(path, images, rectified=True).camera)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"camera_matrix": K, "distortion_coefficients": D}, "the calibration of one camera"),
        (INTRINSICS, "no whole stereo calibration: there is M1, D1, M2, D2"),
        ({**INTRINSICS, "R": R * np.nan, "T": T}, "R holds a number that is not finite"),
    ],
)
def test_what_is_no_pair_is_told(values, message, tmp_path, images):
    with pytest.raises(JaxmapError, match=message):
        read_calibration(write_opencv(tmp_path / "a.yml", values), images)


@pytest.mark.parametrize("text", ["<a", '<!DOCTYPE a [<!ENTITY b "c">]><a>&b;</a>', "<opencv_storage/>"])
def test_xml_that_is_none_is_one_line(text, tmp_path, images):
    (tmp_path / "a.xml").write_text(text)
    with pytest.raises(JaxmapError, match="XML|no stereo calibration"):
        read_calibration(tmp_path / "a.xml", images)


# --- ROS


def matrix(values: np.ndarray) -> dict:
    rows, cols = np.atleast_2d(values).shape
    return {"rows": rows, "cols": cols, "data": np.ravel(values).tolist()}


def write_ros(folder: Path, names: tuple[str, str] = ("left.yaml", "right.yaml"), *, message: bool = False) -> None:
    found = rectified()
    for name, K_one, D_one, side in zip(names, (K, K_RIGHT), (D, D_RIGHT), "12", strict=True):
        matrices = {"K": K_one, "D": D_one, "R": found[f"R{side}"], "P": found[f"P{side}"]}
        content: dict = {"image_width": SIZE[0], "image_height": SIZE[1], "distortion_model": "plumb_bob"}
        if message:
            content = {"width": SIZE[0], "height": SIZE[1], "distortion_model": "plumb_bob"}
            content |= {key: value.ravel().tolist() for key, value in matrices.items()}
        else:
            long = ("camera_matrix", "distortion_coefficients", "rectification_matrix", "projection_matrix")
            content |= {key: matrix(value) for key, value in zip(long, matrices.values(), strict=True)}
        (folder / name).write_text(yaml.safe_dump(content))


@pytest.mark.parametrize("message", [False, True])
@pytest.mark.parametrize(
    "names",
    [
        ("left.yaml", "right.yaml"),
        ("cam0.yaml", "cam1.yaml"),
        ("camera_rect_left_info.yaml", "camera_rect_right_info.yaml"),
    ],
)
def test_pairs_of_camera_info(names, message, tmp_path):
    write_ros(tmp_path, names, message=message)
    for given in (tmp_path / names[0], tmp_path / names[1], tmp_path):
        camera, (note,) = read_calibration(given)
        check_raw(camera)
        assert f"{names[0]} (left)" in note and "for raw images" in note
        check_rectified(read_calibration(given, rectified=True).camera)
    (tmp_path / names[1]).unlink()
    with pytest.raises(JaxmapError, match="no file of the other"):
        read_calibration(tmp_path / names[0])


# --- Kalibr


def chain(model: str = "radtan", count: int = 4, **changes: object) -> dict:
    T_right_left = np.eye(4)
    T_right_left[:3, :3], T_right_left[:3, 3] = R, T
    cameras = {}
    for name, K_one, D_one in (("cam0", K, D), ("cam1", K_RIGHT, D_RIGHT)):
        cameras[name] = {
            "camera_model": "pinhole",
            "intrinsics": [float(K_one[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2))],
            "distortion_model": model,
            "distortion_coeffs": D_one[:count].tolist(),
            "resolution": list(SIZE),
            "rostopic": f"/{name}/image_raw",
        }
    cameras["cam1"]["T_cn_cnm1"] = T_right_left.tolist()
    cameras["cam1"] |= changes
    return cameras


def write(path: Path, content: object) -> Path:
    path.write_text(yaml.safe_dump(content))
    return path


def test_chains_of_kalibr(tmp_path):
    camera, (note,) = read_calibration(write(tmp_path / "camchain.yaml", chain()))
    check_raw(camera, 4)
    assert "cam0 (left) and cam1 (right)" in note


def test_the_left_camera_of_a_chain_is_the_one_on_the_left(tmp_path):
    cameras = chain()
    T_right_left = np.array(cameras["cam1"].pop("T_cn_cnm1"))
    cameras["cam0"], cameras["cam1"] = cameras["cam1"], cameras["cam0"]
    cameras["cam1"]["T_cn_cnm1"] = np.linalg.inv(T_right_left).tolist()
    camera, (note,) = read_calibration(write(tmp_path / "camchain.yaml", cameras))
    check_raw(camera, 4)
    assert "cam1 (left) and cam0 (right)" in note


def test_a_chain_with_an_imu(tmp_path):
    cameras, T_left_imu = chain(), np.eye(4)
    T_left_imu[:3, :3], T_left_imu[:3, 3] = Rotation.from_rotvec([1, 0.2, -0.3]).as_matrix(), [0.1, 0.2, 0.3]
    T_right_left = np.array(cameras["cam1"].pop("T_cn_cnm1"))
    cameras["cam0"]["T_cam_imu"] = T_left_imu.tolist()
    cameras["cam1"]["T_cam_imu"] = (T_right_left @ T_left_imu).tolist()
    check_raw(read_calibration(write(tmp_path / "imucam.yaml", cameras)).camera, 4)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"camera_model": "omni"}, "cam1 is omni with radtan"),
        ({"distortion_model": "fov"}, "cam1 is pinhole with fov"),
        ({"T_cn_cnm1": [1, 2]}, "cam1.T_cn_cnm1 is not four rows"),
        ({"resolution": [640, 480]}, "differ in resolution"),
    ],
)
def test_chains_that_are_not_read_are_told(changes, message, tmp_path):
    with pytest.raises(JaxmapError, match=message):
        read_calibration(write(tmp_path / "camchain.yaml", chain(**changes)))


def test_equidistant_cameras_are_rectified(tmp_path):
    """Points seen by both raw cameras lie in one row of the rectified images, as far apart as their depth says."""
    rig = read_calibration(write(tmp_path / "camchain.yaml", chain("equi"))).camera
    assert isinstance(rig, StereoRig) and rig.model == "equidistant"
    write_camera_yaml(tmp_path / "own.yaml", rig)
    again = read_calibration(tmp_path / "own.yaml").camera
    assert isinstance(again, StereoRig) and again.model == "equidistant"
    rectifier = make_rectifier(rig)
    points = np.random.default_rng(0).uniform([-0.6, -0.4, 1.5], [0.6, 0.4, 4.0], (40, 3))
    turn = Rotation.from_matrix(rig.R_right_left).as_rotvec()
    left, _ = cv2.fisheye.projectPoints(points[:, None], np.zeros(3), np.zeros(3), rig.K_left, rig.distortion_left)
    right, _ = cv2.fisheye.projectPoints(points[:, None], turn, rig.t_right_left_m, rig.K_right, rig.distortion_right)
    u_left, v_left = _rectified_px(rectifier.left_maps, left[:, 0])
    u_right, v_right = _rectified_px(rectifier.right_maps, right[:, 0])
    depth_m = (points @ rectifier.R_rectified_left.T)[:, 2]
    np.testing.assert_allclose(v_left, v_right, atol=1.01)
    disparity_px = float(rectifier.camera.fx_px) * float(rectifier.camera.baseline_m) / depth_m
    np.testing.assert_allclose(u_left - u_right, disparity_px, atol=1.01)
    assert rectifier.seen.mean() > 0.99


def _rectified_px(maps: tuple[np.ndarray, np.ndarray], raw_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The rectified pixels whose raw ones are nearest."""
    u, v = maps[0][..., 0] + (maps[1] & 31) / 32, maps[0][..., 1] + (maps[1] >> 5) / 32
    nearest = [int(((u - x) ** 2 + (v - y) ** 2).argmin()) for x, y in raw_px]
    rows, columns = np.unravel_index(nearest, u.shape)
    return columns, rows


def test_coefficients_of_an_equidistant_camera_are_four():
    with pytest.raises(JaxmapError, match="distortion_left has 5 coefficients"):
        make_stereo_rig(
            K_left=K,
            K_right=K,
            distortion_left=D,
            distortion_right=D,
            R_right_left=R,
            t_right_left_m=T,
            size_px=SIZE,
            model="equidistant",
        )


# --- for any reader


def camera_of_matlab(K_one: np.ndarray, D_one: np.ndarray) -> dict:
    matrix_of_matlab = K_one.copy()
    matrix_of_matlab[:2, 2] += 1
    return {
        "IntrinsicMatrix": matrix_of_matlab.T,
        "RadialDistortion": D_one[[0, 1, 4]],
        "TangentialDistortion": D_one[2:4],
        "WorldUnits": "mm",
    }


def matlab(path: Path) -> Path:
    stereo = {"RotationOfCamera2": R.T, "TranslationOfCamera2": T * 1000}
    cameras = {"CameraParameters1": camera_of_matlab(K, D), "CameraParameters2": camera_of_matlab(K_RIGHT, D_RIGHT)}
    savemat(path, {"stereoParams": stereo | cameras})
    return path


@pytest.mark.parametrize("kind", ["opencv.yml", "opencv.xml", "stereo.mat", "left.yaml"])
def test_a_plain_folder_takes_any_of_them(kind, tmp_path, images):
    (tmp_path / "right").mkdir()
    Image.new("L", SIZE).save(tmp_path / "right" / images[0].name)
    (tmp_path / "poses.tum").write_text("0 0 0 1 0.7071068 0 0 -0.7071068\n")
    path = tmp_path / kind
    if kind == "left.yaml":
        write_ros(tmp_path)
    elif kind == "stereo.mat":
        matlab(path)
    else:
        write_opencv(path, INTRINSICS | BETWEEN)
    sequence = open_sequence(tmp_path, ReadOptions(dataset="folder", calibration=path))
    check_raw(sequence.camera)
    assert any(f"calibration from {kind}" in note for note in sequence.notes)

"""MATLAB's stereo calibrations: plain structs and saved objects, made here, and the data set's own."""

from __future__ import annotations

import struct
import zlib
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.io import savemat
from scipy.spatial.transform import Rotation

from jaxmap.datasets import matlab
from jaxmap.datasets.calibration import read_camera_yaml
from jaxmap.datasets.matlab import read_matlab_calibration, structs_of_objects
from jaxmap.errors import JaxmapError
from jaxmap.host.files import config_folder
from jaxmap.stereo.rectify import make_rectifier

SIZE_PX = (640, 480)
K = np.array([[500.0, 0, 320], [0, 510, 240], [0, 0, 1]])
R = Rotation.from_euler("xyz", [0.01, -0.02, 0.005]).as_matrix()
SKEWED = K + np.array([[0, 1, 0], [0, 0, 0], [0, 0, 0]])
MAT_HEADER_BYTES = 128


def camera(**changes) -> dict:
    return {
        "IntrinsicMatrix": K.T,
        "RadialDistortion": np.array([-0.3, 0.1]),
        "TangentialDistortion": np.array([0.001, -0.002]),
        "WorldUnits": "mm",
        **changes,
    }


def stereo(left=None, right=None, **changes) -> dict:
    return {
        "CameraParameters1": left or camera(),
        "CameraParameters2": right or camera(RadialDistortion=np.array([-0.2, 0.05, 0.01])),
        "RotationOfCamera2": R.T,
        "TranslationOfCamera2": np.array([-120.0, 1.0, 2.0]),
        **changes,
    }


def object_stream(content: dict) -> bytes:
    """A hidden variable of objects: eight bytes of version, then elements, as in a file after its header."""
    file = BytesIO()
    savemat(file, content)
    return b"\0\1IM\0\0\0\0" + file.getvalue()[MAT_HEADER_BYTES:]


def save_objects(path: Path, content: dict) -> None:
    """A file with a hidden variable, which is one without a name."""
    file = BytesIO()
    savemat(file, {"w": np.frombuffer(object_stream(content), np.uint8)[None]})
    data = file.getvalue()
    name = data.index(b"\x01\x00\x01\x00w\x00\x00\x00")
    path.write_bytes(data[:name] + b"\x01\x00\x00\x00\x00\x00\x00\x00" + data[name + 8 :])


def objects_of(content: dict) -> dict:
    """As MATLAB lays them out: cameras first, each in a cell, and numbers instead of them in the stereo struct."""
    cells = np.empty(4, object)
    cells[:] = [
        np.arange(3),
        content["CameraParameters1"],
        content["CameraParameters2"],
        content | {"CameraParameters1": np.arange(6), "CameraParameters2": np.arange(6)},
    ]
    return {"wrapper": cells}


def refused(path: Path) -> str:
    with pytest.raises(JaxmapError) as caught:
        read_matlab_calibration(path, SIZE_PX)
    assert "\n" not in str(caught.value)
    return str(caught.value).replace(str(path), "FILE")


@pytest.mark.parametrize("as_objects", [False, True], ids=["structs", "objects"])
def test_matrices_are_transposed_and_pixels_counted_from_0(tmp_path, as_objects):
    path = tmp_path / "stereo.mat"
    if as_objects:
        save_objects(path, objects_of(stereo()))
    else:
        savemat(path, {"ans": 3, "stereoParams": stereo()})
    rig = read_matlab_calibration(path, SIZE_PX)
    np.testing.assert_allclose(rig.K_left, [[500, 0, 319], [0, 510, 239], [0, 0, 1]])
    np.testing.assert_allclose(rig.distortion_left, [-0.3, 0.1, 0.001, -0.002])
    np.testing.assert_allclose(rig.distortion_right, [-0.2, 0.05, 0.001, -0.002, 0.01])
    np.testing.assert_allclose(rig.R_right_left, R)
    np.testing.assert_allclose(rig.t_right_left_m, [-0.12, 0.001, 0.002])
    assert (rig.width_px, rig.height_px) == SIZE_PX


def test_units_and_sizes_are_those_of_the_file(tmp_path):
    path = tmp_path / "stereo.mat"
    savemat(path, {"s": stereo(left=camera(WorldUnits="inches", ImageSize=np.array([768.0, 1024.0])))})
    rig = read_matlab_calibration(path, SIZE_PX)
    np.testing.assert_allclose(rig.t_right_left_m, np.array([-120, 1, 2]) * 0.0254)
    assert (rig.width_px, rig.height_px) == (1024, 768)
    savemat(path, {"s": stereo(left=camera(WorldUnits="furlongs"))})
    assert refused(path).startswith("lengths in 'furlongs' in FILE; calibrate in m, meters, cm")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"a": 1}, "no stereoParameters in FILE; save that object or its toStruct, or write the numbers as YAML"),
        (
            {"s": stereo(left=camera(IntrinsicMatrix=SKEWED.T))},
            "skewed pixels (skew 1)",
        ),
        ({"s": stereo(left=camera(IntrinsicMatrix=np.zeros(4)))}, "IntrinsicMatrix is missing, or is not 3x3 numbers"),
        ({"s": stereo(left=camera(RadialDistortion="none"))}, "not 2 or 3 radial and 2 tangential coefficients"),
        ({"s": stereo(RotationOfCamera2=np.ones((3, 3)))}, "R_right_left is not a rotation in FILE"),
        ({"s": stereo(TranslationOfCamera2=np.full(3, np.nan))}, "t_right_left_m holds a number that is not finite"),
    ],
)
def test_what_is_no_calibration_is_reported(tmp_path, content, message):
    path = tmp_path / "stereo.mat"
    savemat(path, content)
    assert refused(path).startswith(message)


def test_megabytes_that_hold_gigabytes_are_not_inflated(tmp_path, monkeypatch):
    """Zeros as a variable beside a calibration, deflated to a thousandth."""
    monkeypatch.setattr(matlab, "_MOST_BYTES", 4 << 20)
    path = tmp_path / "stereo.mat"
    savemat(path, {"s": stereo()}, do_compression=True)
    engine = zlib.compressobj(1)
    deflated = engine.compress(bytes(1 << 23)) + engine.flush()
    with open(path, "ab") as file:
        file.write(struct.pack("<2I", 15, len(deflated)) + deflated)
    assert refused(path) == "its variables take more than 4 MiB in FILE; save the calibration alone"


def test_what_is_no_mat_file_is_reported(tmp_path):
    path = tmp_path / "stereo.mat"
    assert refused(path).startswith("there is no file FILE; check the path")
    path.write_text("image_size_px: [1, 2]")
    assert refused(path).startswith("not a MAT file")
    path.write_bytes(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + bytes(400))
    assert refused(path) == "a MAT file of version 7.3 in FILE; save it in MATLAB with -v7"


@given(st.data())
def test_damaged_objects_are_reported_and_never_crash(data):
    stream = bytearray(object_stream(objects_of(stereo())))
    cut = data.draw(st.integers(0, len(stream)))
    for _ in range(data.draw(st.integers(0, 6))):
        stream[data.draw(st.integers(0, len(stream) - 1))] = data.draw(st.integers(0, 255))
    try:
        structs = structs_of_objects(bytes(stream[:cut]), "FILE")
    except JaxmapError as fault:
        assert "in FILE; " in str(fault)
    else:
        assert all(isinstance(struct, dict) for struct in structs)


@pytest.mark.realdata
@pytest.mark.parametrize(("name", "size_px"), [("LocCam", (1024, 768)), ("PanCam", (1280, 960))])
@pytest.mark.parametrize("form", ["calibration", "calibstruct"])
def test_the_bundled_calibrations_are_those_of_the_files(realdata, name, size_px, form):
    rig = read_matlab_calibration(realdata / "katwijk" / "calibration" / f"{name}_{form}.mat", size_px)
    bundled = read_camera_yaml(config_folder() / "cameras" / f"katwijk_{name.lower()}.yaml")
    for field, value in vars(bundled).items():
        np.testing.assert_allclose(getattr(rig, field), value, rtol=1e-12, atol=1e-12)
    if name == "LocCam":
        camera = make_rectifier(rig).camera
        assert float(camera.fx_px) == pytest.approx(784.97, abs=0.01)
        assert float(camera.baseline_m) == pytest.approx(0.120079, abs=1e-6)

"""Camera YAML and the safe reading of text and YAML."""

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from jaxmap.datasets.calibration import read_camera_yaml
from jaxmap.datasets.text_files import load_yaml, read_text
from jaxmap.errors import JaxmapError
from jaxmap.stereo.rectify import StereoRig, make_rectifier
from jaxmap.types import StereoCamera

RECTIFIED = {"image_size_px": [64, 48], "fx_px": 50.5, "cx_px": 31.5, "cy_px": 23.5, "baseline_m": 0.12}
CAMERA = {"fx_px": 50.0, "fy_px": 51.0, "cx_px": 31.5, "cy_px": 23.5, "distortion": [-0.1, 0.01, 0, 0]}
RAW = {
    "image_size_px": [64, 48],
    "left": CAMERA,
    "right": CAMERA,
    "R_right_left": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "t_right_left_m": [-0.12, 0, 0],
}


def refused(path, content) -> str:
    path.write_text(content if isinstance(content, str) else yaml.safe_dump(content))
    with pytest.raises(JaxmapError) as caught:
        read_camera_yaml(path)
    assert "\n" not in str(caught.value)
    return str(caught.value).replace(str(path), "FILE")


def test_a_rectified_camera_is_read(tmp_path):
    path = tmp_path / "camera.yaml"
    path.write_text(yaml.safe_dump(RECTIFIED))
    camera = read_camera_yaml(path)
    assert isinstance(camera, StereoCamera)
    assert (camera.width_px, camera.height_px) == (64, 48)
    assert (float(camera.fx_px), float(camera.fy_px), float(camera.doffs_px)) == (50.5, 50.5, 0.0)
    path.write_text(yaml.safe_dump(RECTIFIED | {"fy_px": 49, "doffs_px": 3}))
    camera = read_camera_yaml(path)
    assert (float(camera.fy_px), float(camera.doffs_px)) == (49.0, 3.0)


def test_a_raw_rig_is_read_and_rectifies(tmp_path):
    path = tmp_path / "camera.yaml"
    path.write_text(yaml.safe_dump(RAW))
    rig = read_camera_yaml(path)
    assert isinstance(rig, StereoRig)
    np.testing.assert_array_equal(rig.K_left, [[50, 0, 31.5], [0, 51, 23.5], [0, 0, 1]])
    np.testing.assert_array_equal(rig.t_right_left_m, [-0.12, 0, 0])
    assert float(make_rectifier(rig).camera.baseline_m) == pytest.approx(0.12)


def test_numbers_that_yaml_takes_for_text_are_read(tmp_path):
    path = tmp_path / "camera.yaml"
    path.write_text(yaml.safe_dump(RECTIFIED).replace("0.12", "12e-2"))
    assert float(read_camera_yaml(path).baseline_m) == pytest.approx(0.12)


def test_all_missing_and_unknown_keys_are_named(tmp_path):
    path = tmp_path / "camera.yaml"
    message = refused(path, {"image_size_px": [64, 48], "fx_px": 1, "cx": 2, "cy_px": 3})
    assert message.startswith("calibration keys missing cx_px, baseline_m and unknown cx in FILE; a rectified pair has")
    message = refused(path, {"left": {"fx_px": 1, "k1": 2}, "right": CAMERA, "depth": 1})
    assert message.startswith(
        "calibration keys missing image_size_px, R_right_left, t_right_left_m, left.fy_px, left.cx_px, left.cy_px, "
        "left.distortion and unknown depth, left.k1 in FILE; "
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fx_px": "wide"}, "fx_px is 'wide', not a number in FILE; give fx_px a number"),
        ({"fx_px": True}, "fx_px is True, not a number"),
        ({"fx_px": None}, "fx_px is None, not a number"),
        ({"fx_px": [1]}, "fx_px is [1], not a number"),
        ({"fx_px": -1}, "fx_px is -1, it must be positive in FILE"),
        ({"cx_px": float("nan")}, "cx_px is nan in FILE; give a finite number"),
        ({"image_size_px": 64}, "image_size_px is not a list of 2 numbers in FILE; write it as [a, b, ...]"),
        ({"image_size_px": [64.5, 48]}, "image_size_px is [64.5, 48] in FILE; give [width, height] in whole pixels"),
        ({"image_size_px": [float("nan"), 48]}, "give [width, height] in whole pixels"),
    ],
)
def test_wrong_values_are_reported_by_key(tmp_path, change, message):
    assert message in refused(tmp_path / "camera.yaml", RECTIFIED | change)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"left": 3}, "left is not a mapping in FILE; give it fx_px fy_px cx_px cy_px distortion"),
        ({"left": CAMERA | {"fx_px": "a"}}, "left.fx_px is 'a', not a number in FILE"),
        ({"right": CAMERA | {"distortion": 0}}, "right.distortion is not a list of numbers in FILE"),
        ({"right": CAMERA | {"distortion": [0, 0]}}, "distortion_right has 2 coefficients in FILE"),
        ({"R_right_left": 5}, "R_right_left is not three rows in FILE"),
        ({"R_right_left": [[1, 0, 0], [0, 1], [0, 0, 1]]}, "R_right_left is not a list of 3 numbers in FILE"),
        ({"R_right_left": [[1, 0, 0], [0, 2, 0], [0, 0, 1]]}, "R_right_left is not a rotation in FILE"),
        ({"t_right_left_m": [0, 0, 0]}, "the stereo baseline is zero in FILE"),
    ],
)
def test_wrong_values_of_a_rig_are_reported_by_key(tmp_path, change, message):
    assert message in refused(tmp_path / "camera.yaml", RAW | change)


def test_opencv_headers_are_tolerated_and_lines_stay_right(tmp_path):
    path = tmp_path / "sensor.yaml"
    path.write_text("%YAML:1.0\n# comment\nresolution: [752, 480]\n")
    assert load_yaml(path) == {"resolution": [752, 480]}
    path.write_text("%YAML:1.0\na: 1\nresolution: [752, 4")
    with pytest.raises(JaxmapError, match=r"malformed YAML .* in .*sensor\.yaml line 3; correct or restore the file"):
        load_yaml(path)


@pytest.mark.parametrize("text", ["", "%YAML:1.0", "- 1\n- 2\n", "words"])
def test_yaml_without_keys_is_refused(tmp_path, text):
    path = tmp_path / "camera.yaml"
    path.write_text(text)
    with pytest.raises(JaxmapError, match=r"no keys and values in .*camera\.yaml; the file must hold"):
        load_yaml(path)


@pytest.mark.parametrize(
    "text",
    [
        "a: !!python/object/apply:os.system [ls]",
        "a: !!opencv-matrix {rows: 1}",
        "a: !!bool maybe",
        "a: !!int ''",
        "a: !!timestamp no",
        "[" * 1200,
        "a: \x07",
        "{[]: 1}",
    ],
)
def test_yaml_that_is_unsafe_or_breaks_the_parser_is_refused(tmp_path, text):
    path = tmp_path / "camera.yaml"
    path.write_text(text)
    with pytest.raises(JaxmapError, match="malformed YAML"):
        load_yaml(path)


def test_text_is_utf8_with_or_without_a_byte_order_mark(tmp_path):
    path = tmp_path / "a.txt"
    path.write_bytes(b"\xef\xbb\xbf1 2\n")
    assert read_text(path) == "1 2\n"
    path.write_bytes(b"x" * 5000 + b"\0")
    with pytest.raises(JaxmapError, match="not a text file"):
        read_text(path)


@given(
    raw=st.booleans(),
    edits=st.lists(st.tuples(st.integers(0, 400), st.binary(min_size=0, max_size=5)), max_size=4),
    length=st.integers(0, 500),
)
def test_corrupted_calibrations_read_or_are_refused(tmp_path_factory, raw, edits, length):
    data = bytearray(yaml.safe_dump(RAW if raw else RECTIFIED).encode())
    for place, junk in edits:
        data[place : place + len(junk)] = junk
    path = tmp_path_factory.mktemp("junk") / "camera.yaml"
    path.write_bytes(bytes(data[:length]))
    try:
        assert isinstance(read_camera_yaml(path), StereoCamera | StereoRig)
    except JaxmapError as fault:
        assert "\n" not in str(fault)

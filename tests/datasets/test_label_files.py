"""Label files made elsewhere: found by name, checked, and brought onto the rectified pixels."""

from __future__ import annotations

import os
import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from rigs import CAMERA, RIG
from scenes import HEIGHT_PX, WIDTH_PX, scene_frame

from jaxmap.datasets.base import FrameRef
from jaxmap.datasets.label_files import LabelFolder, open_label_folder
from jaxmap.errors import FrameError, JaxmapError
from jaxmap.labels import IGNORE
from jaxmap.stereo.front_end import StereoFrontEnd
from jaxmap.stereo.match import StereoOptions

REF = FrameRef("f000", 0.0, Path("left/f000.png"), Path("right/f000.png"))
PLAIN = StereoFrontEnd(CAMERA, StereoOptions())
RAW = StereoFrontEnd(RIG, StereoOptions())


def truth() -> np.ndarray:
    return scene_frame(0).labels.copy()


def read_indices(folder: Path, labels: np.ndarray, front_end: StereoFrontEnd = PLAIN, are: str = "rectified") -> dict:
    Image.fromarray(labels).save(folder / "f000.png")
    return LabelFolder(folder, False, 3, are).read(REF, front_end)


def read_soft(folder: Path, array: np.ndarray, front_end: StereoFrontEnd = PLAIN, are: str = "rectified") -> dict:
    np.save(folder / "f000.npy", array)
    return LabelFolder(folder, True, 3, are).read(REF, front_end)


def one_hot() -> np.ndarray:
    return np.eye(3, dtype=np.float32)[truth()]


@pytest.mark.parametrize(
    ("values", "binary"), [((0, 255), True), ((0, 1, 255), False), ((0,), False), ((1, 255), False)]
)
def test_black_and_white_masks_are_known(tmp_path, values, binary):
    for index, value in enumerate(values):
        Image.fromarray(np.full((6, 9), value, np.uint8)).save(tmp_path / f"f{index}.png")
    names = [f"f{index}" for index in range(len(values))]
    assert LabelFolder(tmp_path, False, 3, "raw").looks_binary([*names, "missing"]) is binary
    assert not LabelFolder(tmp_path, True, 3, "raw").looks_binary(names)


def test_indices_come_as_they_are(tmp_path):
    labels = truth()
    labels[:10] = IGNORE
    fields = read_indices(tmp_path, labels)
    assert set(fields) == {"labels"}
    assert fields["labels"].dtype == np.uint8
    np.testing.assert_array_equal(fields["labels"], labels)


def test_a_palette_image_holds_indices(tmp_path):
    picture = Image.fromarray(truth())
    picture.putpalette([0, 0, 0, 255, 200, 0, 128, 128, 128])
    assert picture.mode == "P"
    picture.save(tmp_path / "f000.png")
    np.testing.assert_array_equal(LabelFolder(tmp_path, False, 3, "raw").read(REF, PLAIN)["labels"], truth())


@pytest.mark.parametrize("name", ["f000.PNG", "f000.tif", "f000.bmp", "deep", "grey as RGB", "two levels"])
def test_indices_may_be_stored_in_other_ways(tmp_path, name):
    labels = truth() if name != "two levels" else np.minimum(truth(), 1)
    pictures = {
        "deep": Image.fromarray(labels.astype(np.uint16)),
        "grey as RGB": Image.fromarray(np.stack([labels] * 3, axis=-1)),
        "two levels": Image.fromarray(labels == 1),
    }
    pictures.get(name, Image.fromarray(labels)).save(tmp_path / (name if "." in name else "f000.png"))
    opened = open_label_folder(tmp_path, 3, "raw", "f000")
    fields = opened.read(REF, PLAIN)
    assert fields["labels"].dtype == np.uint8
    np.testing.assert_array_equal(fields["labels"], labels)


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_probabilities_come_as_float32(tmp_path, dtype):
    fields = read_soft(tmp_path, one_hot().astype(dtype) * dtype(0.5))
    assert set(fields) == {"class_probabilities"}
    assert fields["class_probabilities"].dtype == np.float32
    np.testing.assert_array_equal(fields["class_probabilities"], one_hot() / 2)


def test_labels_of_raw_pixels_are_rectified_and_others_are_not(tmp_path):
    raw = read_indices(tmp_path, truth(), RAW, "raw")["labels"]
    np.testing.assert_array_equal(raw, RAW.rectify_labels(truth()))
    assert (raw != truth()).any()
    np.testing.assert_array_equal(read_indices(tmp_path, truth(), RAW, "rectified")["labels"], truth())
    soft = read_soft(tmp_path, one_hot(), RAW, "raw")["class_probabilities"]
    assert soft.shape == (HEIGHT_PX, WIDTH_PX, 3)
    inside = raw != IGNORE
    sharp = inside & (soft.max(axis=2) > 0.6)
    assert (soft.argmax(axis=2) == raw)[sharp].mean() > 0.99


@pytest.mark.parametrize(
    ("array", "named"),
    [
        (np.zeros((HEIGHT_PX, WIDTH_PX), np.float32), r"an array \(120, 160\)"),
        (np.zeros((HEIGHT_PX, WIDTH_PX, 2), np.float32), r"\(120, 160, 2\)"),
        (np.zeros((HEIGHT_PX, WIDTH_PX, 3), np.uint8), "of uint8"),
        (np.zeros((10, 20, 3), np.float32), "the labels are 20x10 px, the image is 160x120 px"),
        (np.full((HEIGHT_PX, WIDTH_PX, 3), np.nan, np.float32), "not finite"),
        (np.full((HEIGHT_PX, WIDTH_PX, 3), -0.1, np.float32), "not negative"),
        (np.full((HEIGHT_PX, WIDTH_PX, 3), 0.4, np.float32), "sum to more than 1"),
        (np.zeros((0, 0, 3), np.float32), "0x0 px"),
    ],
)
def test_faulty_probabilities_are_refused(tmp_path, array, named):
    with pytest.raises(FrameError, match=named) as caught:
        read_soft(tmp_path, array)
    assert "f000.npy" in str(caught.value)


def test_nothing_is_unpickled(tmp_path):
    np.save(tmp_path / "f000.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
    with pytest.raises(FrameError, match=r"f000\.npy"):
        LabelFolder(tmp_path, True, 3, "raw").read(REF, PLAIN)


@pytest.mark.parametrize(
    ("labels", "named"),
    [
        (np.full((HEIGHT_PX, WIDTH_PX), 3, np.uint8), "label 3, but there are 3 classes"),
        (np.zeros((60, 80), np.uint8), "the labels are 80x60 px"),
        (np.full((HEIGHT_PX, WIDTH_PX, 3), (0, 1, 2), np.uint8), "the mask is in colour"),
        (np.full((HEIGHT_PX, WIDTH_PX), 256, np.uint16), "label 256, but there are 3 classes"),
    ],
)
def test_faulty_indices_are_refused(tmp_path, labels, named):
    with pytest.raises(FrameError, match=named) as caught:
        read_indices(tmp_path, labels)
    assert "f000.png" in str(caught.value)


@pytest.mark.parametrize(("soft", "content"), [(False, None), (False, b"no image"), (True, None), (True, b"no array")])
def test_missing_and_broken_files_are_faults_of_their_frame(tmp_path, soft, content):
    path = tmp_path / ("f000.npy" if soft else "f000.png")
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(FrameError) as caught:
        LabelFolder(tmp_path, soft, 3, "raw").read(REF, PLAIN)
    assert str(path) in str(caught.value)
    assert "; " in str(caught.value)


def test_the_first_frame_distinguishes_which_kind_they_are(tmp_path):
    Image.fromarray(truth()).save(tmp_path / "f000.png")
    np.save(tmp_path / "f001.npy", one_hot())
    assert not open_label_folder(tmp_path, 3, "raw", "f000").soft
    assert open_label_folder(tmp_path, 3, "raw", "f001").soft
    with pytest.raises(JaxmapError, match=r"no f002\.png and no f002\.npy"):
        open_label_folder(tmp_path, 3, "raw", "f002")
    with pytest.raises(JaxmapError, match="no such folder of labels"):
        open_label_folder(tmp_path / "nowhere", 3, "raw", "f000")


def npy(header: bytes, data: bytes = b"") -> bytes:
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + data


HOSTILE_ARRAYS = {
    "brackets that stay open": npy(b"(" * 60_000),
    "minus signs": npy(b"{'descr': '<f4', 'fortran_order': False, 'shape': (" + b"-" * 5_000 + b"1,)}\n"),
    "a shape beyond memory": npy(b"{'descr': '<f4', 'fortran_order': False, 'shape': (1000000000000000,)}\n"),
    "the right number of axes, beyond memory": npy(
        b"{'descr': '<f4', 'fortran_order': False, 'shape': (1000000000000, 1000000, 3)}\n"
    ),
    "no number among huge extents": npy(
        b"{'descr': '<f4', 'fortran_order': False, 'shape': (99999999999999999999, 0, 3)}\n"
    ),
    "negative extents": npy(b"{'descr': '<f4', 'fortran_order': False, 'shape': (-120, -160, 3)}\n"),
    "objects": npy(b"{'descr': '|O', 'fortran_order': False, 'shape': (120, 160, 3)}\n", b"cos\nsystem\n"),
    "half of the numbers": npy(b"{'descr': '<f4', 'fortran_order': False, 'shape': (120, 160, 3)}\n", b"\0" * 1000),
    "a later version": b"\x93NUMPY\x09\x00" + b"\0" * 100,
    "an archive": b"PK\x03\x04" + b"\0" * 100,
    "no header": b"\x93NUMPY",
}


@pytest.mark.parametrize("content", HOSTILE_ARRAYS.values(), ids=HOSTILE_ARRAYS.keys())
def test_an_array_is_known_by_its_header_before_it_is_read(tmp_path, content):
    path = tmp_path / "f000.npy"
    path.write_bytes(content)
    with pytest.raises(FrameError) as caught:
        LabelFolder(tmp_path, True, 3, "rectified").read(REF, PLAIN)
    assert str(path) in str(caught.value) and len(str(caught.value)) < 400


@pytest.mark.parametrize("kind", ["pipe", "device", "archive of arrays"])
def test_probabilities_are_regular_files(tmp_path, kind):
    path = tmp_path / "f000.npy"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    else:
        with open(path, "wb") as file:
            np.savez(file, one_hot())
    with pytest.raises(FrameError, match=str(path)):
        LabelFolder(tmp_path, True, 3, "rectified").read(REF, PLAIN)

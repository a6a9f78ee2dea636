"""How many bits deep images use: once for a sequence, whatever single pixels hold."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from jaxmap.datasets import ReadOptions, open_sequence
from jaxmap.datasets.bit_depth import to_8_bits, used_bits
from jaxmap.datasets.images import sequence_bits
from jaxmap.errors import UsageError

SIZE = (48, 64)
DEPTHS = st.sampled_from([8, 10, 12, 14, 16])


def ramp(bits: int) -> np.ndarray:
    return np.linspace(0, 2**bits - 1, SIZE[0] * SIZE[1]).astype(np.uint16).reshape(SIZE)


@given(bits=DEPTHS, hot=st.lists(st.tuples(st.integers(0, 47), st.integers(0, 63), st.integers(0, 65535)), max_size=8))
def test_a_few_pixels_have_no_say(bits, hot):
    pixels = ramp(bits)
    for row, column, value in hot:
        pixels[row, column] = value
    assert used_bits([pixels]).bits == bits
    clean = np.ones(SIZE, bool)
    for row, column, _ in hot:
        clean[row, column] = False
    np.testing.assert_array_equal(to_8_bits(pixels, bits)[clean], (ramp(bits) >> (bits - 8))[clean])


@given(bits=st.sampled_from([8, 10, 12, 14]), share=st.floats(0, 0.9))
def test_what_is_marked_by_the_greatest_number_has_no_say(bits, share):
    pixels = np.random.default_rng(0).permutation(ramp(bits).ravel()).reshape(SIZE)
    pixels[: int(share * SIZE[0])] = 65535
    found = used_bits([pixels])
    assert found.bits == bits
    assert found.brighter == pytest.approx((pixels >= 2**bits).mean())
    assert (to_8_bits(pixels, bits)[pixels == 65535] == 255).all()


def test_saturated_images_of_16_bits_stay_so():
    assert used_bits([np.full(SIZE, 65535, np.uint16)]).bits == 16
    assert used_bits([np.minimum(ramp(16).astype(int) * 2, 65535).astype(np.uint16)]).bits == 16


def sequence(folder: Path, images: dict[str, list[np.ndarray]]) -> Path:
    for side, pictures in images.items():
        (folder / side).mkdir(parents=True)
        for index, pixels in enumerate(pictures):
            cv2.imwrite(str(folder / side / f"{index:03d}.png"), pixels)
    count = len(images["left"])
    (folder / "times.txt").write_text("".join(f"{index}\n" for index in range(count)))
    (folder / "poses.tum").write_text("".join(f"{index} 0 0 {index} 0 0 0 1\n" for index in range(count)))
    (folder / "camera.yaml").write_text(
        f"{{image_size_px: [{SIZE[1]}, {SIZE[0]}], fx_px: 50, cx_px: 32, cy_px: 24, baseline_m: 0.2}}"
    )
    return folder


def test_one_depth_is_taken_for_all_frames_and_both_cameras(tmp_path):
    """Alone, the first pair would be of 10 bits, and by its brightest pixel of 16."""
    dark, bright = ramp(10), ramp(12)
    dark[5, 5] = 65535
    images = [dark, bright, bright, bright]
    opened = open_sequence(sequence(tmp_path / "a", {"left": images, "right": images}))
    assert [note for note in opened.notes if "12 bits" in note and "--image-bits" in note]
    pair = opened.read_pair(opened.frames[0])
    np.testing.assert_array_equal(pair.right[6:], dark[6:] >> 4)
    np.testing.assert_array_equal(opened.read_pair(opened.frames[1]).left, bright >> 4)


def test_grey_and_grey_stored_as_colour_are_read_alike(tmp_path):
    grey = ramp(12)
    grey[5, 5] = 65535
    deep = np.stack([grey] * 3, axis=-1)
    one = open_sequence(sequence(tmp_path / "grey", {"left": [grey], "right": [grey]}))
    other = open_sequence(sequence(tmp_path / "rgb", {"left": [deep], "right": [deep]}))
    left, coloured = one.read_pair(one.frames[0]).left, other.read_pair(other.frames[0]).left
    np.testing.assert_array_equal(np.stack([left] * 3, axis=-1), coloured)
    assert len(np.unique(left)) == 256


def test_the_depth_can_be_given(tmp_path):
    folder = sequence(tmp_path / "a", {"left": [ramp(12)], "right": [ramp(12)]})
    opened = open_sequence(folder, ReadOptions(image_bits=14))
    np.testing.assert_array_equal(opened.read_pair(opened.frames[0]).left, ramp(12) >> 6)
    assert not any("bits" in note for note in opened.notes)
    with pytest.raises(UsageError, match="image_bits"):
        ReadOptions(image_bits=9)  # type: ignore[arg-type]


def test_images_of_8_bits_are_not_decoded_for_it(tmp_path, monkeypatch):
    paths = [tmp_path / name for name in ("l.png", "r.png")]
    for path in paths:
        Image.fromarray((ramp(8)).astype(np.uint8)).save(path)
    monkeypatch.setattr("jaxmap.datasets.images.read_pixels", lambda *_: pytest.fail("decoded"))
    assert sequence_bits([(paths[0], paths[1])]) is None
    assert sequence_bits([]) is None

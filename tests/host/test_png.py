"""PNG pictures by the quick way: the same pixels as Pillow's, and nothing that Pillow would refuse."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from jaxmap.datasets import images
from jaxmap.datasets.images import read_pixels
from jaxmap.host.pictures import open_picture
from jaxmap.host.png import plain_png

COLOURS = {"L": (0, 1), "RGB": (2, 3), "RGBA": (6, 4)}
"""Type of colours in the file, samples of a pixel."""


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def written(
    path: Path, rows: np.ndarray, kind: str, deep: bool, *, width: int, data: bytes | None = None, interlaced: int = 0
) -> Path:
    """Rows (H, 1 + bytes), each behind the number of its filter, as a PNG whose pixels lie in two chunks."""
    header = struct.pack(">IIBBBBB", width, len(rows), 16 if deep else 8, COLOURS[kind][0], 0, 0, interlaced)
    data = zlib.compress(rows.tobytes()) if data is None else data
    chunks = [(b"IHDR", header), (b"tEXt", b"a\0b"), (b"IDAT", data[:9]), (b"IDAT", data[9:]), (b"IEND", b"")]
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*one) for one in chunks))
    return path


def random_rows(kind: str, deep: bool, size: tuple[int, int], seed: int) -> np.ndarray:
    """Any bytes are some picture, whatever the filters."""
    random, (width, height) = np.random.default_rng(seed), size
    rows = random.integers(0, 256, (height, 1 + width * COLOURS[kind][1] * (2 if deep else 1)), np.uint8)
    rows[:, 0] = random.integers(0, 5, height)
    return rows


def quick(path: Path) -> np.ndarray | None:
    with open_picture(path) as picture:
        return plain_png(picture, path)


def by_pillow(path: Path) -> np.ndarray:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(images, "plain_png", lambda picture, path: None)
        return read_pixels(path)


@given(
    kind=st.sampled_from(sorted(COLOURS)),
    deep=st.booleans(),
    size=st.tuples(st.integers(1, 9), st.integers(1, 9)),
    seed=st.integers(0, 2**32 - 1),
)
def test_the_pixels_are_those_of_the_slow_way(tmp_path_factory, kind, deep, size, seed):
    rows = random_rows(kind, deep, size, seed)
    path = written(tmp_path_factory.getbasetemp() / "a.png", rows, kind, deep, width=size[0])
    pixels, expected = quick(path), by_pillow(path)
    assert pixels is not None and pixels.flags.c_contiguous
    assert pixels.dtype == expected.dtype
    np.testing.assert_array_equal(pixels, expected)
    np.testing.assert_array_equal(read_pixels(path), expected)


def test_a_picture_of_many_blocks_is_read(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 256, (200, 300, 3), np.uint8)
    Image.fromarray(pixels).save(tmp_path / "a.png")
    np.testing.assert_array_equal(quick(tmp_path / "a.png"), pixels)


ROWS = random_rows("RGB", False, (5, 4), 1)
PACKED = zlib.compress(ROWS.tobytes())
DAMAGED = {
    "cut": PACKED[:-9],
    "a row too few": zlib.compress(ROWS[:-1].tobytes()),
    "a row too many": zlib.compress(np.vstack([ROWS, ROWS]).tobytes()),
    "a bomb": zlib.compress(bytes(10**7)),
    "another checksum": PACKED[:-1] + bytes([PACKED[-1] ^ 1]),
    "no such filter": zlib.compress(np.where(np.arange(16) == 0, 7, ROWS).astype(np.uint8).tobytes()),
    "nothing": b"",
    "noise": b"\x78\x9c" + bytes(range(100)),
}


@pytest.mark.parametrize("fault", DAMAGED)
def test_what_is_damaged_is_left_to_pillow(tmp_path, fault):
    path = written(tmp_path / "a.png", ROWS, "RGB", False, width=5, data=DAMAGED[fault])
    assert quick(path) is None
    assert outcome(read_pixels, path) == outcome(by_pillow, path)


def outcome(read, path: Path) -> object:
    try:
        return read(path).tolist()
    except Exception as fault:
        return str(fault)


def test_a_file_that_is_cut_anywhere_is_read_or_refused_as_pillow_does(tmp_path):
    whole = written(tmp_path / "a.png", ROWS, "RGB", False, width=5).read_bytes()
    for length in range(40, len(whole)):
        (tmp_path / "b.png").write_bytes(whole[:length])
        assert outcome(read_pixels, tmp_path / "b.png") == outcome(by_pillow, tmp_path / "b.png"), length


def test_palettes_single_bits_interlaced_and_moving_pictures_are_left_to_pillow(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 256, (6, 9, 3), np.uint8)
    picture = Image.fromarray(pixels)
    picture.convert("P").save(tmp_path / "palette.png")
    picture.convert("1").save(tmp_path / "bits.png")
    picture.convert("LA").save(tmp_path / "grey with alpha.png")
    picture.save(tmp_path / "moving.png", save_all=True, append_images=[Image.fromarray(255 - pixels)])
    written(tmp_path / "interlaced.png", ROWS, "RGB", False, width=5, interlaced=1)
    cv2.imwrite(str(tmp_path / "jpeg.jpg"), pixels)
    for path in tmp_path.iterdir():
        assert quick(path) is None, path.name

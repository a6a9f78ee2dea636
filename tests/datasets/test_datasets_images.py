"""Images and stereo pairs: what is read, what is refused."""

import io

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image, ImageOps

from jaxmap.datasets.base import FrameRef, read_stereo_pair
from jaxmap.datasets.images import first_image_size_px, image_size_px, list_images, read_image
from jaxmap.errors import FrameError, JaxmapError

RNG = np.random.default_rng(0)
GREY = RNG.integers(0, 256, (6, 9), np.uint8)
RGB = RNG.integers(0, 256, (6, 9, 3), np.uint8)


def saved(path, pixels, mode=None):
    image = Image.fromarray(pixels)
    (image.convert(mode) if mode else image).save(path)
    return path


def frame_of(left, right) -> FrameRef:
    return FrameRef("f0", 0.0, left, right)


def test_grey_and_rgb_are_read_as_they_are(tmp_path):
    np.testing.assert_array_equal(read_image(saved(tmp_path / "g.png", GREY)), GREY)
    np.testing.assert_array_equal(read_image(saved(tmp_path / "c.png", RGB)), RGB)


@pytest.mark.parametrize("mode", ["RGBA", "P"])
def test_alpha_and_palettes_become_rgb(tmp_path, mode):
    image = read_image(saved(tmp_path / "a.png", np.full((6, 9, 3), 255, np.uint8), mode))
    assert (image.shape, image.dtype) == ((6, 9, 3), np.uint8)
    assert (image == 255).all()


def test_grey_with_alpha_and_bilevel_become_grey(tmp_path):
    assert read_image(saved(tmp_path / "la.png", GREY, "LA")).shape == (6, 9)
    assert set(np.unique(read_image(saved(tmp_path / "b.png", GREY, "1")))) == {0, 255}


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
def test_deep_grey_is_shifted_from_the_bits_it_uses(tmp_path, bits):
    deep = np.linspace(0, 2**bits - 1, 54).astype(np.uint16).reshape(6, 9)
    image = read_image(saved(tmp_path / "d.png", deep))
    assert image.dtype == np.uint8
    np.testing.assert_array_equal(image, deep >> (bits - 8))


@pytest.mark.parametrize("suffix", ["png", "tif", "ppm"])
def test_deep_colours_are_shifted_as_deep_grey_is(tmp_path, suffix):
    """Pillow alone would cut them to their upper 8 bits, of which 12-bit images use 4."""
    deep = RNG.integers(0, 4096, (6, 9, 3)).astype(np.uint16)
    path = tmp_path / f"c.{suffix}"
    cv2.imwrite(str(path), deep[..., ::-1])
    np.testing.assert_array_equal(read_image(path), deep >> 4)
    np.testing.assert_array_equal(read_image(path, bits=14), deep >> 6)
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(FrameError, match="the image cannot be read"):
        read_image(path)


def test_a_deep_pgm_keeps_its_numbers_whatever_its_greatest(tmp_path):
    deep = np.linspace(0, 4095, 54).astype(">u2").reshape(6, 9)
    (tmp_path / "d.pgm").write_bytes(b"P5 9 6 4095\n" + deep.tobytes())
    np.testing.assert_array_equal(read_image(tmp_path / "d.pgm", bits=12), deep >> 4)


@pytest.mark.parametrize("suffix", ["png", "jpg", "tif"])
@pytest.mark.parametrize("tag", range(1, 9))
def test_a_rotation_tag_is_applied_on_request_only(tmp_path, suffix, tag):
    exif = Image.Exif()
    exif[0x0112] = tag
    stored = np.kron(GREY, np.ones((8, 8), np.uint8))
    path, plain = tmp_path / f"t.{suffix}", tmp_path / f"p.{suffix}"
    Image.fromarray(stored).save(path, exif=exif)
    Image.fromarray(stored).save(plain)
    np.testing.assert_array_equal(read_image(path), read_image(plain))
    assert image_size_px(path) == stored.shape[::-1]
    with Image.open(plain) as image:
        image.getexif()[0x0112] = tag
        shown = np.array(ImageOps.exif_transpose(image))
    np.testing.assert_array_equal(read_image(path, as_shown=True), shown)
    assert image_size_px(path, as_shown=True) == shown.shape[::-1]


def test_both_sides_of_a_deep_pair_are_shifted_alike(tmp_path):
    ramp = np.linspace(0, 1000, 16).astype(np.uint16).reshape(4, 4)
    left, right = saved(tmp_path / "l.png", ramp), saved(tmp_path / "r.png", ramp * 4)
    pair = read_stereo_pair(frame_of(left, right))
    np.testing.assert_array_equal(pair.left, ramp >> 4)
    np.testing.assert_array_equal(pair.right, ramp >> 2)
    given = read_stereo_pair(frame_of(left, right), bits=16)
    np.testing.assert_array_equal(given.right, ramp >> 6)


def test_a_pair_of_grey_and_rgb_becomes_grey(tmp_path):
    pair = read_stereo_pair(frame_of(saved(tmp_path / "l.png", RGB), saved(tmp_path / "r.png", GREY)))
    assert pair.left.shape == pair.right.shape == (6, 9)
    np.testing.assert_allclose(pair.left, RGB @ [0.299, 0.587, 0.114], atol=1)


def test_an_image_of_another_size_than_the_calibration_is_refused_before_it_is_decoded(tmp_path):
    left = saved(tmp_path / "l.png", GREY)
    right = saved(tmp_path / "r.png", np.zeros((600, 900), np.uint8))
    right.write_bytes(right.read_bytes()[:60])
    with pytest.raises(FrameError, match=r"the image is 900x600 px, the calibration is for 9x6 px in .*r\.png"):
        read_stereo_pair(frame_of(left, right), size_px=(9, 6))


def test_sizes_that_differ_are_refused(tmp_path):
    frame = frame_of(saved(tmp_path / "l.png", GREY), saved(tmp_path / "r.png", GREY[:, :5]))
    with pytest.raises(FrameError, match=r"the left image is 9x6, the right one 5x6 in frame f0 .*r\.png.*one size"):
        read_stereo_pair(frame)


def test_missing_and_foreign_files_are_refused(tmp_path):
    with pytest.raises(FrameError, match=r"the image is missing in .*none\.png; restore the file"):
        read_image(tmp_path / "none.png")
    with pytest.raises(FrameError, match=r"the image is missing in .*none\.png"):
        read_stereo_pair(frame_of(saved(tmp_path / "l.png", GREY), tmp_path / "none.png"))
    (tmp_path / "text.png").write_text("hello")
    (tmp_path / "empty.png").write_bytes(b"")
    for name in ("text.png", "empty.png"):
        with pytest.raises(FrameError, match=r"not an image of a known format in .*; give PNG, JPEG"):
            read_image(tmp_path / name)
    with pytest.raises(FrameError, match="cannot be read"):
        read_image(tmp_path)
    Image.fromarray(np.zeros((3, 3), np.float32)).save(tmp_path / "float.tiff")
    with pytest.raises(FrameError, match="pixels of type F"):
        read_image(tmp_path / "float.tiff")
    Image.fromarray(np.full((3, 3), 70000, np.int32)).save(tmp_path / "int.tiff")
    with pytest.raises(FrameError, match="pixels exceed 16 bits"):
        read_image(tmp_path / "int.tiff")


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@pytest.mark.parametrize("share", [0.3, 0.6, 0.9])
def test_truncated_files_are_refused(tmp_path, suffix, share):
    path = saved(tmp_path / f"whole{suffix}", RNG.integers(0, 256, (64, 64, 3), np.uint8))
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])
    with pytest.raises(FrameError, match=r"the image cannot be read \(.*\) in .*; replace it by a whole one"):
        read_image(path)


@pytest.mark.filterwarnings("ignore::UserWarning:PIL")
@given(
    suffix=st.sampled_from(["png", "jpeg", "tiff", "bmp", "ppm"]),
    edits=st.lists(st.tuples(st.integers(0, 300), st.binary(min_size=1, max_size=8)), max_size=4),
    length=st.integers(0, 600),
)
def test_corrupted_images_read_or_are_refused(tmp_path_factory, suffix, edits, length):
    buffer = io.BytesIO()
    Image.fromarray(RGB).save(buffer, suffix)
    data = bytearray(buffer.getvalue())
    for place, junk in edits:
        data[place : place + len(junk)] = junk
    path = tmp_path_factory.mktemp("junk") / "image"
    path.write_bytes(bytes(data[:length]))
    try:
        assert read_image(path).dtype == np.uint8
    except FrameError as fault:
        assert "\n" not in str(fault)


def test_sizes_come_from_headers_and_broken_files_are_passed_over(tmp_path):
    good = saved(tmp_path / "b.png", GREY)
    (tmp_path / "a.png").write_bytes(b"")
    assert image_size_px(good) == (9, 6)
    paths = [tmp_path / "a.png", good]
    assert first_image_size_px(paths, "here") == (9, 6)
    with pytest.raises(JaxmapError, match=r"no left image can be read \(first: not an image .*a\.png\) in here; check"):
        first_image_size_px(paths[:1], "here")


def test_folders_are_listed_in_natural_order(tmp_path):
    for name in ("f10.png", "f2.png", "f1.JPG", ".hidden.png", "notes.txt"):
        (tmp_path / name).write_bytes(b"")
    assert [file.name for file in list_images(tmp_path)] == ["f1.JPG", "f2.png", "f10.png"]
    (tmp_path / "empty").mkdir()
    with pytest.raises(JaxmapError, match=r"no images in .*empty; put image files there"):
        list_images(tmp_path / "empty")
    with pytest.raises(JaxmapError, match=r"no image folder \(No such file or directory\) in .*none"):
        list_images(tmp_path / "none")

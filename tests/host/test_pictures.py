"""The one opener of pictures: the formats that it knows, and what it refuses before anything is decoded."""

from __future__ import annotations

import os
import re
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import jaxmap
from jaxmap.errors import FrameError
from jaxmap.host.pictures import open_picture

PIXELS = np.random.default_rng(0).integers(0, 256, (6, 9, 3), np.uint8)
EPS = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n%%EndComments\nshowpage\n"


def refused(path: Path, **options) -> str:
    with pytest.raises(FrameError) as caught, open_picture(path, **options) as picture:
        picture.load()
    return str(caught.value)


def huge_png(path: Path, width: int, height: int) -> Path:
    """The header of a large picture, and hardly any pixels."""
    chunks = [
        (b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)),
        (b"IDAT", zlib.compress(bytes(100))),
        (b"IEND", b""),
    ]
    body = b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)) for kind, data in chunks
    )
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + body)
    return path


@pytest.mark.parametrize("kind", ["png", "jpeg", "tiff", "bmp", "ppm", "webp"])
def test_a_format_is_known_by_content_and_not_by_name(tmp_path, kind):
    path = tmp_path / "picture.png"
    Image.fromarray(PIXELS).save(path, kind)
    with open_picture(path) as picture:
        assert picture.size == (9, 6) and np.asarray(picture).shape == (6, 9, 3)


@pytest.mark.parametrize("content", [EPS, b"GIF89a" + bytes(40), b"%PDF-1.4", b"RIFF\x10\0\0\0WAVE", b"", b"hello"])
def test_no_other_format_is_opened_whatever_its_name(tmp_path, content, monkeypatch):
    """An EPS would start Ghostscript."""
    monkeypatch.setattr(os, "system", lambda *_: pytest.fail("a program was started"))
    monkeypatch.setattr("subprocess.Popen", lambda *_, **__: pytest.fail("a program was started"))
    path = tmp_path / "000001.png"
    path.write_bytes(content)
    assert refused(path) == f"not an image of a known format in {path}; give PNG, JPEG, TIFF, BMP, PGM, PPM or WebP"


def test_a_large_size_is_refused_by_the_header(tmp_path):
    path = huge_png(tmp_path / "bomb.png", 60_000, 60_000)
    assert "the mask is 60000x60000 px, more than the 134 million" in refused(path, noun="mask")
    path = huge_png(tmp_path / "bomb.png", 300, 200)
    assert "the image is 300x200 px, more" in refused(path, max_px=50_000)


def test_only_regular_files_are_read(tmp_path):
    os.mkfifo(tmp_path / "pipe.png")
    assert "cannot be read (no regular file)" in refused(tmp_path / "pipe.png")
    assert "cannot be read (no regular file)" in refused(tmp_path)
    assert "the image is missing" in refused(tmp_path / "none.png")


def test_the_package_opens_pictures_nowhere_else():
    package = Path(jaxmap.__file__).parent
    opening = re.compile(r"\bImage\.open\(|\bimread\w*\(|\bimdecode\w*\(")
    found = {path.relative_to(package).as_posix() for path in package.rglob("*.py") if opening.search(path.read_text())}
    assert found <= {"datasets/images.py"}  # decodes what `open_picture` opened

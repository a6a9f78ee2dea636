"""Images in ROS messages: `sensor_msgs/Image` and `sensor_msgs/CompressedImage`."""

from __future__ import annotations

import re
from typing import Any

import cv2
import numpy as np

from jaxmap.datasets.bit_depth import to_8_bits
from jaxmap.errors import FrameError

_CHANNELS = {
    **{"mono8": 1, "8UC1": 1, "rgb8": 3, "bgr8": 3, "8UC3": 3, "rgba8": 4, "bgra8": 4, "8UC4": 4},
    **{"mono16": 1, "16UC1": 1, "rgb16": 3, "bgr16": 3},
    **{"yuv422": 2, "uyvy": 2, "yuv422_yuy2": 2, "yuyv": 2},
}
_TO_RGB = {
    **{"bgr8": cv2.COLOR_BGR2RGB, "8UC3": cv2.COLOR_BGR2RGB, "bgr16": cv2.COLOR_BGR2RGB},
    **{"rgba8": cv2.COLOR_RGBA2RGB, "bgra8": cv2.COLOR_BGRA2RGB, "8UC4": cv2.COLOR_BGRA2RGB},
    **{"yuv422": cv2.COLOR_YUV2RGB_UYVY, "uyvy": cv2.COLOR_YUV2RGB_UYVY},
    **{"yuv422_yuy2": cv2.COLOR_YUV2RGB_YUYV, "yuyv": cv2.COLOR_YUV2RGB_YUYV},
}
_BAYER = {
    "rggb": cv2.COLOR_BayerRGGB2RGB,
    "bggr": cv2.COLOR_BayerBGGR2RGB,
    "gbrg": cv2.COLOR_BayerGBRG2RGB,
    "grbg": cv2.COLOR_BayerGRBG2RGB,
}
"""Named by the colours of the first two rows, as ROS does."""
_COMPRESSED = {"JPEG": (b"\xff\xd8\xff", b"\xff\xd9"), "PNG": (b"\x89PNG\r\n\x1a\n", b"IEND")}
"""How the files start and end."""


def decode_image(message: Any, where: object) -> np.ndarray:
    """The pixels of an image message.

    Grey stays grey; colour and Bayer mosaics become RGB. 16-bit pixels stay so.

    Args:
        message: `sensor_msgs/Image` or `CompressedImage`.
        where: the frame, for errors.

    Returns:
        uint8 or uint16, (H, W) or (H, W, 3).

    Raises:
        FrameError: an unknown encoding, missing bytes, or a compressed image that cannot be decoded.
    """
    return _decode_raw(message, where) if hasattr(message, "encoding") else _decode_compressed(message, where)


def as_pair(left: np.ndarray, right: np.ndarray, bits: int, where: object) -> tuple[np.ndarray, np.ndarray]:
    """A decoded pair as 8-bit grey or RGB; where one is grey and the other RGB, both become grey.

    Args:
        left: uint8 or uint16.
        right: likewise.
        bits: how many 16-bit images use.
        where: the frame, for errors.

    Raises:
        FrameError: the two differ in size.
    """
    if left.shape[:2] != right.shape[:2]:
        sizes = [f"{image.shape[1]}x{image.shape[0]}" for image in (left, right)]
        raise FrameError(f"the left image is {sizes[0]}, the right one {sizes[1]}", where=where)
    left, right = to_8_bits(left, bits), to_8_bits(right, bits)
    if left.ndim != right.ndim:
        left, right = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if image.ndim == 3 else image for image in (left, right))
    return left, right


def _decode_raw(message: Any, where: object) -> np.ndarray:
    encoding, width, height = str(message.encoding), int(message.width), int(message.height)
    mosaic = re.fullmatch(r"bayer_([rgb]{4})(8|16)", encoding)
    pattern = mosaic[1] if mosaic else ""
    if encoding not in _CHANNELS and pattern not in _BAYER:
        raise FrameError(
            f"images of encoding {encoding[:40]!r}", where=where, fix="record mono, rgb, bgr or bayer of 8 or 16 bits"
        )
    channels = 1 if mosaic else _CHANNELS[encoding]
    deep = encoding.endswith("16") or encoding.startswith("16")
    row_bytes = width * channels * (2 if deep else 1)
    step = int(message.step) or row_bytes
    data = np.frombuffer(message.data, np.uint8)
    if min(width, height) < 1 or step < row_bytes or len(data) < step * (height - 1) + row_bytes:
        raise FrameError(
            f"{len(data)} bytes are no image of {width}x{height} px and {encoding}", where=where, fix="restore the bag"
        )
    # The last row need not be padded.
    rows = np.lib.stride_tricks.as_strided(data, (height, row_bytes), (step, 1), writeable=False)
    pixels = np.ascontiguousarray(rows).view((">u2" if message.is_bigendian else "<u2") if deep else np.uint8)
    pixels = pixels.astype(np.uint16 if deep else np.uint8).reshape(height, width, channels)
    return _as_rgb(pixels.squeeze(2) if channels == 1 else pixels, encoding, pattern)


def _as_rgb(pixels: np.ndarray, encoding: str, pattern: str) -> np.ndarray:
    if pattern:
        pixels = cv2.cvtColor(pixels, _BAYER[pattern])
    elif encoding in _TO_RGB:
        pixels = cv2.cvtColor(pixels, _TO_RGB[encoding])
    return pixels


def _decode_compressed(message: Any, where: object) -> np.ndarray:
    """OpenCV fills up what a cut file lacks, so the end of the file is looked for."""
    data = np.frombuffer(message.data, np.uint8)
    start, end = data[:8].tobytes(), data[-64:].tobytes()
    kind = next((kind for kind, (magic, _) in _COMPRESSED.items() if start.startswith(magic)), None)
    if kind is None:
        raise FrameError(
            f"a compressed image of format {str(message.format)[:60]!r}", where=where, fix="JPEG and PNG are read"
        )
    whole = _COMPRESSED[kind][1] in end
    pixels = cv2.imdecode(data, cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION) if whole else None
    if pixels is None or pixels.dtype not in (np.uint8, np.uint16):
        raise FrameError(f"a {kind} image that is cut off or damaged", where=where, fix="restore the bag")
    if pixels.ndim == 3:
        return np.ascontiguousarray(pixels[..., 2::-1])
    # "bayer_rggb8; jpeg compressed bgr8" was made RGB before; without the last word the mosaic itself was packed.
    mosaic = re.match(r"bayer_([rgb]{4})(8|16)", str(message.format))
    return _as_rgb(pixels, "", mosaic[1] if mosaic and mosaic[1] in _BAYER else "")

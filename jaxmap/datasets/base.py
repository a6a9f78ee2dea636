"""What a reader delivers: a stereo sequence with poses in a z-up world."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxmap.stereo.rectify import StereoRig
from jaxmap.types import StereoCamera


class StereoPair(NamedTuple):
    """A pair of images as read: uint8, (H, W) grey or (H, W, 3) RGB, both of one size."""

    left: np.ndarray
    right: np.ndarray


@dataclass(frozen=True)
class FrameRef:
    """One frame of a sequence: where its images lie and when the left one was taken.

    `name` is the left image's file name without its ending; label files are found by it.
    """

    name: str
    timestamp_s: float
    left: Path
    right: Path


@dataclass(frozen=True)
class StereoSequence:
    """A stereo sequence, posed.

    Attributes:
        name: a short name for headings and files.
        dataset: the reader's name in the registry.
        camera: a rectified camera, or a `StereoRig` where the images are raw.
        frames: in the order of time.
        T_world_camera: float64 (N, 4, 4), left camera of the images as they lie on disk (raw if
            they are raw), in the z-up world, relative to `site_origin`.
        T_world_source: float64 (4, 4), turns the poses' own world into the z-up world.
        site_origin: float64 (3,), what was subtracted from the positions.
        crs: the coordinate reference system of `site_origin`, e.g. "EPSG:32631", or None.
        notes: what the reader found worth telling (frames left out, conventions assumed).
        read_pair: reads the images of one frame.
    """

    name: str
    dataset: str
    camera: StereoCamera | StereoRig
    frames: tuple[FrameRef, ...]
    T_world_camera: np.ndarray
    read_pair: Callable[[FrameRef], StereoPair]
    T_world_source: np.ndarray = field(default_factory=lambda: np.eye(4))
    site_origin: np.ndarray = field(default_factory=lambda: np.zeros(3))
    crs: str | None = None
    notes: tuple[str, ...] = ()

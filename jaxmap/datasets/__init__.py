"""Readers of stereo sequences: `open_sequence` opens a folder or a bundled sample."""

from jaxmap.datasets import euroc, folder, katwijk, kitti
from jaxmap.datasets.assemble import Reader, ReadOptions
from jaxmap.datasets.base import FrameRef, StereoPair, StereoSequence
from jaxmap.datasets.registry import READERS, open_sequence, register

__all__ = [
    "READERS",
    "FrameRef",
    "ReadOptions",
    "Reader",
    "StereoPair",
    "StereoSequence",
    "open_sequence",
    "register",
]

for _reader in (kitti.READER, euroc.READER, folder.READER, katwijk.READER):
    register(_reader)

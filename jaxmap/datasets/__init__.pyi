from .base import FrameRef, Reader, StereoPair, StereoSequence, assemble, read_pose_track
from .options import ReadOptions
from .registry import READERS, open_sequence, register

__all__ = [
    "READERS",
    "FrameRef",
    "ReadOptions",
    "Reader",
    "StereoPair",
    "StereoSequence",
    "assemble",
    "open_sequence",
    "read_pose_track",
    "register",
]

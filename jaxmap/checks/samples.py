"""The frames of a sequence that are looked at, read and rectified, with the features that their two images share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, UInt8

from jaxmap.datasets.base import StereoSequence
from jaxmap.errors import FrameError
from jaxmap.stereo.align import Alignment, estimate_alignment, match_features
from jaxmap.stereo.blank import blank_reason
from jaxmap.stereo.front_end import StereoFrontEnd

Image = UInt8[np.ndarray, "H W"] | UInt8[np.ndarray, "H W 3"]


class PairSample(NamedTuple):
    """One frame that was looked at.

    Attributes:
        name: of the frame.
        left: as read.
        right: as read.
        matches: column and row left, column and row right on the rectified images, (M, 4).
    """

    name: str
    left: Image
    right: Image
    matches: Float64[np.ndarray, "M 4"]


class Samples(NamedTuple):
    """What was looked at.

    Attributes:
        pairs: frames whose images show something.
        blank: names of the frames with an image that shows nothing, and what is wrong with it.
        unreadable: names of the frames that cannot be read, and why.
        alignment: of the matches of all pairs, in their order; None where these are too few.
    """

    pairs: tuple[PairSample, ...]
    blank: tuple[tuple[str, str], ...]
    unreadable: tuple[tuple[str, str], ...]
    alignment: Alignment | None

    @property
    def looked_at(self) -> int:
        """How many frames were looked at."""
        return len(self.pairs) + len(self.blank) + len(self.unreadable)


def spread_indices(frames: int, count: int) -> list[int]:
    """So many indices of frames at most, spread over a sequence, its first and last among them."""
    return sorted({int(index) for index in np.linspace(0, frames - 1, min(count, frames)).round()})


def take_samples(
    sequence: StereoSequence, front_end: StereoFrontEnd, indices: Sequence[int], shrink: int = 1
) -> Samples:
    """Reads frames and matches the features of their two images.

    Args:
        sequence: whose frames they are.
        front_end: its rectification.
        indices: of the frames.
        shrink: features are found on images shrunk so many times.
    """
    pairs: list[PairSample] = []
    blank: list[tuple[str, str]] = []
    unreadable: list[tuple[str, str]] = []
    for index in indices:
        ref = sequence.frames[index]
        try:
            left, right = sequence.read_pair(ref)
            rectified = front_end.rectify(left, right)
        except FrameError as fault:
            unreadable.append((ref.name, str(fault)))
            continue
        sides = (("left", left), ("right", right))
        reasons = [f"the {side} image {reason}" for side, image in sides if (reason := blank_reason(image)) is not None]
        if reasons:
            blank.append((ref.name, " and ".join(reasons)))
            continue
        pairs.append(PairSample(ref.name, left, right, match_features(*rectified, shrink)))
    found = np.concatenate([np.zeros((0, 4)), *(pair.matches for pair in pairs)])
    return Samples(tuple(pairs), tuple(blank), tuple(unreadable), estimate_alignment(front_end.camera, found))

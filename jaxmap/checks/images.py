"""What is wrong with images by themselves: unreadable, empty, saturated, dark, blurred; pixels that are stuck."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import cv2
import numpy as np

from jaxmap.checks.finding import Finding
from jaxmap.checks.samples import Image, PairSample, Samples

SATURATED_LEVEL, SATURATED_SHARE, LOST_SHARE = 254, 0.4, 0.7
"""An image is saturated where so many pixels are that bright; where more are, little is left to match."""

DARK_LEVEL = 6
"""An image is dark whose median is not above it."""

SHARP, BLURRED_BESIDE = 0.17, 0.4
"""Contrast of details of 1 to 2 px over that of 4 to 8 px: an image is blurred below the first, or below so many times
what the other images of the sequence have. Real sharp images have 0.5 to 1.3, Gaussian blur of 5 px leaves 0.15."""

MIDDLE_PX = 512
"""Edge of the middle of an image, which is enough to tell how sharp it is."""

STUCK_STEP, STUCK_FRAMES, MOVED_SHARE = 60, 3, 0.2
"""A pixel is stuck that differs by so many grey levels from all its neighbours in all frames, at least so many, between
which so large a share of the image has changed."""

MOST_NAMED = 6


def image_findings(samples: Samples) -> list[Finding]:
    """Findings on the images of the frames that were looked at."""
    return [*_unusable(samples), *_exposure(samples.pairs), *_blur(samples.pairs), *_stuck_pixels(samples.pairs)]


def _unusable(samples: Samples) -> list[Finding]:
    findings = []
    for kind, faults, fix in (
        (
            "unreadable-images",
            samples.unreadable,
            "restore the files, or take the frames out (--start, --stop, --stride)",
        ),
        (
            "empty-images",
            samples.blank,
            "take the frames out (--start, --stop, --stride); look at lens, shutter and gain",
        ),
    ):
        if faults:
            names = listed([name for name, _ in faults])
            what = f"{len(faults)} of {samples.looked_at} frames looked at cannot be used: {names} ({faults[0][1]})"
            findings.append(Finding(kind, True, 1.0, what, fix))
    return findings


def _exposure(pairs: Sequence[PairSample]) -> list[Finding]:
    findings = []
    bright = {pair.name: max(_share_at_least(image) for image in (pair.left, pair.right)) for pair in pairs}
    saturated = {name: share for name, share in bright.items() if share > SATURATED_SHARE}
    if saturated:
        share = float(np.median(list(saturated.values())))
        what = (
            f"{len(saturated)} of {len(pairs)} frames are saturated, in {share:.0%} of the pixels: {listed(saturated)}"
        )
        fix = "leave out these frames; expose less (what is saturated cannot be matched)"
        findings.append(Finding("saturated-images", share > LOST_SHARE, min(1.0, 0.5 + share / 2), what, fix))
    dark = [pair.name for pair in pairs if min(np.median(pair.left), np.median(pair.right)) <= DARK_LEVEL]
    if dark:
        what = f"{len(dark)} of {len(pairs)} frames are nearly black: {listed(dark)}"
        findings.append(Finding("dark-images", False, 0.7, what, "expose longer, or leave out these frames"))
    return findings


def _share_at_least(image: Image) -> float:
    least = image if image.ndim == 2 else image.min(axis=2)
    return float((least >= SATURATED_LEVEL).mean())


def _blur(pairs: Sequence[PairSample]) -> list[Finding]:
    if not pairs:
        return []
    sharpness = np.array([[_sharpness(image) for image in (pair.left, pair.right)] for pair in pairs])
    blurred = (sharpness < SHARP) | (sharpness < BLURRED_BESIDE * np.median(sharpness))
    if not blurred.any():
        return []
    named = [pair.name for pair, sides in zip(pairs, blurred, strict=True) if sides.any()]
    sides = " and ".join(side for side, some in zip(("left", "right"), blurred.any(axis=0), strict=True) if some)
    what = (
        f"the {sides} image is blurred in {len(named)} of {len(pairs)} frames: {listed(named)} "
        f"(fine over coarse contrast {sharpness[blurred].min():.2f}, sharp images have 0.5 and more)"
    )
    fix = "focus or clean the lens, expose shorter, or leave out these frames: disparities will be few and coarse"
    return [Finding("blurred-images", False, 0.7, what, fix)]


def _sharpness(image: Image) -> float:
    """Contrast of details of 1 to 2 px over that of 4 to 8 px."""
    rows, columns = (slice(max(0, (length - MIDDLE_PX) // 2), (length + MIDDLE_PX) // 2) for length in image.shape[:2])
    middle = _grey(image[rows, columns]).astype(np.float32)
    blurs = [cv2.GaussianBlur(middle, (0, 0), sigma) for sigma in (1, 2, 4, 8)]
    return float((blurs[0] - blurs[1]).std() / max((blurs[2] - blurs[3]).std(), 1e-6))


def _stuck_pixels(pairs: Sequence[PairSample]) -> list[Finding]:
    """Pixels that stay bright or dark while all around them changes; a scene that stands still tells nothing."""
    if len(pairs) < STUCK_FRAMES:
        return []
    counts = {}
    for side in ("left", "right"):
        images = [_grey(getattr(pair, side)) for pair in pairs]
        if len({image.shape for image in images}) > 1:
            return []
        changes = [(cv2.absdiff(first, second) > 8).mean() > MOVED_SHARE for first, second in pairwise(images)]
        if sum(changes) + 1 < STUCK_FRAMES:
            return []
        counts[side] = int(np.logical_and.reduce([_outstanding(image) for image in images]).sum())
    if not any(counts.values()):
        return []
    found = " and ".join(f"{count} in the {side} camera" for side, count in counts.items() if count)
    what = (
        f"{found} of the pixels are stuck: they stand out in all {len(pairs)} frames looked at while the scene changes"
    )
    fix = "replace them by their neighbours' median when the images are recorded; each makes a few false matches"
    return [Finding("hot-pixels", False, 0.9, what, fix)]


def _outstanding(image: np.ndarray) -> np.ndarray:
    """Pixels that differ from every neighbour by a great step."""
    ring = np.ones((3, 3), np.uint8)
    ring[1, 1] = 0
    wide = image.astype(np.int16)
    brightest, darkest = cv2.dilate(image, ring).astype(np.int16), cv2.erode(image, ring).astype(np.int16)
    return (wide - brightest > STUCK_STEP) | (darkest - wide > STUCK_STEP)


def _grey(image: Image) -> np.ndarray:
    return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)


def listed(names: Sequence[str] | dict[str, float]) -> str:
    """Names of frames, not too many."""
    every = list(names)
    more = len(every) - MOST_NAMED
    return ", ".join(every[:MOST_NAMED]) + (f" and {more} more" if more > 0 else "")

"""Whether left and right images fit the calibration: rows, order, the nearest and farthest depth."""

from __future__ import annotations

import numpy as np

from jaxmap.checks.finding import Finding
from jaxmap.checks.samples import Samples
from jaxmap.stereo.align import BEHIND_PX, MIN_MATCHES, Alignment
from jaxmap.stereo.front_end import StereoFrontEnd
from jaxmap.types import StereoCamera

ROW_PX = 0.8
"""Rows that are off by more, for a quarter of the matches, spoil matching; well calibrated pairs have 0.02 to 0.6."""

AGREE_SHARE = 0.5
"""Where fewer matches agree on any rotation, the calibration is of other cameras, or the images of other moments."""

HARDLY_ANY = 5
"""Matches in a frame; images of one scene have more, however dull."""

NEAR_SHARE, NEAR_MATCHES, NEAR_STOPS_SHARE = 0.02, 8, 0.1
"""Matches nearer than the disparities reach that are worth a word, and those that leave a hole in the map."""


def pair_findings(samples: Samples, front_end: StereoFrontEnd) -> list[Finding]:
    """Findings on what the two cameras see of one scene."""
    camera, alignment = front_end.camera, samples.alignment
    if alignment is None:
        return _no_matches(samples) if samples.pairs else []
    disparity_px = alignment.disparity_px[alignment.inliers]
    certain = _certainty(alignment)
    if np.median(disparity_px) < 0 and alignment.inliers.mean() > AGREE_SHARE:
        what = f"left and right look swapped: {np.mean(disparity_px < 0):.0%} of the matches have a negative disparity"
        return [Finding("swapped-images", True, certain, what, "swap the two folders or cameras")]
    return [*_rows(camera, alignment, certain), *_near_limit(front_end, alignment, certain)]


def _certainty(alignment: Alignment) -> float:
    """How far matches are to be trusted, by their number and agreement."""
    count = int(alignment.inliers.sum())
    return round(float(alignment.inliers.mean() * count / (count + MIN_MATCHES)), 2)


def _no_matches(samples: Samples) -> list[Finding]:
    found = sum(len(pair.matches) for pair in samples.pairs)
    what = f"left and right have hardly anything in common: {found} matches of features in {len(samples.pairs)} frames"
    fix = "check that the two images of a frame are of one moment and scene, and that they show texture"
    return [Finding("no-matches", found < HARDLY_ANY * len(samples.pairs), 0.6, what, fix)]


def _rows(camera: StereoCamera, alignment: Alignment, certain: float) -> list[Finding]:
    """Rows that differ between left and right, and matches behind infinity: the calibration is off."""
    inliers = alignment.inliers
    explained_px = (alignment.row_error_px - alignment.row_residual_px)[inliers]
    off_px = float(np.quantile(np.abs(explained_px), 0.75))
    behind_px = -alignment.rotation_rad[1] * float(camera.fx_px)
    low, high = np.quantile(explained_px, (0.05, 0.95))
    about = " ".join(f"{angle:+.2f}" for angle in np.degrees(alignment.rotation_rad))
    if off_px > ROW_PX or behind_px > BEHIND_PX:
        what = (
            f"matches lie on other rows in the right image, by {low:+.1f} to {high:+.1f} px "
            f"({len(inliers)} matches; a rotation of the right camera by {about} degrees about x, y, z mends it)"
        )
        if behind_px > BEHIND_PX:
            what += f", and far points behind infinity, by {behind_px:.1f} px of disparity"
        fix = "--stereo.align estimates that rotation and rectifies with it; better, calibrate the cameras anew"
        return [Finding("vertical-disparity", True, certain, what, fix)]
    if inliers.mean() < AGREE_SHARE:
        what = f"only {inliers.mean():.0%} of {len(inliers)} matches agree on how rows of left and right correspond"
        fix = "check that calibration and images belong together, and that left and right are of one moment"
        return [Finding("rows-disagree", True, 0.6, what, fix)]
    return []


def _near_limit(front_end: StereoFrontEnd, alignment: Alignment, certain: float) -> list[Finding]:
    """Matches that are nearer than the searched disparities reach."""
    camera, matcher = front_end.camera, front_end.matcher
    doffs_px, bf_px_m = float(camera.doffs_px), float(camera.fx_px) * float(camera.baseline_m)
    lowest_px = matcher.options.min_disparity_px
    limit_px = lowest_px + matcher.num_disparities - 1
    disparity_px = alignment.disparity_px[alignment.inliers] - doffs_px
    # Wrong matches lie on either side; those beyond the other end tell how many they are.
    wrong = int((disparity_px < min(lowest_px, 0) - 2).sum())
    beyond = disparity_px[disparity_px > limit_px + 1]
    share = (len(beyond) - 3 * wrong) / len(disparity_px)
    if share < NEAR_SHARE or len(beyond) < NEAR_MATCHES or limit_px + doffs_px <= 0:
        return []
    nearest_px = float(np.quantile(beyond, 0.95))
    needed = int(-(-(nearest_px + 2 - lowest_px) // 16) * 16)
    what = (
        f"{len(beyond) / len(disparity_px):.0%} of the matches are nearer than the {matcher.num_disparities} "
        f"disparities searched can see: nothing nearer than {bf_px_m / (limit_px + doffs_px):.2f} m, while "
        f"something stands at {bf_px_m / (nearest_px + doffs_px):.2f} m"
    )
    fix = f"--stereo.num-disparities {needed}"
    return [Finding("near-limit", share > NEAR_STOPS_SHARE, certain, what, fix)]

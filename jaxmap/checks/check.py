"""All checks of a sequence: a thorough form, and a quick one that other commands begin with."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from jaxmap.checks.calibration import calibration_findings
from jaxmap.checks.clock import clock_findings
from jaxmap.checks.finding import Finding
from jaxmap.checks.images import image_findings
from jaxmap.checks.pairs import pair_findings
from jaxmap.checks.pose_convention import pose_findings
from jaxmap.checks.samples import Samples, spread_indices, take_samples
from jaxmap.datasets.base import StereoSequence
from jaxmap.errors import JaxmapError
from jaxmap.stereo.front_end import StereoFrontEnd
from jaxmap.stereo.match import StereoOptions


class Extent(NamedTuple):
    """How closely a sequence is looked at.

    Attributes:
        frames: how many, at most.
        width_px: images are shrunk to about so many columns at least.
        steps: between how many pairs of frames the motion is measured.
        clock: whether the clocks of images and poses are compared, on many frames in a row.
    """

    frames: int
    width_px: int
    steps: int
    clock: bool


THOROUGH, QUICK = Extent(6, 1024, steps=6, clock=True), Extent(3, 512, steps=3, clock=False)
"""Some 5 to 10 s, and 1 s or less, for images of 1024 columns on two cores."""

_UNMEASURABLE = {"swapped-images", "rows-disagree", "vertical-disparity"}


class CheckReport(NamedTuple):
    """What a check has found, the gravest and surest first, and what it looked at, as plain values."""

    findings: tuple[Finding, ...]
    looked_at: dict[str, Any]

    @property
    def stops(self) -> bool:
        """Whether a map would be wrong."""
        return any(finding.stops for finding in self.findings)


def check_sequence(sequence: StereoSequence, front_end: StereoFrontEnd, extent: Extent) -> CheckReport:
    """Compares what a sequence says with what its images show.

    Args:
        sequence: the sequence.
        front_end: its rectification and matcher.
        extent: how closely to look.
    """
    started_s = time.perf_counter()
    samples = _samples(sequence, front_end, extent)
    findings = [*calibration_findings(sequence.camera, front_end.camera), *image_findings(samples)]
    findings += pair_findings(samples, front_end)
    # Motions are measured by disparities: where these are wrong, only what the poses themselves say is looked at.
    measurable = not {finding.kind for finding in findings} & _UNMEASURABLE
    findings += pose_findings(sequence, front_end, extent.steps if measurable else 0)
    if extent.clock and measurable:
        findings += clock_findings(sequence, front_end)
    findings.sort(key=lambda finding: (not finding.stops, -finding.confidence))
    looked_at: dict[str, Any] = {
        "frames": samples.looked_at,
        "of": len(sequence.frames),
        "matches": sum(len(pair.matches) for pair in samples.pairs),
    }
    if (alignment := samples.alignment) is not None and alignment.inliers.any():
        errors_px, residuals_px = np.abs(alignment.row_error_px), np.abs(alignment.row_residual_px)
        looked_at["row_error_px"] = round(float(np.median(errors_px[alignment.inliers])), 3)
        looked_at["row_error_aligned_px"] = round(float(np.median(residuals_px[alignment.inliers])), 3)
    looked_at["seconds"] = round(time.perf_counter() - started_s, 2)
    return CheckReport(tuple(findings), looked_at)


def _samples(sequence: StereoSequence, front_end: StereoFrontEnd, extent: Extent) -> Samples:
    indices = spread_indices(len(sequence.frames), extent.frames)
    shrink = max(1, round(front_end.camera.width_px / extent.width_px))
    return take_samples(sequence, front_end, indices, shrink)


def open_front_end(
    sequence: StereoSequence, options: StereoOptions, notify: Callable[[str], None] = lambda line: None
) -> StereoFrontEnd:
    """The stereo front end of a sequence; with `options.align`, corrected by what some of its frames show.

    Args:
        sequence: the sequence.
        options: of rectification and matching.
        notify: takes a line on the correction.

    Raises:
        JaxmapError: the calibration cannot be used, or too few features match to correct it.
    """
    front_end = StereoFrontEnd(sequence.camera, options)
    if not options.align:
        return front_end
    samples = _samples(sequence, front_end, THOROUGH)
    if samples.alignment is None:
        raise JaxmapError(
            f"too few matches between left and right to align them, in {samples.looked_at} frames",
            where=sequence.name,
            fix="leave out --stereo.align, and see what jaxmap check says of the images",
        )
    alignment = samples.alignment
    about = " ".join(f"{angle:+.3f}" for angle in np.degrees(alignment.rotation_rad))
    before, after = (
        float(np.median(np.abs(rows)[alignment.inliers]))
        for rows in (alignment.row_error_px, alignment.row_residual_px)
    )
    notify(
        f"right camera rotated by {about} degrees about x, y, z: rows of {alignment.inliers.sum():,} matches differ by "
        f"{after:.2f} px, {before:.2f} px before"
    )
    return StereoFrontEnd(sequence.camera, options, alignment.rotation_rad)

"""Whether the numbers of a calibration can be those of these images: baseline, principal point, distortion."""

from __future__ import annotations

import numpy as np

from jaxmap.checks.finding import Finding
from jaxmap.stereo.rectify import StereoRig
from jaxmap.types import StereoCamera

BASELINES_M = (0.005, 3.0)
"""Stereo rigs of rovers and cars have 0.02 to 1.5 m."""

UNITS_M = {"mm": 1e-3, "cm": 1e-2}
USUAL_BASELINES_M = (0.02, 1.5)

MIDDLE = 0.2
"""Lenses look at the middle of their images, by this share of the width and height at worst."""


def calibration_findings(given: StereoCamera | StereoRig, camera: StereoCamera) -> list[Finding]:
    """What a calibration itself shows.

    Args:
        given: as it was given.
        camera: rectified.
    """
    return [*_baseline(camera), *_principal_point(given), *_distortion(given)]


def _principal_point(camera: StereoCamera | StereoRig) -> list[Finding]:
    """A principal point far from the middle in both directions, as that of images of another size is."""
    centre_px = camera.K_left[:2, 2] if isinstance(camera, StereoRig) else (camera.cx_px, camera.cy_px)
    x, y = (np.asarray(centre_px, np.float64) + 0.5) / (camera.width_px, camera.height_px)
    if min(abs(x - 0.5), abs(y - 0.5)) < MIDDLE:
        return []
    what = f"the principal point lies at {x:.2f} of the width of the images and {y:.2f} of their height, off the middle"
    fix = "give the calibration of images of this size; if these are cut out of larger ones, all is well"
    return [Finding("principal-point", False, 0.8, what, fix)]


def _distortion(camera: StereoCamera | StereoRig) -> list[Finding]:
    """Lenses that do not bend: simulated ones, whose cameras are exactly parallel, or their distortion is lost."""
    if not isinstance(camera, StereoRig) or np.array_equal(camera.R_right_left, np.eye(3)):
        return []
    if camera.distortion_left.any() or camera.distortion_right.any():
        return []
    what = "the calibration of these raw images has no distortion, which lenses have; a map of bent images is bent"
    fix = "give the distortion of both cameras; if it was taken out of the images, all is well"
    return [Finding("no-distortion", False, 0.6, what, fix)]


def _baseline(camera: StereoCamera) -> list[Finding]:
    """A baseline that no rig has."""
    baseline_m = float(camera.baseline_m)
    if BASELINES_M[0] <= baseline_m <= BASELINES_M[1]:
        return []
    least, most = USUAL_BASELINES_M
    units = [unit for unit, metres in UNITS_M.items() if least <= baseline_m * metres <= most]
    what = f"the baseline is {baseline_m:g} m, and no rover's cameras stand so far apart"
    if baseline_m < 1:
        what = f"the baseline is {1e3 * baseline_m:g} mm, and no two cameras stand so close together"
    fix = "give the baseline in metres in the calibration"
    if units:
        options = " or ".join(f"--baseline-unit {unit}" for unit in units)
        fix += f"; if it is {baseline_m * UNITS_M[units[0]]:g} m: {options.split(' or ')[0]}"
        if len(units) > 1:
            fix += f" (or {options.split(' or ')[1]})"
    return [Finding("baseline-unit", True, 0.95, what, fix)]

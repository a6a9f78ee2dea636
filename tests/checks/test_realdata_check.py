"""Recorded sequences: nothing is wrong with the good ones, and what is wrong with the others is told by its cause."""

from __future__ import annotations

from pathlib import Path

import pytest

from jaxmap.checks.check import QUICK, THOROUGH, CheckReport, check_sequence, open_front_end
from jaxmap.datasets import ReadOptions, open_sequence
from jaxmap.stereo.match import StereoOptions

pytestmark = [pytest.mark.realdata, pytest.mark.slow]

GOOD = (
    "sample:traverse",
    "sample:motorcycle",
    "simdata/traverse_a/Part1",
    "simdata/traverse_b/Part5",
    "realdata/kitti_odometry/sequences/01",
    "cases/01-world-z-down/seq",
)
CASES = {
    "01-world-z-down": ("poses.tum", None, "pose-convention", "--poses-world z_down"),
    "02-pose-of-body-axes": ("poses.tum", None, "pose-convention", "--pose-convention body"),
    "05-near-wall": (None, None, "near-limit", "--stereo.num-disparities 80"),
    "14-baseline-in-mm": (None, "camera_mm.yaml", "baseline-unit", "--baseline-unit mm"),
    "19-right-image-two-rows-off": (None, None, "vertical-disparity", "--stereo.align"),
    "20-lens-cap": (None, None, "empty-images", "take the frames out"),
}


def checked(source: str, extent=THOROUGH, *, align: bool = False, **options) -> CheckReport:
    sequence = open_sequence(source, ReadOptions(**options))
    return check_sequence(sequence, open_front_end(sequence, StereoOptions(align=align)), extent)


def shared(realdata: Path, name: str) -> Path:
    path = realdata.parent / name
    if not path.exists():
        pytest.skip(f"no {path}")
    return path


@pytest.mark.parametrize("extent", [QUICK, THOROUGH])
@pytest.mark.parametrize("name", GOOD)
def test_nothing_is_wrong_with_good_sequences(realdata, name, extent):
    source = name if name.startswith("sample:") else str(shared(realdata, name))
    assert checked(source, extent).findings == ()


@pytest.mark.parametrize("name", CASES)
def test_the_cause_is_told(realdata, name):
    folder = shared(realdata, f"cases/{name}")
    poses, calibration, kind, fix = CASES[name]
    options = {key: folder / file for key, file in (("poses", poses), ("calibration", calibration)) if file}
    first = checked(str(folder / "seq"), **options).findings[0]
    assert (first.kind, first.stops) == (kind, True)
    assert fix in first.fix


def test_a_rig_whose_calibration_is_off_is_told_and_aligned(realdata):
    folder = str(shared(realdata, "realdata/k10"))
    (found,) = checked(folder).findings
    assert found.kind == "vertical-disparity" and "behind infinity" in found.what
    aligned = checked(folder, align=True)
    assert "vertical-disparity" not in [finding.kind for finding in aligned.findings]
    assert aligned.looked_at["row_error_px"] < 0.5

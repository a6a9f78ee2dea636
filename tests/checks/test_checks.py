"""What is wrong with a sequence is found, by its cause, and nothing is found where nothing is wrong."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from PIL import Image
from scenes import CAMERA, HEIGHT_PX, WIDTH_PX, write_folder_sequence

from jaxmap.checks.calibration import calibration_findings
from jaxmap.checks.check import QUICK, THOROUGH, CheckReport, check_sequence, open_front_end
from jaxmap.commands.check import main
from jaxmap.datasets import ReadOptions, open_sequence
from jaxmap.stereo.match import StereoOptions
from jaxmap.stereo.rectify import StereoRig, make_rectifier, make_stereo_rig

FRAMES = 4


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_folder_sequence(tmp_path / "seq", FRAMES)


def checked(folder: Path, extent=QUICK, stereo: StereoOptions | None = None, **options) -> CheckReport:
    sequence = open_sequence(str(folder), ReadOptions(**options))
    return check_sequence(sequence, open_front_end(sequence, stereo or StereoOptions()), extent)


def kinds(report: CheckReport) -> list[str]:
    return [finding.kind for finding in report.findings]


def change(folder: Path, side: str, changed, frames=range(FRAMES)) -> None:
    """Writes images of a side anew, each as a function of its pixels makes it."""
    for index, path in enumerate(sorted((folder / side).glob("*.png"))):
        if index in frames:
            Image.fromarray(changed(np.asarray(Image.open(path))).astype(np.uint8)).save(path)


@pytest.mark.parametrize("extent", [QUICK, THOROUGH])
def test_nothing_is_wrong_with_a_good_sequence(folder, extent):
    report = checked(folder, extent)
    assert not report.findings and not report.stops
    assert report.looked_at["frames"] == min(extent.frames, FRAMES)
    assert report.looked_at["matches"] > 100


@pytest.mark.parametrize("rows", [-3, 2, 12])
def test_rows_that_are_off_are_told_and_aligned(folder, rows):
    change(folder, "right", lambda image: np.roll(image, rows, axis=0))
    (found,) = checked(folder).findings
    assert found.kind == "vertical-disparity" and found.stops and found.confidence > 0.7
    assert "--stereo.align" in found.fix
    assert not checked(folder, stereo=StereoOptions(align=True)).findings


def test_swapped_images_are_told(folder):
    left, right = folder / "left", folder / "right"
    left.rename(folder / "kept")
    right.rename(left)
    (folder / "kept").rename(right)
    (found,) = checked(folder).findings
    assert found.kind == "swapped-images" and found.stops


@pytest.mark.parametrize(("level", "word"), [(0, "black"), (255, "white"), (120, "one grey")])
def test_blank_images_are_named(folder, level, word):
    change(folder, "left", lambda image: np.full_like(image, level), frames=[0])
    (found,) = checked(folder).findings
    assert found.kind == "empty-images" and found.stops
    assert "f000" in found.what and "left" in found.what and word in found.what


def test_a_blank_image_with_noise_is_blank(folder):
    rng = np.random.default_rng(0)
    change(folder, "right", lambda image: rng.integers(0, 6, image.shape))
    assert kinds(checked(folder)) == ["empty-images"]


def test_saturated_images_are_told(folder):
    change(folder, "left", lambda image: np.clip(3.0 * image, 0, 255))
    report = checked(folder)
    assert "saturated-images" in kinds(report)


def test_a_blurred_image_is_told(folder):
    change(folder, "left", lambda image: cv2.GaussianBlur(image, (0, 0), 5), frames=[0])
    found = next(found for found in checked(folder).findings if found.kind == "blurred-images")
    assert not found.stops and "f000" in found.what and "left image" in found.what


def test_stuck_pixels_are_told(folder):
    def stuck(image: np.ndarray) -> np.ndarray:
        image = image.copy()
        image[30, 40] = image[90, 101] = 255 if image[30, 40] < 128 else 0
        return image

    change(folder, "left", stuck)
    (found,) = checked(folder, THOROUGH).findings
    assert found.kind == "hot-pixels" and not found.stops and found.what.startswith("2 in the left camera")


def test_a_missing_image_is_named(folder):
    (folder / "right" / "f003.png").unlink()
    (found,) = checked(folder).findings
    assert found.kind == "unreadable-images" and "f003" in found.what


@pytest.mark.parametrize(("baseline", "option"), [(120.0, "--baseline-unit mm"), (12.0, "--baseline-unit cm")])
def test_a_baseline_in_another_unit_is_told(folder, baseline, option):
    (folder / "camera.yaml").write_text(yaml.safe_dump(CAMERA | {"baseline_m": baseline}))
    found = next(found for found in checked(folder).findings if found.kind == "baseline-unit")
    assert found.stops and option in found.fix


@pytest.mark.parametrize("size", [2.0, 0.5])
def test_a_calibration_of_images_of_another_size_is_told(folder, size):
    scaled = {name: size * CAMERA[name] for name in ("fx_px", "cx_px", "cy_px")}
    (folder / "camera.yaml").write_text(yaml.safe_dump(CAMERA | scaled))
    assert "principal-point" in kinds(checked(folder))


def rig(distortion: list[float], turned_rad: float) -> StereoRig:
    """A calibration of raw images; the right camera is turned about its vertical."""
    K = [[200.0, 0, 79.5], [0, 200.0, 59.5], [0, 0, 1]]
    return make_stereo_rig(
        K_left=K,
        distortion_left=distortion,
        K_right=K,
        distortion_right=distortion,
        R_right_left=cv2.Rodrigues(np.array([0.0, turned_rad, 0.0]))[0],
        t_right_left_m=[-0.2, 0, 0],
        size_px=(160, 120),
    )


def test_raw_images_without_distortion_are_told_unless_they_are_simulated():
    bent, straight = [-0.3, 0.1, 0.0, 0.0], [0.0] * 4
    camera = make_rectifier(rig(bent, 0.01)).camera
    assert not calibration_findings(rig(bent, 0.01), camera)
    (found,) = calibration_findings(rig(straight, 0.01), camera)
    assert found.kind == "no-distortion" and not found.stops
    assert not calibration_findings(rig(straight, 0.0), camera)


def test_what_is_nearer_than_searched_is_told(folder):
    wall = cv2.GaussianBlur(np.random.default_rng(0).normal(size=(HEIGHT_PX, WIDTH_PX + 40)), (0, 0), 1.2)
    wall = cv2.normalize(wall, None, 0, 255, cv2.NORM_MINMAX)
    change(folder, "left", lambda image: wall[:, :WIDTH_PX])
    change(folder, "right", lambda image: wall[:, 40:])
    (found,) = [one for one in checked(folder).findings if one.kind != "blurred-images"]
    assert found.kind == "near-limit" and found.stops and found.fix == "--stereo.num-disparities 48"
    assert not checked(folder, stereo=StereoOptions(num_disparities=48)).findings


def test_pairs_of_two_scenes_are_told(folder):
    rng = np.random.default_rng(0)
    change(folder, "right", lambda image: rng.integers(0, 256, image.shape))
    assert "no-matches" in kinds(checked(folder))


def test_the_command_prints_and_writes_what_it_found(folder, tmp_path, capsys):
    assert main([str(folder), "--out", str(tmp_path / "good.json")]) == 0
    assert "nothing wrong found" in capsys.readouterr().out
    assert json.loads((tmp_path / "good.json").read_text())["findings"] == []
    change(folder, "right", lambda image: np.roll(image, 3, axis=0))
    assert main([str(folder), "--out", str(tmp_path / "bad.json")]) == 1
    assert "vertical-disparity" in capsys.readouterr().out
    content = json.loads((tmp_path / "bad.json").read_text())
    assert content["stops"] and content["findings"][0]["fix"].startswith("--stereo.align")
    assert main([str(folder), "--stereo.align"]) == 0

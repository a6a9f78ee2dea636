"""Observations on disk: what is kept is what was seen, a frame is whole or absent, and damage is named."""

from __future__ import annotations

import errno
import json
import os
import shutil
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

import jaxmap.mapping.observations as store
from jaxmap.errors import FrameError, JaxmapError
from jaxmap.mapping.observations import (
    Observation,
    ObservationAttributes,
    is_observed,
    open_observations,
    remove_stray_frames,
    write_attributes,
    write_observation,
)
from jaxmap.mapping.quantised import quantise_disparity, quantise_kept, restore_disparity, restore_kept

SIZE = (6, 8)
CAMERA = dict(fx_px=8.0, fy_px=8.0, cx_px=4.0, cy_px=3.0, baseline_m=0.1, doffs_px=0.0, width_px=8.0, height_px=6.0)
ATTRIBUTES = ObservationAttributes(
    sequence="somewhere",
    name="small",
    dataset="folder",
    camera=CAMERA,
    settings={"stereo": {"mode": "3way"}},
    kept="logits",
    kept_shape=(2, 3, 4),
    classes=("a", "b", "c", "d"),
    site_origin=(5.0, 6.0, 7.0),
)


def seen(number: int, rng: np.random.Generator) -> Observation:
    pose = np.eye(4)
    pose[:3, 3] = rng.normal(size=3)
    disparity_px = rng.uniform(0, 100, SIZE).astype(np.float32)
    disparity_px[rng.random(SIZE) < 0.3] = np.nan
    return Observation(f"f{number}", 10.0 + number, pose, disparity_px, rng.normal(0, 9, (2, 3, 4)), 0.25, 99.0)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three frames, written out of order."""
    rng, folder = np.random.default_rng(0), tmp_path / "observations.zarr"
    write_attributes(folder, ATTRIBUTES)
    for number in (2, 0, 1):
        write_observation(folder, seen(number, rng), "logits")
    return folder


@given(arrays(np.float32, SIZE, elements=st.floats(-2047, 2047, width=32) | st.just(np.nan)))
def test_a_kept_disparity_is_off_by_a_32nd_at_most_and_unknown_stays_unknown(disparity_px):
    again = restore_disparity(quantise_disparity(disparity_px))
    np.testing.assert_array_equal(np.isnan(again), np.isnan(disparity_px))
    assert np.nanmax(np.abs(again - disparity_px), initial=0) <= 1 / 32
    np.testing.assert_array_equal(restore_disparity(quantise_disparity(again)), again)


@given(arrays(np.float32, (3, 4, 2), elements=st.floats(-1e4, 1e4, width=32)))
def test_kept_logits_are_off_by_half_a_step_of_the_greatest(logits):
    stored, scale = quantise_kept(logits, "logits")
    again = restore_kept(stored, "logits", scale)
    assert stored.dtype == np.int16
    assert np.abs(again - logits).max() <= max(np.abs(logits).max(), 1e-6) / 65_534 * 1.01
    # Once kept, they stay what they are.
    stored_again, scale_again = quantise_kept(again, "logits")
    np.testing.assert_allclose(restore_kept(stored_again, "logits", scale_again), again, atol=scale, rtol=0)


@given(arrays(np.float32, (3, 4, 2), elements=st.floats(0, 1, width=32)))
def test_kept_probabilities_are_off_by_a_510th(shares):
    stored, scale = quantise_kept(shares, "class_probabilities")
    np.testing.assert_allclose(restore_kept(stored, "class_probabilities", scale), shares, atol=1 / 510 + 1e-6, rtol=0)


def test_a_disparity_too_great_and_logits_that_are_no_numbers_are_refused():
    with pytest.raises(FrameError, match="a disparity of 3000 px cannot be kept"):
        quantise_disparity(np.full(SIZE, 3000, np.float32))
    with pytest.raises(FrameError, match="the logits are not finite"):
        quantise_kept(np.full((1, 1, 2), np.nan), "logits")


def test_what_was_written_is_read_in_the_order_of_time(folder):
    rng = np.random.default_rng(0)
    written = {number: seen(number, rng) for number in (2, 0, 1)}
    observations = open_observations(folder)
    assert [frame.name for frame in observations.frames] == ["f0", "f1", "f2"]
    assert [frame.timestamp_s for frame in observations.frames] == [10.0, 11.0, 12.0]
    assert observations.attributes == ATTRIBUTES
    assert (observations.camera.width_px, observations.camera.height_px) == (8, 6)
    for number, expected in written.items():
        again = observations.observation(number)
        np.testing.assert_array_equal(again.T_world_camera, expected.T_world_camera)
        np.testing.assert_array_equal(again.disparity_px, restore_disparity(quantise_disparity(expected.disparity_px)))
        np.testing.assert_allclose(again.kept, expected.kept, atol=1e-3)
        assert (again.too_near, again.nearest_px) == (0.25, 99.0)
        frame = observations.read(number)
        assert frame.logits is not None and frame.logits.shape == (2, 3, 4)
        np.testing.assert_allclose(
            frame.T_world_camera.as_matrix(), expected.T_world_camera.astype(np.float32), atol=1e-6
        )


def test_frames_are_read_from_threads(folder):
    observations = open_observations(folder)
    with ThreadPoolExecutor(4) as pool:
        frames = list(pool.map(observations.read, [0, 1, 2] * 8))
    for index, frame in enumerate(frames):
        np.testing.assert_array_equal(frame.disparity_px, frames[index % 3].disparity_px)


def test_other_zarr_readers_can_read_them(folder):
    import zarr

    group = zarr.open_group(folder, mode="r")
    assert group.attrs["format_version"] == 1 and sorted(group.group_keys()) == ["f0", "f1", "f2"]
    assert group["f1/disparity"].dtype == np.int16  # type: ignore[union-attr]


def test_frames_are_chosen_and_poses_replaced(folder):
    observations = open_observations(folder)
    assert [frame.name for frame in observations.selected(slice(None, None, 2)).frames] == ["f0", "f2"]
    moved = observations.T_world_camera + np.array([[0, 0, 0, 1.0]] + [[0.0] * 4] * 3)
    again = replace(observations, T_world_camera=moved)
    assert again.read(1).T_world_camera.translation()[0] == pytest.approx(moved[1, 0, 3])


def test_a_frame_that_is_there_stays(folder):
    before = open_observations(folder).observation(1)
    write_observation(folder, seen(1, np.random.default_rng(99)), "logits")
    np.testing.assert_array_equal(open_observations(folder).observation(1).disparity_px, before.disparity_px)
    assert not [path for path in folder.iterdir() if path.name.startswith(".")]


@pytest.mark.parametrize("victim", ["disparity/c.0.0", "logits/c.0.0.0", "disparity/zarr.json"])
@pytest.mark.parametrize("cut", [0.0, 0.6, None])
def test_a_damaged_frame_is_named_and_the_others_are_read(folder, victim, cut):
    path = folder / "f1" / victim
    if cut is None:
        path.unlink()
    else:
        path.write_bytes(path.read_bytes()[: int(path.stat().st_size * cut)])
    observations = open_observations(folder)
    with pytest.raises(FrameError, match=r"f1.*remove that folder and run jaxmap perceive again"):
        observations.read(1)
    observations.read(0), observations.read(2)


def test_a_flipped_byte_is_found(folder):
    path = folder / "f1" / "logits" / "c.0.0.0"
    data = bytearray(path.read_bytes())
    data[-5] ^= 0xFF
    path.write_bytes(data)
    with pytest.raises(FrameError, match="the logits of the frame is damaged"):
        open_observations(folder).read(1)


def test_a_frame_of_another_form_is_refused(folder):
    shutil.rmtree(folder / "f1")
    odd = replace(ATTRIBUTES, kept_shape=(2, 2, 4))
    write_attributes(folder, odd)
    with pytest.raises(FrameError, match=r"logits is int16 \(2, 3, 4\), not int16 \(2, 2, 4\)"):
        open_observations(folder).read(0)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"format_version": 2}, "observations of format 2, this jaxmap reads 1.*upgrade jaxmap"),
        ({"format_version": None}, "not jaxmap's observations: no format_version"),
        ({"kept": "sounds"}, "the attribute kept is damaged"),
        ({"classes": ["a", "b", "c", "e"]}, "the attributes are not those that the frames were perceived with"),
        ({"camera": {**CAMERA, "fx_px": 9.0}}, "the attributes are not those that the frames were perceived with"),
        ({"site_origin": [1, 2]}, "the attribute site_origin.* is damaged"),
    ],
)
def test_attributes_that_do_not_serve_are_named(folder, changes, expected):
    path = folder / "zarr.json"
    tree = json.loads(path.read_text())
    tree["attributes"] |= changes
    path.write_text(json.dumps(tree))
    with pytest.raises(JaxmapError, match=expected):
        open_observations(folder)


def test_no_folder_and_an_empty_one_are_named(tmp_path):
    with pytest.raises(JaxmapError, match="no such observations"):
        open_observations(tmp_path / "none.zarr")
    (tmp_path / "empty.zarr").mkdir()
    with pytest.raises(JaxmapError, match="there is no file"):
        open_observations(tmp_path / "empty.zarr")
    write_attributes(tmp_path / "empty.zarr", ATTRIBUTES)
    with pytest.raises(JaxmapError, match="no frame was perceived"):
        open_observations(tmp_path / "empty.zarr")


def test_a_full_disk_leaves_no_half_of_a_frame(folder, monkeypatch):
    def full(path: Path) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(store, "sync", full)
    with pytest.raises(JaxmapError, match="disk full"):
        write_observation(folder, seen(3, np.random.default_rng(3)), "logits")
    assert sorted(path.name for path in folder.iterdir()) == ["f0", "f1", "f2", "zarr.json"]


def test_what_a_killed_process_left_is_no_frame_and_is_removed(folder):
    dead, alive = folder / ".f3.tmp-1-99999999", folder / f".f4.tmp-1-{os.getpid()}"
    for path in (dead, alive):
        shutil.copytree(folder / "f0", path)
    assert len(open_observations(folder).frames) == 3 and not is_observed(folder, "f3")
    remove_stray_frames(folder)
    assert not dead.exists() and alive.exists()

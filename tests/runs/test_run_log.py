"""The log of a run: it tells medians and totals, survives JSON, and does not grow with the frames."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxmap.errors import JaxmapError
from jaxmap.runs.log import MOST_KEPT, RunLog, Sample

numbers = st.lists(st.floats(0, 1e6, allow_nan=False), max_size=60)


def sample_of(values) -> Sample:
    sample = Sample()
    for value in values:
        sample.add(float(value))
    return sample


@given(numbers)
def test_of_few_numbers_all_are_kept(values):
    sample = sample_of(values)
    assert sample.kept == values
    assert (sample.count, sample.stride) == (len(values), 1)
    assert sample.total == pytest.approx(sum(values))


@given(st.integers(0, 6 * MOST_KEPT))
def test_of_many_every_so_many_th_is_kept_evenly(count):
    sample = sample_of(range(count))
    assert len(sample.kept) <= MOST_KEPT
    assert sample.kept == list(range(0, count, sample.stride))
    assert sample.count == count
    # Never thinner than it must be.
    assert sample.stride == 1 or len(sample.kept) * 2 >= MOST_KEPT


def test_percentiles_of_a_long_run_are_those_of_all_its_numbers():
    values = np.random.default_rng(0).gamma(2.0, 30.0, 10 * MOST_KEPT)
    sample = sample_of(values)
    for percent in (50, 95):
        assert sample.percentile(percent) == pytest.approx(np.percentile(values, percent), rel=0.05)


def long_log(frames: int) -> RunLog:
    log = RunLog(next_index=frames, fused=frames, complete=True)
    for name in ("read", "rectify", "match", "wait", "step"):
        log.stages_ms[name] = sample_of(range(frames))
    return log


def test_the_log_does_not_grow_with_the_frames():
    sizes = [len(json.dumps(long_log(frames).as_json())) for frames in (4 * MOST_KEPT, 32 * MOST_KEPT)]
    assert sizes[1] < 1.5 * sizes[0]


@given(st.integers(0, 40))
def test_a_log_goes_through_json_and_back(frames):
    log = long_log(frames)
    log.skipped.append({"frame": "f", "reason": "none"})
    assert RunLog.from_json(json.loads(json.dumps(log.as_json())), "here") == log


@pytest.mark.parametrize(
    "damage",
    [
        {"next_index": "two"},
        {"fused": ["f000"]},
        {"stages_ms": {"read": [1.0, 2.0]}},
        {"stages_ms": {"read": {"kept": "no"}}},
        {"valid_fractions": None},
        {"skipped": {"f": 1}},
        {"pages": 3},
    ],
)
def test_a_damaged_log_is_told(damage):
    with pytest.raises(JaxmapError, match=r"map\.zarr.*--overwrite"):
        RunLog.from_json(damage, "map.zarr")

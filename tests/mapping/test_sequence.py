"""Reading ahead: in order, bounded, with errors passed on and threads ended; and runs equal plain loops."""

from __future__ import annotations

import gc
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from fixtures import FRAMES, scene_copy, scene_folder, shared_cache  # noqa: F401
from hypothesis import given
from hypothesis import strategies as st
from planned_runs import planned
from scenes import scene_frame

from jaxmap.datasets.base import StereoPair
from jaxmap.errors import FrameError, JaxmapError
from jaxmap.host.prefetch import prefetch
from jaxmap.mapping.sequence import prepare_frames, run_sequence


def own_threads() -> list[threading.Thread]:
    """The threads that are left; nobody waits for them, so they get a moment to end what they are at."""
    for _ in range(200):
        left = [thread for thread in threading.enumerate() if thread.name.startswith("jaxmap")]
        if not left:
            break
        time.sleep(0.01)
    return left


def test_a_generator_closed_in_one_of_its_own_threads_does_not_wait_for_itself():
    suspended, closed = threading.Event(), threading.Event()

    def work(number: int) -> int:
        if number == 1:
            suspended.wait()
            results.close()
            closed.set()
        return number

    results = prefetch(work, range(10), 1, 2)
    assert next(results) == 0
    suspended.set()
    assert closed.wait(5)
    assert own_threads() == []


@pytest.mark.parametrize("workers", [1, 4])
@pytest.mark.parametrize("ahead", [1, 2, 7, 50])
def test_results_come_in_the_order_of_the_items(workers, ahead):
    def slow_at_first(number: int) -> int:
        time.sleep(0.004 * (number % 5 == 0))
        return number * number

    assert list(prefetch(slow_at_first, range(30), workers, ahead)) == [number**2 for number in range(30)]
    assert own_threads() == []


def test_nothing_comes_of_nothing():
    assert list(prefetch(str, [], 2, 4)) == []
    assert own_threads() == []


def test_no_more_than_ahead_items_are_in_the_making():
    begun, taken, most = 0, 0, 0
    lock = threading.Lock()

    def count(number: int) -> int:
        nonlocal begun, most
        with lock:
            begun += 1
            most = max(most, begun - taken)
        return number

    for _ in prefetch(count, range(40), 4, 3):
        time.sleep(0.002)
        with lock:
            taken += 1
    assert begun == taken == 40
    # The result that the consumer holds is one more.
    assert most <= 3 + 1


def test_an_endless_source_is_read_no_further_than_needed():
    read = 0

    def source():
        nonlocal read
        while True:
            read += 1
            yield read

    results = prefetch(lambda number: number, source(), 2, 4)
    assert [next(results) for _ in range(5)] == [1, 2, 3, 4, 5]
    assert read <= 5 + 4
    results.close()
    assert own_threads() == []


@given(
    count=st.integers(0, 25),
    workers=st.integers(1, 4),
    ahead=st.integers(1, 8),
    stop=st.none() | st.integers(0, 25),
    failing=st.none() | st.integers(0, 25),
    seed=st.integers(0, 2**16),
)
def test_whatever_the_delays_order_bound_and_end_hold(count, workers, ahead, stop, failing, seed):
    """A slow consumer holds the work back, an early end leaves no thread, a fault comes in its item's place."""
    pause_s = np.random.default_rng(seed).choice([0.0, 0.0, 0.001], (2, 26))
    begun, taken, most, lock = 0, 0, 0, threading.Lock()

    def work(number: int) -> int:
        nonlocal begun, most
        with lock:
            begun += 1
            most = max(most, begun - taken)
        time.sleep(pause_s[0, number])
        if number == failing:
            raise ValueError(number)
        return number

    results, got, failed = prefetch(work, range(count), workers, ahead), [], False
    try:
        for number in results:
            got.append(number)
            time.sleep(pause_s[1, number])
            with lock:
                taken += 1
            if number == stop:
                break
    except ValueError:
        failed = True
    results.close()
    ends = [end for end in (count, failing, None if stop is None else stop + 1) if end is not None]
    assert got == list(range(min(ends)))
    assert failed == (failing is not None and failing < count and failing == min(ends))
    # The result that the consumer holds is one more.
    assert most <= ahead + 1
    assert own_threads() == []


def test_the_first_items_are_begun_before_one_is_asked_for():
    begun = threading.Semaphore(0)
    results = prefetch(lambda number: begun.release(), range(10), 2, 3)
    for _ in range(3):
        assert begun.acquire(timeout=5)
    assert not begun.acquire(timeout=0.05)
    results.close()


def test_a_generator_that_nobody_asks_leaves_no_threads():
    prefetch(str, range(10), 2, 4)
    gc.collect()
    assert own_threads() == []


def test_work_runs_ahead_of_the_consumer():
    done = threading.Semaphore(0)

    def work(number: int) -> int:
        done.release()
        return number

    results = prefetch(work, range(10), 2, 4)
    next(results)
    # Items that nobody has asked for yet are made while the consumer is busy.
    for _ in range(4):
        assert done.acquire(timeout=5)
    results.close()


def test_an_exception_comes_where_its_item_stood():
    def work(number: int) -> int:
        if number == 5:
            raise ValueError("five")
        return number

    taken = []
    with pytest.raises(ValueError, match="five"):
        for result in prefetch(work, range(20), 3, 4):
            taken.append(result)
    assert taken == [0, 1, 2, 3, 4]
    assert own_threads() == []


def test_a_consumer_that_stops_leaves_no_threads():
    started = []

    def work(number: int) -> int:
        started.append(number)
        time.sleep(0.005)
        return number

    for result in prefetch(work, range(1000), 3, 6):
        if result == 3:
            break
    del result
    deadline_s = time.monotonic() + 5
    while own_threads() and time.monotonic() < deadline_s:
        time.sleep(0.01)
    assert own_threads() == []
    assert len(started) <= 4 + 6


@pytest.mark.slow
def test_a_sequence_equals_a_plain_loop_of_steps(scene_folder):
    plan = planned(scene_folder)
    for result, fused in run_sequence(
        plan.mapper, plan.mapper.init(), prepare_frames(plan.sequence, plan.front_end), plan.params, plan.key
    ):
        assert fused.info is not None
    mapped = np.asarray(result.log_odds)
    looped = plan.mapper.init()
    for prepared in [*prepare_frames(plan.sequence, plan.front_end, workers=1, ahead=1)]:
        looped, _ = plan.mapper.step(looped, prepared.frame, plan.params, plan.key)
    np.testing.assert_array_equal(mapped, np.asarray(looped.log_odds))
    assert int(looped.frames_fused) == FRAMES
    assert plan.mapper.compilations() == 1


def test_the_same_key_gives_the_same_map_however_many_threads_read(scene_folder):
    plan = planned(scene_folder, stop=4)
    maps = []
    for workers, ahead in ((1, 1), (4, 8)):
        frames = prepare_frames(plan.sequence, plan.front_end, workers=workers, ahead=ahead)
        for result, _ in run_sequence(plan.mapper, plan.mapper.init(), frames, plan.params, plan.key):
            pass
        maps.append(np.asarray(result.log_odds))
    np.testing.assert_array_equal(*maps)


def test_frames_carry_their_truth_times_and_index(scene_folder):
    plan = planned(scene_folder)
    prepared = list(prepare_frames(plan.sequence, plan.front_end, indices=range(2, FRAMES)))
    assert [frame.index for frame in prepared] == [2, 3, 4, 5]
    for frame in prepared:
        np.testing.assert_array_equal(frame.rectified.left, scene_frame(frame.index).left)
        assert set(frame.stages_s) == {"read", "rectify", "match"}
        assert min(frame.stages_s.values()) >= 0


def test_an_unusable_frame_is_yielded_with_its_reason(scene_copy):
    (scene_copy / "right" / "f001.png").unlink()
    plan = planned(scene_copy)
    prepared = list(prepare_frames(plan.sequence, plan.front_end))
    assert [frame.fault is None for frame in prepared] == [True, False, True, True, True, True]
    assert isinstance(prepared[1].fault, FrameError)
    before = plan.mapper.init()
    results = run_sequence(plan.mapper, before, prepared[1:2], plan.params, plan.key)
    voxel_map, fused = next(results)
    assert voxel_map is before
    assert fused.info is None
    with pytest.raises(FrameError, match=r"f001\.png"):
        list(run_sequence(plan.mapper, before, prepared, plan.params, plan.key, strict=True))


def test_a_fault_that_is_not_of_one_frame_stops_the_run(scene_folder):
    plan = planned(scene_folder)

    def broken(ref) -> StereoPair:
        raise JaxmapError("the disk is gone")

    sequence = replace(plan.sequence, read_pair=broken)
    with pytest.raises(JaxmapError, match="the disk is gone"):
        list(prepare_frames(sequence, plan.front_end))
    assert own_threads() == []


def test_memory_does_not_grow_with_the_sequence(scene_folder):
    """At no time do more frames live than are read ahead, however long the sequence is."""
    plan = planned(scene_folder)
    sequence = replace(
        plan.sequence, frames=plan.sequence.frames * 5, T_world_camera=np.tile(plan.sequence.T_world_camera, (5, 1, 1))
    )
    living, most = 0, 0
    lock = threading.Lock()

    class Image(np.ndarray):
        def __del__(self) -> None:
            nonlocal living
            if self.base is None:
                with lock:
                    living -= 1

    read = plan.sequence.read_pair

    def counted(ref) -> StereoPair:
        nonlocal living, most
        pair = read(ref)
        left = Image(pair.left.shape, np.uint8)
        left[...] = pair.left
        with lock:
            living += 1
            most = max(most, living)
        return StereoPair(left, pair.right)

    frames = prepare_frames(replace(sequence, read_pair=counted), plan.front_end, workers=2, ahead=4)
    count = 0
    for _, fused in run_sequence(plan.mapper, plan.mapper.init(), frames, plan.params, plan.key):
        count += fused.info is not None
    assert count == 30
    # Read ahead, plus the one being fused and the one just taken.
    assert most <= 4 + 2

"""A profile of a run: every stage of the step is named in its program, traced, and reported in metrics.json."""

from __future__ import annotations

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest
from fixtures import cli, map_words, scene_folder, shared_cache  # noqa: F401
from jax.profiler import ProfileData
from planned_runs import planned

from jaxmap.errors import JaxmapError
from jaxmap.mapping.sequence import prepare_frames
from jaxmap.mapping.step import compile_step
from jaxmap.native.build import FUSE_TARGET, has_kernel
from jaxmap.profiling.program import OTHER, STAGES, Operation, read_program
from jaxmap.profiling.step_profile import (
    TRACED_FRAMES,
    WARM_UP_FRAMES,
    Peaks,
    StepProfile,
    read_operation_times,
    stage_table,
    table_lines,
)


def event_names(folder: Path) -> set[str]:
    (trace,) = folder.glob("plugins/profile/*/*.xplane.pb")
    planes = ProfileData.from_file(str(trace)).planes
    return {event.name for plane in planes for line in plane.lines for event in line.events}


def test_a_trace_shows_the_stages_of_the_host(scene_folder, tmp_path):
    plan = planned(scene_folder, stop=2, labeller="files", labels=scene_folder / "labels")
    with jax.profiler.trace(str(tmp_path)):
        list(prepare_frames(plan.sequence, plan.front_end, plan.label_folder))
    assert event_names(tmp_path) >= {"read", "rectify", "match", "labels"}


POINTS = ("project", "transform")
FUSION = (*POINTS, "carve", "count_points", "frame_evidence", "add_evidence")


@pytest.mark.parametrize(
    ("settings", "stages"),
    [
        ({}, (*FUSION, "mlesac")),
        pytest.param(
            {"ensemble": {"members": 2}},
            (*FUSION, "mlesac", "fuse_members"),
            marks=pytest.mark.slow,
        ),
        pytest.param({"labeller": "deeplab"}, (*FUSION, "network", "pixel_labels"), marks=pytest.mark.slow),
    ],
)
def test_every_stage_is_named_in_the_compiled_step(scene_folder, settings, stages, monkeypatch):
    monkeypatch.setenv("JAXMAP_NATIVE", "0")
    check_stages(scene_folder, settings, stages)


@pytest.mark.skipif(not has_kernel(FUSE_TARGET), reason="no C++ compiler makes the kernel")
@pytest.mark.slow
def test_the_kernel_is_one_stage(scene_folder):
    check_stages(scene_folder, {}, (*POINTS, "fuse", "mlesac", "plane_labels"))


def check_stages(scene_folder, settings, stages) -> None:
    plan = planned(scene_folder, **settings)
    _, cost = compile_step(plan.mapper, plan.mapper.init(), plan.frame_form, plan.params, plan.key)
    named = {operation.stage for operation in read_program(cost.program()).values()}
    assert named >= set(stages)
    assert named <= {*STAGES, OTHER}


def test_a_trace_of_steps_is_summed_by_stages(tmp_path, monkeypatch):
    monkeypatch.setattr("jaxmap.profiling.step_profile.measure_peaks", lambda: PEAKS)

    def step(values):
        with jax.named_scope("carve"):
            values = jnp.sin(values @ values)
        with jax.named_scope("mlesac"):
            return jnp.cumsum(jnp.sort(values), axis=0)

    compiled = jax.jit(step).lower(jnp.ones((200, 200))).compile()
    profile, values = StepProfile(tmp_path), jnp.ones((200, 200))
    for _ in range(WARM_UP_FRAMES + TRACED_FRAMES + 2):
        values = compiled(values).block_until_ready()
        profile.step_done()
    summary = profile.summary(compiled.as_text)
    assert summary is not None
    assert summary["frames"] == TRACED_FRAMES
    assert set(summary["stages"]) >= {"carve", "mlesac"}
    assert sum(row["share"] for row in summary["stages"].values()) == pytest.approx(1, abs=0.01)
    assert all(row["median_ms"] > 0 for row in summary["stages"].values())


@pytest.mark.slow
def test_a_profiled_run_reports_where_its_steps_went(cli, scene_folder, tmp_path, monkeypatch):
    monkeypatch.setenv("JAXMAP_NATIVE", "0")
    run = tmp_path / "run"
    outcome = cli(*map_words(scene_folder, run, "--profile"))
    assert outcome.status == 0
    assert "profile/" in outcome.out
    assert "add_evidence" in outcome.err and "GFLOP/s" in outcome.err
    profile = json.loads((run / "metrics.json").read_text())["profile"]
    # Six frames, of which the first three warm up.
    assert profile["frames"] == 3
    assert set(profile["stages"]) >= {"mlesac", "carve", "count_points", "add_evidence"}
    assert sum(row["share"] for row in profile["stages"].values()) == pytest.approx(1, abs=0.01)
    assert all(row["median_ms"] > 0 for row in profile["stages"].values())
    assert profile["copy_gb_per_s"] > 0 and profile["matmul_gflop_per_s"] > 0
    assert event_names(run / "profile") >= {"step", "wait"}

    # Too few frames cost the profile and not the run; that of the earlier run is removed.
    outcome = cli(*map_words(scene_folder, run, "--overwrite", "--profile", "--stop", "2"))
    assert outcome.status == 0
    assert "2 frames are too few for a profile" in outcome.err
    assert "profile" not in json.loads((run / "metrics.json").read_text())
    assert not (run / "profile").exists()


def test_without_a_folder_nothing_is_recorded():
    profile = StepProfile(None)
    for _ in range(20):
        profile.step_done()
    profile.close()
    assert profile.summary(lambda: "HloModule jit_step") is None


def test_a_missing_trace_is_an_error(tmp_path):
    with pytest.raises(JaxmapError, match="no trace was written"):
        read_operation_times(tmp_path, "jit_step")


PEAKS = Peaks(bytes_per_s=10e9, flops_per_s=100e9)
OPERATIONS = {
    "copy": Operation("carve", 0.0, 8e6),
    "dot": Operation("network", 90e6, 1e6),
    "tick": Operation("mlesac", 10.0, 40.0),
}
RUNS = [{"copy": [1e-3], "dot": [1e-3], "tick": [1e-5] * 3, "unknown": [5.0]}] * 2 + [{"copy": [9.0], "dot": [9.0]}]


def test_the_table_is_as_computed_by_hand():
    table = stage_table(OPERATIONS, RUNS, PEAKS)
    assert list(table) == ["mlesac", "network", "carve"]
    assert table["carve"]["gb_per_s"] == 8.0
    assert table["network"]["gflop_per_s"] == 90.0
    assert table["mlesac"]["operations"] == 3
    assert table["mlesac"]["median_ms"] == 0.03
    assert [table[stage]["bound"] for stage in table] == ["overhead", "arithmetic", "memory"]
    assert table["carve"]["share"] == pytest.approx(1 / 2.03, abs=1e-4)


def test_no_run_is_no_table():
    assert stage_table(OPERATIONS, [], PEAKS) == {}


def test_the_table_as_text_has_a_line_for_each_stage():
    summary = {"stages": stage_table(OPERATIONS, RUNS, PEAKS), "frames": 3, "device": "cpu"}
    lines = table_lines({**summary, "copy_gb_per_s": 10.0, "matmul_gflop_per_s": 100.0})
    assert [line.split()[0] for line in lines[1:4]] == ["mlesac", "network", "carve"]
    assert "10.0 GB/s" in lines[-1]

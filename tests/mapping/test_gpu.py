"""The same step on a GPU: what comes out is that of the CPU, within what another order of sums changes."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np
import pytest
from fixtures import scene_folder, shared_cache  # noqa: F401
from planned_runs import planned

from jaxmap.mapping.sequence import prepare_frames
from jaxmap.mapping.step import StepReport
from jaxmap.runs.mapping_plan import Plan
from jaxmap.types import Plane

SETTINGS: list[dict[str, Any]] = [
    {"labeller": "none"},
    {"labeller": "plane"},
    {"labeller": "deeplab"},
    {"labeller": "plane", "ensemble": {"members": 2}},
]


@pytest.fixture(scope="module")
def gpu() -> jax.Device:
    """The first GPU; skips where there is none."""
    try:
        return jax.devices("gpu")[0]
    except RuntimeError as error:
        pytest.skip(f"JAX sees no GPU here ({error})")


def mapped(plan: Plan, device: jax.Device) -> tuple[np.ndarray, StepReport]:
    """The map of the whole sequence, made on a device, and what its last step did."""
    frames = prepare_frames(
        plan.sequence, plan.front_end, needs=plan.labeller.needs, pose_errors=plan.pose_errors, workers=1
    )
    voxel_map, params, key = jax.device_put((plan.mapper.init(), plan.params, plan.key), device)
    info = None
    for prepared in frames:
        voxel_map, info = plan.mapper.step(voxel_map, jax.device_put(prepared.frame, device), params, key)
        assert voxel_map.log_odds.devices() == {device}
    assert info is not None
    return np.asarray(voxel_map.log_odds), info


def assert_same_map(one: tuple[np.ndarray, StepReport], other: tuple[np.ndarray, StepReport]) -> None:
    """Equal but for points so near to the face of a voxel that rounding decides."""
    apart = np.abs(one[0] - other[0]).max(axis=0) > 0.02
    assert (one[0] != 0).any()
    assert apart.mean() < 2e-3
    for name in ("points_valid", "points_in_range", "points_kept", "voxels_hit", "voxels_freed"):
        np.testing.assert_allclose(getattr(one[1], name), getattr(other[1], name), rtol=5e-3, err_msg=name)
    if isinstance(one[1].estimate, Plane):
        np.testing.assert_allclose(one[1].estimate.normal, other[1].estimate.normal, atol=5e-3)
        np.testing.assert_allclose(one[1].estimate.offset_m, other[1].estimate.offset_m, atol=5e-3)


@pytest.mark.parametrize("settings", SETTINGS, ids=lambda one: "-".join(map(str, one)) + "-" + one["labeller"])
def test_a_gpu_makes_the_map_of_the_cpu(gpu, scene_folder, settings):
    plan = planned(scene_folder, stop=3, **settings)
    assert_same_map(mapped(plan, gpu), mapped(plan, jax.devices("cpu")[0]))


@pytest.mark.slow
def test_the_comparison_tells_maps_apart(scene_folder):
    """Where there is no GPU: equal maps pass, and another one does not."""
    cpu = jax.devices("cpu")[0]
    plan = planned(scene_folder, stop=2)
    whole = mapped(plan, cpu)
    assert_same_map(whole, mapped(plan, cpu))
    with pytest.raises(AssertionError):
        assert_same_map(whole, mapped(planned(scene_folder, stop=1), cpu))


@pytest.mark.slow
@pytest.mark.parametrize("settings", SETTINGS, ids=lambda one: "-".join(map(str, one)) + "-" + one["labeller"])
def test_the_step_can_be_lowered_for_a_gpu(scene_folder, settings):
    """No operation of it is for CPUs alone: JAX has a lowering of each for CUDA."""
    plan = planned(scene_folder, stop=1, **settings)
    traced = jax.jit(plan.mapper.fuse).trace(plan.mapper.init(), plan.frame_form, plan.params, plan.key)
    text = traced.lower(lowering_platforms=("cuda",)).as_text()
    assert "callback" not in text
    assert "f64" not in text

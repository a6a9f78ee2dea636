"""Start-up: what is imported, what is compiled, and that a second start compiles nothing."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import jax
import numpy as np
import pytest
from fixtures import map_words, scene_folder, shared_cache  # noqa: F401
from networks import SMALL
from planned_runs import planned

import jaxmap
from jaxmap.fusion.params import make_fusion_params
from jaxmap.mapping.sequence import frame_form, prepare_frames
from jaxmap.models.network import fold_batch_norm, initial_weights
from jaxmap.types import make_grid, make_stereo_camera, to_device

COUNTING = """
import json, sys
import jax
from jaxmap.commands.main import main

misses = []


def hear(event, **_):
    if event.endswith("cache_misses"):
        misses.append(event)


jax.monitoring.register_event_listener(hear)
status = main(sys.argv[1:])
print(json.dumps({"status": status, "misses": len(misses)}))
"""


@contextmanager
def compiled_programs() -> Iterator[list[str]]:
    """Records each program that is compiled within."""
    heard: list[str] = []
    listening = True

    def hear(event: str, duration_s: float, **_: object) -> None:
        if listening and event.endswith("backend_compile_duration"):
            heard.append(event)

    # JAX cannot remove a listener: this one stops listening.
    jax.monitoring.register_event_duration_secs_listener(hear)
    try:
        yield heard
    finally:
        listening = False


def test_the_listener_hears():
    with compiled_programs() as heard:
        jax.jit(lambda x: x + 17)(np.zeros(17)).block_until_ready()
    assert heard


STARTING = """
import os, sys
from jaxmap.commands.main import main

def loaded(*names):
    return [name for name in names if name in sys.modules]

for words in (["--help"], ["--version"]):
    assert main(words) == 0
print(loaded("numpy", "jax", "tyro", "pydantic", "rich", "yaml"))
for words in (["map", "--help"], ["export", "--help"], ["refine", "--help"]):
    try:
        main(words)
    except SystemExit as stop:
        assert not stop.code
print(loaded("jax", "cv2", "zarr", "rasterio", "matplotlib"), flush=True)

read, write = os.pipe(); os.close(read); os.dup2(write, 1)
assert main(["weights", "--help"]) == 1, "nobody reads the output"
"""


def test_help_imports_nothing_heavy_and_a_closed_pipe_is_no_fault():
    """The overview and the version do without NumPy, help of a command without JAX and OpenCV."""
    environment = {**os.environ, "PYTHONPATH": str(Path(jaxmap.__file__).parents[1])}
    done = subprocess.run(
        [sys.executable, "-c", STARTING], capture_output=True, text=True, env=environment, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert [line for line in done.stdout.splitlines() if line.startswith("[")] == ["[]", "[]"]


def test_numbers_reach_the_device_without_a_program():
    """Of whatever shape they are; and networks are folded on the host."""
    weights = {name: np.asarray(value) for name, value in initial_weights(SMALL, jax.random.key(0)).items()}
    with compiled_programs() as heard:
        to_device(np.ones((2, 3, 5, 7)), np.float32)
        make_stereo_camera(fx_px=31, cx_px=15, cy_px=11, baseline_m=0.2, width_px=33, height_px=21)
        make_grid([0, 0, 0], [1, 2, 3], 0.1)
        make_fusion_params([f"class {index}" for index in range(11)])
        fold_batch_norm(SMALL, weights)
    assert heard == []


@pytest.mark.parametrize("dtype", [np.float32, np.int32, np.uint8, None])
def test_numbers_on_the_device_are_those_of_the_host(dtype):
    values = np.arange(12.0).reshape(3, 4)
    array = to_device(values, dtype)
    assert isinstance(array, jax.Array)
    assert array.dtype == (np.float32 if dtype is None else dtype)
    np.testing.assert_array_equal(array, values)


@pytest.mark.parametrize("settings", [{}, {"ensemble": {"members": 2}}, {"labeller": "none"}, {"labeller": "deeplab"}])
def test_the_form_of_frames_is_that_of_the_frames(scene_folder, settings):
    """Otherwise the step would be compiled for frames that never come."""
    plan = planned(scene_folder, stop=1, **settings)
    (prepared,) = prepare_frames(plan.sequence, plan.front_end, needs=plan.labeller.needs, pose_errors=plan.pose_errors)
    form = frame_form(plan.front_end.camera, plan.labeller, plan.members)
    assert jax.tree.structure(form) == jax.tree.structure(prepared.frame)
    for leaf, array in zip(jax.tree.leaves(form), jax.tree.leaves(prepared.frame), strict=True):
        assert (leaf.shape, leaf.dtype) == (array.shape, array.dtype)


@pytest.mark.parametrize("soft", [False, True])
def test_the_form_of_frames_with_labels_from_files(scene_folder, tmp_path, soft):
    if soft:
        np.save(tmp_path / "f000.npy", np.full((120, 160, 3), 1 / 3, np.float32))
    plan = planned(scene_folder, stop=1, labeller="files", labels=tmp_path if soft else scene_folder / "labels")
    (prepared,) = prepare_frames(plan.sequence, plan.front_end, plan.label_folder)
    form = frame_form(plan.front_end.camera, plan.labeller)
    assert jax.tree.structure(form) == jax.tree.structure(prepared.frame)
    for leaf, array in zip(jax.tree.leaves(form), jax.tree.leaves(prepared.frame), strict=True):
        assert (leaf.shape, leaf.dtype) == (array.shape, array.dtype)


@pytest.mark.slow
@pytest.mark.parametrize("labeller", ["plane", "deeplab"])
def test_a_second_start_of_the_same_kind_compiles_nothing(scene_folder, tmp_path, labeller):
    """Neither for the step nor for anything before and after it."""
    cache = tmp_path / "cache"

    def start(out: str) -> tuple[int, set[str]]:
        words = map_words(scene_folder, tmp_path / out, "--labeller", labeller, "--stop", "2")
        environment = {**os.environ, "JAXMAP_CACHE": str(cache), "PYTHONPATH": str(Path(jaxmap.__file__).parents[1])}
        done = subprocess.run(
            [sys.executable, "-c", COUNTING, *words], capture_output=True, text=True, env=environment, check=True
        )
        result = json.loads(done.stdout.splitlines()[-1])
        assert result["status"] == 0, done.stderr
        return result["misses"], {path.name for path in (cache / "compiled").iterdir() if path.name.endswith("-cache")}

    first, kept = start("first")
    again, kept_then = start("second")
    assert first > 0
    assert kept
    assert again == 0
    assert kept_then == kept

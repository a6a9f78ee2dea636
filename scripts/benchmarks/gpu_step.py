"""Matching and the whole step, from two images to the map, on the device that JAX has: times, memory, and correctness.

    python scripts/benchmarks/gpu_step.py [--size 1024x768] [--labellers relief,plane,deeplab] [--seconds 240]

On a CUDA device it times the parts of matching by the kernels made for it and by `lax.scan`, and holds the first
against the second, bit for bit; a map is held against the one that the same step makes on the CPU. On a CPU the kernels
are interpreted, so take a small size there: --size 64x48 --disparities 16. Each part stands alone: where
one fails, the others are still printed. Nothing new is begun after --seconds.
"""

from __future__ import annotations

import argparse
import functools
import gzip
import json
import statistics
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from jaxmap.matching.aggregate import aggregate_planes
from jaxmap.matching.aggregate_gpu import winners_gpu
from jaxmap.matching.blobs import drop_blobs
from jaxmap.matching.costs import census, cost_planes, cost_volume
from jaxmap.matching.design import MatchDesign, MatchParams
from jaxmap.matching.match import grey, match, penalties
from jaxmap.matching.rectify import rectify_pair
from jaxmap.matching.select import Winners, decide, winners
from jaxmap.runs.config import check_config
from jaxmap.runs.mapping_plan import Plan, plan_run
from jaxmap.stereo.rectify import make_raw_pair, make_rectifier, make_stereo_rig

SAMPLE = "sample:traverse"
RUNS, WARM_UP = 30, 3
ON_CPU = jax.default_backend() == "cpu"


class Table:
    """Prints lines as they come, and keeps their figures."""

    def __init__(self, seconds: float) -> None:
        self.figures: dict[str, Any] = {}
        self.compiled: dict[str, Callable[..., Any]] = {}
        self.end_s = time.perf_counter() + seconds

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """One part: what goes wrong in it is printed, and the next goes on."""
        started_s = time.perf_counter()
        if started_s > self.end_s:
            raise TimeIsUp(name)
        try:
            yield
        except Exception as error:
            last = traceback.extract_tb(error.__traceback__)[-1]
            text = str(error)
            print(f"!! {name}: {type(error).__name__} at {Path(last.filename).name}:{last.lineno}: ", end="")
            print(text if len(text) < 900 else f"{text[:300]} ... {text[-600:]}", flush=True)
            self.figures[name] = {"error": f"{type(error).__name__}: {text[:500]}"}
        print(f"   ({name}: {time.perf_counter() - started_s:.1f} s)", flush=True)

    def timed(self, name: str, function: Callable[..., Any], *inputs: Any) -> Any:
        """Compiles and times a function; prints and returns its result."""
        started_s = time.perf_counter()
        compiled = jax.jit(function).lower(*inputs).compile()
        compile_s = time.perf_counter() - started_s
        self.compiled[name] = compiled
        result = jax.block_until_ready(compiled(*inputs))
        times_s = []
        runs = RUNS + WARM_UP
        while len(times_s) < runs:
            started_s = time.perf_counter()
            jax.block_until_ready(compiled(*inputs))
            times_s.append(time.perf_counter() - started_s)
            if sum(times_s) > 5:
                break
        temporary = getattr(compiled.memory_analysis(), "temp_size_in_bytes", 0)
        self.put(name, times_s[WARM_UP:] or times_s, compile_s, temporary)
        return result

    def put(self, name: str, times_s: list[float], compile_s: float, temporary_bytes: int = 0) -> None:
        """A line of times."""
        median_ms = 1e3 * statistics.median(times_s)
        least_ms = 1e3 * min(times_s)
        self.figures[name] = {"median_ms": round(median_ms, 4), "least_ms": round(least_ms, 4)}
        print(
            f"{name:44s} {median_ms:10.3f} ms (least {least_ms:.3f})  {1e3 / median_ms:8.1f} /s  "
            f"temporary {temporary_bytes / 2**20:7.0f} MiB  compiled in {compile_s:.1f} s",
            flush=True,
        )

    def equal(self, name: str, ours: Any, expected: Any) -> None:
        """Prints the share of equal numbers, NaN and NaN too."""
        ours, expected = np.asarray(ours), np.asarray(expected)
        share = float(((ours == expected) | ((ours != ours) & (expected != expected))).mean())
        self.figures[f"{name}: equal"] = share
        print(f"   {name}: {'equal' if share == 1 else f'NOT EQUAL, {share:.6f} of the numbers are'}", flush=True)


class TimeIsUp(Exception):
    """No part is begun any more."""


def pair_of(plan: Plan, size_px: tuple[int, int]) -> tuple[jax.Array, jax.Array]:
    """The grey images of the plan's first frame, at that size."""
    frame = next(one.frame for one in plan.prepare() if one.frame is not None)
    sides = (np.asarray(grey(jnp.asarray(image))) for image in (frame.image, frame.right_image))
    left, right = (jnp.asarray(cv2.resize(image, size_px, interpolation=cv2.INTER_AREA)) for image in sides)
    return left, right


def matching(table: Table, design: MatchDesign, params: MatchParams, left: jax.Array, right: jax.Array) -> None:
    """The parts of matching, by kernels and by scans."""
    p1, p2 = penalties(design, params)
    volume = by_paths = None
    with table.part("costs"):
        table.timed("census of both", lambda *pair: [census(one, design.census_window_px) for one in pair], left, right)
        at_once = functools.partial(cost_volume, design, params=params, at_once=True)
        volume = table.timed("costs, all at once", at_once, left, right)
    with table.part("winners by kernels"):
        kernels: Callable[..., Winners] = lambda volume, p1, p2: winners_gpu(  # noqa: E731
            volume, p1, p2, design.paths, interpret=ON_CPU
        )
        by_paths = table.timed("winners by kernels", kernels, volume, p1, p2)
    with table.part("speckles"):
        assert by_paths is not None
        found = table.timed("decide", lambda won: decide(design, won, params), by_paths)
        without = replace(design, speckle_window_px=0)
        plain = table.timed("decide without speckles", lambda won: decide(without, won, params), by_paths)
        table.timed("speckles", lambda image: drop_blobs(image, 2.0, 983), plain)
        known, before = (float(jnp.isfinite(image).mean()) for image in (found, plain))
        print(f"   known: {known:.3f}, with speckles {before:.3f}")
    with table.part("match"):
        table.timed("match", lambda left, right: match(design, left, right, params), left, right)
        print_hot_spots(lambda: table.compiled["match"](left, right))
    with table.part("match against the CPU's"):
        inputs = jax.device_put((left, right, params), jax.devices("cpu")[0])
        expected = jax.jit(lambda left, right, params: match(design, left, right, params))(*inputs)
        table.equal("disparity", table.compiled["match"](left, right), expected)


def by_scan(table: Table, design: MatchDesign, params: MatchParams, left: jax.Array, right: jax.Array) -> None:
    """Costs and winners as other devices have them, and whether the kernels find the same."""
    p1, p2 = penalties(design, params)
    in_turn = functools.partial(cost_planes, design, params=params)
    planes = table.timed("costs, in turn", in_turn, left, right)
    scan = lambda planes: aggregate_planes(planes, p1, p2, design.paths, winners)  # noqa: E731
    expected = table.timed("winners by scan", scan, planes)
    volume = table.compiled["costs, all at once"](left, right)
    table.equal("costs", volume, jnp.moveaxis(planes, 0, -1))
    for name, one, other in zip(
        Winners._fields, table.compiled["winners by kernels"](volume, p1, p2), expected, strict=True
    ):
        table.equal(name, one, other)


def rectification(table: Table, left: jax.Array, right: jax.Array) -> None:
    """Of raw images of that size, as if a lens had distorted them."""
    height, width = left.shape
    K = np.array([[0.8 * width, 0, width / 2], [0, 0.8 * width, height / 2], [0, 0, 1]])
    lens = np.array([-0.1, 0.02, 1e-3, -1e-3])
    rig = make_stereo_rig(
        K_left=K,
        distortion_left=lens,
        K_right=K,
        distortion_right=-0.5 * lens,
        R_right_left=cv2.Rodrigues(np.array([0.01, -0.01, 0.02]))[0],
        t_right_left_m=np.array([-0.12, 0.001, -0.001]),
        size_px=(width, height),
    )
    rectifier, pair = make_rectifier(rig), make_raw_pair(rig)
    ours = table.timed("rectify both", lambda *images: rectify_pair(pair, rectifier.camera, *images), left, right)
    for name, image, maps in (("left", left, rectifier.left_maps), ("right", right, rectifier.right_maps)):
        apart = np.abs(getattr(ours, name) - cv2.remap(np.asarray(image), *maps, cv2.INTER_LINEAR))
        seen = np.asarray(getattr(ours, f"{name}_seen"))
        print(
            f"   {name}: {apart[seen].mean():.3f} grey levels from OpenCV's on average, {apart[seen].max():.2f} at most"
        )


def plan_of(labeller: str, settings: dict[str, Any]) -> Plan:
    """A run of the sample whose step matches."""
    stereo = {**settings["stereo"], "matcher": "sgm"}
    config = check_config({**settings, "stereo": stereo, "labeller": labeller})
    return plan_run(SAMPLE, config, lambda line: None, match_in_step=True)


def whole_step(table: Table, labeller: str, settings: dict[str, Any]) -> None:
    """From two images to the map; the frames lie on the device, as the next ones do while a step runs."""
    plan = plan_of(labeller, settings)
    params, key = jax.device_put((plan.params, plan.key))
    frames = [jax.device_put(one.frame) for one in plan.prepare() if one.frame is not None]
    voxel_map, number, report = plan.mapper.init(), 0, None

    def step() -> Any:
        nonlocal voxel_map, number, report
        number += 1
        voxel_map, report = plan.mapper.step(voxel_map, frames[number % len(frames)], params, key)
        return voxel_map.log_odds

    started_s = time.perf_counter()
    jax.block_until_ready(step())
    compile_s, times_s = time.perf_counter() - started_s, []
    while len(times_s) < RUNS + WARM_UP and sum(times_s) < 8:
        started_s = time.perf_counter()
        jax.block_until_ready(step())
        times_s.append(time.perf_counter() - started_s)
    table.put(f"the step, {labeller}", times_s[WARM_UP:] or times_s, compile_s)
    # Without waiting for each, as a run would that reads ahead.
    started_s = time.perf_counter()
    jax.block_until_ready([step() for _ in times_s][-1])
    table.put(f"the step, {labeller}, frames in a row", [(time.perf_counter() - started_s) / len(times_s)], 0)
    assert report is not None
    print(f"   {int(report.points_kept)} points kept, {int(report.voxels_hit)} voxels hit", flush=True)
    print_hot_spots(step)


def against_cpu(table: Table, labeller: str, settings: dict[str, Any]) -> None:
    """The map of one frame, made here and on the CPU; it is equal within what another order of sums changes."""
    plan = plan_of(labeller, settings)
    frame = next(one.frame for one in plan.prepare() if one.frame is not None)
    maps = []
    for device in (jax.devices()[0], jax.devices("cpu")[0]):
        inputs = jax.device_put((plan.mapper.init(), frame, plan.params, plan.key), device)
        maps.append(np.asarray(plan.mapper.step(*inputs)[0].log_odds))
    apart, touched = np.abs(maps[0] - maps[1]).max(axis=0) > 0.02, (maps[1] != 0).any(axis=0)
    print(f"   {apart.sum()} of {touched.sum()} voxels touched differ by more than 0.02 from the CPU's", flush=True)
    table.figures[f"{labeller}: voxels that differ"] = [int(apart.sum()), int(touched.sum())]


def print_hot_spots(run: Callable[[], Any], runs: int = 3, most: int = 12) -> None:
    """The kernels that take most of a run's time on a GPU, and how many there are."""
    if ON_CPU:
        return
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            for _ in range(runs):
                jax.block_until_ready(run())
        traced = next(Path(folder).rglob("*.trace.json.gz"))
        events = json.loads(gzip.decompress(traced.read_bytes()))["traceEvents"]
    streams = {
        (one["pid"], one["tid"])
        for one in events
        if one.get("name") == "thread_name" and str(one["args"].get("name", "")).startswith("Stream")
    }
    time_us: Counter[str] = Counter()
    count: Counter[str] = Counter()
    for one in events:
        if one.get("ph") == "X" and (one["pid"], one["tid"]) in streams:
            about = one.get("args", {})
            scope = str(about.get("tf_op") or about.get("name") or about.get("hlo_op") or "")
            name = f"{one['name'][:48]} | {scope[-72:]}"
            time_us[name] += one["dur"]
            count[name] += 1
    total_ms = sum(time_us.values()) / runs / 1e3
    print(f"   {sum(count.values()) / runs:.0f} kernels and copies, which take {total_ms:.3f} ms; the longest:")
    for name, spent_us in time_us.most_common(most):
        print(f"     {spent_us / runs / 1e3:8.3f} ms in {count[name] / runs:6.1f}: {name}", flush=True)


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", default="1024x768", help="of the images matched; the step's are the sample's")
    parser.add_argument("--disparities", type=int, default=128)
    parser.add_argument("--labellers", default="relief,plane,deeplab")
    parser.add_argument("--seconds", type=float, default=240)
    parser.add_argument("--voxel-size-m", type=float, help="by default the map's, 0.05 x 0.05 x 0.2 m")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    device = jax.devices()[0]
    searched = f"{given.size}, {given.disparities} disparities"
    print(f"{device.device_kind}, jax {jax.__version__}, {searched}, medians of {RUNS} runs")
    table = Table(given.seconds)
    width, height = map(int, given.size.split("x"))
    settings = {
        "stop": 2,
        "grid": {"voxel_size_m": given.voxel_size_m} if given.voxel_size_m else {},
        "stereo": {"num_disparities": given.disparities},
    }
    try:
        plan = plan_of("none", settings)
        design, params = plan.mapper.design.match, plan.params.match
        assert design is not None and params is not None
        pair = pair_of(plan, (width, height))
        matching(table, design, params, *pair)
        labellers = given.labellers.split(",")
        for labeller in labellers:
            with table.part(f"the step, {labeller}"):
                whole_step(table, labeller, settings)
        with table.part("rectification"):
            rectification(table, *pair)
        with table.part("winners by scan"):
            by_scan(table, design, params, *pair)
        if not ON_CPU:
            with table.part("the map against the CPU's"):
                against_cpu(table, labellers[0], settings)
    except TimeIsUp:
        print("the rest is left out")
    memory = device.memory_stats() or {}
    print(f"greatest memory in use: {memory.get('peak_bytes_in_use', 0) / 2**20:.0f} MiB")
    if given.json:
        given.json.write_text(json.dumps({"device": device.device_kind, **table.figures}, indent=2) + "\n")


if __name__ == "__main__":
    main()

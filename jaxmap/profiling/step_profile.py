"""A profile of the step: the time of each stage, from a recorded trace, compared with the peaks of the machine."""

from __future__ import annotations

import statistics
import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.profiler import ProfileData

from jaxmap.errors import JaxmapError
from jaxmap.host.files import write_error
from jaxmap.profiling.program import OTHER, STAGES, Operation, read_program

WARM_UP_FRAMES = 3
"""Frames before the trace begins: the first ones allocate memory and fill caches."""

TRACED_FRAMES = 10

OperationTimes = dict[str, list[float]]
"""Seconds of each execution of an operation, by its name."""

_COPIED = 1 << 25
_EDGE = 2048
_REPEATS = 7


class StepProfile:
    """Records a trace of a few steps of a run, after the first ones.

    Call `step_done` after each step, and `close` when no more come.

    Attributes:
        steps: how many were done; those after the first `WARM_UP_FRAMES` are traced.
    """

    def __init__(self, folder: Path | None) -> None:
        """The trace goes into `folder`, for TensorBoard (XProf) or Perfetto; None records nothing."""
        self._folder = folder
        self.steps, self._recording = 0, False

    def step_done(self) -> None:
        """Counts a step; the trace may begin or end here."""
        self.steps += 1
        if self.steps == WARM_UP_FRAMES and self._folder is not None:
            self._start()
        elif self.steps == WARM_UP_FRAMES + TRACED_FRAMES:
            self.close()

    def close(self) -> None:
        """Ends the trace, if it is still being recorded.

        Raises:
            JaxmapError: the disk is full or refuses.
        """
        if self._recording:
            self._recording = False
            try:
                jax.profiler.stop_trace()
            except OSError as error:
                raise write_error(error, Path(str(self._folder))) from error

    def summary(self, program: Callable[[], str | None] | None) -> dict[str, Any] | None:
        """The stages of the steps (`stage_table`) and the peaks of the machine; None if nothing was traced.

        Args:
            program: returns the text of the step's program, where the backend has one; None where no step was compiled.

        Raises:
            JaxmapError: the trace cannot be read.
        """
        self.close()
        text = program() if program is not None else None
        if self._folder is None or text is None or self.steps <= WARM_UP_FRAMES:
            return None
        peaks = measure_peaks()
        runs = read_operation_times(self._folder, _module_name(text))
        return {
            "frames": len(runs),
            "device": jax.devices()[0].device_kind,
            "copy_gb_per_s": round(peaks.bytes_per_s / 1e9, 2),
            "matmul_gflop_per_s": round(peaks.flops_per_s / 1e9, 1),
            "stages": stage_table(read_program(text), runs, peaks),
        }

    def _start(self) -> None:
        options = jax.profiler.ProfileOptions()
        # Python's own calls would fill most of the trace and take most of the time.
        options.python_tracer_level = 0
        try:
            jax.profiler.start_trace(str(self._folder), profiler_options=options)
        except RuntimeError as error:
            raise JaxmapError(f"no trace can be recorded: {error}", fix="leave --profile out") from error
        self._recording = True


def stage_table(
    operations: Mapping[str, Operation], runs: Sequence[OperationTimes], peaks: Peaks
) -> dict[str, dict[str, Any]]:
    """Each stage's share of the steps, and how close it comes to the peaks of the machine.

    An operation's time is that from its start to its end. Where operations run side by side their times add up to more
    than the step's.

    Args:
        operations: of the program (`read_program`).
        runs: the times of each run of it.
        peaks: of the machine.

    Returns:
        For each stage, in the order of the step: `median_ms` over the runs, `share` of the sum of all, `operations`,
        `mb` and `mflop` a frame, `gb_per_s` and `gflop_per_s` while it runs, and `bound`: `memory` or `arithmetic`,
        the peak that it comes closer to, or `overhead` where it stays below a tenth of both.
    """
    rows: dict[str, dict[str, Any]] = {}
    in_order = [*STAGES, OTHER]
    by_run = [_of_stages(operations, run) for run in runs]
    whole_s = sum(statistics.median(one[stage][0] for one in by_run) for stage in in_order) if runs else 0.0
    for stage in in_order if runs else ():
        time_s, flops, moved, count = (statistics.median(one[stage][part] for one in by_run) for part in range(4))
        if not time_s:
            continue
        of_memory, of_arithmetic = moved / time_s / peaks.bytes_per_s, flops / time_s / peaks.flops_per_s
        nearest = "memory" if of_memory >= of_arithmetic else "arithmetic"
        rows[stage] = {
            "median_ms": round(1e3 * time_s, 3),
            "share": round(time_s / whole_s, 4),
            "operations": int(count),
            "mb": round(moved / 1e6, 2),
            "mflop": round(flops / 1e6, 2),
            "gb_per_s": round(moved / time_s / 1e9, 2),
            "gflop_per_s": round(flops / time_s / 1e9, 2),
            "bound": nearest if max(of_memory, of_arithmetic) >= 0.1 else "overhead",
        }
    return rows


def _of_stages(operations: Mapping[str, Operation], run: OperationTimes) -> Mapping[str, list[float]]:
    """Seconds, flops, bytes and operations of each stage in one run."""
    sums: dict[str, list[float]] = defaultdict(lambda: [0.0, 0.0, 0.0, 0.0])
    for name, times_s in run.items():
        if name in operations:
            stage, flops, moved = operations[name]
            added = (sum(times_s), flops * len(times_s), moved * len(times_s), len(times_s))
            sums[stage] = [one + more for one, more in zip(sums[stage], added, strict=True)]
    return sums


def _module_name(text: str) -> str:
    return text.split(maxsplit=2)[1].rstrip(",")


def table_lines(summary: Mapping[str, Any]) -> list[str]:
    """The table as text."""
    lines = [
        f"{'stage':15s}{'ms':>9s}{'share':>8s}{'ops':>6s}{'MB':>9s}{'MFLOP':>10s}{'GB/s':>8s}{'GFLOP/s':>9s}  bound by"
    ]
    for stage, row in summary["stages"].items():
        lines.append(
            f"{stage:15s}{row['median_ms']:9.3f}{row['share']:8.1%}{row['operations']:6d}{row['mb']:9.1f}"
            f"{row['mflop']:10.1f}{row['gb_per_s']:8.2f}{row['gflop_per_s']:9.2f}  {row['bound']}"
        )
    lines.append(
        f"a copy reaches {summary['copy_gb_per_s']:.1f} GB/s, a product of matrices "
        f"{summary['matmul_gflop_per_s']:.0f} GFLOP/s; {summary['device']}, median of {summary['frames']} frames"
    )
    return lines


class Peaks(NamedTuple):
    """Peak rates of a machine, per second: bytes of a copy, read and written, and operations of a float32 product."""

    bytes_per_s: float
    flops_per_s: float


def measure_peaks() -> Peaks:
    """Negates 128 MiB in place, more than caches hold; multiplies 2048 x 2048 matrices: each the median of seven."""
    # In place: allocating fresh memory takes longer than filling it.
    negate = jax.jit(jnp.negative, donate_argnums=0)
    values, matrix = jnp.ones(_COPIED, jnp.float32), jnp.ones((_EDGE, _EDGE), jnp.float32)
    copied_s = _median_s(negate, values, over=True)
    product = jax.jit(lambda one: jnp.dot(one, one, precision=jax.lax.Precision.HIGHEST))
    return Peaks(8 * _COPIED / copied_s, 2 * _EDGE**3 / _median_s(product, matrix, over=False))


def _median_s(function: Callable[[jax.Array], jax.Array], argument: jax.Array, *, over: bool) -> float:
    """How long a function takes; `over`: each call takes the result of the one before."""
    result = function(argument).block_until_ready()
    times_s = []
    for _ in range(_REPEATS):
        started_s = time.perf_counter()
        result = function(result if over else argument).block_until_ready()
        times_s.append(time.perf_counter() - started_s)
    return statistics.median(times_s)


def read_operation_times(folder: Path, module: str) -> list[OperationTimes]:
    """The times of a program's operations in a trace, one entry for each run of the program, in order.

    Args:
        folder: where `jax.profiler` has written a trace.
        module: the program's name, such as `jit_step`.

    Raises:
        JaxmapError: there is no trace.
    """
    files = sorted(folder.glob("plugins/profile/*/*.xplane.pb"))
    if not files:
        raise JaxmapError("no trace was written", where=folder, fix="give a folder that can be written to")
    planes = list(ProfileData.from_file(str(files[-1])).planes)
    # An accelerator has planes of its own; events of the host are then no operations.
    planes = [plane for plane in planes if plane.name.startswith("/device:")] or planes
    runs: dict[Any, OperationTimes] = defaultdict(lambda: defaultdict(list))
    for plane in planes:
        for line in plane.lines:
            for event in line.events:
                stats: dict[Any, Any] = dict(event.stats)
                if stats.get("hlo_module") == module and "hlo_op" in stats:
                    runs[stats.get("run_id")][stats["hlo_op"]].append(event.duration_ns / 1e9)
    return [dict(times) for times in runs.values()]

"""What a recorded trace says of the operations of one program."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Any

from jax.profiler import ProfileData

from jaxmap.errors import JaxmapError

OperationTimes = dict[str, list[float]]
"""Seconds of each time that an operation ran, by its name."""


def read_operation_times(folder: Path, module: str) -> list[OperationTimes]:
    """The times of a program's operations, one entry for each run of the program, in their order.

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
    # An accelerator has planes of its own; what the host does for it then is no operation.
    planes = [plane for plane in planes if plane.name.startswith("/device:")] or planes
    runs: dict[Any, OperationTimes] = defaultdict(lambda: defaultdict(list))
    for plane in planes:
        for line in plane.lines:
            for event in line.events:
                told: dict[Any, Any] = dict(event.stats)
                if told.get("hlo_module") == module and "hlo_op" in told:
                    runs[told.get("run_id")][told["hlo_op"]].append(event.duration_ns / 1e9)
    return [dict(times) for times in runs.values()]

"""Runs the cases one after the other, prints them, and keeps what the JSON and the report hold."""

from __future__ import annotations

import gc
import importlib.metadata
import platform
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax

from benchmarks.gate import Cases, verdicts
from benchmarks.groups import Group, case_name
from benchmarks.harness import measure
from benchmarks.threads import usable_cores
from benchmarks.wording import case_lines
from jaxmap.host.memory import peak_resident_mib

LIBRARIES = (
    *("jax", "numpy", "opencv-python-headless", "scikit-image"),
    *("octomap-python", "open3d", "torch", "onnxruntime", "openvino"),
)


def run_cases(groups: Sequence[Group], sizes: Sequence[str], budget_s: float, baseline: Cases) -> dict[str, Any]:
    """Measures and prints every case; the report of the whole run."""
    results: dict[str, Mapping[str, Any]] = {}
    for group in groups:
        for size in sizes:
            name = case_name(group, size)
            results[name] = {"group": group.name, "size": size, **measure(group.build(size), budget_s)}
            for line in case_lines(name, results[name], verdicts({name: results[name]}, baseline)):
                print(line, flush=True)
            # What a case held is given back before the next is built.
            gc.collect()
    return {
        "machine": machine(),
        "peak_resident_mib": round(peak_resident_mib()),
        "groups": {group.name: group.told for group in groups},
        "cases": results,
    }


def machine() -> dict[str, Any]:
    """What the figures were measured on."""
    return {
        "processor": _processor(),
        "cores": usable_cores(),
        "device": jax.devices()[0].device_kind,
        "python": platform.python_version(),
        "versions": dict(_versions(LIBRARIES)),
    }


def _versions(names: Iterable[str]) -> Iterable[tuple[str, str]]:
    for name in names:
        try:
            yield name, importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue


def _processor() -> str:
    described = Path("/proc/cpuinfo")
    lines = described.read_text().splitlines() if described.exists() else []
    named = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(named, platform.processor() or platform.machine())

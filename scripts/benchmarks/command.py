"""What `scripts/bench.py` does, once its threads are limited: libraries are loaded from here on."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.gate import merged, verdicts
from benchmarks.groups import Group, all_groups
from jaxmap.host.files import atomic_path
from jaxmap.host.output_folder import write_json


def run(arguments: argparse.Namespace, baseline_path: Path) -> int:
    """Measures, prints, writes and judges; the exit status."""
    if arguments.list:
        for group in all_groups():
            print(f"{group.name:14s} {group.told}")
        return 0
    baseline = json.loads(baseline_path.read_text("utf-8")) if baseline_path.exists() else {"cases": {}}
    report = _report(arguments, baseline["cases"])
    found = verdicts(report["cases"], baseline["cases"])
    if arguments.json:
        write_json(arguments.json, report)
    if arguments.report:
        from benchmarks.page import bench_page

        with atomic_path(arguments.report) as temporary:
            temporary.write_text(bench_page(report, found), encoding="utf-8")
    if arguments.write_baseline:
        write_json(baseline_path, {**report, "cases": merged(baseline["cases"], report["cases"])})
    passed = [verdict for verdict in found if verdict.passed]
    print(f"peak resident {report['peak_resident_mib']} MiB; {len(passed)} of {len(found)} gates kept")
    for verdict in found:
        if not verdict.passed:
            print(f"TOO SLOW: {verdict.case} beside {verdict.peer}: {verdict.ratio:.3g}, gate {verdict.bound:.3g}")
    return 0 if len(passed) == len(found) else 1


def _report(arguments: argparse.Namespace, baseline: dict[str, Any]) -> dict[str, Any]:
    if arguments.from_json:
        return json.loads(arguments.from_json.read_text("utf-8"))
    import cv2

    from benchmarks.run import run_cases

    cv2.setNumThreads(arguments.threads)
    return run_cases(chosen(all_groups(), arguments.only), arguments.sizes, arguments.budget_s, baseline)


def chosen(groups: Sequence[Group], names: Sequence[str] | None) -> list[Group]:
    """The groups of these names, in their own order; all if none are named."""
    known = [group.name for group in groups]
    if unknown := [name for name in names or [] if name not in known]:
        sys.exit(f"error: no group {', '.join(unknown)}; there are {', '.join(known)}")
    return [group for group in groups if names is None or group.name in names]

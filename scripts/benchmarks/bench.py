"""Times every stage, the step and whole sequences beside other programs, and prints one table.

    python scripts/benchmarks/bench.py                          all cases at three sizes
    python scripts/benchmarks/bench.py --only fuse mlesac       some groups; --list prints them
    python scripts/benchmarks/bench.py --sizes medium           the sizes that targets are set for
    python scripts/benchmarks/bench.py --json F                 also writes the figures
    python scripts/benchmarks/bench.py --write-baseline         also puts them into baseline.json

The table has a line for each case and one for each peer: median, spread (interquartile range), the ratio of our time
to the peer's, its target, and the gate. The gate of a ratio is the smaller of its target and 1.5 times the ratio of the
committed baseline, never tighter than 0.9 times the target; a target that the baseline misses must get no worse. Exit
status 1 where a gate is passed. Peers come with the extra `bench`; those that are not installed are left out.

All runs of a case are timed in turn in one process, bound to two cores, which keeps the memory that it frees.
"""

from __future__ import annotations

import argparse
import gc
import importlib.metadata
import json
import platform
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from harness import Group, bound, limit_threads, measure, usable_cores

BASELINE = Path(__file__).with_name("baseline.json")
SIZES = ("small", "medium", "large")
LIBRARIES = ["jax", "numpy", "opencv-python-headless", "octomap-python", "open3d", "torch", "onnxruntime", "openvino"]
WIDTH = 40
HEADER = f"{'':23s} {'times in ms':{WIDTH}s} {'median':>9s} {'spread':>9s} {'ratio':>8s} {'target':>7s} {'gate':>7s}"


def main() -> int:
    """Measures, prints, judges; 1 where a gate is passed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", metavar="GROUP", help="groups to run")
    parser.add_argument("--sizes", nargs="+", choices=SIZES, default=list(SIZES))
    parser.add_argument("--list", action="store_true", help="print the groups and end")
    parser.add_argument("--json", type=Path, metavar="F", help="write the figures")
    parser.add_argument("--from-json", type=Path, metavar="F", help="measure nothing: print and judge these figures")
    parser.add_argument("--write-baseline", action="store_true", help=f"put the figures into {BASELINE.name}")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--budget-s", type=float, default=3.0, help="about how long a case is timed")
    given = parser.parse_args()
    baseline = json.loads(BASELINE.read_text("utf-8"))
    if given.from_json:
        report = json.loads(given.from_json.read_text("utf-8"))
        print(HEADER)
        failed = [line for name, case in report["cases"].items() for line in print_case(name, case, baseline["cases"])]
    else:
        report, failed = run_cases(parser, given, baseline["cases"])
    if given.json:
        given.json.write_text(json.dumps(report, indent=1) + "\n", "utf-8")
    if given.write_baseline:
        cases = {**baseline["cases"], **report["cases"]}
        BASELINE.write_text(json.dumps({**report, "cases": cases}, indent=1) + "\n", "utf-8")
    print(f"peak resident {report['peak_resident_mib']} MiB; {len(failed)} gates passed over")
    for line in failed:
        print(f"TOO SLOW: {line}")
    return 1 if failed else 0


def run_cases(
    parser: argparse.ArgumentParser, given: argparse.Namespace, baseline: dict[str, Any]
) -> tuple[dict[str, Any], list[str]]:
    """Measures and prints every case: the report of the whole run, and the cases that fail their gates."""
    from jaxmap.host.memory import peak_resident_mib, restart_with_lasting_memory

    if not given.list:
        restart_with_lasting_memory()
    limit_threads(given.threads)
    # Only now, as the numerical libraries ask for the number of threads when they are imported.
    import cv2
    from cases import GROUPS

    if given.list:
        parser.exit(message="".join(f"{name:17s} {group.title}\n" for name, group in GROUPS.items()))
    if unknown := set(given.only or []) - GROUPS.keys():
        parser.error(f"no group {', '.join(sorted(unknown))}; there are {', '.join(GROUPS)}")
    cv2.setNumThreads(given.threads)
    chosen: dict[str, Group] = {name: GROUPS[name] for name in GROUPS if name in (given.only or GROUPS)}
    cases: dict[str, Any] = {}
    failed: list[str] = []
    print(HEADER)
    for group, (_, build) in chosen.items():
        for size in given.sizes:
            name = f"{group} {size}"
            cases[name] = {"group": group, "size": size, **measure(build(size), given.budget_s)}
            failed += print_case(name, cases[name], baseline)
            # What a case held is given back before the next is built.
            gc.collect()
    report = {
        "machine": machine(),
        "peak_resident_mib": round(peak_resident_mib()),
        "groups": {name: group.title for name, group in GROUPS.items()},
        "cases": cases,
    }
    return report, failed


def print_case(name: str, case: dict[str, Any], baseline: dict[str, Any]) -> Iterator[str]:
    """Prints the lines of a case; yields those of its ratios that fail their gates."""
    work, grown, rate = case["work"], case["grown"], case["work_per_s"]
    notes = [f"{grown['count']:,.0f} {grown['unit']}", f"{rate:{',.0f' if rate >= 100 else '.3g'}} {work['unit']}/s"]
    notes += [f"compiled in {case['compile_s']:.2f} s"] if "compile_s" in case else []
    notes += [f"{case['temporary_mib']:.1f} MiB temporary"] if "temporary_mib" in case else []
    print(f"{name:23s} {'jaxmap':{WIDTH}s} {_times(case)} {'':24s}  {'; '.join(notes)}", flush=True)
    for peer, figures in case["peers"].items():
        ratio, limit, gate, verdict = figures["ratio"], figures.get("limit"), "", ""
        if limit is not None and figures["gated"]:
            before = baseline.get(name, {}).get("peers", {}).get(peer, {}).get("ratio")
            greatest = bound(limit, before)
            gate, verdict = f"{greatest:.3g}", "ok" if ratio <= greatest else "TOO SLOW"
            if ratio > greatest:
                yield f"{name} beside {peer}: {ratio:.3g}, gate {gate}"
        if limit is not None and ratio > limit:
            verdict = f"{verdict}, target missed".removeprefix(", ")
        target = "" if limit is None else f"{limit:.3g}"
        print(f"{'':23s} {peer:{WIDTH}s} {_times(figures)} {ratio:8.3g} {target:>7s} {gate:>7s}  {verdict}")
    for peer, modules in case["missing"].items():
        print(f"{'':23s} {peer:{WIDTH}s} left out: {', '.join(modules)} not installed")
    for fact, value in case["facts"].items():
        print(f"{'':23s} {fact}: {value:.3g}")


def _times(figures: dict[str, Any]) -> str:
    return f"{figures['median_ms']:9.3f} {figures['spread_ms']:9.3f}"


def machine() -> dict[str, Any]:
    """What the figures were measured on."""
    import jax

    described = Path("/proc/cpuinfo")
    lines = described.read_text().splitlines() if described.exists() else []
    named = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return {
        "processor": next(named, platform.processor() or platform.machine()),
        "cores": usable_cores(),
        "device": jax.devices()[0].device_kind,
        "python": platform.python_version(),
        "versions": {name: version for name in LIBRARIES if (version := version_of(name)) is not None},
    }


def version_of(name: str) -> str | None:
    """The version of an installed library."""
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


if __name__ == "__main__":
    sys.exit(main())

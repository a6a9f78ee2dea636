"""The command of the benchmarks, in a process of its own: its groups, its gate, and one small run."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPTS = Path(__file__).resolve().parents[1] / "scripts"
BASELINE = SCRIPTS / "benchmarks" / "baseline.json"


def bench(*words: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, SCRIPTS / "benchmarks" / "bench.py", *words]
    return subprocess.run([str(word) for word in command], capture_output=True, text=True)


def test_the_committed_baseline_keeps_its_own_gates():
    done = bench("--from-json", BASELINE)
    assert done.returncode == 0, done.stderr
    assert "sequence large" in done.stdout and "TOO SLOW" not in done.stdout


@pytest.mark.parametrize(
    ("case", "peer", "ratio"),
    [
        # Within the target, and too far from the baseline.
        ("fuse medium", "OctoMap, discretised", 0.0666),
        # The baseline misses this target: it must get no worse.
        ("sequence large", "SGBM 3WAY, 128 disparities, 72 times", 3.3),
    ],
)
def test_a_ratio_past_its_gate_fails_the_command(tmp_path: Path, case: str, peer: str, ratio: float):
    report = json.loads(BASELINE.read_text())
    beside = report["cases"][case]["peers"][peer]
    assert beside["gated"] and beside["ratio"] < ratio
    beside["ratio"] = ratio
    (tmp_path / "report.json").write_text(json.dumps(report))
    done = bench("--from-json", tmp_path / "report.json")
    assert done.returncode == 1 and f"TOO SLOW: {case} beside {peer}" in done.stdout


@pytest.mark.slow
def test_the_smallest_group_runs_and_the_baseline_is_of_groups_that_there_are(tmp_path: Path):
    done = bench("--only", "carve", "--sizes", "small", "--budget-s", "0", "--json", tmp_path / "report.json")
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "report.json").read_text())
    case = report["cases"]["carve small"]
    assert case["median_ms"] > 0 and case["grown"] == {"count": 8000, "unit": "voxels"}
    assert {case["group"] for case in json.loads(BASELINE.read_text())["cases"].values()} <= report["groups"].keys()


@pytest.mark.slow
def test_every_script_says_how_to_call_it():
    scripts = [path for path in sorted(SCRIPTS.glob("**/*.py")) if "__main__" in path.read_text()]
    silent = []
    for path in scripts:
        done = subprocess.run([sys.executable, str(path), "--help"], capture_output=True, text=True)
        if done.returncode or f"python {path.relative_to(SCRIPTS.parent)}" not in done.stdout:
            silent.append((path.name, done.stderr[-300:]))
    assert len(scripts) > 15 and not silent

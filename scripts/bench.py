"""Benchmarks: each case beside its peers, in one process, turn by turn; figures are medians and ratios.

    python scripts/bench.py                          all cases at three sizes; fails where a ratio passes its gate
    python scripts/bench.py --only fuse mlesac       some
    python scripts/bench.py --sizes medium           at the sizes that targets are set for
    python scripts/bench.py --json F --report F.html also writes the figures, and a page with them and their growth
    python scripts/bench.py --write-baseline         also puts them into scripts/bench_baseline.json

A ratio is our time over the peer's. The gate of a ratio is the smaller of its limit and 1.5 times the ratio in the
committed baseline, but never tighter than 0.9 times the limit: machines are noisy, ratios less so. Peers come with the
extra `bench`; those that are not installed are left out, and named. Exit status 1 where a gate is passed, else 0.

The process is bound to two cores and keeps the memory it frees, which helps all alike.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from benchmarks.threads import limit_threads

ROOT = Path(__file__).resolve().parent.parent
BASELINE = Path(__file__).with_name("bench_baseline.json")
SIZES = ("small", "medium", "large")


def parse() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", metavar="NAME", help="groups to run; --list tells them")
    parser.add_argument("--sizes", nargs="+", choices=SIZES, default=list(SIZES))
    parser.add_argument("--list", action="store_true", help="tell the groups and end")
    parser.add_argument("--json", type=Path, metavar="F", help="write the figures")
    parser.add_argument("--report", type=Path, metavar="F.html", help="write a page with the figures and their growth")
    parser.add_argument("--from-json", type=Path, metavar="F", help="measure nothing: report and gate these figures")
    parser.add_argument("--write-baseline", action="store_true", help=f"put the figures into {BASELINE.name}")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--budget-s", type=float, default=3.0, help="about how long a case is timed")
    return parser.parse_args()


def main() -> int:
    """Runs the cases; 1 where a gate is passed."""
    arguments = parse()
    sys.path[:0] = [str(ROOT), str(ROOT / "tests"), str(ROOT / "tests" / "golden")]
    if not (arguments.list or arguments.from_json):
        from jaxmap.host.memory import restart_with_lasting_memory

        restart_with_lasting_memory()
    limit_threads(arguments.threads)
    from benchmarks.command import run

    return run(arguments, BASELINE)


if __name__ == "__main__":
    sys.exit(main())

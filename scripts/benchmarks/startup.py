"""How long jaxmap takes to start: its help, and the first mapped frame, with an empty cache and with a full one.

    python scripts/benchmarks/startup.py [--sequence SEQUENCE] [--config NAME] [--labellers none plane] [--repeats 5]

Every figure is that of a process of its own, from its creation on, as wall time and as processor time: where others use
the same cores the wall time grows, the other less so. Threads that read ahead count, too, as two frames and more are
matched by the time the first one is mapped. The empty cache is a new folder for each labeller; the full one is the same
folder from then on. Prints one table: medians of the repeats, and how many programs the cache did not hold.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from contextlib import nullcontext
from pathlib import Path
from typing import Any

HELPS = {"jaxmap --help": ["--help"], "jaxmap map --help": ["map", "--help"]}


def age_s() -> float:
    """Since this process was made, as the system knows (Linux), or since the script started it."""
    try:
        ticks = int(Path("/proc/self/stat").read_text().rpartition(")")[2].split()[19])
        return time.clock_gettime(time.CLOCK_BOOTTIME) - ticks / os.sysconf("SC_CLK_TCK")
    except OSError:
        return time.time() - float(os.environ["STARTED_S"])


def map_first_frame(words: list[str]) -> None:
    """`jaxmap map`, which ends as soon as a frame is in the map, and prints the time that took as JSON."""
    from jaxmap.commands import main as cli
    from jaxmap.commands import map as command

    class Stopwatch(command.Console):
        """A console whose progress bar ends the process at the first frame."""

        def __init__(self) -> None:
            import jax

            super().__init__()
            self.events: list[str] = []
            jax.monitoring.register_event_listener(lambda event, **_: self.events.append(event))

        def progress(self, title: str, total: int) -> Any:
            import jax

            def first(fused: object) -> None:
                missed = self.events.count("/jax/compilation_cache/cache_misses")
                figures = {"wall_s": age_s(), "processor_s": time.process_time(), "compiled": missed}
                print(json.dumps({**figures, "device": jax.devices()[0].device_kind}), flush=True)
                os._exit(0)

            return nullcontext(first)

    command.Console = Stopwatch
    # The command may restart this process by its own words.
    sys.argv = ["jaxmap", *words]
    sys.exit(cli.main())


def in_process(words: list[str], cache: Path | None = None) -> tuple[str, dict[str, float]]:
    """Runs Python on these words; what it printed, and its wall and processor time."""
    environment = {**os.environ, "STARTED_S": str(time.time())}
    if cache is not None:
        environment["JAXMAP_CACHE"] = str(cache)
    before = os.times()
    done = subprocess.run([sys.executable, *words], capture_output=True, text=True, env=environment)
    after = os.times()
    if done.returncode:
        raise SystemExit(done.stderr)
    spent_s = after.children_user + after.children_system - before.children_user - before.children_system
    return done.stdout, {"wall_s": after.elapsed - before.elapsed, "processor_s": spent_s}


def first_frame(sequence: str, config: str | None, labeller: str, cache: Path) -> dict[str, Any]:
    """Times of the first frame of one run."""
    with tempfile.TemporaryDirectory() as out:
        options = [*(["--config", config] if config else []), "--labeller", labeller, "--out", f"{out}/run"]
        printed, _ = in_process([__file__, "--first-frame", sequence, *options], cache)
    return json.loads(printed.splitlines()[-1])


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sequence", default="sample:traverse")
    parser.add_argument("--config", help="YAML file, or the name of a bundled one")
    parser.add_argument("--labellers", nargs="+", default=["none", "plane", "deeplab"])
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    results: dict[str, dict[str, Any]] = {}

    def record(name: str, figures: list[dict[str, Any]]) -> None:
        median = {key: statistics.median(one[key] for one in figures) for key in figures[0] if key != "device"}
        results[name] = {**figures[-1], **{key: round(value, 3) for key, value in median.items()}}
        compiled = str(results[name].get("compiled", ""))
        print(f"{name:36s}{median['wall_s']:9.2f}{median['processor_s']:14.2f}{compiled:>10s}", flush=True)

    print(f"{'':36s}{'wall, s':>9s}{'processor, s':>14s}{'compiled':>10s}")
    for name, words in HELPS.items():
        record(name, [in_process(["-m", "jaxmap", *words])[1] for _ in range(given.repeats)])
    for labeller in given.labellers:
        with tempfile.TemporaryDirectory() as cache:
            task = (given.sequence, given.config, labeller, Path(cache))
            record(f"first frame, {labeller}, empty cache", [first_frame(*task)])
            record(f"first frame, {labeller}, full cache", [first_frame(*task) for _ in range(given.repeats)])
    device = next((one["device"] for one in results.values() if "device" in one), "no frame mapped")
    print(f"{device}, {os.cpu_count()} processors")
    if given.json:
        given.json.write_text(json.dumps(results, indent=2) + "\n")


if __name__ == "__main__":
    if sys.argv[1:2] == ["--first-frame"]:
        map_first_frame(["map", *sys.argv[2:]])
    main()

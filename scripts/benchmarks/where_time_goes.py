"""Where the time of the compiled step goes, stage by stage, against what memory and arithmetic of this machine reach.

    python scripts/benchmarks/where_time_goes.py [SEQUENCE] [--config NAME] [--labeller plane] [--frames 4] [--json F]

The frames are read and matched beforehand: while the steps are traced, nothing else runs in this process (`jaxmap map
--profile` measures the same within a whole run, with reading and matching beside it). docs/performance.md explains the
table.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from dataclasses import replace
from itertools import cycle, islice
from pathlib import Path

import jax

from jaxmap.host.cache import keep_compiled_programs
from jaxmap.host.memory import restart_with_lasting_memory
from jaxmap.mapping.step import compile_step
from jaxmap.profiling.step_profile import TRACED_FRAMES, WARM_UP_FRAMES, StepProfile, table_lines
from jaxmap.runs.config import MapConfig, config_of_observations, load_config, observations_in
from jaxmap.runs.mapping_plan import plan_run


def main() -> None:
    """Measures one labeller and prints its table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequence", nargs="?", default="sample:traverse")
    parser.add_argument("--config", help="YAML file, or the name of a bundled one")
    parser.add_argument("--labeller", default="plane", choices=["none", "plane", "deeplab"])
    parser.add_argument("--frames", type=int, default=4, help="different frames, used in turn")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    # As the command does: with memory that comes fresh from the system at each frame, a step takes longer.
    restart_with_lasting_memory()
    keep_compiled_programs(scopes=True)
    if (perceived := observations_in(given.sequence)) is not None:
        config = config_of_observations(perceived, given.config)
    else:
        config = load_config(given.config) if given.config else MapConfig()
    config = replace(config, labeller=given.labeller, stop=given.frames)
    plan = plan_run(given.sequence, config, lambda line: None)
    prepared = list(plan.prepare())
    frames = [one.frame for one in prepared if one.frame is not None]
    voxel_map = plan.mapper.init()
    mapper, cost = compile_step(plan.mapper, voxel_map, frames[0], plan.params, plan.key)
    with tempfile.TemporaryDirectory() as folder:
        profile, times_s = StepProfile(Path(folder)), []
        for frame in islice(cycle(frames), WARM_UP_FRAMES + TRACED_FRAMES):
            started_s = time.perf_counter()
            voxel_map, _ = mapper.step(voxel_map, frame, plan.params, plan.key)
            jax.block_until_ready(voxel_map.log_odds)
            times_s.append(time.perf_counter() - started_s)
            profile.step_done()
        summary = profile.summary(cost.program)
    step_ms = 1e3 * sorted(times_s[WARM_UP_FRAMES:])[TRACED_FRAMES // 2]
    assert summary is not None
    print("\n".join([f"labeller {given.labeller}: a traced step takes {step_ms:.1f} ms", *table_lines(summary)]))
    if given.json:
        given.json.write_text(json.dumps({**summary, "step_ms": round(step_ms, 3)}, indent=2) + "\n")


if __name__ == "__main__":
    main()

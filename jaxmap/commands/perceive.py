"""`jaxmap perceive`: matches and labels every frame once, and keeps what was seen."""

from __future__ import annotations

import signal
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated

import tyro

from jaxmap.commands.console import Console, Workers, check_bounds, check_workers, parse
from jaxmap.runs.config import PerceiveConfig, load_perception

OUTPUTS = ("observations.zarr", "config.yaml", "metrics.json", "pictures/")


@dataclass(frozen=True)
class PerceiveArguments:
    """Perceive a stereo sequence: match every frame and show it to the network once, and keep what was seen.

    Writes into the folder: observations.zarr, config.yaml, metrics.json and pictures/. jaxmap map, tune and train read
    them as often as one likes, with other grids, ranges, fusion numbers or poses. A frame that is there is not
    perceived again: after an interruption, the same command goes on.
    """

    sequence: tyro.conf.Positional[str]
    """Folder of one sequence, a ROS bag, or sample:motorcycle."""
    out: Path
    """The folder to write; not the sequence's own folder."""
    config: str | None = None
    """YAML file, or the name of a bundled one; options given here go before it, and what concerns the map alone is left
    aside."""
    overwrite: bool = False
    """Replace observations that lie in the folder; they stay until the new ones are whole."""
    workers: Annotated[int, Workers] = 1
    """Processes on this machine that perceive at the same time."""
    scheduler: str | None = None
    """Address of a Dask scheduler, tcp://HOST:8786, whose workers perceive instead."""
    settings: Annotated[PerceiveConfig, tyro.conf.arg(name="")] = field(default_factory=PerceiveConfig)


def main(words: Sequence[str]) -> int:
    """Runs the command."""
    arguments = parse(PerceiveArguments, "perceive", words, with_config=_with_config)
    config = arguments.settings
    check_bounds(arguments, "perceive")

    # JAX is imported only now: help and wrong options need not wait for it.
    from jaxmap.fusion.options import FusionOptions
    from jaxmap.host import executors
    from jaxmap.host.cache import keep_compiled_programs
    from jaxmap.runs.folder import RunFolder
    from jaxmap.runs.perceiving import make_keeper, observing, resolved_settings, run_perception
    from jaxmap.runs.perceiving_shared import check_shareable, keep_on_workers
    from jaxmap.runs.perception import plan_perception

    keep_compiled_programs()
    workers = executors.Workers(arguments.workers, arguments.scheduler)
    check_workers(arguments.workers, arguments.scheduler)
    if workers.shared:
        check_shareable(config)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    console = Console()
    folder = RunFolder(arguments.out)
    with console.counted("odometry", "frames") as on_frame:
        seen = plan_perception(arguments.sequence, config, console.notify, on_frame)
    folder.check_apart(seen.source, seen.images, (config.poses, config.calibration, config.model))
    keeper = make_keeper(seen, config, FusionOptions().disparity_sigma_px)
    settings = {"sequence": seen.source, **resolved_settings(seen, config)}
    with (
        folder.locked(),
        observing(folder, settings, overwrite=arguments.overwrite, notify=console.notify) as work,
        console.steps("perceiving", "frames", len(seen.sequence.frames)) as advance,
    ):
        keep = None
        if workers.shared:
            keep = partial(keep_on_workers, keeper, config, work, workers=workers, notify=console.notify)
        metrics = run_perception(keeper, work, strict=config.strict, notify=console.notify, on_frame=advance, keep=keep)
    sequence, times = metrics["sequence"], metrics["times"]
    console.notify(
        f"{sequence['kept']} of {sequence['frames']} frames are kept, {metrics['bytes_per_frame'] / 1e6:.2f} MB each; "
        f"{times['perceived']} were perceived now, {times['frames_per_s']:.1f} frames/s"
    )
    for skipped in sequence["skipped"]:
        console.notify(f"skipped {skipped['frame']}: {skipped['reason']}")
    console.result(arguments.out, OUTPUTS)
    return 0


def _with_config(name: str) -> PerceiveArguments:
    """The defaults under a configuration; the two required arguments are filled in by the parser."""
    return PerceiveArguments(sequence=tyro.MISSING, out=tyro.MISSING, config=name, settings=load_perception(name))

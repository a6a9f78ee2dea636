"""`jaxmap map`: batch mapping of one stereo sequence."""

from __future__ import annotations

import signal
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from jaxmap.commands.console import Console, Workers, check_bounds, check_workers, parse
from jaxmap.errors import UsageError
from jaxmap.host.settings import NotNegative
from jaxmap.runs.config import MapConfig, config_of_observations, load_config, observations_in

if TYPE_CHECKING:
    from jaxmap.runs.folder import RunFolder

OUTPUTS = (
    *("report.html", "map.zarr", "map.ply", "bev.tif", "bev.png", "metrics.json"),
    *("config.yaml", "poses.tum", "frames.csv", "pictures/"),
)


@dataclass(frozen=True)
class MapArguments:
    """Map a stereo sequence, or what jaxmap perceive has kept of one, into a voxel map and its pictures.

    Writes into the run folder: map.zarr, map.ply, bev.tif, bev.png, metrics.json, config.yaml, poses.tum, frames.csv,
    pictures/ and report.html; with --ensemble.members N also missed.png, and a layer of map.zarr and bev.tif: the
    probability of a missed rock.
    """

    sequence: tyro.conf.Positional[str]
    """Folder of one sequence, a ROS bag, or sample:motorcycle; or a folder of observations, whose settings then are the
    defaults."""
    out: Path
    """The run folder to write; not the sequence's own folder."""
    config: str | None = None
    """YAML file, or the name of a bundled one (chiodini2020, katwijk, sand); options given here go before it."""
    resume: bool = False
    """Resume an interrupted run."""
    overwrite: bool = False
    """Replace a run that lies in the folder; it stays until the new one is whole."""
    keep_observations: bool = False
    """Keep what is perceived on the way as observations.zarr in the run folder, as jaxmap perceive does."""
    checkpoint_every_s: Annotated[float, NotNegative] = 30.0
    """How often the map is saved on the way."""
    workers: Annotated[int, Workers] | None = None
    """Processes on this machine that share the work: frames are perceived apart, then regions of the map are fused
    apart, whose bounds are whole tiles. The map is the same, to the bit, for any number of them."""
    scheduler: str | None = None
    """Address of a Dask scheduler, tcp://HOST:8786, whose workers share the work instead; docs/clusters.md."""
    update: bool = False
    """Bring the run of these observations that lies in the folder up to date: what frames that are new, gone or of
    other poses (--poses) touch, or what is damaged on disk, is fused again, and the rest stays."""
    profile: bool = False
    """Record a trace of ten steps, and of the reading and matching beside them, into profile/ (for Perfetto or
    TensorBoard), and report where the time of a step goes; docs/performance.md explains it."""
    devices: Annotated[int, Workers] | None = None
    """On how many GPUs frames are fused, one on each at a time; by default on all. A CPU is one device."""
    view: bool = False
    """Show the run in the viewer of rerun while it goes on (pip install 'jaxmap[view]')."""
    view_save: Path | None = None
    """Write what --view shows into this .rrd file, and open no window."""
    settings: Annotated[MapConfig, tyro.conf.arg(name="")] = field(default_factory=MapConfig)


def main(words: Sequence[str]) -> int:
    """Runs the command."""
    arguments = parse(MapArguments, "map", words, with_config=_with_config)
    if (perceived := observations_in(arguments.sequence)) is not None:
        arguments = parse(MapArguments, "map", words, default=_on(perceived, arguments.config))
        if arguments.keep_observations:
            raise UsageError("--keep-observations keeps those of a sequence", where=perceived, fix="leave it out")
    config = arguments.settings
    ways = [name for name in ("resume", "overwrite", "update") if getattr(arguments, name)]
    if len(ways) > 1:
        raise UsageError(f"{' and '.join(f'--{name}' for name in ways)} exclude each other", fix="give one of them")
    check_bounds(arguments, "map")
    check_workers(arguments.workers, arguments.scheduler)

    # JAX is imported only now: help and wrong options need not wait for it.
    from jaxmap.host.cache import keep_compiled_programs
    from jaxmap.mapping.devices import choose_devices
    from jaxmap.report.recording import check_viewer
    from jaxmap.runs.folder import RunFolder
    from jaxmap.runs.mapping import run_plan, unwatched
    from jaxmap.runs.mapping_plan import plan_run
    from jaxmap.runs.viewing import live_view

    watched = arguments.view or arguments.view_save is not None
    if watched:
        check_viewer(arguments.view_save)
    keep_compiled_programs(scopes=arguments.profile)
    # SIGTERM, which ends jobs of clusters and services, counts as Ctrl-C: the map is saved first.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    console = Console()
    folder = RunFolder(arguments.out)
    if arguments.workers is not None or arguments.scheduler is not None or arguments.update:
        metrics = _map_shared(arguments, folder, console)
        return _tell(arguments, metrics, console)
    with console.counted("odometry", "frames") as on_frame:
        plan = plan_run(
            arguments.sequence,
            config,
            console.notify,
            on_frame,
            keep=arguments.keep_observations,
            # A viewer shows the disparity of every frame.
            match_in_step=not watched,
            in_tiles=True,
        )
    devices = choose_devices(arguments.devices, plan.members)
    folder.check_apart(plan.source, plan.images, (config.poses, config.calibration, config.model))
    resume, overwrite = arguments.resume, arguments.overwrite
    with (
        folder.locked(),
        folder.writing(plan.settings(config), resume=resume, overwrite=overwrite) as work,
        live_view(plan, arguments.view_save) if watched else nullcontext(unwatched) as watch,
        console.progress("mapping", len(plan.sequence.frames)) as advance,
    ):
        metrics = run_plan(
            plan,
            work,
            strict=config.strict,
            checkpoint_every_s=arguments.checkpoint_every_s,
            notify=console.notify,
            on_frame=advance,
            watch=watch,
            profile=arguments.profile,
            devices=devices,
        )
    return _tell(arguments, metrics, console)


def _map_shared(arguments: MapArguments, folder: RunFolder, console: Console) -> dict[str, Any]:
    """Maps on workers, or brings a run up to date."""
    from jaxmap.host import executors
    from jaxmap.runs.fusing import map_observations, map_on_workers

    if arguments.profile:
        raise UsageError("workers are not profiled", where="--profile", fix="leave --profile or the workers out")
    if arguments.devices is not None:
        raise UsageError("workers fuse on one device each", where="--devices", fix="leave --devices or the workers out")
    workers = executors.Workers(arguments.workers or 1, arguments.scheduler)
    config, tell = arguments.settings, (console.notify, console.steps)
    if observations_in(arguments.sequence) is not None:
        ways = {"resume": arguments.resume, "overwrite": arguments.overwrite, "update": arguments.update}
        return map_observations(arguments.sequence, config, folder, workers, *tell, **ways)
    if arguments.update:
        raise UsageError(
            "--update brings a map of observations up to date",
            where=arguments.sequence,
            fix="give the folder that jaxmap perceive has written",
        )
    ways = {"resume": arguments.resume, "overwrite": arguments.overwrite, "keep": arguments.keep_observations}
    return map_on_workers(arguments.sequence, config, folder, workers, *tell, **ways)


def _tell(arguments: MapArguments, metrics: dict[str, Any], console: Console) -> int:
    """Says what a run did, and where its outputs are."""
    config, keep = arguments.settings, arguments.keep_observations
    console.notify(summary(metrics))
    for skipped in metrics["sequence"]["skipped"]:
        console.notify(f"skipped {skipped['frame']}: {skipped['reason']}")
    missed, profile = ["missed.png"] if config.ensemble.members else [], ["profile/"] if arguments.profile else []
    kept = ["observations.zarr"] if keep else []
    console.result(arguments.out, (*OUTPUTS, *kept, *missed, *profile))
    if arguments.view_save is not None:
        console.result(arguments.view_save.parent, [arguments.view_save.name])
    return 0


def summary(metrics: dict) -> str:
    """One line on what a run did."""
    sequence, times, voxels = metrics["sequence"], metrics["times"], metrics["voxels"]
    return (
        f"{sequence['fused']} of {sequence['frames']} frames fused, {times['frames_per_s']:.1f} frames/s "
        f"(compiled in {times['compile_s']:.1f} s); {voxels['occupied']:,} voxels occupied, {voxels['free']:,} free; "
        f"peak memory {metrics['memory']['peak_resident_mib']:.0f} MiB"
    )


def _with_config(name: str) -> MapArguments:
    """The defaults under a configuration; the two required arguments are filled in by the parser."""
    return MapArguments(sequence=tyro.MISSING, out=tyro.MISSING, config=name, settings=load_config(name))


def _on(perceived: Path, name: str | None) -> MapArguments:
    """The defaults of mapping observations, under a configuration or without."""
    settings = config_of_observations(perceived, name)
    return MapArguments(sequence=tyro.MISSING, out=tyro.MISSING, config=name, settings=settings)

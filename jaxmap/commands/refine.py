"""`jaxmap refine`: poses, camera mounting and stereo calibration, refined until the frames agree."""

from __future__ import annotations

import math
import signal
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from annotated_types import Interval, MinLen

from jaxmap.commands.console import Console, check_bounds, parse
from jaxmap.datasets.options import ReadOptions

Adjustable = Literal["poses", "mounting", "baseline", "offset"]
Positive = Annotated[float, Interval(ge=1e-9, lt=1e4)]


@dataclass(frozen=True)
class RefineArguments:
    """Refine the poses of a sequence, and on request the camera's mounting, its baseline and its disparity offset.

    Patches of the ground are matched between frames, and a least-squares problem makes frames, points and priors agree.
    What frames alone leave unobservable (where the map as a whole lies; the camera's height) keeps its given value,
    unless --dem or --ground-truth ties the map to the ground; report.html says what was observable. Writes poses.tum
    (for jaxmap map --poses), refine.json, report.html with its pictures, and calibration.yaml (for jaxmap map
    --calibration) where mounting, baseline or offset were refined.
    """

    sequence: tyro.conf.Positional[str]
    """Folder of one sequence, or sample:traverse."""
    out: Path
    """Folder for the results; not the sequence's own folder."""
    adjust: Annotated[tuple[Adjustable, ...], MinLen(1)] = ("poses",)
    """What may be wrong: poses (each independently), mounting (the same displacement of the camera in every frame),
    baseline, offset (of disparity)."""
    ground_truth: tuple[Path, ...] = ()
    """A labelled orthomosaic (GeoTIFF: 0 unlabelled, 1 sand, 2 rock) or lists of rocks: locates the map to some
    0.1 m."""
    dem: Path | None = None
    """An elevation model (GeoTIFF, metres, the height system of the poses): determines position, height and attitude
    to centimetres and tenths of a degree."""
    ground_below_camera_m: Positive | None = None
    """Height of the given camera poses above the ground that the rover drives over, by its drawings (Katwijk's LocCam:
    1.10): makes an error of the mounting's height observable."""
    sigma_position_m: Positive | None = None
    """Standard deviation of the given positions, each frame and axis; estimated from the data by default."""
    sigma_angle_deg: Positive | None = None
    """Standard deviation of the given attitudes, likewise."""
    sigma_mounting_m: Positive = 0.1
    """Standard deviation of the camera's position in its mounting, each axis."""
    sigma_mounting_deg: Positive = 2.0
    """Standard deviation of its attitude in the mounting, each axis."""
    sigma_baseline: Positive = 0.01
    """Standard deviation of the baseline, as a share of it."""
    sigma_offset_px: Positive = 0.5
    """Standard deviation of the disparity offset."""
    max_depth_m: Positive | None = None
    """Farther points are not used; by default those whose depth noise exceeds 0.35 m."""
    remap: tuple[str, ...] = ()
    """What the values of the orthomosaic mean: 0=unlabelled 7=rock '*=sand', or colours: '#b23c2e=rock'."""
    palette: Path | None = None
    """The same as a YAML file of CODE: CLASS."""
    truth_crs: str | None = None
    """Coordinate reference system of the ground truth, in place of its own."""
    align: bool = False
    """Rectify with an estimated rotation of the right camera, as jaxmap map --stereo.align does."""
    strict: bool = False
    """Stop where the quick check of the sequence finds something that would make a map wrong."""
    overwrite: bool = False
    """Replace an earlier refinement in the folder; it stays until the new one is whole."""
    reading: Annotated[ReadOptions, tyro.conf.arg(name="")] = field(default_factory=ReadOptions)


def main(words: Sequence[str]) -> int:
    """Runs the command."""
    arguments = parse(RefineArguments, "refine", words)
    check_bounds(arguments, "refine")

    from jaxmap.datasets.label_raster import choose_coding
    from jaxmap.host.cache import keep_compiled_programs
    from jaxmap.runs.evaluation import TruthOptions
    from jaxmap.runs.refinement import CALIBRATION, OUTPUTS, GroundFiles, check_inputs_apart, run_refine

    keep_compiled_programs()
    # A job that is ended (SIGTERM) stops as with Ctrl-C; the best result so far is in the folder.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    console = Console()
    reading = arguments.reading
    inputs = (reading.poses, reading.calibration, arguments.dem, arguments.palette, *arguments.ground_truth)
    check_inputs_apart(arguments.sequence, arguments.out, inputs)
    truth = TruthOptions(coding=choose_coding(arguments.remap, arguments.palette), crs=arguments.truth_crs)
    files = GroundFiles(arguments.ground_truth, truth, arguments.dem, arguments.ground_below_camera_m)
    with console.steps("refining", "steps", 100) as advance:
        content = run_refine(
            arguments.sequence,
            arguments.out,
            reading,
            _prior(arguments),
            files,
            max_depth_m=arguments.max_depth_m,
            align=arguments.align,
            strict=arguments.strict,
            overwrite=arguments.overwrite,
            advance=lambda share, note: advance(round(100 * share), note),
            notify=console.notify,
        )
    _print_results(console, content)
    written = (*OUTPUTS, CALIBRATION) if set(arguments.adjust) - {"poses"} else OUTPUTS
    console.result(arguments.out, written)
    return 0


def _prior(arguments: RefineArguments) -> Any:
    from jaxmap.refinement.solver import Prior

    def sigma(adjusted: Adjustable, value: float) -> float:
        return value if adjusted in arguments.adjust else 0.0

    poses = "poses" in arguments.adjust
    position_m, angle_deg = arguments.sigma_position_m, arguments.sigma_angle_deg
    return Prior(
        position_m=position_m if poses else 0.0,
        angle_rad=(None if angle_deg is None else math.radians(angle_deg)) if poses else 0.0,
        mounting_m=sigma("mounting", arguments.sigma_mounting_m),
        mounting_rad=math.radians(sigma("mounting", arguments.sigma_mounting_deg)),
        baseline_scale=sigma("baseline", arguments.sigma_baseline),
        offset_px=sigma("offset", arguments.sigma_offset_px),
    )


def _print_results(console: Console, content: dict[str, Any]) -> None:
    spread, residual, matches = content["map_height_spread_m"], content["match_residual_px"], content["matches"]
    console.notify(
        f"{matches['count']:,} matches in {matches['pairs']} pairs of frames; median residual "
        f"{residual['before']:.2f} px before, {residual['after']:.2f} px after; heights differ between frames by "
        f"{100 * spread['before']:.1f} cm before, {100 * spread['after']:.1f} cm after"
    )
    for note in content["notes"]:
        console.notify(f"note: {note}")
    rows = [
        {"group": group, **{key: row[key] for key in ("name", "value", "sigma", "prior_sigma")}}
        | {"observable": "yes" if row["observable"] else "no: prior kept"}
        for group, key in (("refined", "parameters"), ("whole map", "whole_map"))
        for row in content[key]
    ]
    columns = {
        "group": "",
        "name": "parameter",
        "value": "found",
        "sigma": "+- 1 sigma",
        "prior_sigma": "prior +- 1 sigma",
        "observable": "observable",
    }
    console.table("what was refined, and how certain it is", columns, rows)

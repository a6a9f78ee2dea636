"""`jaxmap refine`: poses, camera mounting and stereo calibration, refined until the frames agree."""

from __future__ import annotations

import math
import signal
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro

from jaxmap.commands.console import Console, parse
from jaxmap.errors import UsageError

What = Literal["poses", "mounting", "baseline", "offset"]


@dataclass(frozen=True)
class RefineArguments:
    """Refine the poses of a sequence, and on demand how its camera is mounted, its baseline and its disparity offset.

    Patches of the ground are matched between frames, and a least-squares problem makes frames, points and priors agree.
    What frames cannot tell by themselves (where the map as a whole lies; the camera's height) stays as given, unless
    --dem or --ground-truth ties the map to the ground; report.html says what could be told. Writes poses.tum (for
    jaxmap map --poses), refine.json, report.html, its pictures, and calibration.yaml (for jaxmap map --calibration)
    where mounting, baseline or offset were refined.
    """

    sequence: tyro.conf.Positional[str]
    """Folder of one sequence, or sample:traverse."""
    out: Path
    """Folder for the results; not the sequence's own folder."""
    adjust: tuple[What, ...] = ("poses",)
    """What may be wrong: poses (each by itself), mounting (the same displacement of the camera in every frame),
    baseline, offset (of disparity)."""
    ground_truth: tuple[Path, ...] = ()
    """A labelled orthomosaic (GeoTIFF: 0 unlabelled, 1 sand, 2 rock) or lists of rocks: tells the place of the map to
    some 0.1 m."""
    dem: Path | None = None
    """An elevation model (GeoTIFF, metres, the height system of the poses): tells place, height and attitude to
    centimetres and tenths of a degree."""
    ground_below_camera_m: float | None = None
    """How far below the given camera poses the ground lies that the rover drives over, by its drawings (Katwijk's
    LocCam: 1.10): tells an error of the mounting's height from the height that the cameras see."""
    sigma_position_m: float | None = None
    """How wrong the given positions may be, each frame and axis, one sigma; by default told from the data."""
    sigma_angle_deg: float | None = None
    """How wrong the given attitudes may be, likewise."""
    sigma_mounting_m: float = 0.1
    """How far the camera may sit from where it should, each axis."""
    sigma_mounting_deg: float = 2.0
    """How far it may be turned, each axis."""
    sigma_baseline: float = 0.01
    """How wrong the baseline may be, as a share of it."""
    sigma_offset_px: float = 0.5
    """How wrong the disparity offset may be."""
    max_depth_m: float | None = None
    """Farther points do not count; by default where depth noise reaches 0.35 m."""
    dataset: str = "auto"
    """The reader: auto, kitti, euroc, folder or katwijk."""
    poses: Path | None = None
    """Pose file in place of the sequence's own: TUM, KITTI or EuRoC text."""
    calibration: Path | None = None
    """Camera file in place of the sequence's own."""
    camera: str | None = None
    """Which stereo camera, where there are several; Katwijk: loccam (the default) or pancam."""
    crs: str | None = None
    """Coordinate reference system of the poses, such as EPSG:32631."""
    remap: tuple[str, ...] = ()
    """What the values of the orthomosaic mean: 0=unlabelled 7=rock '*=sand', or colours: '#b23c2e=rock'."""
    palette: Path | None = None
    """The same as a YAML file of CODE: CLASS."""
    truth_crs: str | None = None
    """Coordinate reference system of the ground truth, in place of its own."""
    max_pose_gap_s: float = 1.0
    """Poses farther apart are not bridged."""
    start: int = 0
    """First frame."""
    stop: int | None = None
    """Frame to stop before, from the end if negative; by default the end."""
    stride: int = 1
    """Take every so many frames."""
    overwrite: bool = False
    """Replace a refinement that lies in the folder."""


def main(words: Sequence[str]) -> int:
    """Runs the command."""
    arguments = parse(RefineArguments, "refine", words)
    _check(arguments)

    from jaxmap.datasets import ReadOptions
    from jaxmap.datasets.label_coding import choose_coding
    from jaxmap.host.cache import keep_compiled_programs
    from jaxmap.runs.evaluation import TruthOptions
    from jaxmap.runs.refinement import CALIBRATION, OUTPUTS, GroundFiles, check_inputs_apart, run_refine

    keep_compiled_programs()
    # What ends a job is told like Ctrl-C; the best so far lies in the folder.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    console = Console()
    options = ReadOptions(
        dataset=arguments.dataset,
        poses=arguments.poses,
        calibration=arguments.calibration,
        camera=arguments.camera,
        crs=arguments.crs,
        max_pose_gap_s=arguments.max_pose_gap_s,
        start=arguments.start,
        stop=arguments.stop,
        stride=arguments.stride,
    )
    inputs = (arguments.poses, arguments.calibration, arguments.dem, arguments.palette, *arguments.ground_truth)
    check_inputs_apart(arguments.sequence, arguments.out, inputs)
    truth = TruthOptions(coding=choose_coding(arguments.remap, arguments.palette), crs=arguments.truth_crs)
    files = GroundFiles(arguments.ground_truth, truth, arguments.dem, arguments.ground_below_camera_m)
    with console.steps("refining", "steps", 100) as advance:
        content = run_refine(
            arguments.sequence,
            arguments.out,
            options,
            _prior(arguments),
            files,
            max_depth_m=arguments.max_depth_m,
            overwrite=arguments.overwrite,
            advance=lambda share, note: advance(round(100 * share), note),
            notify=console.notify,
        )
    _print(console, content)
    written = (*OUTPUTS, CALIBRATION) if set(arguments.adjust) - {"poses"} else OUTPUTS
    console.result(arguments.out, written)
    return 0


def _prior(arguments: RefineArguments) -> Any:
    from jaxmap.refinement.solver import Prior

    def sigma(what: What, value: float) -> float:
        return value if what in arguments.adjust else 0.0

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


def _check(arguments: RefineArguments) -> None:
    """Refuses options without meaning.

    Raises:
        UsageError: a number is out of range, or nothing is to be refined.
    """
    if not arguments.adjust:
        raise UsageError("nothing is to be refined", where="--adjust", fix="name poses, mounting, baseline or offset")
    numbers = {
        "--sigma-position-m": arguments.sigma_position_m,
        "--sigma-angle-deg": arguments.sigma_angle_deg,
        "--sigma-mounting-m": arguments.sigma_mounting_m,
        "--sigma-mounting-deg": arguments.sigma_mounting_deg,
        "--sigma-baseline": arguments.sigma_baseline,
        "--sigma-offset-px": arguments.sigma_offset_px,
        "--max-depth-m": arguments.max_depth_m,
        "--ground-below-camera-m": arguments.ground_below_camera_m,
        "--max-pose-gap-s": arguments.max_pose_gap_s,
    }
    for option, value in numbers.items():
        if value is not None and not (math.isfinite(value) and 0 < value < 1e4):
            raise UsageError(f"{value} is out of range", where=option, fix="give a number above 0")


def _print(console: Console, content: dict[str, Any]) -> None:
    spread, residual, matches = content["map_height_spread_m"], content["match_residual_px"], content["matches"]
    console.notify(
        f"{matches['count']:,} matches in {matches['pairs']} pairs of frames, off by {residual['before']:.2f} px "
        f"before and {residual['after']:.2f} px now; between frames heights differ by {100 * spread['before']:.1f} cm "
        f"before and {100 * spread['after']:.1f} cm now"
    )
    for note in content["notes"]:
        console.notify(f"note: {note}")
    rows = [
        {"group": group, **{key: row[key] for key in ("name", "value", "sigma", "prior_sigma")}}
        | {"told": "yes" if row["observable"] else "no: as given"}
        for group, key in (("refined", "parameters"), ("whole map", "whole_map"))
        for row in content[key]
    ]
    columns = {
        "group": "",
        "name": "number",
        "value": "found",
        "sigma": "+- 1 sigma",
        "prior_sigma": "given +- 1 sigma",
        "told": "told by the data",
    }
    console.table("what was found, and what could be told", columns, rows)

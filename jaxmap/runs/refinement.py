"""`jaxmap refine` with files: reads a sequence and the ground it is tied to, writes poses, calibration and a report."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64
from scipy.ndimage import map_coordinates

from jaxmap.checks.check import open_front_end
from jaxmap.checks.finding import Finding
from jaxmap.datasets import ReadOptions, StereoSequence, open_sequence
from jaxmap.datasets.calibration import write_camera_yaml
from jaxmap.datasets.crs import Extent, transform_between
from jaxmap.datasets.label_raster import TARGET, UNLABELLED
from jaxmap.datasets.poses import write_tum
from jaxmap.datasets.rasters import read_heights
from jaxmap.errors import FrameError, JaxmapError, UsageError
from jaxmap.geometry.bounds import usable_depth
from jaxmap.host.bounded_text import read_json
from jaxmap.host.files import real_path
from jaxmap.host.output_folder import check_inputs_stay, locked, write_json
from jaxmap.host.prefetch import prefetch
from jaxmap.host.replacement import Replacement
from jaxmap.refinement.frames import DisparityFrame, make_disparity_frame
from jaxmap.refinement.ground import GroundRaster
from jaxmap.refinement.refine import GroundReference, Refinement, refine, results
from jaxmap.refinement.solver import Prior
from jaxmap.report.refine_page import write_refine_report
from jaxmap.runs.checking import finding_line, warn_of_faults
from jaxmap.runs.evaluation import TruthOptions, read_truth
from jaxmap.stereo.front_end import StereoFrontEnd
from jaxmap.stereo.match import StereoOptions
from jaxmap.stereo.rectify import StereoRig
from jaxmap.types import StereoCamera, pinhole

RESULTS = "refine.json"
"""Written first: a folder that holds it holds a refinement."""

OUTPUTS = ("poses.tum", RESULTS, "report.html", "consistency.png", "trajectory.png")
CALIBRATION = "calibration.yaml"

DEPTH_SIGMA_M = 0.35
"""Points are used up to the depth where their noise reaches this, at half a pixel of disparity."""

MAX_RASTER_CELLS = 8_000_000

READING = 0.2
"""Share of the work that reading and matching the pairs takes."""

Advance = Callable[[float, str], None]
"""Called with the share that is done, and what is being done."""

Notify = Callable[[str], None]
"""Takes lines for the user."""


@dataclass(frozen=True)
class GroundFiles:
    """What is known of the ground: labelled orthomosaic or lists of rocks, elevation model, height of the cameras."""

    truth: tuple[Path, ...] = ()
    truth_options: TruthOptions = field(default_factory=TruthOptions)
    heights: Path | None = None
    below_camera_m: float | None = None


def run_refine(
    source: str,
    out: Path,
    options: ReadOptions,
    prior: Prior,
    files: GroundFiles,
    *,
    max_depth_m: float | None = None,
    align: bool = False,
    strict: bool = False,
    overwrite: bool = False,
    advance: Advance = lambda done, note: None,
    notify: Notify = lambda line: None,
) -> dict[str, Any]:
    """Refines a sequence and writes the best result so far after every round.

    Args:
        source: the folder of one sequence, or `sample:NAME`.
        out: folder for poses.tum, refine.json, calibration.yaml and the report.
        options: how the sequence is read.
        prior: what may be wrong, and by how much.
        files: what is known of the ground.
        max_depth_m: farther points are not used; by default where depth noise reaches `DEPTH_SIGMA_M`.
        align: rectify with an estimated correction, as jaxmap map --stereo.align does.
        strict: stop where the quick check of the sequence finds what makes a map wrong.
        overwrite: replace an earlier refinement in the folder.
        advance: reports progress.
        notify: takes lines for the user.

    Returns:
        The content of refine.json.

    Raises:
        JaxmapError: inputs that cannot be used, other files in the folder, or failed writing.
    """
    replacement = Replacement(out, lambda: [out / name for name in (*OUTPUTS, CALIBRATION)])
    replacement.settle_for_reading()
    check_replaceable(out, overwrite=overwrite)
    with locked(out), replacement.place(RESULTS, notify) as work:
        inputs = read_inputs(source, options, advance, notify, align=align, strict=strict)
        started_s = time.perf_counter()
        sequence, camera = inputs.sequence, inputs.front_end.camera
        depth_range_m = (0.3, max_depth_m or max(usable_depth(camera, DEPTH_SIGMA_M, 0.5), 0.5))
        ground, notes = read_ground(files, inputs, depth_range_m[1])
        content: dict[str, Any] = {}

        def write(state: Refinement) -> None:
            content.clear()
            content.update(results(state, inputs.T_world_camera, prior))
            content["frames"] = [frame.name for frame in sequence.frames]
            content["skipped"] = inputs.skipped
            content["notes"] = [*map(finding_line, inputs.findings), *notes, *state.notes]
            content["seconds"] = round(inputs.seconds + time.perf_counter() - started_s, 1)
            write_json(work / RESULTS, content)
            _write_poses(work, state, inputs, prior)

        state = refine(
            inputs.frames,
            inputs.T_world_camera,
            pinhole(camera),
            prior,
            ground,
            depth_range_m,
            advance=lambda done, note: advance(READING + (1 - READING) * done / (3 * len(inputs.frames)), note),
            on_round=write,
        )
        write_refine_report(work, sequence.name, state, content)
        return content


def check_inputs_apart(source: str, out: Path, inputs: Iterable[Path | None]) -> None:
    """Refuses to write where inputs lie; to be called before anything is made.

    Raises:
        UsageError: the folder is the sequence's own, or an output would overwrite an input.
    """
    if real_path(out) == real_path(source):
        raise UsageError("the folder is the sequence's own", where=out, fix="choose another --out")
    check_inputs_stay((out / name for name in (*OUTPUTS, CALIBRATION)), inputs)


def check_replaceable(out: Path, *, overwrite: bool) -> None:
    """Checks that the files in the folder may be replaced; removes none.

    Raises:
        JaxmapError: the folder holds a refinement, or files of the same names that no refinement has written.
    """
    there = [name for name in (*OUTPUTS, CALIBRATION) if (out / name).exists()]
    if not there:
        return
    try:
        earlier = read_json(out / RESULTS)
    except JaxmapError:
        earlier = None
    if not isinstance(earlier, dict) or not earlier.keys() >= {"matches", "map_height_spread_m", "whole_map"}:
        raise JaxmapError(
            f"{', '.join(there)} would be replaced, but no refinement has written them",
            where=out,
            fix="choose another --out",
        )
    if not overwrite:
        raise JaxmapError(
            "the folder holds a refinement already",
            where=out,
            fix="replace it (--overwrite), or choose another folder",
        )


@dataclass(frozen=True)
class RefineInputs:
    """A sequence, read and matched.

    Attributes:
        sequence: with the frames that can be used, and their given poses.
        front_end: its stereo front end.
        frames: one for each frame of the sequence.
        skipped: names of the other frames, with the reason.
        seconds: that reading took.
        findings: of the quick check.
    """

    sequence: StereoSequence
    front_end: StereoFrontEnd
    frames: list[DisparityFrame]
    skipped: list[dict[str, str]]
    seconds: float = 0.0
    findings: tuple[Finding, ...] = ()

    @property
    def T_world_camera(self) -> Float64[np.ndarray, "N 4 4"]:
        """Given poses of the rectified camera."""
        return self.sequence.T_world_camera @ self.front_end.T_raw_rectified


def read_inputs(
    source: str,
    options: ReadOptions,
    advance: Advance = lambda done, note: None,
    notify: Notify = lambda line: None,
    *,
    align: bool = False,
    strict: bool = False,
) -> RefineInputs:
    """Reads, checks and matches a sequence.

    Raises:
        JaxmapError: the sequence cannot be read, fewer than two of its frames can, or the check stops it (`strict`).
    """
    started_s = time.perf_counter()
    sequence = open_sequence(source, options, lambda done, total: advance(0.0, f"odometry {done} of {total}"))
    for note in sequence.notes:
        notify(f"note: {note}")
    front_end = open_front_end(sequence, StereoOptions(align=align), notify)
    findings = warn_of_faults(sequence, front_end, strict=strict, notify=notify)
    used: list[DisparityFrame] = []
    kept: list[int] = []
    skipped: list[dict[str, str]] = []

    def read(index: int) -> DisparityFrame | FrameError:
        frame = sequence.frames[index]
        try:
            pair = sequence.read_pair(frame)
            rectified = front_end(pair.left, pair.right)
            if index == 0:
                front_end.check_order(rectified, f"frame {frame.name}")
            made = make_disparity_frame(rectified.left, front_end.disparity_of(rectified))
            return made or FrameError("hardly any pixel has a disparity", fix="check the images")
        except FrameError as fault:
            return fault

    for index, found in enumerate(prefetch(read, range(len(sequence.frames)), workers=2, ahead=4)):
        if isinstance(found, DisparityFrame):
            used.append(found)
            kept.append(index)
        else:
            skipped.append({"frame": sequence.frames[index].name, "reason": str(found)})
        advance(READING * (index + 1) / len(sequence.frames), "reading")
    if len(used) < 2:
        reason = f"; the first of the others: {skipped[0]['reason']}" if skipped else ""
        raise JaxmapError(
            f"{len(used)} of {len(sequence.frames)} frames can be used{reason}",
            where=source,
            fix="refining needs two frames that overlap, or more",
        )
    frames = tuple(sequence.frames[index] for index in kept)
    sequence = replace(sequence, frames=frames, T_world_camera=sequence.T_world_camera[kept])
    return RefineInputs(sequence, front_end, used, skipped, time.perf_counter() - started_s, findings)


def read_ground(files: GroundFiles, inputs: RefineInputs, max_depth_m: float) -> tuple[GroundReference, list[str]]:
    """Reads what is known of the ground onto grids of the sequence's world; and notes on what was assumed.

    Raises:
        JaxmapError: a file cannot be read, or does not lie where the sequence was taken.
    """
    sequence = inputs.sequence
    track, origin = sequence.T_world_camera[:, :2, 3], sequence.site_origin
    lower, upper = track.min(axis=0) - max_depth_m, track.max(axis=0) + max_depth_m
    (west, south), (east, north) = lower + origin[:2], upper + origin[:2]
    place = Extent(float(west), float(south), float(east), float(north), sequence.crs)
    heights = is_rock = None
    notes: list[str] = []
    if files.heights is not None:
        raster = read_heights(files.heights, place)
        notes += raster.notes
        found = _on_grid(raster.height_m, raster.T_crs_pixel, raster.crs, (lower, upper), sequence, order=1)
        heights = found._replace(values=found.values - origin[2])
        _check_heights(heights, sequence, files.heights)
    if files.truth:
        labels = read_truth(files.truth, place, files.truth_options)
        notes += labels.notes
        values = np.where(labels.labels == UNLABELLED, np.nan, (labels.labels == TARGET).astype(np.float64))
        is_rock = _on_grid(values, labels.T_crs_pixel, labels.crs, (lower, upper), sequence, order=0)
        if not np.isfinite(is_rock.values).any():
            raise JaxmapError(
                "nothing is labelled where the sequence was taken",
                where=", ".join(map(str, files.truth)),
                fix="check that both are of one site, and --crs",
            )
    return GroundReference(heights, is_rock, files.below_camera_m), notes


def _on_grid(
    values: np.ndarray,
    T_crs_pixel: np.ndarray,
    crs: str | None,
    bounds: tuple[np.ndarray, np.ndarray],
    sequence: StereoSequence,
    order: int,
) -> GroundRaster:
    """Resamples a raster onto a grid of the world, as fine as the raster or as the memory allows."""
    lower, upper = bounds
    # Pixels of a raster in degrees look tiny; no ground is known more finely than to a centimetre.
    pixel_m = max(float(np.sqrt(abs(np.linalg.det(T_crs_pixel[:2, :2])))), 0.01)
    cell_m = max(pixel_m, float(np.sqrt(np.prod(upper - lower) / MAX_RASTER_CELLS)))
    if crs is not None and sequence.crs is not None and pixel_m == 0.01:
        cell_m = max(cell_m, 0.05)
    shape = np.ceil((upper - lower) / cell_m).astype(int)
    axes = (lower[axis] + (np.arange(shape[axis]) + 0.5) * cell_m + sequence.site_origin[axis] for axis in (0, 1))
    x, y = transform_between(sequence.crs, crs, "the ground")(*np.meshgrid(*axes, indexing="ij"))
    column, row = np.einsum("ij,jxy->ixy", np.linalg.inv(T_crs_pixel)[:2, :2], np.stack([x, y]))
    shift = np.linalg.inv(T_crs_pixel)[:2, 2]
    at = [row + shift[1] - 0.5, column + shift[0] - 0.5]
    return GroundRaster(map_coordinates(values, at, order=order, cval=np.nan), lower, cell_m)


def _check_heights(heights: GroundRaster, sequence: StereoSequence, path: Path) -> None:
    """Refuses an elevation model of another height system.

    Raises:
        JaxmapError: there is no height near the track, or it is far from the cameras'.
    """
    known = heights.values[np.isfinite(heights.values)]
    if not len(known):
        raise JaxmapError("no height where the sequence was taken", where=path, fix="check that both are of one site")
    above_m = float(np.median(sequence.T_world_camera[:, 2, 3]) - np.median(known))
    if not -5 < above_m < 20:
        raise JaxmapError(
            f"the cameras are {above_m:.1f} m above the elevation model",
            where=path,
            fix="check that poses and model use one height system (ellipsoid or geoid)",
        )


def _write_poses(out: Path, state: Refinement, inputs: RefineInputs, prior: Prior) -> None:
    """Writes the poses, and the calibration where any of it was refined, for the images as they lie on disk."""
    sequence, T_raw_rectified = inputs.sequence, inputs.front_end.T_raw_rectified
    T_world_raw = state.rig.T_world_camera @ np.linalg.inv(T_raw_rectified)
    T_world_raw[:, :3, 3] += sequence.site_origin
    write_tum(out / "poses.tum", np.array([frame.timestamp_s for frame in sequence.frames]), T_world_raw)
    mounted = prior.mounting_m or prior.mounting_rad
    if prior.baseline_scale or prior.offset_px or mounted:
        T_nominal_raw = T_raw_rectified @ state.rig.T_nominal_camera @ np.linalg.inv(T_raw_rectified)
        write_camera_yaml(out / CALIBRATION, _calibrated(sequence.camera, state), T_nominal_raw if mounted else None)


def _calibrated(camera: StereoCamera | StereoRig, state: Refinement) -> StereoCamera | StereoRig:
    scale, offset_px = float(np.exp(state.rig.log_baseline_scale)), state.rig.offset_px
    if isinstance(camera, StereoRig):
        return replace(camera, t_right_left_m=camera.t_right_left_m * scale, doffs_px=camera.doffs_px + offset_px)
    return replace(
        camera,
        baseline_m=jnp.asarray(float(camera.baseline_m) * scale, jnp.float32),
        doffs_px=jnp.asarray(float(camera.doffs_px) + offset_px, jnp.float32),
    )

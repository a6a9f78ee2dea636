"""`jaxmap refine`, from files to files: a sequence and what is known of the ground in, refined poses out."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64
from scipy.ndimage import map_coordinates

from jaxmap.datasets import ReadOptions, StereoSequence, open_sequence
from jaxmap.datasets.calibration import write_camera_yaml
from jaxmap.datasets.crs import Extent, transform_between
from jaxmap.datasets.label_raster import TARGET, UNLABELLED
from jaxmap.datasets.poses import write_tum
from jaxmap.datasets.rasters import read_heights
from jaxmap.errors import FrameError, JaxmapError, UsageError
from jaxmap.geometry.bounds import usable_depth
from jaxmap.host.files import remove
from jaxmap.host.output_folder import check_inputs_stay, locked, write_json
from jaxmap.host.prefetch import prefetch
from jaxmap.refinement.anchors import Raster
from jaxmap.refinement.rounds import Ground, Refinement, refine
from jaxmap.refinement.solve import Prior
from jaxmap.refinement.summary import results
from jaxmap.refinement.views import View, make_view, pinhole
from jaxmap.report.refine_page import write_refine_report
from jaxmap.runs.evaluation import TruthOptions, read_truth
from jaxmap.stereo.front_end import StereoFrontEnd
from jaxmap.stereo.match import StereoOptions
from jaxmap.stereo.rectify import StereoRig
from jaxmap.types import StereoCamera

RESULTS = "refine.json"
"""Written first: where it lies, the other files are a refinement's."""

PAGE = ("report.html", "consistency.png", "trajectory.png")
"""Written last."""

OUTPUTS = ("poses.tum", RESULTS, *PAGE)
CALIBRATION = "calibration.yaml"


def check_apart(source: str, out: Path, inputs: Iterable[Path | None]) -> None:
    """Refuses to write where inputs lie; to be called before anything is made.

    Raises:
        UsageError: the folder is the sequence's own, or an output would overwrite an input.
    """
    if out.resolve() == Path(source).resolve():
        raise UsageError("the folder is the sequence's own", where=out, fix="choose another --out")
    check_inputs_stay((out / name for name in (*OUTPUTS, CALIBRATION)), inputs)


def begin(out: Path, *, overwrite: bool) -> None:
    """Checks that what lies in the folder may be replaced; nothing is removed yet.

    Raises:
        JaxmapError: it holds a refinement already, or files of the same names that no refinement has written.
    """
    there = [name for name in (*OUTPUTS, CALIBRATION) if (out / name).exists()]
    if not there:
        return
    if not _is_refinement(out):
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


def _is_refinement(out: Path) -> bool:
    """Whether what lies here was written by a refinement."""
    try:
        content = json.loads((out / RESULTS).read_text(encoding="utf8"))
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(content, dict) and content.keys() >= {"matches", "map_height_spread_m", "whole_map"}


def forget_earlier(out: Path) -> None:
    """Removes what an earlier refinement has written beside its results; to be called once there are new ones.

    The results themselves go last, by being replaced: they tell whose the folder is.

    Raises:
        JaxmapError: a file cannot be removed.
    """
    for name in (*OUTPUTS, CALIBRATION):
        if name != RESULTS:
            remove(out / name)


MAX_RASTER_CELLS = 8_000_000
READING = 0.2
"""Share of the work that reading and matching the pairs is."""

DEPTH_SIGMA_M = 0.35
"""Depths count up to where their noise reaches this, at half a pixel of disparity."""


@dataclass(frozen=True)
class GroundFiles:
    """What is known of the ground: labelled orthomosaic or lists of rocks, elevation model, height of the cameras."""

    truth: tuple[Path, ...] = ()
    truth_options: TruthOptions = field(default_factory=TruthOptions)
    heights: Path | None = None
    below_camera_m: float | None = None


@dataclass(frozen=True)
class RefineInputs:
    """A sequence, read and matched.

    Attributes:
        sequence: with the frames that can be used, and their poses as given.
        front_end: its stereo front end.
        views: one for each frame.
        skipped: names of the other frames, with the reason.
        seconds: that reading took.
    """

    sequence: StereoSequence
    front_end: StereoFrontEnd
    views: list[View]
    skipped: list[dict[str, str]]
    seconds: float = 0.0

    @property
    def T_world_camera(self) -> Float64[np.ndarray, "N 4 4"]:
        """Given poses of the rectified camera."""
        return self.sequence.T_world_camera @ self.front_end.T_raw_rectified


Advance = Callable[[float, str], None]
"""Told the share that is done, and what is being done."""
Notify = Callable[[str], None]


def read_inputs(source: str, options: ReadOptions, advance: Advance = lambda done, note: None) -> RefineInputs:
    """Reads and matches a sequence.

    Raises:
        JaxmapError: the sequence cannot be read, or fewer than two of its frames can.
    """
    started_s = time.perf_counter()
    sequence = open_sequence(source, options)
    front_end = StereoFrontEnd(sequence.camera, StereoOptions())
    views: list[View] = []
    kept: list[int] = []
    skipped: list[dict[str, str]] = []

    def read(index: int) -> View | FrameError:
        frame = sequence.frames[index]
        try:
            pair = sequence.read_pair(frame)
            rectified = front_end(pair.left, pair.right)
            if index == 0:
                front_end.check_order(rectified, f"frame {frame.name}")
            view = make_view(rectified.left, rectified.disparity_px)
            return view or FrameError("hardly any pixel has a disparity", fix="check the images")
        except FrameError as fault:
            return fault

    for index, found in enumerate(prefetch(read, range(len(sequence.frames)), workers=2, ahead=4)):
        if isinstance(found, View):
            views.append(found)
            kept.append(index)
        else:
            skipped.append({"frame": sequence.frames[index].name, "reason": str(found)})
        advance(READING * (index + 1) / len(sequence.frames), "reading")
    if len(views) < 2:
        reason = f"; the first of the others: {skipped[0]['reason']}" if skipped else ""
        raise JaxmapError(
            f"{len(views)} of {len(sequence.frames)} frames can be used{reason}",
            where=source,
            fix="refining needs two frames that overlap, or more",
        )
    frames = tuple(sequence.frames[index] for index in kept)
    used = replace(sequence, frames=frames, T_world_camera=sequence.T_world_camera[kept])
    return RefineInputs(used, front_end, views, skipped, time.perf_counter() - started_s)


def ground_of(files: GroundFiles, inputs: RefineInputs, max_depth_m: float) -> tuple[Ground, list[str]]:
    """Reads what is known of the ground, onto grids of the sequence's world; and what was assumed.

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
    return Ground(heights, is_rock, files.below_camera_m), notes


def _on_grid(
    values: np.ndarray,
    T_crs_pixel: np.ndarray,
    crs: str | None,
    bounds: tuple[np.ndarray, np.ndarray],
    sequence: StereoSequence,
    order: int,
) -> Raster:
    """A raster brought onto a grid of the world, as fine as it is itself or as the memory allows."""
    lower, upper = bounds
    # Of a raster in degrees, the pixel is small: finer than a centimetre no ground is known.
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
    return Raster(map_coordinates(values, at, order=order, cval=np.nan), lower, cell_m)


def _check_heights(heights: Raster, sequence: StereoSequence, path: Path) -> None:
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


def run_refine(
    source: str,
    out: Path,
    options: ReadOptions,
    prior: Prior,
    files: GroundFiles,
    *,
    max_depth_m: float | None = None,
    overwrite: bool = False,
    advance: Advance = lambda done, note: None,
    notify: Notify = lambda line: None,
) -> dict[str, Any]:
    """Refines a sequence and writes what comes out, after every round the best so far.

    Args:
        source: the folder of one sequence, or `sample:NAME`.
        out: folder for poses.tum, refine.json, calibration.yaml and the report.
        options: how the sequence is read.
        prior: what may be wrong, and by how much.
        files: what is known of the ground.
        max_depth_m: farther points do not count; by default where depth noise reaches `DEPTH_SIGMA_M`.
        overwrite: replace a refinement that lies in the folder.
        advance: told how far it is.
        notify: takes lines for the user.

    Returns:
        What is in refine.json.

    Raises:
        JaxmapError: the inputs do not serve, the folder holds other files, or writing failed.
    """
    with locked(out):
        begin(out, overwrite=overwrite)
        inputs = read_inputs(source, options, advance)
        for note in inputs.sequence.notes:
            notify(f"note: {note}")
        return _refined(out, inputs, prior, files, max_depth_m, advance)


def _refined(
    out: Path, inputs: RefineInputs, prior: Prior, files: GroundFiles, max_depth_m: float | None, advance: Advance
) -> dict[str, Any]:
    """Refines what was read, and writes it after every round."""
    started_s = time.perf_counter()
    sequence, camera = inputs.sequence, inputs.front_end.camera
    depth_range_m = (0.3, max_depth_m or max(usable_depth(camera, DEPTH_SIGMA_M, 0.5), 0.5))
    ground, notes = ground_of(files, inputs, depth_range_m[1])
    frames = len(inputs.views)
    content: dict[str, Any] = {}

    def keep(state: Refinement) -> None:
        if not content:
            forget_earlier(out)
        content.clear()
        content.update(results(state, inputs.T_world_camera, prior))
        content["frames"] = [frame.name for frame in sequence.frames]
        content["skipped"] = inputs.skipped
        content["notes"] = [*notes, *state.notes]
        content["seconds"] = round(inputs.seconds + time.perf_counter() - started_s, 1)
        _write(out, state, inputs, prior, content)

    state = refine(
        inputs.views,
        inputs.T_world_camera,
        pinhole(camera),
        prior,
        ground,
        depth_range_m,
        advance=lambda done, note: advance(READING + (1 - READING) * done / (3 * frames), note),
        on_round=keep,
    )
    write_refine_report(out, sequence.name, state, content)
    return content


def _write(out: Path, state: Refinement, inputs: RefineInputs, prior: Prior, content: dict[str, Any]) -> None:
    """Writes results and poses, and the calibration where something of it was refined."""
    sequence, front_end = inputs.sequence, inputs.front_end
    T_raw_rectified = front_end.T_raw_rectified
    T_world_raw = state.rig.T_world_camera @ np.linalg.inv(T_raw_rectified)
    T_world_raw[:, :3, 3] += sequence.site_origin
    write_json(out / RESULTS, content)
    write_tum(out / "poses.tum", np.array([frame.timestamp_s for frame in sequence.frames]), T_world_raw)
    if not (prior.baseline_scale or prior.offset_px or prior.mounting_m or prior.mounting_rad):
        return
    # The displacement in the frame of the images as they lie on disk.
    T_nominal_raw = T_raw_rectified @ state.rig.T_nominal_camera @ np.linalg.inv(T_raw_rectified)
    mounted = T_nominal_raw if prior.mounting_m or prior.mounting_rad else None
    write_camera_yaml(out / CALIBRATION, _calibrated(sequence.camera, state), mounted)


def _calibrated(camera: StereoCamera | StereoRig, state: Refinement) -> StereoCamera | StereoRig:
    scale, offset_px = float(np.exp(state.rig.log_baseline_scale)), state.rig.offset_px
    if isinstance(camera, StereoRig):
        return replace(camera, t_right_left_m=camera.t_right_left_m * scale, doffs_px=camera.doffs_px + offset_px)
    return replace(
        camera,
        baseline_m=jnp.asarray(float(camera.baseline_m) * scale, jnp.float32),
        doffs_px=jnp.asarray(float(camera.doffs_px) + offset_px, jnp.float32),
    )

"""`jaxmap evaluate`, from files to files: a run and its ground truth in, scores and an error map out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float64, UInt8

import jaxmap
from jaxmap.datasets.crs import Extent, crs_text, read_crs, transform_between
from jaxmap.datasets.label_raster import DEFAULT_CODING, LabelCoding, LabelRaster, read_label_orthomosaic
from jaxmap.datasets.poses import read_poses
from jaxmap.datasets.rasters import read_picture
from jaxmap.datasets.rock_list import DEFAULT_DIAMETERS_M, draw_rocks, find_rock_lists, read_rock_lists
from jaxmap.ensemble.layer import layer_names, stored_layers
from jaxmap.errors import JaxmapError, UsageError
from jaxmap.evaluation.camera_track import CameraTrack
from jaxmap.evaluation.evaluate import ClassLayer, Evaluation, evaluate_map, place_of
from jaxmap.evaluation.options import ScoringOptions
from jaxmap.evaluation.truth_cells import MAX_HEADING_RAD, pixel_corners, sample_between
from jaxmap.fusion.options import FusionRule
from jaxmap.fusion.params import FusionParams, stored_fusion
from jaxmap.fusion.query import TopDown, top_down
from jaxmap.geometry.grid import exact_corner
from jaxmap.host.bounded_text import read_json
from jaxmap.host.output_folder import write_json
from jaxmap.mapping.arrays import TILE
from jaxmap.mapping.attributes import MapAttributes
from jaxmap.mapping.columns import MOST_WHOLE, part_of, top_down_of
from jaxmap.mapping.store import Columns, MapReader, open_map
from jaxmap.report.error_map import write_error_map
from jaxmap.runs.folder import RunFolder
from jaxmap.types import GridSpec, VoxelMap

_MARGIN_M, _MARGIN_SHARE = 3.0, 0.05
_BACKDROP_SAMPLES = 8
_AROUND_M, _RIM_SAMPLES = 10.0, 33


@dataclass(frozen=True)
class TruthOptions:
    """How the ground truth is read.

    Attributes:
        target: the class of the map, and of the truth, that is scored.
        coding: what the values of an orthomosaic mean.
        crs: the system of the truth, in place of its own.
        diameters_m: of rocks in lists that give none, by size class.
    """

    target: str = "rock"
    coding: LabelCoding = DEFAULT_CODING
    crs: str | None = None
    diameters_m: Mapping[str, float] | None = None


class ScoredMap(NamedTuple):
    """A map that is scored for one class, not yet read."""

    reader: MapReader
    params: FusionParams
    rule: FusionRule
    target: str
    path: Path

    def layer(self, within: Columns) -> ClassLayer:
        """The class over a rectangle of columns.

        Raises:
            JaxmapError: a tile is damaged, or no memory holds the columns.
        """
        attributes = self.reader.attributes
        top = top_down_of(self.reader, self.params, self.rule, within)
        grid = part_of(self.reader.grid, within)
        where = (np.asarray(attributes.site_origin, np.float64), attributes.crs)
        layer = _class_layer(top, grid, self.reader.classes, self.params, self.target, *where)
        if not attributes.layers.keys() >= set(layer_names(self.target)):
            return layer
        ensemble = stored_layers(self.reader.layers(within), self.target, self.path)
        return layer if ensemble is None else replace(layer, ensemble=np.asarray(ensemble.probability))


def open_scored(run: Path, target: str) -> ScoredMap:
    """Opens the map of a run to be scored for the class `target`.

    Raises:
        JaxmapError: there is no map, or it is damaged.
        UsageError: it has no such class.
    """
    folder = RunFolder(run)
    if not run.is_dir():
        raise JaxmapError("no such run folder", where=run, fix="give a folder that `jaxmap map` wrote")
    reader = open_map(folder.map)
    if target not in reader.classes:
        known = f"its classes are {' '.join(reader.classes)}" if reader.classes else "it has no class at all"
        raise UsageError(f"the map has no class {target!r}: {known}", where=folder.map, fix="name one with --class")
    params, rule = stored_fusion(reader.attributes.fusion, reader.classes, folder.map)
    return ScoredMap(reader, params, rule, target, folder.map)


def class_layer_of(
    voxel_map: VoxelMap,
    params: FusionParams,
    rule: FusionRule,
    target: str,
    *,
    site_origin: Float64[np.ndarray, "3"],
    crs: str | None,
) -> ClassLayer:
    """One class of a map, as it is scored.

    Args:
        voxel_map: the map.
        params: of fusion, by which the evidence is read.
        rule: of fusion, likewise.
        target: name of the class.
        site_origin: where the origin of the map's world lies in `crs`, metres.
        crs: coordinate reference system of the site, or None.
    """
    top = top_down(voxel_map, params, rule)
    return _class_layer(top, voxel_map.grid, voxel_map.classes, params, target, site_origin, crs)


def _class_layer(
    top: TopDown,
    grid: GridSpec,
    classes: tuple[str, ...],
    params: FusionParams,
    target: str,
    site_origin: Float64[np.ndarray, "3"],
    crs: str | None,
) -> ClassLayer:
    index, observed = classes.index(target), np.asarray(top.observed)
    return ClassLayer(
        grid=grid,
        is_class=(np.asarray(top.label) == index) & observed,
        probability=np.asarray(top.probability[index]),
        observed=observed,
        height_m=np.asarray(top.height_m),
        prior=float(jax.nn.sigmoid(params.class_prior[index])),
        site_origin=site_origin,
        crs=crs,
    )


def read_cameras(run: Path, site_origin: np.ndarray) -> tuple[CameraTrack | None, str]:
    """The cameras of a run from its poses.tum and metrics.json; None, and why, where they cannot be read.

    The poses are those of the images as they were stored: where jaxmap rectified them, the view is off by the
    rectifying rotation, fractions of a degree for a usual rig.
    """
    folder = RunFolder(run)
    try:
        track = read_poses(folder.poses)
        metrics = read_json(folder.metrics)
        camera, depth_range_m = metrics["camera"], metrics["grid"]["depth_range_m"]
        T_world_camera = track.T.copy()
        T_world_camera[:, :3, 3] -= site_origin
        numbers = {name: float(camera[f"{name}_px"]) for name in ("fx", "fy", "cx", "cy", "width", "height")}
        cameras = CameraTrack(
            T_world_camera,
            (numbers["fx"], numbers["fy"]),
            (numbers["cx"], numbers["cy"]),
            (int(numbers["width"]), int(numbers["height"])),
            float(depth_range_m[1]),
        )
    except (JaxmapError, ValueError, KeyError, TypeError, IndexError, OverflowError) as error:
        reason = error if isinstance(error, JaxmapError) else f"{folder.metrics.name} cannot be read"
        return (
            None,
            f"the cameras' view is not known ({reason}): every labelled cell of the map counts as in view",
        )
    return cameras, ""


def read_truth(sources: Sequence[Path], place: Extent, options: TruthOptions) -> LabelRaster:
    """Reads ground truth: one labelled orthomosaic, or lists of rocks (files, or a folder of them).

    Raises:
        JaxmapError: nothing there, what the readers refuse, or kinds that do not go together.
    """
    lists = [path for source in sources for path in find_rock_lists(source)]
    rasters = [source for source in sources if not source.is_dir() and source not in lists]
    if lists and not rasters:
        rocks = read_rock_lists(lists, options.diameters_m or DEFAULT_DIAMETERS_M)
        return draw_rocks(rocks, place, options.crs, ", ".join(path.name for path in lists))
    if len(rasters) != 1 or lists:
        where = ", ".join(str(source) for source in sources)
        raise UsageError(
            "no ground truth" if not lists and not rasters else "several ground truths",
            where=where,
            fix="give one labelled orthomosaic, or lists of rocks (x y [diameter], .txt or .csv)",
        )
    if options.crs is not None:
        read_crs(options.crs, "--truth-crs")
    margin = _MARGIN_M + _MARGIN_SHARE * max(place.east - place.west, place.north - place.south)
    return read_label_orthomosaic(
        rasters[0], place, coding=options.coding, target=options.target, crs=options.crs, margin=margin
    )


def evaluate_run(
    run: Path, sources: Sequence[Path], truth_options: TruthOptions, options: ScoringOptions
) -> tuple[Evaluation, ClassLayer]:
    """Scores the map of a run; `scores` records all that they rest on.

    Raises:
        JaxmapError: map or truth cannot be read, or do not lie over each other.
    """
    scored = open_scored(run, truth_options.target)
    grid, attributes = scored.reader.grid, scored.reader.attributes
    site_origin = np.asarray(attributes.site_origin, np.float64)
    cameras, remark = read_cameras(run, site_origin)
    if cameras is None and options.max_range_m is not None:
        raise JaxmapError(
            f"--max-range-m needs poses.tum and metrics.json of the run: {remark}", where=run, fix="map again"
        )
    raster = read_truth(sources, place_of(grid, site_origin, attributes.crs), truth_options)
    within = slice(0, grid.shape[0]), slice(0, grid.shape[1])
    if grid.shape[0] * grid.shape[1] > MOST_WHOLE:
        within = _columns_under(raster, grid, within, attributes)
    layer = scored.layer(within)
    evaluation = evaluate_map(layer, raster, cameras, options)
    evaluation.scores.update(
        {
            "class": truth_options.target,
            "run": str(run),
            "ground_truth": [str(source) for source in sources],
            "crs": crs_text(layer.crs or raster.crs) if layer.crs or raster.crs else None,
            "notes": [*raster.notes, *([remark] if remark else [])],
            "jaxmap_version": jaxmap.__version__,
        }
    )
    return evaluation, layer


def _columns_under(raster: LabelRaster, grid: GridSpec, within: Columns, attributes: MapAttributes) -> Columns:
    """The columns that a truth can be compared with, some metres around it included: the rest of a large map is left.

    Raises:
        JaxmapError: no transformation is known between its system and the map's.
    """
    height, width = raster.labels.shape
    rim = np.linspace(0, 1, _RIM_SAMPLES)
    zero, one = np.zeros_like(rim), np.ones_like(rim)
    column, row = np.concatenate([[rim, zero], [rim, one], [zero, rim], [one, rim]], axis=1)
    T, transform = raster.T_crs_pixel, transform_between(raster.crs, attributes.crs, raster.name)
    xy = np.stack(transform(*(T[i, 0] * column * width + T[i, 1] * row * height + T[i, 2] for i in (0, 1))), axis=-1)
    xy = xy[np.isfinite(xy).all(axis=-1)] - np.asarray(attributes.site_origin)[:2]
    if not len(xy):
        return within
    # Far enough for the ground beside it, and for a truth that is turned and shifted to where it fits.
    margin_m = _AROUND_M + 2 * MAX_HEADING_RAD * float(np.linalg.norm(np.ptp(xy, axis=0)))
    corner_m, voxel_m = (numbers[:2] for numbers in exact_corner(grid))
    first = np.floor((xy.min(axis=0) - margin_m - corner_m) / voxel_m).astype(int)
    last = np.ceil((xy.max(axis=0) + margin_m - corner_m) / voxel_m).astype(int)
    # Whole tiles: what is left out does not move the cells.
    first, last = first // TILE[:2] * TILE[:2], -(-last // TILE[:2]) * TILE[:2]
    x, y = (
        slice(max(int(a), part.start), max(min(int(b), part.stop), max(int(a), part.start) + 1))
        for a, b, part in zip(first, last, within, strict=True)
    )
    return x, y


def read_backdrop(path: Path, evaluation: Evaluation, layer: ClassLayer) -> UInt8[np.ndarray, "BI BJ 3"]:
    """An orthomosaic on the cells of an evaluation, several samples for each, moved as the truth was.

    Raises:
        JaxmapError: it cannot be read.
    """
    pixels, T_crs_pixel, crs = read_picture(path, layer.place)
    place = (evaluation.cells, layer.site_origin, layer.crs, evaluation.alignment)
    return sample_between(pixels, pixel_corners(T_crs_pixel, crs, *place), _BACKDROP_SAMPLES)


def write_evaluation(
    out: Path, picture: Path, evaluation: Evaluation, backdrop: UInt8[np.ndarray, "BI BJ 3"] | None
) -> None:
    """Writes the scores as JSON and the error map as PNG, over a backdrop (`read_backdrop`) where there is one.

    Raises:
        JaxmapError: writing failed.
    """
    write_error_map(picture, evaluation, backdrop)
    write_json(out, evaluation.scores)


def summary(scores: dict[str, Any]) -> str:
    """One line on what scores rest on."""
    frames = "" if scores["frames"] is None else f"{scores['frames']} frames, "
    within = "" if scores["max_range_m"] is None else f" within {scores['max_range_m']:g} m"
    rocks = scores["rocks"]
    return (
        f"{frames}{scores['cells']:,} cells of {scores['cell_size_m']:g} m observed and labelled{within}, "
        f"{scores['rock_cells']:,} of them {scores['class']}; {rocks['count'] - rocks['missed']} of {rocks['count']} "
        f"rocks in view found (at least {rocks['found_share']:.0%} of their area called {scores['class']})"
    )

"""What metrics.json holds of a mapping run, and what of it the user is told."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

import jaxmap
from jaxmap.geometry.bounds import map_bytes
from jaxmap.host.memory import peak_resident_mib
from jaxmap.mapping.store import MapReader
from jaxmap.runs.checking import finding_line, findings_tree
from jaxmap.runs.folder import count_voxels
from jaxmap.runs.log import RunLog
from jaxmap.runs.mapping_plan import Plan
from jaxmap.types import GridSpec

FEW_MATCHED = 0.01
"""Where fewer pixels of a frame have a depth in range, it is not the bounds that leave a map empty."""


def metrics_of(plan: Plan, log: RunLog, reader: MapReader) -> dict[str, Any]:
    """What metrics.json holds."""
    return {
        "jaxmap_version": jaxmap.__version__,
        "sequence": _of_sequence(plan, log),
        "camera": _of_camera(plan),
        "grid": grid_metrics(plan.grid) | {"depth_range_m": list(plan.depth_range_m)},
        "labeller": plan.labeller.name,
        **({"model": {"file": str(plan.model.path), "sha256": plan.model.sha256}} if plan.model is not None else {}),
        "times": {
            "total_s": round(log.total_s, 3),
            "compile_s": round(log.compile_s, 3),
            "frames_per_s": round(log.fused / max(log.total_s, 1e-9), 3),
            "stages": log.stage_summary(),
        },
        "points": {
            "valid_fraction": round(log.valid_fractions.percentile(50), 4),
            "fused": log.points_fused,
            **({"frames_too_near": log.too_near} if log.too_near else {}),
        },
        **(
            {"disparity": {name: round(sample.total / sample.count, 4) for name, sample in log.disparity.items()}}
            if log.disparity
            else {}
        ),
        "voxels": count_voxels(reader, plan.params.fusion, plan.rule),
        "memory": _of_memory(plan, log),
    }


def _of_sequence(plan: Plan, log: RunLog) -> dict[str, Any]:
    sequence = plan.sequence
    steps_m = np.linalg.norm(np.diff(sequence.T_world_camera[:, :3, 3], axis=0), axis=1)
    return {
        "name": sequence.name,
        "dataset": sequence.dataset,
        "frames": len(sequence.frames),
        "fused": log.fused,
        "skipped": log.skipped,
        **({} if log.without_ground is None else {"without_ground": log.without_ground}),
        "crs": sequence.crs,
        "site_origin": sequence.site_origin.tolist(),
        "path_length_m": round(float(steps_m.sum()), 3),
        "notes": [*sequence.notes, *map(finding_line, plan.findings)],
        **({"findings": findings_tree(plan.findings)} if plan.findings else {}),
    }


def _of_camera(plan: Plan) -> dict[str, Any]:
    front_end = plan.front_end
    camera, T_raw_rectified, turn = front_end.camera, front_end.T_raw_rectified, front_end.alignment_rad
    numbers = ("fx_px", "fy_px", "cx_px", "cy_px", "baseline_m", "doffs_px")
    # Poses of the rectified camera, relative to the site origin.
    poses = {index: plan.sequence.T_world_camera[index] @ T_raw_rectified for index in plan.key_frames}
    return {
        **{name: round(float(getattr(camera, name)), 6) for name in numbers},
        "width_px": camera.width_px,
        "height_px": camera.height_px,
        "rectified_here": front_end.rectified_here,
        **({} if turn is None else {"alignment_rad": turn.round(8).tolist()}),
        "key_frames": {f"{index:06d}": pose.round(6).tolist() for index, pose in poses.items()},
        "T_raw_rectified": T_raw_rectified.round(9).tolist(),
    }


def grid_metrics(grid: GridSpec) -> dict[str, Any]:
    """What metrics.json holds of a grid."""
    return {
        "shape": list(grid.shape),
        "voxel_size_m": np.asarray(grid.voxel_size_m, np.float64).round(6).tolist(),
        "origin_m": np.asarray(grid.origin_m, np.float64).round(6).tolist(),
    }


def _of_memory(plan: Plan, log: RunLog) -> dict[str, float]:
    grid, classes = plan.grid, len(plan.labeller.classes)
    taken = {"map": map_bytes(grid, classes)}
    if plan.block_shape is not None:
        taken["block"] = map_bytes(replace(grid, shape=plan.block_shape), classes)
    if plan.members:
        taken["members"] = map_bytes(grid, 0, plan.members) - map_bytes(grid, 0)
    taken["step_temporary"] = log.temporary_bytes
    mib = {f"{name}_mib": round(size / 2**20, 2) for name, size in taken.items()}
    return mib | {"peak_resident_mib": round(peak_resident_mib(), 1)}


def notes(plan: Plan, log: RunLog, metrics: dict[str, Any]) -> Iterator[str]:
    """What the user should look at."""
    said = {finding.kind for finding in plan.findings}
    if log.too_near and not said & {"near-limit", "vertical-disparity"}:
        matcher = plan.front_end.matcher
        needed = -(-(log.nearest_px + 1 - matcher.options.min_disparity_px) // 16) * 16
        yield (
            f"in {log.too_near} of {log.fused} frames something is nearer than {matcher.num_disparities} disparities "
            f"can see, and was left out: the map has a hole there; --stereo.num-disparities {needed:.0f} sees it"
        )
    if scores := metrics.get("disparity"):
        yield (
            f"against the true disparity: median error {scores['median_error_px']:.2f} px, {scores['bad_2']:.1%} off "
            f"by more than 2 px, {scores['valid']:.0%} of the pixels matched"
        )
    if log.without_ground:
        yield (
            f"no ground below the camera in {log.without_ground} of {log.fused} frames: nothing there is sand or rock "
            "by its shape; check that the poses are of the left camera in a z-up world"
        )
    if not metrics["voxels"]["occupied"]:
        matched = log.valid_fractions.percentile(50)
        reason = "check the bounds, the range and the poses"
        if matched < FEW_MATCHED:
            reason = f"only {matched:.1%} of the pixels lie in range; jaxmap check tells what is wrong with the images"
        yield f"no voxel is occupied: {reason}"

"""What a run left in its folder, read for the report."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxmap.datasets.poses import read_poses
from jaxmap.errors import JaxmapError
from jaxmap.fusion.options import FusionRule
from jaxmap.fusion.params import FusionParams, stored_fusion
from jaxmap.mapping.store import MapAttributes, load_map
from jaxmap.types import VoxelMap

PICTURE_KINDS = ("left", "disparity", "labels")
_PICTURE_NAME = re.compile(rf"(?P<frame>.+)_(?P<kind>{'|'.join(PICTURE_KINDS)})\.png")


@dataclass(frozen=True)
class RunContents:
    """A run that was read.

    Attributes:
        metrics: the content of `metrics.json`.
        trajectory_world: positions of the left camera in the map's world, None without `poses.tum`.
        pictures: paths by kind (`PICTURE_KINDS`), by the number of their key frame.
        config_text: the resolved configuration, empty without `config.yaml`.
        remarks: what could not be read, in words.
    """

    path: Path
    voxel_map: VoxelMap
    attributes: MapAttributes
    params: FusionParams
    rule: FusionRule
    metrics: dict[str, Any]
    trajectory_world: Float[np.ndarray, "N 3"] | None
    pictures: dict[str, dict[str, Path]]
    config_text: str
    remarks: tuple[str, ...]


def read_run(run: Path) -> RunContents:
    """Reads a run folder.

    Raises:
        JaxmapError: the map or the metrics are missing or broken.
    """
    run = Path(run)
    if not run.is_dir():
        raise JaxmapError("no such run folder", where=run, fix="give a folder that `jaxmap map` wrote")
    voxel_map, attributes = load_map(run / "map.zarr")
    params, rule = stored_fusion(attributes.fusion, voxel_map.classes, run / "map.zarr")
    trajectory_world, remarks = _trajectory(run / "poses.tum", attributes.site_origin)
    config = run / "config.yaml"
    return RunContents(
        path=run,
        voxel_map=voxel_map,
        attributes=attributes,
        params=params,
        rule=rule,
        metrics=_metrics(run / "metrics.json"),
        trajectory_world=trajectory_world,
        pictures=_pictures(run / "pictures"),
        config_text=config.read_text(encoding="utf-8", errors="replace") if config.is_file() else "",
        remarks=remarks,
    )


def _metrics(path: Path) -> dict[str, Any]:
    fix = "finish the run (jaxmap map ... --resume), or bring the file back"
    try:
        metrics = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise JaxmapError("no such file", where=path, fix=fix) from error
    except (OSError, ValueError) as error:
        raise JaxmapError(f"not readable as JSON ({error})", where=path, fix=fix) from error
    if not isinstance(metrics, dict):
        raise JaxmapError("not a JSON object", where=path, fix=fix)
    return metrics


def _trajectory(
    path: Path, site_origin: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "N 3"] | None, tuple[str, ...]]:
    if not path.is_file():
        return None, ()
    try:
        return read_poses(path).T[:, :3, 3] - site_origin, ()
    except JaxmapError:
        return None, (f"{path.name} could not be read: the path is left out.",)


def _pictures(folder: Path) -> dict[str, dict[str, Path]]:
    pictures: dict[str, dict[str, Path]] = {}
    for path in sorted(folder.glob("*.png")):
        if match := _PICTURE_NAME.fullmatch(path.name):
            pictures.setdefault(match["frame"], {})[match["kind"]] = path
    return pictures

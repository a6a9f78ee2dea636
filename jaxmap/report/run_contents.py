"""What a run left in its folder, read for its page."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxmap.datasets.poses import read_poses
from jaxmap.errors import JaxmapError
from jaxmap.export.voxels import OccupiedVoxels, occupied_voxels
from jaxmap.fusion.params import FusionParams, FusionRule, stored_fusion
from jaxmap.host.bounded_text import read_json
from jaxmap.mapping.store import MapAttributes, load_map
from jaxmap.types import VoxelMap

PICTURES = {"left": "Left image", "labels": "Labels", "disparity": "Disparity, near red to far blue"}
"""The kinds of pictures of a key frame, with their captions."""
_PICTURE_NAME = re.compile(rf"(?P<frame>\d+)_(?P<kind>{'|'.join(PICTURES)})\.(png|webp)")


@dataclass(frozen=True)
class RunContents:
    """What a run left in its folder.

    Attributes:
        path: the folder.
        voxel_map: the map, with its attributes.
        params: of fusion, by which the map is read.
        rule: of fusion, likewise.
        voxels: the occupied ones.
        metrics: the content of `metrics.json`.
        trajectory_world: positions of the left camera in the map's world, None without `poses.tum`.
        pictures: paths by kind (left, disparity, labels), by the number of their key frame.
        remarks: what could not be read.
    """

    path: Path
    voxel_map: VoxelMap
    attributes: MapAttributes
    params: FusionParams
    rule: FusionRule
    voxels: OccupiedVoxels
    metrics: dict[str, Any]
    trajectory_world: Float[np.ndarray, "N 3"] | None
    pictures: dict[str, dict[str, Path]]
    remarks: list[str]

    @property
    def name(self) -> str:
        """That of the sequence, or else of the folder."""
        return str(self.group("sequence").get("name") or self.path.resolve().name)

    def group(self, key: str) -> dict[str, Any]:
        """A group of metrics; empty where it is absent or no group."""
        value = self.metrics.get(key)
        return value if isinstance(value, dict) else {}


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
    path, fix = run / "metrics.json", "finish the run (jaxmap map ... --resume), or bring the file back"
    try:
        metrics = read_json(path)
    except JaxmapError as error:
        raise JaxmapError(error.what, where=error.where, fix=fix) from error
    if not isinstance(metrics, dict):
        raise JaxmapError("not a JSON object", where=path, fix=fix)
    trajectory_world, remarks = None, []
    if (run / "poses.tum").is_file():
        try:
            trajectory_world = read_poses(run / "poses.tum").T[:, :3, 3] - attributes.site_origin
        except JaxmapError:
            remarks.append("poses.tum could not be read: the path is left out.")
    pictures: dict[str, dict[str, Path]] = {}
    for picture in sorted((run / "pictures").glob("*")):
        if match := _PICTURE_NAME.fullmatch(picture.name):
            pictures.setdefault(match["frame"], {})[match["kind"]] = picture
    voxels = occupied_voxels(voxel_map, params, rule)
    return RunContents(run, voxel_map, attributes, params, rule, voxels, metrics, trajectory_world, pictures, remarks)

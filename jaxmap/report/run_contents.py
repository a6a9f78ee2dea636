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
from jaxmap.export.source import Source
from jaxmap.export.voxels import OccupiedVoxels
from jaxmap.host.bounded_text import read_json
from jaxmap.mapping.attributes import MapAttributes
from jaxmap.mapping.store import MapReader, open_map
from jaxmap.report.voxel_view import merge_voxels

MOST_VOXELS = 400_000
"""That are held of a map: a page draws a quarter of them."""

PICTURES = {"left": "Left image", "labels": "Labels", "disparity": "Disparity, near red to far blue"}
"""The kinds of pictures of a key frame, with their captions."""
_PICTURE_NAME = re.compile(rf"(?P<frame>\d+)_(?P<kind>{'|'.join(PICTURES)})\.(png|webp)")


@dataclass(frozen=True)
class RunContents:
    """What a run left in its folder.

    Attributes:
        path: the folder.
        source: the map, to be gone through block by block.
        voxels: the occupied ones; of a large map merged, so many along each edge that they are few enough.
        merged: that number, 1 where they are the map's own.
        occupied: how many voxels of the map are occupied.
        area_m2: of the columns that they stand in.
        metrics: the content of `metrics.json`.
        trajectory_world: positions of the left camera in the map's world, None without `poses.tum`.
        pictures: paths by kind (left, disparity, labels), by the number of their key frame.
        remarks: what could not be read.
    """

    path: Path
    source: Source
    voxels: OccupiedVoxels
    merged: int
    occupied: int
    area_m2: float
    metrics: dict[str, Any]
    trajectory_world: Float[np.ndarray, "N 3"] | None
    pictures: dict[str, dict[str, Path]]
    remarks: list[str]

    @property
    def reader(self) -> MapReader:
        """The map."""
        return self.source.reader

    @property
    def attributes(self) -> MapAttributes:
        """What is stored beside the map."""
        return self.reader.attributes

    @property
    def classes(self) -> tuple[str, ...]:
        """Of the map."""
        return self.reader.classes

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
    source = Source(open_map(run / "map.zarr"), run / "map.zarr")
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
            trajectory_world = read_poses(run / "poses.tum").T[:, :3, 3] - source.site_origin
        except JaxmapError:
            remarks.append("poses.tum could not be read: the path is left out.")
    pictures = find_pictures(run)
    return RunContents(run, source, *_gathered(source), metrics, trajectory_world, pictures, remarks)


def _gathered(source: Source) -> tuple[OccupiedVoxels, int, int, float]:
    """The occupied voxels, merged 2 x 2 x 2 as often as it takes to have few enough; see `RunContents`."""
    indices, labels = [np.zeros((0, 3), np.int32)], [np.zeros(0, np.uint8)]
    merged, occupied, columns = 1, 0, 0
    for voxels in source.voxels():
        index, label = voxels.index, voxels.label
        occupied += len(label)
        # A block has whole columns.
        columns += len(np.unique(index[:, :2], axis=0))
        for _ in range(merged.bit_length() - 1):
            index, label = merge_voxels(index, label)
        indices.append(index)
        labels.append(label)
        while sum(map(len, labels)) > MOST_VOXELS:
            index, label = merge_voxels(np.concatenate(indices), np.concatenate(labels))
            indices, labels, merged = [index], [label], 2 * merged
    index, label = np.concatenate(indices), np.concatenate(labels)
    order = np.lexsort(index.T[::-1])
    index, label = index[order], label[order]
    size_m = source.size_m * merged
    centres = (source.corner_m + (index + 0.5) * size_m).astype(np.float32)
    unknown = np.full(len(label), np.nan, np.float32)
    voxels = OccupiedVoxels(index, centres, label, unknown, size_m.astype(np.float32))
    return voxels, merged, occupied, columns * float(np.prod(source.size_m[:2]))


def find_pictures(run: Path) -> dict[str, dict[str, Path]]:
    """The pictures of key frames by kind (left, disparity, labels), by the number of the frame."""
    pictures: dict[str, dict[str, Path]] = {}
    for picture in sorted((run / "pictures").glob("*")):
        if match := _PICTURE_NAME.fullmatch(picture.name):
            pictures.setdefault(match["frame"], {})[match["kind"]] = picture
    return pictures

"""Occupied voxels as LAS 1.4 points, LAZ where the file is to be compressed."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from jaxmap.errors import JaxmapError
from jaxmap.export.source import Source, optional
from jaxmap.host.files import atomic_path
from jaxmap.labels import IGNORE

FIRST_CLASS = 64
"""Classification of class 0: codes from here to 255 are for the user (LAS 1.4 R15, table 17)."""
UNCLASSIFIED = 1
_STEP_M = 1e-4


def write_las(source: Source, path: Path) -> None:
    """Writes voxel centres in the map's coordinate reference system, LAS 1.4, point format 7 (with colours).

    Coordinates are whole tenths of millimetres from the site origin. The classification of class `i` is
    `FIRST_CLASS + i`, named by the record `Classification Lookup`; the extra dimension `probability` is that of the
    label.

    Raises:
        JaxmapError: laspy is missing, the coordinate reference system is unknown, there are more classes than codes,
            or the disk is full or refuses.
    """
    laspy = optional("laspy", "laspy[lazrs]", "LAS")
    if path.suffix == ".laz":
        optional("lazrs", "laspy[lazrs]", "LAZ")
    if len(source.classes) > 256 - FIRST_CLASS:
        raise JaxmapError(
            f"{len(source.classes)} classes: LAS has codes for {256 - FIRST_CLASS}", where=path, fix="write a PLY"
        )
    header = laspy.LasHeader(point_format=7, version="1.4")
    header.scales, header.offsets = np.full(3, _STEP_M), source.site_origin
    header.generating_software = "jaxmap"
    header.add_extra_dim(laspy.ExtraBytesParams(name="probability", type=np.float32, description="of the label"))
    _add_crs(header, source, path)
    if source.classes:
        lookup = laspy.vlrs.known.ClassificationLookupVlr()
        for index, name in enumerate(source.classes):
            # The record has fifteen bytes for a name.
            lookup[FIRST_CLASS + index] = name.encode("ascii", "replace")[:15].decode()
        header.vlrs.append(lookup)
    with atomic_path(path) as temporary, temporary.open("wb") as stream:
        compressed = path.suffix == ".laz"
        with laspy.open(stream, "w", header=header, do_compress=compressed, closefd=False) as las:
            for voxels in source.voxels():
                points = laspy.ScaleAwarePointRecord.zeros(len(voxels.label), header=header)
                points.x, points.y, points.z = (voxels.centres_world + source.site_origin).T
                colours = source.colours_of(voxels.centres_world, voxels.label)
                # Sixteen bits: 255 is to be full, not dark.
                points.red, points.green, points.blue = colours.T.astype(np.uint16) * 257
                label = voxels.label.astype(np.uint16)
                points.classification = np.where(label == IGNORE, UNCLASSIFIED, label + FIRST_CLASS).astype(np.uint8)
                points.return_number = points.number_of_returns = np.ones(len(label), np.uint8)
                points["probability"] = voxels.probability
                las.write_points(points)


def _add_crs(header: object, source: Source, path: Path) -> None:
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    crs = source.reader.attributes.crs
    if crs:
        try:
            header.add_crs(CRS.from_user_input(crs))  # pyright: ignore[reportAttributeAccessIssue]
        except CRSError as error:
            raise JaxmapError(
                f"unknown coordinate reference system {crs!r}", where=path, fix='give a name such as "EPSG:32631"'
            ) from error

"""A path in the forms that ground stations and GIS read: GeoJSON and CSV, in the coordinates of the map."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxmap.host.files import atomic_path


def write_geojson(path: Path, points: Float[np.ndarray, "N 2"], crs: str | None, properties: Mapping[str, Any]) -> None:
    """Writes a path as one LineString.

    Coordinates are those of `crs`, named by the member `crs` as GDAL and QGIS read it (GeoJSON of 2008); RFC 7946
    knows longitude and latitude alone.

    Raises:
        JaxmapError: the disk is full or refuses.
    """
    line = {"type": "LineString", "coordinates": np.round(points, 4).tolist()}
    tree: dict[str, Any] = {"type": "FeatureCollection"}
    if crs is not None and ":" in crs:
        authority, _, code = crs.partition(":")
        tree["crs"] = {"type": "name", "properties": {"name": f"urn:ogc:def:crs:{authority}::{code}"}}
    tree["features"] = [{"type": "Feature", "properties": dict(properties), "geometry": line}]
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(tree, allow_nan=False, indent=1) + "\n", encoding="utf8")


def write_csv(path: Path, columns: Mapping[str, Float[np.ndarray, "N"]]) -> None:
    """Writes numbers along a path, one line for each place; empty where a number is not known.

    Raises:
        JaxmapError: the disk is full or refuses.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    for row in zip(*columns.values(), strict=True):
        writer.writerow(["" if np.isnan(number) else round(float(number), 4) for number in row])
    with atomic_path(path) as temporary:
        temporary.write_text(text.getvalue(), encoding="utf8")

"""Keywords of planetary labels by group: GDAL parses PDS3 and VICAR; PDS4, which is XML, gets the names of PDS3."""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import numpy as np

from jaxmap.datasets.text_files import read_text
from jaxmap.errors import JaxmapError

if TYPE_CHECKING:
    from rasterio.io import DatasetReader

LABEL_SUFFIXES = (".xml", ".lbl", ".img", ".vic", ".vicar")
"""In the order in which they are tried where one image has several."""

Groups = dict[str, dict[str, Any]]
"""Keywords by the name of their group, "" for those in none; no prefixes of name spaces, no `_PARMS` at the end."""


@contextmanager
def opened_product(path: Path) -> Iterator[DatasetReader]:
    """An image product, opened by GDAL's planetary drivers alone.

    Raises:
        JaxmapError: no such file, or none that they read.
    """
    import rasterio
    from rasterio.errors import NotGeoreferencedWarning, RasterioError

    try:
        with open(path, "rb") as file:
            head = file.read(2**16)
    except OSError as fault:
        raise JaxmapError(f"the file cannot be read ({fault.strerror})", where=path, fix="check the path") from fault
    # A label may name its image, and GDAL would follow such a name anywhere.
    if b"/vsi" in head or b"://" in head.partition(b"^IMAGE")[2].partition(b"\n")[0]:
        raise JaxmapError("the label points to a virtual file", where=path, fix="keep label and image in one folder")
    if path.suffix.lower() == ".xml":
        read_text(path)
    driver = "PDS4" if path.suffix.lower() == ".xml" else "VICAR" if head.startswith(b"LBLSIZE") else "PDS"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        try:
            with rasterio.open(path, driver=driver) as product:
                yield product
        except (RasterioError, UnicodeDecodeError) as fault:
            # GDAL quotes what it cannot read, and rasterio takes that for UTF-8.
            raise JaxmapError(
                f"not a whole PDS3, PDS4 or VICAR image ({fault})", where=path, fix="restore label and image"
            ) from fault


def is_label(path: Path) -> bool:
    """Whether a file starts like a PDS3, PDS4 or VICAR label; it never raises."""
    try:
        if path.suffix.lower() not in LABEL_SUFFIXES or not path.is_file():
            return False
        with open(path, "rb") as file:
            head = file.read(2**13)
    except OSError:
        return False
    if path.suffix.lower() == ".xml":
        return b"<Product_Observational" in head
    return b"PDS_VERSION_ID" in head[:2048] or head.startswith(b"LBLSIZE")


def read_groups(path: Path, product: DatasetReader) -> Groups:
    """The keywords of an opened product's label.

    Raises:
        JaxmapError: the label cannot be parsed.
    """
    if path.suffix.lower() == ".xml":
        return _pds4_groups(path)
    for name in {"json:PDS", "json:VICAR"} & set(product.tag_namespaces()):
        for key, value in product.tags(ns=name).items():
            # rasterio takes the document for `KEY=VALUE`; it was cut at the first `:` or `=`.
            for separator in (":", "="):
                try:
                    tree = json.loads(key + separator + value)
                except (ValueError, RecursionError):
                    continue
                groups: Groups = {"": {}}
                _collect(tree, "", groups)
                return groups
    raise JaxmapError("the label cannot be parsed", where=path, fix="restore the label")


def find(groups: Groups, key: str, *names: str) -> Any:
    """The value of a keyword, from the first of the named groups that has it, else from any; None where none has."""
    for name in (*names, "", *groups):
        if key in groups.get(name, {}):
            value = groups[name][key]
            return value["value"] if isinstance(value, dict) and "value" in value else value
    return None


def numbers(value: Any, count: int) -> np.ndarray | None:
    """That many finite numbers, None where the value is not those."""
    items = value if isinstance(value, list) else [value]
    if len(items) != count:
        return None
    try:
        # GDAL leaves units and blanks on some: `0.3 <rad>`.
        found = np.array([float(str(item).partition("<")[0]) for item in items], np.float64)
    except ValueError:
        return None
    return found if np.isfinite(found).all() else None


def _collect(tree: dict[str, Any], name: str, groups: Groups, depth: int = 0) -> None:
    group = groups.setdefault(name, {})
    for key, value in tree.items():
        key = key.rpartition(":")[2]
        if isinstance(value, dict) and "value" not in value:
            # VICAR's history of tasks may repeat old values.
            if key != "TASK" and depth < 8:
                inner = "" if key == "PROPERTY" else key.removesuffix("_PARMS")
                _collect(value, inner, groups, depth + 1)
        else:
            group.setdefault(key, value)


def _pds4_groups(path: Path) -> Groups:
    """The keywords of a PDS4 label, under the names that they have in PDS3."""
    text = read_text(path)
    try:
        if "<!ENTITY" in text or "<!DOCTYPE" in text:
            raise ValueError("it declares entities")
        root = ElementTree.fromstring(text.encode())
    except (ElementTree.ParseError, ValueError) as fault:
        raise JaxmapError(f"the label is not plain XML ({fault})", where=path, fix="restore the label") from fault
    for node in root.iter():
        node.tag = node.tag.rpartition("}")[2] if isinstance(node.tag, str) else ""

    def text_of(*paths: str) -> str | None:
        return next((found for found in (root.findtext(f".//{name}") for name in paths) if found), None)

    own = {
        "PRODUCT_ID": (text_of("logical_identifier") or "").rpartition(":")[2],
        "INSTRUMENT_HOST_NAME": text_of("Investigation_Area/name"),
        "INSTRUMENT_ID": text_of("instrument_id", "Instrument_Information/instrument_name"),
        "INSTRUMENT_NAME": _pds4_instrument(root),
        "SPACECRAFT_CLOCK_START_COUNT": text_of("spacecraft_clock_start", "spacecraft_clock_start_count"),
        "START_TIME": text_of("Time_Coordinates/start_date_time"),
        "FIRST_LINE": text_of("Subframe/first_line", "Detector/first_line"),
        "FIRST_LINE_SAMPLE": text_of("Subframe/first_sample", "Detector/first_sample"),
        "PIXEL_AVERAGING_WIDTH": text_of("Pixel_Averaging_Dimensions/width_pixels"),
        "PIXEL_AVERAGING_HEIGHT": text_of("Pixel_Averaging_Dimensions/height_pixels"),
        "DERIVED_IMAGE_TYPE": text_of("derived_image_type_name"),
    }
    groups: Groups = {"": {key: value for key, value in own.items() if value}}
    for parameters in root.iter("Camera_Model_Parameters"):
        kind = parameters.findtext("model_type") or ""
        model = parameters.find(f"{kind}_Model")
        if model is not None:
            group: dict[str, Any] = {"MODEL_TYPE": kind}
            names = ("Center", "Axis", "Horizontal", "Vertical", "Optical")
            nodes = [*(model.find(f"Vector_{name}") for name in names), model.find("Radial_Terms")]
            for index, node in enumerate([*nodes, model.find("Entrance_Terms")], start=1):
                group[f"MODEL_COMPONENT_{index}"] = [child.text for child in node] if node is not None else []
            group["MODEL_COMPONENT_8"] = model.findtext("cahvore_model_type")
            group["MODEL_COMPONENT_9"] = model.findtext("cahvore_model_parameter")
            group["REFERENCE_COORD_SYSTEM_NAME"] = _pds4_frame(parameters.find("Coordinate_Space_Reference"))
            groups.setdefault("GEOMETRIC_CAMERA_MODEL", group)
    for node in root.iter("Coordinate_Space_Definition"):
        group = _pds4_definition(node)
        groups.setdefault(f"{group['COORDINATE_SYSTEM_NAME']} COORDINATE_SYSTEM", group)
    return groups


def _pds4_definition(node: ElementTree.Element) -> dict[str, Any]:
    quaternion = [node.findtext(f"Quaternion_Plus_Direction/{key}") for key in ("qcos", "qsin1", "qsin2", "qsin3")]
    if (node.findtext("Quaternion_Plus_Direction/rotation_direction") or "Forward") != "Forward":
        # What turns the reference into this frame: not used by any mission's products seen so far.
        quaternion = []
    index = node.findtext("Coordinate_Space_Present//Coordinate_Space_Index/index_value_number")
    return {
        "COORDINATE_SYSTEM_NAME": _pds4_frame(node.find("Coordinate_Space_Present")),
        "COORDINATE_SYSTEM_INDEX": [index] if index else [],
        "ORIGIN_OFFSET_VECTOR": [node.findtext(f"Vector_Origin_Offset/{axis}_position") for axis in "xyz"],
        "ORIGIN_ROTATION_QUATERNION": quaternion,
        "REFERENCE_COORD_SYSTEM_NAME": _pds4_frame(node.find("Coordinate_Space_Reference")),
    }


def _pds4_frame(node: ElementTree.Element | None) -> str:
    """The name of a frame: its type, or its local identifier without the counters at its end."""
    if node is None:
        return ""
    kind = node.findtext(".//coordinate_space_frame_type")
    return kind or re.sub(r"(_-?[0-9]+)+(_[A-Z]+)?$", "", node.findtext(".//local_identifier_reference") or "")


def _pds4_instrument(root: ElementTree.Element) -> str | None:
    for component in root.iter("Observing_System_Component"):
        if (component.findtext("type") or "").lower() == "instrument":
            return component.findtext("name")
    return None

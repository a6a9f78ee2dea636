"""The surface of a map as a mesh: PLY and binary glTF 2.0, written patch by patch."""

from __future__ import annotations

import json
import shutil
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from jaxmap.errors import JaxmapError
from jaxmap.export.ply import header, vertex_lines
from jaxmap.export.source import Source
from jaxmap.export.surface import patches
from jaxmap.host.files import atomic_path

_FLOAT, _UINT16, _UINT32, _ARRAY, _INDICES = 5126, 5123, 5125, 34962, 34963
_MOST_BYTES = 2**32 - 1
_TO_Y_UP = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]], np.float64)


def write_mesh_ply(source: Source, path: Path) -> None:
    """Writes the surface as triangles with coloured corners, binary little-endian.

    Coordinates are as in `write_ply`: metres, x east, y north, z up, the site origin added.

    Raises:
        JaxmapError: the disk is full or refuses.
    """
    site_origin = source.site_origin
    real = "<f8" if site_origin.any() else "<f4"
    form = np.dtype([(axis, real) for axis in "xyz"] + [(name, "u1") for name in ("red", "green", "blue")])
    face_form = np.dtype([("count", "u1"), ("corners", "<u4", 3)])
    comments = ["jaxmap: surface seen from above, metres, x east y north z up"]
    comments += [f"site_origin {' '.join(map(str, site_origin.tolist()))} (already added)"]

    def top(points: int, triangles: int) -> bytes:
        faces = ["property list uchar uint vertex_indices"]
        return header([("vertex", points, vertex_lines(form)), ("face", triangles, faces)], comments)

    # The corners come first in the file: triangles wait beside it.
    with atomic_path(path) as temporary, temporary.open("wb") as stream, _beside(temporary) as faces:
        stream.write(top(0, 0))
        points = triangles = 0
        for patch in patches(source):
            vertices = np.empty(len(patch.points_world), form)
            for axis, name in enumerate("xyz"):
                vertices[name] = patch.points_world[:, axis] + site_origin[axis]
            for channel, name in enumerate(("red", "green", "blue")):
                vertices[name] = patch.colours[:, channel]
            stream.write(vertices.tobytes())
            table = np.empty(len(patch.triangles), face_form)
            table["count"], table["corners"] = 3, patch.triangles + points
            faces.write(table.tobytes())
            points, triangles = points + len(vertices), triangles + len(table)
        faces.seek(0)
        shutil.copyfileobj(faces, stream)
        stream.seek(0)
        stream.write(top(points, triangles))


def write_gltf(source: Source, path: Path) -> None:
    """Writes the surface as binary glTF 2.0: y up, metres, relative to the site origin (in the `extras` of the asset).

    East is x, north -z, up y, as the specification asks (section 3.4); colours are linear (section 3.7.2.1), and shown
    as they are, without light, by viewers that know `KHR_materials_unlit`.

    Raises:
        JaxmapError: nothing was observed, it is larger than the 4 GiB of the format, or the disk is full or refuses.
    """
    document: dict[str, Any] = dict(accessors=[], bufferViews=[], meshes=[{"primitives": []}])
    with atomic_path(path) as temporary, temporary.open("wb") as stream, _beside(temporary) as binary:
        for patch in patches(source):
            points = (patch.points_world @ _TO_Y_UP.T).astype(np.float32)
            # An opaque fourth channel keeps each corner on four bytes.
            colours = np.full((len(points), 4), 65535, np.uint16)
            colours[:, :3] = np.rint(_linear(patch.colours) * 65535)
            spans = dict(min=points.min(axis=0).tolist(), max=points.max(axis=0).tolist())
            position = _accessor(document, binary, points, _FLOAT, "VEC3", _ARRAY, **spans)
            colour = _accessor(document, binary, colours, _UINT16, "VEC4", _ARRAY, normalized=True)
            corners = patch.triangles.astype(np.uint32).ravel()
            indices = _accessor(document, binary, corners, _UINT32, "SCALAR", _INDICES)
            attributes = {"POSITION": position, "COLOR_0": colour}
            document["meshes"][0]["primitives"].append(dict(attributes=attributes, indices=indices, material=0))
        if not document["accessors"]:
            raise JaxmapError("nothing was observed: there is no surface", where=source.where, fix="see its report")
        attributes = source.reader.attributes
        document |= dict(
            asset=dict(
                version="2.0",
                generator="jaxmap",
                extras=dict(site_origin=source.site_origin.tolist(), crs=attributes.crs, axes="x east, y up, z south"),
            ),
            scene=0,
            scenes=[dict(nodes=[0])],
            nodes=[dict(mesh=0, name="surface")],
            materials=[
                dict(
                    doubleSided=True,
                    pbrMetallicRoughness=dict(metallicFactor=0.0, roughnessFactor=1.0),
                    extensions=dict(KHR_materials_unlit={}),
                )
            ],
            extensionsUsed=["KHR_materials_unlit"],
            buffers=[dict(byteLength=binary.tell())],
        )
        text = json.dumps(document, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        length = 12 + 8 + len(text) + 8 + binary.tell()
        if length > _MOST_BYTES:
            raise JaxmapError("the surface is larger than the 4 GiB of glTF", where=path, fix="write a mesh (PLY)")
        stream.write(struct.pack("<4sII", b"glTF", 2, length))
        stream.write(struct.pack("<I4s", len(text), b"JSON") + text)
        stream.write(struct.pack("<I4s", binary.tell(), b"BIN\0"))
        binary.seek(0)
        shutil.copyfileobj(binary, stream)


def _accessor(
    document: dict[str, Any], binary: BinaryIO, values: np.ndarray, component: int, kind: str, target: int, **more: Any
) -> int:
    """Appends an array, and returns its number; all are multiples of four bytes."""
    view = dict(buffer=0, byteOffset=binary.tell(), byteLength=values.nbytes, target=target)
    binary.write(values.tobytes())
    document["bufferViews"].append(view)
    here = len(document["accessors"])
    document["accessors"].append(
        dict(bufferView=here, componentType=component, count=len(values), type=kind) | more,
    )
    return here


def _linear(colours: np.ndarray) -> np.ndarray:
    """Linear light of sRGB colours (IEC 61966-2-1), 0 to 1."""
    value = colours / 255.0
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


@contextmanager
def _beside(path: Path) -> Iterator[BinaryIO]:
    """A file beside another, gone at the end."""
    part = path.with_name(f"{path.name}.part")
    try:
        with part.open("w+b") as stream:
            yield stream
    finally:
        part.unlink(missing_ok=True)

"""The top-down surface as triangles with coloured corners: a height field, which looks as the ground does.

An isosurface of the voxels would show the layers of their noise from below; the rover saw the ground from above.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt8

from jaxmap.export.source import Columns, Source


class Patch(NamedTuple):
    """A part of the surface.

    Attributes:
        points_world: corners of triangles, relative to the site origin, metres.
        colours: theirs, RGB.
        triangles: three corners each, anticlockwise from above.
    """

    points_world: Float[np.ndarray, "N 3"]
    colours: UInt8[np.ndarray, "N 3"]
    triangles: Int[np.ndarray, "T 3"]


def patches(source: Source) -> Iterator[Patch]:
    """The surface through the centres of the observed columns, block by block, without seams between them.

    Corners on the edge of two blocks are in both.
    """
    for columns in source.columns(margin=1):
        patch = _patch(source, columns)
        if len(patch.triangles):
            yield patch


def _patch(source: Source, columns: Columns) -> Patch:
    height_m, observed = columns.height_m, np.asarray(columns.top.observed)
    number = np.arange(observed.size).reshape(observed.shape)
    quads = np.stack([number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]], axis=-1).reshape(-1, 4)
    known = observed.ravel()[quads]
    # A quad is of the block that has its first known corner; that block is stored, whatever else is.
    own = np.zeros(observed.shape, bool)
    own[columns.own] = True
    first_known = quads[np.arange(len(quads)), known.argmax(axis=1)]
    mine = own.ravel()[first_known] & (known.sum(axis=1) >= 3)
    quads, known = quads[mine], known[mine]
    z = np.where(observed, height_m, 0.0).ravel()[quads]
    # Along the diagonal that bends less; where three corners are known, the triangle of those.
    straight = np.abs(z[:, 0] - z[:, 2]) <= np.abs(z[:, 1] - z[:, 3])
    whole = known.all(axis=1)
    split = [
        quads[whole & straight][:, [0, 1, 2, 0, 2, 3]],
        quads[whole & ~straight][:, [0, 1, 3, 1, 2, 3]],
    ]
    three = quads[~whole][known[~whole]].reshape(-1, 3)
    triangles = np.concatenate([*(six.reshape(-1, 3) for six in split), three])
    used, compact = np.unique(triangles, return_inverse=True)
    x, y = np.unravel_index(used, observed.shape)
    place = np.stack([x, y], axis=-1) + np.asarray(columns.corner) + 0.5
    points = np.column_stack([source.corner_m[:2] + place * source.size_m[:2], height_m[x, y]])
    label = np.asarray(columns.top.label)[x, y]
    return Patch(points, source.colours_of(points, label), compact.reshape(-1, 3).astype(np.int64))

"""The top-down surface as triangles with coloured corners: a height field, which looks as the ground does.

An isosurface of the voxels would show their noise as layers and holes; the rover saw the ground from above. Steps of
the voxels are smoothed, but the surface stays within the voxel that it was seen in.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from jaxmap.export.source import SURFACE, Source, TopDownPart

_SIGMA, _REACH = 2.0, 6
"""Of the smoothing, in columns."""


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
    for part in source.parts(margin=_REACH + 1):
        patch = _patch(source, part)
        if len(patch.triangles):
            yield patch


def _patch(source: Source, part: TopDownPart) -> Patch:
    observed = np.asarray(part.top.observed)
    height_m = part.height_m if SURFACE in part.layers else _smooth(part.height_m, observed, source.size_m[2])
    number = np.arange(observed.size).reshape(observed.shape)
    quads = np.stack([number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]], axis=-1).reshape(-1, 4)
    known = observed.ravel()[quads]
    # A quad is of the block that has its first known corner; that block is stored, whatever else is.
    own = np.zeros(observed.shape, bool)
    own[part.own] = True
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
    place = np.stack([x, y], axis=-1) + np.asarray(part.corner) + 0.5
    points = np.column_stack([source.corner_m[:2] + place * source.size_m[:2], height_m[x, y]])
    label = np.asarray(part.top.label)[x, y]
    return Patch(points, source.colours_of(points, label), compact.reshape(-1, 3).astype(np.int64))


def _smooth(
    height_m: Float[np.ndarray, "X Y"], observed: Bool[np.ndarray, "X Y"], step_m: float
) -> Float[np.ndarray, "X Y"]:
    """Heights averaged over the observed columns around each, no farther off than half a voxel."""
    from scipy.ndimage import correlate1d

    weights = np.exp(-0.5 * (np.arange(-_REACH, _REACH + 1) / _SIGMA) ** 2)

    def spread(values: np.ndarray) -> np.ndarray:
        for axis in (0, 1):
            values = correlate1d(values, weights, axis=axis, mode="constant")
        return values

    height_m = np.asarray(height_m, np.float64)
    mean_m = spread(np.where(observed, height_m, 0.0)) / np.maximum(spread(observed.astype(np.float64)), 1e-12)
    return mean_m.clip(height_m - step_m / 2, height_m + step_m / 2)

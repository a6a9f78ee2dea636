"""The faces of voxels that can be seen, and coarser voxels where there are too many of them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Int, UInt8

# The corners of a face, for each axis it can be normal to, going round.
_SQUARE = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
_KEY_SPAN = 2**21


class Faces(NamedTuple):
    """Square faces of voxels: `corner` is that of the voxel grid, two triangles to a face.

    `voxel` says which voxel a face belongs to.
    """

    corner: Int[np.ndarray, "P 3"]
    triangle: Int[np.ndarray, "2F 3"]
    voxel: Int[np.ndarray, "F"]


def exposed_faces(index: Int[np.ndarray, "N 3"], *, undersides: bool = True) -> Faces:
    """The faces between a voxel of `index` (each given once) and a neighbour that is not in it."""
    index = np.asarray(index, np.int64)
    low = index.min(axis=0, initial=0) - 1
    keys = _key(index - low)
    order = np.argsort(keys)
    ordered = keys[order]
    corners, voxels = [], []
    for axis in range(3):
        for side in (0, 1):
            if (axis, side) == (2, 0) and not undersides:
                continue
            step = np.zeros(3, np.int64)
            step[axis] = 2 * side - 1
            voxel = np.flatnonzero(~_contains(ordered, _key(index - low + step)))
            square = np.insert(_SQUARE, axis, side, axis=1)
            # Seen from outside, corners go round against the clock (y is the one axis whose plane is left-handed).
            square = square if (side == 1) != (axis == 1) else square[::-1]
            corners.append((index[voxel, None] + square[None]).reshape(-1, 3))
            voxels.append(voxel)
    corner, inverse = _unique_rows(np.concatenate(corners), low)
    quads = inverse.reshape(-1, 4)
    return Faces(
        corner=corner,
        triangle=quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3).astype(np.int32),
        voxel=np.concatenate(voxels).astype(np.int32),
    )


def merge_voxels(
    index: Int[np.ndarray, "N 3"], label: UInt8[np.ndarray, "N"]
) -> tuple[Int[np.ndarray, "M 3"], UInt8[np.ndarray, "M"]]:
    """Merges 2 x 2 x 2 voxels into one, with the label of most of them (the lowest among equals)."""
    half = np.asarray(index, np.int64) // 2
    low = half.min(axis=0, initial=0)
    pairs, counts = np.unique(_key(half - low) * 256 + label, return_counts=True)
    parents = pairs // 256
    # Sorted by parent, then by falling count: the first of each parent wins.
    order = np.lexsort((pairs, -counts, parents))
    first = order[np.unique(parents[order], return_index=True)[1]]
    merged = parents[first]
    index = np.stack([merged // _KEY_SPAN**2, merged // _KEY_SPAN % _KEY_SPAN, merged % _KEY_SPAN], axis=-1) + low
    return index.astype(np.int32), (pairs[first] % 256).astype(np.uint8)


def _key(index: Int[np.ndarray, "*s 3"]) -> Int[np.ndarray, "*s"]:
    return (index[..., 0] * _KEY_SPAN + index[..., 1]) * _KEY_SPAN + index[..., 2]


def _contains(ordered: Int[np.ndarray, "N"], keys: Int[np.ndarray, "K"]) -> np.ndarray:
    at = np.searchsorted(ordered, keys).clip(max=max(len(ordered) - 1, 0))
    return ordered[at] == keys if len(ordered) else np.zeros(len(keys), bool)


def _unique_rows(rows: Int[np.ndarray, "R 3"], low: Int[np.ndarray, "3"]) -> tuple[np.ndarray, np.ndarray]:
    _, first, inverse = np.unique(_key(rows - low), return_index=True, return_inverse=True)
    return rows[first].astype(np.int32), inverse

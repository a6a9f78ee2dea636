"""The view from above as colours: classes or heights, lit from the north-west."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, UInt8

from jaxmap.fusion.query import TopDown
from jaxmap.labels import IGNORE, class_colours

UNOBSERVED_COLOUR = (241, 240, 236)
HEIGHT_COLOUR_MAP = "viridis"
_LIGHT_WORLD = np.array([-0.5, 0.5, 0.75]) / np.linalg.norm([-0.5, 0.5, 0.75])


class Relief(NamedTuple):
    """Colours of cells, x first; `by_height` says that they show heights, over `height_range_m`."""

    colours: UInt8[np.ndarray, "X Y 3"]
    by_height: bool
    height_range_m: tuple[float, float]


def relief(top: TopDown, cell_size_m: Float[np.ndarray, "2"], classes: Sequence[str]) -> Relief:
    """Colours the cells by class and shades them by their slope; by height where no cell has a class."""
    from matplotlib import colormaps

    observed, label = np.asarray(top.observed), np.asarray(top.label)
    height_m = np.asarray(top.height_m, np.float64)
    colours = np.tile(np.array(UNOBSERVED_COLOUR, np.uint8), (*observed.shape, 1))
    if not observed.any():
        return Relief(colours, False, (0.0, 0.0))
    low, high = np.percentile(height_m[observed], [1, 99])
    by_height = bool((label[observed] == IGNORE).all())
    if by_height:
        scaled = ((height_m[observed] - low) / max(high - low, 1e-6)).clip(0, 1)
        base = colormaps[HEIGHT_COLOUR_MAP](scaled, bytes=True)[:, :3]
    else:
        base = class_colours(classes)[label[observed]]
    shade = ground_shade(height_m, observed, cell_size_m)[observed]
    colours[observed] = np.rint(base * shade[:, None]).clip(0, 255)
    return Relief(colours, by_height, (float(low), float(high)))


def ground_shade(
    height_m: Float[np.ndarray, "X Y"], observed: Bool[np.ndarray, "X Y"], cell_size_m: Float[np.ndarray, "2"]
) -> Float[np.ndarray, "X Y"]:
    """Brightness of lit ground, 1 where it is level."""
    from scipy.ndimage import distance_transform_edt, gaussian_filter

    # Heights of the nearest seen cell keep the rim of the map level; a slight blur hides the steps of the voxels.
    nearest: Any = distance_transform_edt(~observed, return_distances=False, return_indices=True)
    smooth_m = gaussian_filter(height_m[tuple(nearest)], 0.7, mode="nearest")
    slopes = [_slope(smooth_m, axis) / cell_size_m[axis] for axis in (0, 1)]
    normal = np.stack([-slopes[0], -slopes[1], np.ones_like(smooth_m)], axis=-1)
    lit = (normal @ _LIGHT_WORLD) / np.linalg.norm(normal, axis=-1) / _LIGHT_WORLD[2]
    return (0.35 + 0.65 * lit.clip(0)).clip(0.45, 1.3)


def _slope(height_m: Float[np.ndarray, "X Y"], axis: int) -> Float[np.ndarray, "X Y"]:
    return np.gradient(height_m, axis=axis) if height_m.shape[axis] > 1 else np.zeros_like(height_m)

"""Tuned parameters as a configuration that `jaxmap map` reads."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from jaxmap.config import MapConfig, check_config, config_tree
from jaxmap.tuning.parametrisation import TunedParams

_DATA = ("labels", "labels_are", "poses", "poses_world", "calibration", "start", "stop", "stride")
"""Settings that are of the data tuned on, and not of how they are mapped."""

_SECTION = {
    "temperature": "deeplab",
    "sigma_m": "plane",
    "threshold_m": "plane",
    "softness_m": "plane",
}
"""The section that holds each number of a labeller."""


def tuned_tree(config: MapConfig, params: TunedParams) -> dict[str, Any]:
    """The settings with the tuned parameters in them, and without what is of the data alone.

    Args:
        config: how the traverses were mapped.
        params: what came out.

    Raises:
        UsageError: a parameter is none that the settings accept; the parametrisation rules that out.
    """
    tree = {name: value for name, value in config_tree(config).items() if name not in _DATA and value is not None}
    fusion, sigmoid = params.fusion, jax.nn.sigmoid
    tree["fusion"] = tree["fusion"] | {
        "occupancy_hit": _plain(fusion.occupancy_hit),
        "occupancy_miss": _plain(fusion.occupancy_miss),
        "occupancy_prior": _plain(sigmoid(fusion.occupancy_prior)),
        "class_increments": _plain(fusion.class_increments),
        "class_prior": _plain(sigmoid(fusion.class_prior)),
        "disparity_sigma_px": _plain(fusion.disparity_sigma_px),
        "full_evidence_points": _plain(fusion.full_evidence_points),
        "occupancy_threshold": _plain(fusion.occupancy_threshold),
        "class_threshold": _plain(fusion.class_threshold),
    }
    if fusion.class_kernel is not None:
        tree["fusion"]["class_kernel"] = _plain(fusion.class_kernel)
    for name, value in params.labeller.items():
        tree[_SECTION[name]] = tree[_SECTION[name]] | {name: _plain(value)}
    check_config(tree, "the tuned configuration")
    return tree


def _plain(value: Any) -> Any:
    """Numbers to six digits, as lists where there are several."""
    array = np.asarray(value, np.float64)
    rounded = np.array([float(f"{number:.6g}") for number in array.ravel()]).reshape(array.shape)
    return rounded.tolist()

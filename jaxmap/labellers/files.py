"""Labels made elsewhere, read from files and carried by the frame."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from jaxmap.geometry.cloud import PointCloud
from jaxmap.labellers.base import Labeller, LabellerParams, Numbers, PointFeatures, dense_features
from jaxmap.types import Frame


def make_files_labeller(classes: Sequence[str], *, soft: bool) -> Labeller:
    """Labels made elsewhere, carried by the frame: class indices, or probabilities where `soft`."""
    needs = "class_probabilities" if soft else "labels"

    def features(frame: Frame, cloud: PointCloud, params: LabellerParams, key: Array) -> PointFeatures:
        carried = getattr(frame, needs)
        values = carried.reshape(carried.shape[0] * carried.shape[1], -1)
        return PointFeatures(cloud.in_range.reshape(-1), dense_features(values, carried.shape[:2]))

    def label(values: Array, estimate: Any, numbers: Numbers) -> tuple[Array, ...]:
        return tuple(values[:, c] for c in range(len(classes))) if soft else (values[:, 0].astype(jnp.int32),)

    return Labeller("files", tuple(classes), needs, features, label, soft=soft, draws=False)

"""Labels made elsewhere, read from files and carried by the frame."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from jaxmap.labellers.base import Labeller, Needs, fixed_labels
from jaxmap.types import Frame, PointLabels


def make_files_labeller(classes: Sequence[str], *, soft: bool) -> Labeller:
    """Labels made elsewhere, carried by the frame: class indices, or probabilities where `soft`."""

    def label(frame: Frame, points_world: Array, valid: Array, params: Any, key: Array) -> tuple[PointLabels, None]:
        if soft:
            assert frame.class_probabilities is not None
            return PointLabels(keep=valid, probabilities=frame.class_probabilities.reshape(-1, len(classes))), None
        assert frame.labels is not None
        return PointLabels(keep=valid, labels=frame.labels.reshape(-1).astype(jnp.int32)), None

    needs: Needs = "class_probabilities" if soft else "labels"
    return Labeller("files", tuple(classes), needs, label, tunable=fixed_labels(label))

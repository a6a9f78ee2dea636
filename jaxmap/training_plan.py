"""A training run, decided in full before the first step: data, network, order, recipe."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxmap.errors import UsageError
from jaxmap.models.checkpoint import load_model
from jaxmap.training.batches import Order, Pixels
from jaxmap.training.data import TrainingSet, check_training_set, digest, open_training_set
from jaxmap.training.losses import class_weights
from jaxmap.training.starts import Start, make_start
from jaxmap.training.step import Trainer, make_trainer
from jaxmap.training_config import TrainConfig


class TrainingPlan(NamedTuple):
    """A run, decided in full.

    Attributes:
        config: its settings.
        training_set: its images.
        class_pixels: pixels of each class, in training (row 0) and validation (row 1).
        start: the network and its first weights.
        init: the file that training starts from, or None.
        order: which example is seen when.
        pixels: reads them.
        trainer: the compiled step.
    """

    config: TrainConfig
    training_set: TrainingSet
    class_pixels: np.ndarray
    start: Start
    init: Path | None
    order: Order
    pixels: Pixels
    trainer: Trainer

    def digest(self) -> str:
        """A fingerprint of what a resumed run must share beside its settings."""
        return digest(self.training_set)


def plan_training(
    folder: Path,
    config: TrainConfig,
    init: Path | None,
    *,
    tell: Callable[[str], None],
    advance: Callable[[int], None] = lambda done: None,
) -> TrainingPlan:
    """Reads all the data once, and builds network and step.

    Args:
        folder: of the training data.
        config: the settings.
        init: a model file to start from.
        tell: takes lines for the user.
        advance: is called with the number of images read so far.

    Raises:
        JaxmapError: data, settings and file do not serve.
    """
    low, high = config.augmentation.scale
    if low > high:
        raise UsageError(f"augmentation.scale is {low} {high}", fix="give the least factor first")
    losses = config.loss
    if not (losses.cross_entropy or losses.soft_iou or losses.lovasz):
        raise UsageError("every loss has a weight of 0", where="--loss", fix="give one of them a weight")
    devices = jax.local_device_count()
    if config.batch_size % devices:
        raise UsageError(
            f"batch_size {config.batch_size} cannot be shared by {devices} devices",
            fix=f"take a multiple of {devices}",
        )
    training_set = open_training_set(
        folder,
        config.classes,
        remap=config.data.remap,  # type: ignore[arg-type]
        palette=config.data.palette,  # type: ignore[arg-type]
        validation_share=config.data.validation_share,
        seed=config.seed,
    )
    for note in training_set.notes:
        tell(f"note: {note}")
    counts = check_training_set(training_set, advance)
    tell(
        f"{len(training_set.train)} images to train on, {len(training_set.validation)} to validate; training pixels: "
        + ", ".join(
            f"{name} {share:.1%}" for name, share in zip(config.classes, counts[0] / counts[0].sum(), strict=True)
        )
    )
    saved = None if init is None else load_model(init)
    start = make_start(config.network, config.norm, config.classes, saved, seed=config.seed, where=init or "network")
    order = Order.of(len(training_set.train), config)
    record, numbers = start.architecture, sum(jnp.size(weight) for weight in start.weights.values())
    tell(
        f"DeepLabv3{'+' * record.decoder} on {record.backbone}, {numbers / 1e6:.1f} million numbers, "
        f"output stride {record.output_stride}; fresh: {', '.join(start.fresh) or 'nothing'}; "
        f"batch norm learns in: {', '.join(start.batch_norms) or 'nothing'}"
    )
    trainer = make_trainer(
        record,
        config,
        steps=order.steps,
        class_weights=jnp.asarray(class_weights(config.loss, counts[0])),
        batch_norms=start.batch_norms,
    )
    return TrainingPlan(
        config, training_set, counts, start, init, order, Pixels(training_set.train, training_set.lookup), trainer
    )

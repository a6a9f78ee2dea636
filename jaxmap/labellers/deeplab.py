"""The network as a labeller: DeepLab inside the compiled step, its classes turned into the map's."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt8

from jaxmap.errors import JaxmapError
from jaxmap.labellers.base import Cues, Labeller, TunableLabels, fixed_labels
from jaxmap.labels import IGNORE
from jaxmap.models.checkpoint import SavedModel
from jaxmap.models.deeplab import Weights, fold_batch_norm, pure_network
from jaxmap.models.pixelwise import Size, Upsampling, check_size, map_pixels, resized_input, upsampling
from jaxmap.models.tensor_files import shortened
from jaxmap.types import Frame, PointLabels, to_device

_WHERE = "deeplab labeller"


class DeeplabParams(NamedTuple):
    """The numbers of the network; every leaf is differentiable.

    `weights` are those with batch norm folded into the convolutions. Logits are divided by
    `exp(log_temperature)` before the softmax (Guo et al. 2017, "On Calibration of Modern Neural Networks").
    """

    weights: Weights
    log_temperature: Float[Array, ""]


class ClassMap(NamedTuple):
    """What the classes of a network become.

    Attributes:
        classes: the classes of the map.
        targets: for each class of the network, the index of the map's class, or `IGNORE` for none.
    """

    classes: tuple[str, ...]
    targets: tuple[int, ...]


def make_class_map(
    network_classes: Sequence[str], classes: Sequence[str] | None = None, renamed: Mapping[str, str] | None = None
) -> ClassMap:
    """Decides which class of the map each class of a network becomes.

    A class becomes what `renamed` says; without an entry there it keeps its name where the map has a
    class of that name, and otherwise becomes none.

    Args:
        network_classes: in the order of the logits.
        classes: those of the map; by default the new names of `renamed` in its order, and all of the
            network's where it is empty.
        renamed: the map's name for the network's; several may become one.

    Raises:
        JaxmapError: a name that the network or the map has not, or a class of the map that nothing
            becomes; all are told together.
    """
    renamed = {} if renamed is None else dict(renamed)
    if classes is None:
        classes = tuple(dict.fromkeys(renamed.values())) or tuple(network_classes)
    new_names = [renamed.get(name, name) for name in network_classes]
    faults = {
        "the network has no class": [name for name in renamed if name not in network_classes],
        "the map has no class": [name for name in dict.fromkeys(renamed.values()) if name not in classes],
        "no class of the network becomes": [name for name in classes if name not in new_names],
    }
    told = [f"{what} {shortened(names)}" for what, names in faults.items() if names]
    if told or not classes:
        raise JaxmapError(
            "; ".join(told) or "the map has no class at all",
            where=_WHERE,
            fix=f"name classes of the network ({shortened(network_classes, 8)}), or rename them in class_map",
        )
    return ClassMap(tuple(classes), tuple(classes.index(name) if name in classes else IGNORE for name in new_names))


def make_deeplab_labeller(
    saved: SavedModel,
    classes: Sequence[str] | None = None,
    *,
    class_map: Mapping[str, str] | None = None,
    size_px: Size | None = None,
    soft: bool = True,
    temperature: float = 1.0,
) -> Labeller:
    """Labels by a network that sees the rectified left image inside the step.

    The labels are those of `jaxmap segment` with the same model and size. A pixel's point is kept
    whatever its class: what the network gives to classes that the map has not is evidence that
    something is there, and for no class.

    Args:
        saved: the network; its batch norm is folded. Its weights become the labeller's params.
        classes: the classes of the map (`make_class_map`).
        class_map: the map's names for the network's classes, where they differ.
        size_px: height and width that the network runs at; those of the image if not given.
        soft: probabilities of the classes, where several become one their sum; otherwise one label,
            that of the network's likeliest class.
        temperature: softens probabilities above 1 and sharpens them below.

    Raises:
        JaxmapError: only a backbone, faulty classes, a size below 1, or a temperature that is not positive.
    """
    if saved.holds != "network":
        raise JaxmapError(
            f"there is only a backbone ({saved.architecture.backbone})", where=_WHERE, fix="train a network from it"
        )
    check_size(size_px, _WHERE)
    if not 0 < temperature < float("inf"):
        raise JaxmapError(f"temperature {temperature}", where=_WHERE, fix="give a number above 0")
    mapped = make_class_map(saved.architecture.classes, classes, class_map)
    network = pure_network(*fold_batch_norm(saved.architecture, jax.tree.map(np.asarray, saved.weights)))
    groups = [
        [index for index, target in enumerate(mapped.targets) if target == wanted]
        for wanted in range(len(mapped.classes))
    ]

    def see(frame: Frame, params: Any) -> tuple[Array, Upsampling]:
        image = _image(frame)
        with jax.named_scope("network"):
            coarse = network.apply_coarse(params.weights, resized_input(image[None], size_px))[0]
        return coarse, upsampling(network.architecture, coarse.shape[:2], image.shape[:2], size_px)

    def label(frame: Frame, points_world: Array, valid: Array, params: Any, key: Array) -> tuple[PointLabels, None]:
        coarse, places = see(frame, params)
        coarse = coarse * jnp.exp(-params.log_temperature)
        with jax.named_scope("pixel_labels"):
            if soft:
                shares = map_pixels(lambda logits: _merged_softmax(logits, groups), coarse, places)
                # They are never stored side by side: each scatter reads its own one.
                probabilities = jnp.stack([share.reshape(-1) for share in shares], axis=-1)
                return PointLabels(keep=valid, probabilities=probabilities), None
            (labels,) = map_pixels(lambda logits: (_likeliest(logits, mapped.targets),), coarse, places)
            return PointLabels(keep=valid, labels=labels.reshape(-1)), None

    def cues(frame: Frame, points_world: Array, valid: Array, params: Any, key: Array) -> Cues:
        count = len(saved.architecture.classes)
        logits = map_pixels(lambda rows: tuple(rows[:, index] for index in range(count)), *see(frame, params))
        return Cues(valid, jnp.stack([one.reshape(-1) for one in logits], axis=-1))

    def probabilities(values: Array, frame: Array, shared: Any, numbers: dict[str, Array]) -> Array:
        every = jax.nn.softmax(values / numbers["temperature"], axis=-1)
        return jnp.stack([every[:, jnp.array(group)].sum(axis=-1) for group in groups], axis=-1)

    params = DeeplabParams(network.weights, to_device(np.log(temperature), np.float32))
    soft_labels = TunableLabels({"temperature": temperature}, {"temperature": (0.02, 50.0)}, cues, probabilities)
    tunable = soft_labels if soft else fixed_labels(label)
    return Labeller("deeplab", mapped.classes, "image", label, params, tunable)


def _image(frame: Frame) -> UInt8[Array, "H W 3"]:
    """The frame's image as RGB.

    Raises:
        JaxmapError: it is not of the size of the disparity, whose pixels are the points.
    """
    assert frame.image is not None
    image = frame.image if frame.image.ndim == 3 else jnp.repeat(frame.image[..., None], 3, axis=-1)
    if image.shape != (*frame.disparity_px.shape, 3):
        raise JaxmapError(
            f"the image is {tuple(frame.image.shape)}, the disparity {tuple(frame.disparity_px.shape)}",
            where=_WHERE,
            fix="give the rectified left image, grey or RGB",
        )
    return image


def _merged_softmax(logits: Float[Array, "R C W"], groups: list[list[int]]) -> tuple[Float[Array, "R W"], ...]:
    """The summed probability of each group of classes."""
    powers = jnp.exp(logits - jax.lax.stop_gradient(logits.max(axis=1, keepdims=True)))
    # Without the barriers they would be computed anew for each group.
    powers = jax.lax.optimization_barrier(powers)
    scale = jax.lax.optimization_barrier(1.0 / powers.sum(axis=1))
    return tuple(sum(powers[:, index] for index in group) * scale for group in groups)


def _likeliest(logits: Float[Array, "R C W"], targets: Sequence[int]) -> Int[Array, "R W"]:
    """What the likeliest class becomes; the first of those that are equal."""
    top = logits.max(axis=1)
    labels = jnp.full(top.shape, IGNORE, jnp.int32)
    # Comparisons are vectorised where an argmax is not.
    for index in reversed(range(len(targets))):
        labels = jnp.where(logits[:, index] == top, targets[index], labels)
    return labels

"""A segmentation network as a labeller, inside the compiled step, its classes turned into the map's.

The bundled one is a DeepLabv3+, which gave the labeller its name; the model file says which kind of network it holds.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt8

from jaxmap.errors import JaxmapError
from jaxmap.fusion.bijectors import positive
from jaxmap.geometry.cloud import PointCloud
from jaxmap.geometry.options import GroundOptions
from jaxmap.geometry.relief import RELIEF_STRIDE, relief_channels
from jaxmap.labellers.base import Labeller, LabellerParams, Numbers, PointFeatures, Pointwise
from jaxmap.labellers.options import DeeplabOptions
from jaxmap.labellers.relief import floating_points, ground_seen
from jaxmap.labellers.shares import Odds, merged_softmax, pixel_shares
from jaxmap.labels import IGNORE
from jaxmap.models.architecture import Architecture
from jaxmap.models.checkpoint import SavedModel
from jaxmap.models.network import fold_batch_norm, pure_network
from jaxmap.models.pixelwise import map_pixels, resized_input, upsampling
from jaxmap.models.tensor_files import shortened
from jaxmap.types import Frame, to_device

_WHERE = "deeplab labeller"


class ClassMapping(NamedTuple):
    """What the classes of a network become.

    Attributes:
        classes: the classes of the map.
        targets: for each class of the network, the index of the map's class, or `IGNORE` for none.
    """

    classes: tuple[str, ...]
    targets: tuple[int, ...]


def map_classes(
    network_classes: Sequence[str], classes: Sequence[str] | None = None, renamed: Mapping[str, str] | None = None
) -> ClassMapping:
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
            becomes; all are named together.
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
    faulty = [f"{what} {shortened(names)}" for what, names in faults.items() if names]
    if faulty or not classes:
        raise JaxmapError(
            "; ".join(faulty) or "the map has no class at all",
            where=_WHERE,
            fix=f"name classes of the network ({shortened(network_classes, 8)}), or rename them in class_map",
        )
    return ClassMapping(tuple(classes), tuple(classes.index(name) if name in classes else IGNORE for name in new_names))


def make_deeplab_labeller(
    saved: SavedModel, classes: Sequence[str] | None = None, options: DeeplabOptions | None = None, **changes: Any
) -> Labeller:
    """Labels by a network that sees the rectified left image inside the step.

    The labels are those of `jaxmap segment` with the same model and size; a network that was trained with relief sees
    that of the frame as well. What becomes of its logits `make_logits_labeller` says.

    Args:
        saved: the network; its batch norm is folded. Its weights become the labeller's params.
        classes: the classes of the map (`map_classes`).
        options: by default those of `DeeplabOptions`.
        **changes: fields of `DeeplabOptions` that differ from it.

    Raises:
        JaxmapError: only a backbone, faulty classes, or an option out of bounds.
    """
    options = replace(options or DeeplabOptions(), **changes)
    if saved.holds != "network":
        raise JaxmapError(
            f"there is only a backbone ({saved.architecture.backbone})", where=_WHERE, fix="train a network from it"
        )
    network = pure_network(*fold_batch_norm(saved.architecture, jax.tree.map(np.asarray, saved.weights)))
    behind = make_logits_labeller(saved.architecture, classes, options)

    def perceive(frame: Frame, cloud: PointCloud, params: LabellerParams) -> Float[Array, "h w C"]:
        image, relief = _image(frame, cloud), None
        if behind.ground is not None:
            assert cloud.relief is not None
            relief = relief_channels(cloud.relief)[None]
        with jax.named_scope("network"):
            return network.apply_coarse(params.weights, resized_input(image[None], options.size_px), relief)[0]

    def features(frame: Frame, cloud: PointCloud, params: LabellerParams, key: Array) -> PointFeatures:
        return behind.features(replace(frame, logits=perceive(frame, cloud, params)), cloud, params, key)

    params = LabellerParams(network.weights, behind.params.numbers)
    return behind._replace(needs="image", features=features, params=params, perceive=perceive)


def make_logits_labeller(
    architecture: Architecture,
    classes: Sequence[str] | None = None,
    options: DeeplabOptions | None = None,
    **changes: Any,
) -> Labeller:
    """Labels by what a network has made of the image before: by the frame's logits, at the network's resolution.

    A pixel's point is kept whatever its class: what the network gives to classes that the map has not is evidence that
    something is there, and for no class. Where the network was shown relief, false matches in the air are left out.
    Logits are divided by the temperature before the softmax (Guo et al. 2017, "On Calibration of Modern Neural
    Networks").

    Args:
        architecture: of the network.
        classes: the classes of the map (`map_classes`).
        options: by default those of `DeeplabOptions`; `size_px` and `see_relief` are those that the network ran with.
        **changes: fields of `DeeplabOptions` that differ from it.

    Raises:
        JaxmapError: faulty classes, or an option out of bounds.
    """
    options = replace(options or DeeplabOptions(), **changes)
    mapped = map_classes(architecture.classes, classes, options.class_map)
    ground = GroundOptions() if architecture.relief_channels and options.see_relief else None

    def features(frame: Frame, cloud: PointCloud, params: LabellerParams, key: Array) -> PointFeatures:
        coarse, image_px, keep = frame.logits, cloud.valid.shape, cloud.in_range.reshape(-1)
        assert coarse is not None
        of_frame = ()
        if ground is not None:
            of_frame, keep = ground_seen(cloud), keep & ~floating_points(cloud)
        places = upsampling(architecture, coarse.shape[:2], image_px, options.size_px)

        def map_rows(function: Pointwise, more: Array | None = None) -> tuple[Array, ...]:
            with jax.named_scope("pixel_labels"):
                # The sky, and what lies too far: a third of many images.
                images = map_pixels(function, coarse, places, more, RELIEF_STRIDE, cloud.in_range)
                return tuple(image.reshape(-1) for image in images)

        def label_all(numbers: Numbers, odds: Odds | None) -> tuple[Array, ...]:
            with jax.named_scope("pixel_labels"):
                temperature, count = numbers["temperature"], len(mapped.classes)
                return pixel_shares(coarse, places, mapped.targets, count, temperature, cloud.in_range, odds)

        return PointFeatures(keep, map_rows, of_frame, label_all if options.soft else None)

    def label(logits: Array, estimate: Any, numbers: Numbers) -> tuple[Array, ...]:
        if options.soft:
            return merged_softmax(logits / numbers["temperature"], mapped.targets, len(mapped.classes))
        return (_likeliest(logits, mapped.targets),)

    numbers = {"temperature": to_device(options.temperature, np.float32)} if options.soft else {}
    return Labeller(
        "deeplab",
        mapped.classes,
        "logits",
        features,
        label,
        params=LabellerParams(numbers=numbers),
        bijectors={"temperature": positive(0.02, 50.0)},
        soft=options.soft,
        ground=ground,
        draws=False,
    )


def _image(frame: Frame, cloud: PointCloud) -> UInt8[Array, "H W 3"]:
    """The frame's image as RGB.

    Raises:
        JaxmapError: it is not of the size of the disparity, whose pixels are the points.
    """
    assert frame.image is not None
    image = frame.image if frame.image.ndim == 3 else jnp.repeat(frame.image[..., None], 3, axis=-1)
    if image.shape != (*cloud.valid.shape, 3):
        raise JaxmapError(
            f"the image is {tuple(frame.image.shape)}, the disparity {cloud.valid.shape}",
            where=_WHERE,
            fix="give the rectified left image, grey or RGB",
        )
    return image


def _likeliest(logits: Float[Array, "N D *w"], targets: Sequence[int]) -> Int[Array, "N *w"]:
    """What the likeliest class becomes; the first of those that are equal."""
    top = logits.max(axis=1)
    labels = jnp.full(top.shape, IGNORE, jnp.int32)
    # Comparisons are vectorised where an argmax is not.
    for index in reversed(range(len(targets))):
        labels = jnp.where(logits[:, index] == top, targets[index], labels)
    return labels

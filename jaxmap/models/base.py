"""What all segmentation networks share: their input, the last upsampling, and relief on the pixels of a decoder."""

from __future__ import annotations

from abc import abstractmethod

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float, PRNGKeyArray, UInt8

from jaxmap.errors import JaxmapError
from jaxmap.models.architecture import Architecture
from jaxmap.models.backbones import BUILDERS, Pyramid
from jaxmap.models.resizing import resize_area, resize_bilinear

Images = UInt8[Array, "B H W 3"] | Float[Array, "B H W 3"]
"""RGB, 0 to 255, of any size."""

Relief = Float[Array, "B g v R"]
"""Channels of relief over the field of view of the images, of any size; zeros where nothing is known."""

LOW_LEVEL_STRIDE = 4
"""Input pixels for each pixel of the decoder that sees relief."""


class Network(nnx.Module):
    """A segmentation network, fixed by its `Architecture`: a backbone, and what makes logits of its features.

    Arrays under `backbone.` are the backbone's, those under `classifier.` have the classes as their last axis.
    """

    def __init__(self, record: Architecture) -> None:
        self.record = record
        self.backbone = BUILDERS[record.backbone](record)

    def __call__(
        self, images: Images, relief: Relief | None = None, *, dropout_key: PRNGKeyArray | None = None
    ) -> Float[Array, "B H W C"]:
        """Class logits at the size of the images; see `coarse_logits`."""
        height, width = images.shape[1:3]
        logits = self.coarse_logits(images, relief, dropout_key=dropout_key)
        padded = (padded_size(height, self.record), padded_size(width, self.record))
        with jax.named_scope("upsample"):
            logits = resize_bilinear(logits, *padded, align_corners=self.record.align_corners)
        return logits[:, :height, :width]

    def coarse_logits(
        self, images: Images, relief: Relief | None = None, *, dropout_key: PRNGKeyArray | None = None
    ) -> Float[Array, "B h w C"]:
        """Class logits before the last upsampling, over the padded images: at the stride where the network ends.

        Features are dropped only where a key is given.

        Raises:
            JaxmapError: relief that is not what the network was made for; None is unknown relief to those that see it.
        """
        relief = placed_relief(relief, images.shape, self.record)
        with jax.named_scope("backbone"):
            pyramid = self.backbone(normalise(images, self.record))
        return self.decode(pyramid, relief, dropout_key)

    @abstractmethod
    def decode(
        self, pyramid: Pyramid, relief: Float[Array, "B h w R"] | None, dropout_key: PRNGKeyArray | None
    ) -> Float[Array, "B h w C"]:
        """Class logits of the backbone's features."""


def padded_size(size: int, record: Architecture) -> int:
    """The least size not below `size` that the output stride divides, apart from `size_remainder`."""
    stride, remainder = record.output_stride, record.size_remainder
    return max(-(-(size - remainder) // stride), 1) * stride + remainder


def normalise(images: Images, record: Architecture) -> Float[Array, "B h w 3"]:
    """Images on the scale the network was trained on, padded below and to the right with zeros (the mean)."""
    # Whole numbers and halves become float32; float64, which checks of gradients need, stays.
    dtype = jnp.promote_types(images.dtype, jnp.float32)
    mean, std = (jnp.asarray(values, dtype) * 255 for values in (record.mean, record.std))
    scaled = (images.astype(dtype) - mean) / std
    after = [padded_size(size, record) - size for size in images.shape[1:3]]
    return jnp.pad(scaled, ((0, 0), (0, after[0]), (0, after[1]), (0, 0)))


def placed_relief(relief: Relief | None, images: tuple[int, ...], record: Architecture) -> Array | None:
    """Relief on the pixels of the decoder, padded as the images are; zeros where there is none.

    Raises:
        JaxmapError: the network sees none, or one of another shape.
    """
    channels, (batch, *size, _) = record.relief_channels, images
    if relief is None:
        if not channels:
            return None
        relief = jnp.zeros((batch, 1, 1, channels))
    if relief.ndim != 4 or (relief.shape[0], relief.shape[3]) != (batch, channels) or not channels:
        wanted = f"relief of {batch} images in {channels} channels" if channels else "no relief"
        raise JaxmapError(
            f"relief of shape {list(relief.shape)}, the network sees {wanted}",
            where="relief",
            fix="give what the network was trained on, or none",
        )
    inside = [-(-length // LOW_LEVEL_STRIDE) for length in size]
    after = [
        -(-padded_size(length, record) // LOW_LEVEL_STRIDE) - pixels
        for length, pixels in zip(size, inside, strict=True)
    ]
    with jax.named_scope("relief"):
        return jnp.pad(resize_area(relief, *inside), ((0, 0), (0, after[0]), (0, after[1]), (0, 0)))

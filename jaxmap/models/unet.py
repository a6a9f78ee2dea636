"""U-Net (Ronneberger, Fischer and Brox 2015) on a backbone, as segmentation_models_pytorch builds it."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float, PRNGKeyArray

from jaxmap.models.architecture import Architecture
from jaxmap.models.backbones import Pyramid
from jaxmap.models.base import Network
from jaxmap.models.layers import ConvBlock


class UNet(Network):
    """Step by step up to the size of the images, each step joined by the backbone's features of its size.

    The authors' network crops, as its convolutions do not pad; here they do. A step repeats each pixel, in the place of
    a transposed convolution.
    """

    def __init__(self, record: Architecture) -> None:
        super().__init__(record)
        *skips, inputs = self.backbone.channels
        norm, steps = "batch" if record.head_norm else "bias", []
        for step, skip in enumerate([*reversed(skips), 0]):
            width = max(record.head_channels >> step, 1)
            steps.append(
                nnx.List(
                    ConvBlock(before, width, 3, norm=norm, eps=record.head_eps) for before in (inputs + skip, width)
                )
            )
            inputs = width
        self.decoder = nnx.List(steps)
        self.classifier = ConvBlock(inputs, len(record.classes), 3, norm="bias", activation="none")

    def decode(
        self, pyramid: Pyramid, relief: Float[Array, "B h w R"] | None, dropout_key: PRNGKeyArray | None
    ) -> Float[Array, "B h w C"]:
        """Class logits at the size of the padded images."""
        *skips, features = pyramid.levels
        with jax.named_scope("decoder"):
            for convs, skip in zip(self.decoder, [*reversed(skips), None], strict=True):
                features = features.repeat(2, axis=1).repeat(2, axis=2)
                if skip is not None:
                    features = jnp.concatenate([features, skip], axis=-1)
                for block in convs:
                    features = block(features)
            return self.classifier(features)

"""SegNet (Badrinarayanan, Kendall and Cipolla 2017) on a backbone whose strides are max pooling."""

from __future__ import annotations

from itertools import pairwise

import jax
from flax import nnx
from jaxtyping import Array, Float, PRNGKeyArray

from jaxmap.models.architecture import Architecture
from jaxmap.models.backbones import Pyramid
from jaxmap.models.base import Network
from jaxmap.models.layers import ConvBlock
from jaxmap.models.unpooling import unpool


class SegNet(Network):
    """A mirror of the encoder: each step puts the features back where the encoder's pooling found them, and convolves.

    A step has two convolutions of 3 x 3; the classifier is the last one, as of the authors' network. Where the backbone
    ends with other channels than its last pooling kept, a 1x1 convolution comes first.
    """

    def __init__(self, record: Architecture) -> None:
        super().__init__(record)
        pooled, inputs = self.backbone.pooled, self.backbone.channels[-1]

        def conv(inputs: int, outputs: int, size: int) -> ConvBlock:
            norm = "batch" if record.head_norm else "bias"
            return ConvBlock(inputs, outputs, size, norm=norm, eps=record.head_eps)

        self.reduce = None if inputs == pooled[-1] else conv(inputs, pooled[-1], 1)
        steps = [nnx.List([conv(width, width, 3), conv(width, after, 3)]) for after, width in pairwise(pooled)]
        self.decoder = nnx.List([*reversed(steps), nnx.List([conv(pooled[0], pooled[0], 3)])])
        self.classifier = ConvBlock(pooled[0], len(record.classes), 3, norm="bias", activation="none")

    def decode(
        self, pyramid: Pyramid, relief: Float[Array, "B h w R"] | None, dropout_key: PRNGKeyArray | None
    ) -> Float[Array, "B h w C"]:
        """Class logits at the size of the padded images."""
        features = pyramid.levels[-1]
        with jax.named_scope("decoder"):
            if self.reduce is not None:
                features = self.reduce(features)
            for convs, places in zip(self.decoder, reversed(pyramid.places), strict=True):
                features = unpool(features, places)
                for block in convs:
                    features = block(features)
            return self.classifier(features)

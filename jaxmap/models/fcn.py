"""Fully convolutional networks (Long, Shelhamer and Darrell 2015): FCN-8s, and the one of torchvision."""

from __future__ import annotations

import jax
from flax import nnx
from jaxtyping import Array, Float, PRNGKeyArray

from jaxmap.models.architecture import Architecture
from jaxmap.models.backbones import Pyramid
from jaxmap.models.base import Network
from jaxmap.models.layers import ConvBlock, dropped
from jaxmap.models.resizing import resize_bilinear

SKIPS = 2
"""Finer levels whose scores FCN-8s adds: those at stride 16 and 8."""


class Fcn(Network):
    """Scores of the coarsest features; with a decoder (FCN-8s) those at stride 16 and 8 are added on the way up.

    The convolution before the scores is torchvision's 3 x 3, in the place of two of 4096 channels. Upsampling stays
    bilinear, from which the authors' learned one starts.
    """

    def __init__(self, record: Architecture) -> None:
        super().__init__(record)
        *finer, coarsest = self.backbone.channels
        norm = "batch" if record.head_norm else "bias"
        self.refine = ConvBlock(coarsest, record.head_channels, 3, norm=norm, eps=record.head_eps)
        inputs = [record.head_channels, *(reversed(finer[-SKIPS:]) if record.decoder else ())]
        self.classifier = nnx.List(
            ConvBlock(channels, len(record.classes), norm="bias", activation="none") for channels in inputs
        )

    def decode(
        self, pyramid: Pyramid, relief: Float[Array, "B h w R"] | None, dropout_key: PRNGKeyArray | None
    ) -> Float[Array, "B h w C"]:
        """Class logits at stride 8, or without a decoder at the output stride."""
        with jax.named_scope("decoder"):
            features = dropped(self.refine(pyramid.levels[-1]), self.record.dropout, dropout_key)
            first, *others = self.classifier
            scores = first(features)
            for classifier, level in zip(others, reversed(pyramid.levels[:-1]), strict=False):
                scores = resize_bilinear(scores, *level.shape[1:3], align_corners=self.record.align_corners)
                scores = scores + classifier(level)
            return scores

"""DeepLabv3 and DeepLabv3+ (Chen et al. 2017, 2018)."""

from __future__ import annotations

import jax
from jaxtyping import Array, Float, PRNGKeyArray

from jaxmap.models.architecture import Architecture
from jaxmap.models.backbones import Pyramid
from jaxmap.models.base import Network
from jaxmap.models.heads import Aspp, Decoder
from jaxmap.models.layers import ConvBlock


class DeepLab(Network):
    """Atrous spatial pyramid pooling of the coarsest features, then (v3+) a decoder with those at stride 4."""

    def __init__(self, record: Architecture) -> None:
        super().__init__(record)
        channels = self.backbone.channels
        self.aspp = Aspp(channels[-1], record)
        self.decoder = Decoder(channels[0], record) if record.decoder else None
        self.classifier = ConvBlock(record.head_channels, len(record.classes), norm="bias", activation="none")

    def decode(
        self, pyramid: Pyramid, relief: Float[Array, "B h w R"] | None, dropout_key: PRNGKeyArray | None
    ) -> Float[Array, "B h w C"]:
        """Class logits at stride 4, or without a decoder at the output stride."""
        with jax.named_scope("aspp"):
            features = self.aspp(pyramid.levels[-1], dropout_key)
        if self.decoder is None:
            return self.classifier(features)
        with jax.named_scope("decoder"):
            return self.decoder(features, pyramid.levels[0], self.classifier, relief)

"""The network, growing with the image that it sees."""

from __future__ import annotations

import cv2
import numpy as np
from golden.seeded_weights import seeded_state_of

from benchmarks import ours
from benchmarks.groups import Group
from benchmarks.harness import Amount, Case, Peer
from benchmarks.network_peers import MODULES, NetworkPeers
from benchmarks.scene import make_scene
from benchmarks.threads import usable_cores

SEEN_PX = {"small": (192, 256), "medium": ours.NETWORK_PX, "large": (768, 1024)}
"""Height and width."""


def network(size: str) -> Case:
    """Probabilities of all pixels; the peers only compute logits, of an image that was made smaller and normalised."""
    scene, (height_px, width_px) = make_scene(), SEEN_PX[size]
    prepared = ours.label_pixels(scene, (height_px, width_px))
    seen = cv2.resize(scene.left, (width_px, height_px), interpolation=cv2.INTER_AREA)[None]
    made = NetworkPeers(ours.BACKBONE, seeded_state_of(ours.BACKBONE), np.ascontiguousarray(seen), usable_cores())
    beside = [Peer(name, make, modules=MODULES[name]) for name, make in made.makers().items()]
    pixels = Amount(height_px * width_px, "pixels")
    return Case(prepared.run, pixels, Amount(1, "images"), beside, prepared.compile_s, prepared.temporary_bytes)


GROUPS = (Group("network", "MobileNetV2 on an image of 1024 x 768, by the pixels that it sees", network),)

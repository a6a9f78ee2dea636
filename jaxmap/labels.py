"""Class names and their colours."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

IGNORE = 255
"""Label of a pixel or voxel that carries no class."""

ANY_OTHER = 254
"""Label of a pixel of a training mask that is of any class but one, which the masks negate ("not rock")."""

ROVER_CLASSES: tuple[str, ...] = ("background", "sand", "rock")
"""The paper's three classes, in the order of the label PNGs (0, 1, 2)."""

_KNOWN_COLOURS: dict[str, tuple[int, int, int]] = {
    "background": (110, 129, 150),
    "sand": (222, 184, 120),
    "rock": (178, 60, 46),
}
UNLABELLED_COLOUR: tuple[int, int, int] = (130, 130, 130)


def class_colours(classes: Sequence[str]) -> np.ndarray:
    """Colours of classes, fixed for the rover's own and spread around the hue circle for others.

    Returns:
        uint8 (256, 3): RGB by label; rows that are no class (`IGNORE` too) are grey.
    """
    table = np.tile(np.array(UNLABELLED_COLOUR, np.uint8), (256, 1))
    for index, name in enumerate(classes):
        table[index] = _KNOWN_COLOURS.get(name, _hue_colour(index))
    return table


def _hue_colour(index: int) -> tuple[int, int, int]:
    import colorsys

    # Steps of the golden ratio keep any number of hues apart.
    hue = (0.11 + index * 0.618034) % 1.0
    red, green, blue = colorsys.hsv_to_rgb(hue, 0.62, 0.82)
    return round(red * 255), round(green * 255), round(blue * 255)

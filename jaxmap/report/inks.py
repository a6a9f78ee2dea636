"""Colours of classes as lines and words: dark enough on a light page, light enough on a dark one."""

from __future__ import annotations

from collections.abc import Sequence

from jaxmap.labels import class_colours

LEAST_CONTRAST = 3.0
"""Of lines and large text, as the WCAG 2.1 ask for."""

LIGHT_PANEL, DARK_PANEL = (255, 255, 255), (27, 30, 36)
"""The grounds of the page's panels, as page.css has them."""

Rgb = tuple[int, ...]


def class_inks(classes: Sequence[str]) -> str:
    """A style sheet that defines `--class-INDEX` for each class, for light and dark pages."""
    colours = [tuple(colour) for colour in class_colours(classes)[: len(classes)].tolist()]
    light, dark = (
        "".join(f"--class-{index}:rgb{with_contrast(colour, ground)};" for index, colour in enumerate(colours))
        for ground in (LIGHT_PANEL, DARK_PANEL)
    )
    return f":root{{{light}}}@media (prefers-color-scheme: dark){{:root{{{dark}}}}}"


def with_contrast(colour: Rgb, ground: Rgb) -> Rgb:
    """The colour, mixed with as little black or white as gives it `LEAST_CONTRAST` to the ground."""
    end = 0 if _luminance(ground) > 0.18 else 255
    shades = (tuple(round(value + (end - value) * step / 20) for value in colour) for step in range(21))
    return next(shade for shade in shades if contrast(shade, ground) >= LEAST_CONTRAST)


def contrast(one: Rgb, other: Rgb) -> float:
    """The contrast ratio of two sRGB colours, 1 to 21 (WCAG 2.1, "contrast ratio")."""
    low, high = sorted((_luminance(one), _luminance(other)))
    return (high + 0.05) / (low + 0.05)


def _luminance(colour: Rgb) -> float:
    linear = [value / 255 / 12.92 if value <= 10 else ((value / 255 + 0.055) / 1.055) ** 2.4 for value in colour]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]

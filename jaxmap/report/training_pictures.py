"""Examples side by side: image, true labels, those of the network, and where they differ."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from html import escape

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from jaxmap.labels import IGNORE, class_colours
from jaxmap.report.pictures import overlay_labels

PANEL_WIDTH_PX = 480

WRONG, MISSED = (213, 94, 0), (0, 114, 178)
"""Vermilion and blue, which colour-blind people tell apart (Okabe & Ito 2008)."""

Pixels = UInt8[np.ndarray, "H W 3"]
Labels = UInt8[np.ndarray, "H W"]


def example_panels(name: str, image: Pixels, truth: Labels, prediction: Labels, classes: Sequence[str]) -> str:
    """Four pictures of one example in a row, as HTML."""
    image, truth, prediction = _smaller(image, truth, prediction)
    panels = {
        "Image": image,
        "Truth": overlay_labels(image, truth, classes),
        "Network": overlay_labels(image, prediction, classes),
        "Error": error_picture(image, truth, prediction, len(classes)),
    }
    figures = "".join(
        f"<figure>{_inline(picture, f'{caption}, {name}')}<figcaption>{caption}</figcaption></figure>"
        for caption, picture in panels.items()
    )
    return f'<div class="frame"><h3>{escape(name)}</h3><div class="row quad">{figures}</div></div>'


def error_picture(image: Pixels, truth: Labels, prediction: Labels, class_count: int) -> Pixels:
    """The image in pale grey, and in colour what the network has wrong; what carries no label is dark.

    All errors are `WRONG`; but of two classes, pixels of the second that the network missed are `MISSED`.
    """
    grey = np.array(Image.fromarray(image).convert("L"))
    unlabelled = truth == IGNORE
    level = np.where(unlabelled, grey * 0.35, 130 + grey * 0.45)
    picture = np.repeat(level[..., None], 3, axis=2)
    wrong = (prediction != truth) & ~unlabelled
    picture[wrong] = WRONG
    if class_count == 2:
        picture[wrong & (truth == 1)] = MISSED
    return picture.astype(np.uint8)


def legend(classes: Sequence[str]) -> str:
    """What the colours of the panels mean, as HTML."""
    entries = list(zip(classes, class_colours(classes)[: len(classes)].tolist(), strict=True))
    if len(classes) == 2:
        entries += [(f"{classes[1]} missed", MISSED), (f"{classes[1]} where there is none", WRONG)]
    else:
        entries.append(("error", WRONG))
    return (
        '<p class="legend">'
        + "".join(f"<span>{swatch(colour)}{escape(text)}</span>" for text, colour in entries)
        + "</p>"
    )


def swatch(colour: Sequence[int]) -> str:
    """A small square of a colour."""
    return f'<i class="swatch" style="background:{rgb(colour)}"></i>'


def rgb(colour: Sequence[int]) -> str:
    """A colour as CSS has it."""
    return f"rgb({','.join(map(str, colour))})"


def _smaller(image: Pixels, truth: Labels, prediction: Labels) -> tuple[Pixels, Labels, Labels]:
    height, width = image.shape[:2]
    if width <= PANEL_WIDTH_PX:
        return image, truth, prediction
    size = PANEL_WIDTH_PX, max(1, round(height * PANEL_WIDTH_PX / width))
    rows = (np.arange(size[1]) + 0.5) * height // size[1]
    columns = (np.arange(size[0]) + 0.5) * width // size[0]
    nearest = np.ix_(rows.astype(int), columns.astype(int))
    small = np.array(Image.fromarray(image).resize(size, Image.Resampling.BOX))
    return small, truth[nearest], prediction[nearest]


def _inline(picture: Pixels, alt: str) -> str:
    buffer = io.BytesIO()
    # JPEG with whole colour is several times faster than WebP, and the page is written after every epoch.
    Image.fromarray(picture).save(buffer, "jpeg", quality=88, subsampling=0)
    data = base64.b64encode(buffer.getvalue()).decode("ascii")
    height, width = picture.shape[:2]
    return f'<img src="data:image/jpeg;base64,{data}" alt="{escape(alt)}" width="{width}" height="{height}">'

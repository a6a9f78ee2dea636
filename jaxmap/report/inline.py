"""Pictures and data put into a page, so that it needs no other file."""

from __future__ import annotations

import base64
import io
from html import escape
from pathlib import Path

from jaxmap.errors import JaxmapError


def inline_image(path: Path, alt: str, *, width_px: int | None = None) -> str:
    """An `<img>` that holds the picture, scaled down to `width_px` where it is wider.

    Raises:
        JaxmapError: the picture cannot be read.
    """
    from PIL import Image, UnidentifiedImageError

    try:
        content, kind = path.read_bytes(), "png"
        with Image.open(io.BytesIO(content)) as image:
            image.load()
            if width_px is not None:
                image = image.convert("RGB")
                image.thumbnail((width_px, width_px * 4))
                buffer = io.BytesIO()
                image.save(buffer, "webp", quality=86)
                content, kind = buffer.getvalue(), "webp"
            size = image.size
    except (OSError, ValueError, SyntaxError, UnidentifiedImageError) as error:
        raise JaxmapError("not a readable picture", where=path, fix="remove it or map again") from error
    data = base64.b64encode(content).decode("ascii")
    return f'<img src="data:image/{kind};base64,{data}" alt="{escape(alt)}" width="{size[0]}" height="{size[1]}">'


def script_text(content: str) -> str:
    """JSON that is safe inside a `<script>`."""
    return content.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")

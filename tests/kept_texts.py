"""Texts kept in a file, so that a change of wording is seen in review; JAXMAP_UPDATE_SNAPSHOTS=1 writes them anew."""

from __future__ import annotations

import os
import re
from pathlib import Path

DECODERS = "image file is truncated|unrecognized data stream|broken PNG|Error while deserializing"
"""The words of image and tensor libraries differ from version to version."""


class KeptTexts:
    """The texts of one file in `snapshots`, each under a name."""

    def __init__(self, name: str) -> None:
        """Reads the file, where there is one."""
        self._path = Path(__file__).parent / "snapshots" / name
        lines = self._path.read_text().splitlines() if self._path.exists() else []
        self._kept = {name: line.strip() for name, line in zip(lines[::2], lines[1::2], strict=True)}

    @property
    def names(self) -> set[str]:
        """Of the texts in the file."""
        return set(self._kept)

    def compare(self, name: str, text: str, **folders: Path) -> None:
        """Fails where a text is not the one kept; paths below `folders` are written as <NAME>/..."""
        for label, folder in folders.items():
            text = text.replace(str(folder), f"<{label}>")
        text = re.sub(rf"\(({DECODERS})[^;]*\)", "(<decoder>)", text)
        if os.environ.get("JAXMAP_UPDATE_SNAPSHOTS"):
            self._kept[name] = text
            self._path.write_text("".join(f"{key}\n    {line}\n" for key, line in sorted(self._kept.items())))
        assert text == self._kept.get(name, "JAXMAP_UPDATE_SNAPSHOTS=1 writes it")

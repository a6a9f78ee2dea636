"""Standard output and error that are closed, full, or know few letters: a run of hours must not end for their sake."""

from __future__ import annotations

import io
import os
import sys
from typing import Any


class _Lasting(io.FileIO):
    """A stream of the process that drops what it cannot write, and remembers why."""

    fault: OSError | None = None

    def write(self, data: Any, /) -> int:
        try:
            # A part at a time is right: the buffer above calls again for the rest.
            return super().write(data) or 0
        except BrokenPipeError:
            raise
        except OSError as fault:
            self.fault = fault
            return len(memoryview(data).cast("B"))


class _LastingError(_Lasting):
    """Standard error, which may lose its reader, too."""

    def write(self, data: Any, /) -> int:
        try:
            return super().write(data)
        except BrokenPipeError as fault:
            self.fault = fault
            return len(memoryview(data).cast("B"))


def lasting_streams() -> None:
    """Replaces standard output and error by such as go on where writing fails; letters they lack are escaped.

    What is closed is opened on nothing, so that no file of the run gets its number and no library writes into it. A
    reader of standard output that has gone is still an error (`BrokenPipeError`).
    """
    handle = 0
    while handle <= 2:
        handle = os.open(os.devnull, os.O_RDWR)
    os.close(handle)
    for name, number, kind in (("stdout", 1, _Lasting), ("stderr", 2, _LastingError)):
        old = getattr(sys, name)
        encoding = "utf-8" if old is None else old.encoding
        buffer = io.BufferedWriter(kind(number, "w", closefd=False))
        interactive = number == 2 or buffer.isatty()
        stream = io.TextIOWrapper(buffer, encoding, "backslashreplace", line_buffering=interactive)
        setattr(sys, name, stream)


def lost_output() -> OSError | None:
    """Why something that was written to standard output was lost, None where nothing was."""
    raw = getattr(getattr(sys.stdout, "buffer", None), "raw", None)
    return raw.fault if isinstance(raw, _Lasting) else None

"""Errors that a user can act on: what went wrong, where, and what to do about it."""

from __future__ import annotations


class JaxmapError(Exception):
    """A fault in the input or the machine, in one line.

    Args:
        what: what is wrong, without a full stop.
        where: the file, field or frame it is wrong in.
        fix: what the reader can do about it.
    """

    exit_code = 1

    def __init__(self, what: str, *, where: object = "", fix: str = "") -> None:
        self.what, self.where, self.fix = what, str(where), fix
        place = f" in {where}" if str(where) else ""
        advice = f"; {fix}" if fix else ""
        super().__init__(" ".join(f"{what}{place}{advice}".split()))


class UsageError(JaxmapError):
    """A wrong command line or configuration (exit status 2)."""

    exit_code = 2


class FrameError(JaxmapError):
    """One frame that cannot be used; a sequence goes on without it unless it is strict."""

    def at(self, where: object) -> FrameError:
        """This error; placed there, if it does not say where it is."""
        return self if self.where else FrameError(self.what, where=where, fix=self.fix)

"""Errors that a user can act on: what went wrong, where, and what to do about it."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager

_OPTION = re.compile(r"(?<![\w-])--[a-z][\w.-]*\w")


class JaxmapError(Exception):
    """A fault in the input or the machine, told in one line.

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


def with_options(text: str, renamed: Callable[[str], str]) -> str:
    """A text whose options are called as `renamed` says."""
    return _OPTION.sub(lambda found: renamed(found[0]), text)


@contextmanager
def options_as(renamed: Callable[[str], str]) -> Iterator[None]:
    """Lets errors of the block name options as the command at hand calls them; `renamed` gives its name of each."""
    try:
        yield
    except JaxmapError as error:
        what, where, fix = (with_options(text, renamed) for text in (error.what, error.where, error.fix))
        raise type(error)(what, where=where, fix=fix) from error

"""A run that replaces another: written within its folder, and put in its place once it is whole.

`.new` is being written. Once whole it is renamed to `.whole`, and from then on the new run counts: what the old one has
written goes to `.old`, `.whole` becomes `.moving`, its files move up, `.old` is removed. `settle` does whatever of that
a killed process has left undone, so that a folder holds the old run or the new one, never a mixture.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from jaxmap.errors import JaxmapError
from jaxmap.host.files import sync, write_error
from jaxmap.host.output_folder import locked

Outputs = Callable[[], Iterable[Path]]
"""Gives the paths of what a run has written into the folder, there or not."""


class Replacement:
    """The places of a run and of the one that is to replace it.

    Args:
        folder: of the run.
        outputs: what an old run has written there, which goes with it; everything else stays.
        name: of the run, where the folder holds others too.
    """

    def __init__(self, folder: Path, outputs: Outputs, name: str = "") -> None:
        self._folder, self._outputs = folder, outputs
        stem = f".{name}." if name else "."
        self.new, self._whole, self._moving, self._old = (
            folder / f"{stem}{part}" for part in ("new", "whole", "moving", "old")
        )

    @contextmanager
    def written(self, keep: Callable[[], object]) -> Iterator[None]:
        """Puts what the block writes into `new` in place, if it ends without an error.

        Args:
            keep: whether what has been written is worth keeping if the block fails (to be resumed, or looked at).

        Raises:
            JaxmapError: the operating system refused; the next run in the folder goes on where it did.
        """
        try:
            yield
        except BaseException:
            if not keep():
                self.discard()
            raise
        try:
            os.rename(self.new, self._whole)
            sync(self._folder)
        except OSError as error:
            raise write_error(error, self._folder) from error
        self.settle()

    @contextmanager
    def place(self, result: str, notify: Callable[[str], None]) -> Iterator[Path]:
        """Yields the folder to write into: the run's own, or where there are outputs to be replaced, `new`.

        Args:
            result: name of the file that is worth keeping if the block fails.
            notify: takes a line on where that is.
        """
        self.settle()
        if not any(path.exists() for path in self._outputs()):
            yield self._folder
            return
        self.discard()
        self.new.mkdir()

        def keep() -> bool:
            there = (self.new / result).exists()
            if there:
                notify(f"stopped; what was to be replaced stays, the best so far is in {self.new}")
            return there

        with self.written(keep):
            yield self.new

    def discard(self) -> None:
        """Removes what an unfinished replacement has written."""
        shutil.rmtree(self.new, ignore_errors=True)

    def settle(self) -> None:
        """Does what is left to do of a replacement that is whole; the folder must be locked.

        Raises:
            JaxmapError: the operating system refused.
        """
        try:
            if self._whole.exists():
                for path in [*self._outputs()]:
                    if path.exists():
                        aside = self._old / path.relative_to(self._folder)
                        aside.parent.mkdir(parents=True, exist_ok=True)
                        os.rename(path, aside)
                os.rename(self._whole, self._moving)
            if self._moving.exists():
                _move_up(self._moving, self._folder)
                sync(self._folder)
            shutil.rmtree(self._old, ignore_errors=True)
        except OSError as error:
            raise write_error(error, self._folder) from error

    def settle_for_reading(self) -> None:
        """`settle`, unless another process has the folder: it does so itself."""
        if not any(path.exists() for path in (self._whole, self._moving, self._old)):
            return
        try:
            with locked(self._folder):
                self.settle()
        except JaxmapError:
            return


def _move_up(source: Path, target: Path) -> None:
    """Moves all that lies in a folder into another, and removes it; files that are there only in the other stay."""
    for path in [*source.iterdir()]:
        if path.is_dir() and (target / path.name).is_dir():
            _move_up(path, target / path.name)
        else:
            os.replace(path, target / path.name)
    source.rmdir()

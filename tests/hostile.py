"""Inputs that are out to hang, to take all memory or to break a reader: made from good ones, by seed."""

from __future__ import annotations

import os
import random
import re
import resource
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from jaxmap.errors import JaxmapError

SECONDS, GROWTH_MB = 30, 2048
"""What reading one hostile file may take, however slow the machine is."""


def growing(levels: int = 9) -> str:
    """Aliases of aliases: some hundred bytes that stand for 9**levels values."""
    lines = ["a0: &a0 [x]"]
    lines += [f"a{level}: &a{level} [{', '.join([f'*a{level - 1}'] * 9)}]" for level in range(1, levels)]
    return "{" + ", ".join(lines) + "}"


TOKENS = (
    *("1e300", "-1e300", "1e-300", "nan", ".inf", "-1", "0", "1e38", "3.5e38", "99999999999999999999"),
    *("9" * 5000, "0x" + "f" * 5000, "1:" * 500 + "1", "!!timestamp x", "!!float x", "!!int x", "!!bool x", "!!null x"),
    *("2001-99-99", "[" * 10_000, "{a: " * 5000, "- " * 5000, "*a", "&a [*a]", growing(), "~", "", "x", "[]", "{}"),
    *("!!python/object/apply:os.system [true]", "\x07", "\ufeff", "岩", "%s%n", "../../../etc/passwd", "null"),
)

Change = Callable[[Path, random.Random], None]


def replace_number(path: Path, rng: random.Random) -> None:
    """One number of a text becomes something else."""
    text = path.read_text(encoding="utf8")
    numbers = list(re.finditer(r"(?<![\w.])-?\d[\d.]*(?:e-?\d+)?", text))
    if numbers:
        place, token = rng.choice(numbers), rng.choice(TOKENS)
        path.write_text(text[: place.start()] + token + text[place.end() :], encoding="utf8")


def replace_value(path: Path, rng: random.Random) -> None:
    """What stands behind one key becomes something else."""
    text = path.read_text(encoding="utf8")
    values = list(re.finditer(r"(?<=: )[^\n,]+", text))
    if values:
        place, token = rng.choice(values), rng.choice(TOKENS)
        path.write_text(text[: place.start()] + token + text[place.end() :], encoding="utf8")


def flip_bytes(path: Path, rng: random.Random) -> None:
    """Some bytes become others, most of them in the first hundred, where headers are."""
    data = bytearray(path.read_bytes())
    for _ in range(rng.choice((1, 3, 30))):
        data[rng.randrange(min(len(data), rng.choice((100, len(data)))))] = rng.choice((0, 0xFF, rng.randrange(256)))
    path.write_bytes(data)


def cut(path: Path, rng: random.Random) -> None:
    """The file ends early."""
    os.truncate(path, rng.randrange(path.stat().st_size))


def become_pipe(path: Path, rng: random.Random) -> None:
    """Nobody ever writes into it."""
    path.unlink()
    os.mkfifo(path)


def become_device(path: Path, rng: random.Random) -> None:
    """It never ends."""
    path.unlink()
    path.symlink_to("/dev/zero")


def become_loop(path: Path, rng: random.Random) -> None:
    """It links to itself."""
    path.unlink()
    path.symlink_to(path)


def become_folder(path: Path, rng: random.Random) -> None:
    """It holds nothing."""
    path.unlink()
    path.mkdir()


def become_huge(path: Path, rng: random.Random) -> None:
    """A terabyte of zeros behind what was there."""
    os.truncate(path, 1 << 40)


FILE_CHANGES: tuple[Change, ...] = (
    become_pipe,
    become_device,
    become_loop,
    become_folder,
    become_huge,
    cut,
    flip_bytes,
)
TEXT_CHANGES: tuple[Change, ...] = (replace_number, replace_number, replace_value, *FILE_CHANGES)


class TooLong(BaseException):
    """Time is up; no error that a reader could take for its own."""


class Campaign:
    """Tries hostile inputs, one after the other, and gathers what did not end as it must."""

    def __init__(self, seed: int) -> None:
        self.rng = random.Random(seed)
        self.faults: list[str] = []
        self._before_mb = _peak_mb()

    @contextmanager
    def trial(self, name: str) -> Iterator[None]:
        """A block that must end soon, well or with one line."""

        def too_long(number: int, frame: object) -> None:
            raise TooLong(f"more than {SECONDS} s")

        before = signal.signal(signal.SIGALRM, too_long)
        signal.alarm(SECONDS)
        try:
            yield
        except JaxmapError as fault:
            if "\n" in str(fault) or len(str(fault)) > 600:
                self.faults.append(f"{name}: {len(str(fault))} letters: {fault}"[:300])
        except (Exception, TooLong) as fault:
            self.faults.append(f"{name}: {type(fault).__name__}: {fault}"[:300])
        finally:
            signal.alarm(0)
            signal.signal(signal.SIGALRM, before)

    def check(self) -> None:
        """All ended as they must, within memory."""
        assert not self.faults, "\n".join(self.faults)
        assert _peak_mb() - self._before_mb < GROWTH_MB


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1 << 20 if sys.platform == "darwin" else 1 << 10)

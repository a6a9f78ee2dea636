"""Runs that end badly: a process that is killed, and a disk that is full."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

import jaxmap
import jaxmap.host.files

SLOW_DISK = """\
import sys, time, jaxmap.host.files
from jaxmap.commands.main import main
sync = jaxmap.host.files.sync
def slowly(path):
    time.sleep(2)
    sync(path)
jaxmap.host.files.sync = slowly
sys.exit(main(sys.argv[1:]))
"""
"""A program that runs a command whose files take a while to reach the disk: it can be killed in the midst of one."""


def kill_when(ready: Callable[[], object], program: str, words: Sequence[object], deadline_s: float = 300.0) -> None:
    """Runs Python's `program` with `words` in a process of its own, and kills that as soon as it is `ready`."""
    tests = Path(__file__).parent
    folders = map(str, (Path(jaxmap.__file__).parents[1], tests, tests / "training"))
    process = subprocess.Popen(
        [sys.executable, "-c", program, *map(str, words)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(folders)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        until_s = time.monotonic() + deadline_s
        while not ready():
            assert process.poll() is None, "the run ended before it could be killed"
            assert time.monotonic() < until_s
            time.sleep(0.02)
        process.send_signal(signal.SIGKILL)
    finally:
        process.kill()
        process.wait()


def fill_disk(patch: pytest.MonkeyPatch, name: str) -> None:
    """Lets the disk be full as soon as a file of this name is written; its temporary name keeps stem and suffix."""
    sync, wanted = jaxmap.host.files.sync, Path(name)

    def full(path: Path) -> None:
        if path.name.startswith(f".{wanted.stem}.tmp-") and path.suffix == wanted.suffix:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        sync(path)

    patch.setattr(jaxmap.host.files, "sync", full)

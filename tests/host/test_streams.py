"""A command goes on without the streams it was started with."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

LINE = f"{sys.executable} -m jaxmap"
ROOT = Path(__file__).resolve().parents[2]


def run(line: str, **environment: str) -> subprocess.CompletedProcess:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), **environment}
    return subprocess.run(["bash", "-c", line], capture_output=True, env=environment, timeout=60, cwd=ROOT, check=False)


@pytest.mark.parametrize(
    ("redirection", "status"),
    [(">&-", 0), ("2>&-", 0), (">&- 2>&-", 0), ("<&- >&- 2>&-", 0), (">/dev/full", 1), ("2>/dev/full", 0)],
)
def test_a_command_goes_on_without_its_streams(redirection, status):
    done = run(f"{LINE} --version {redirection}")
    assert done.returncode == status
    assert b"Traceback" not in done.stderr + done.stdout
    assert done.stderr == (
        b"error: standard output was not written (No space left on device); all files were\n" * status
    )


@pytest.mark.parametrize("encoding", ["ascii", "latin-1"])
def test_names_beyond_the_letters_of_a_terminal_are_escaped(encoding):
    done = run(f"{LINE} 岩$'\\xff'", PYTHONIOENCODING=encoding)
    assert done.returncode == 2
    assert done.stderr.startswith(rb"error: there is no command '\u5ca9\udcff'") and done.stderr.count(b"\n") == 1


def test_an_error_that_nobody_reads_keeps_its_status():
    assert run(f"{LINE} nothing 2>/dev/full").returncode == 2

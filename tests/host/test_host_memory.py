"""Lasting memory is asked for once, where the C library knows how, and the command line stays what it was."""

from __future__ import annotations

import os
import platform
import subprocess
import sys

import pytest

from jaxmap.host import memory as host_memory

ASKED = f"glibc.malloc.hugetlb=1:glibc.malloc.mmap_max=0:glibc.malloc.trim_threshold={1 << 62}:glibc.malloc.arena_max=1"
SCRIPT = """
import os, sys
from jaxmap.host import memory as host_memory
print(os.getpid(), sys.argv[1:], os.environ.get("GLIBC_TUNABLES", "unset"), flush=True)
host_memory.restart_with_lasting_memory()
"""
WORK = """
import resource
from jaxmap.host import memory as host_memory
host_memory.restart_with_lasting_memory()
import numpy as np
faults = []
for _ in range(6):
    np.ones(40_000_000, np.uint8)
    faults.append(resource.getrusage(resource.RUSAGE_SELF).ru_minflt)
print(faults[-1] - faults[1])
"""


@pytest.fixture
def restarts(monkeypatch):
    """What the process would have been replaced by."""
    made = []
    monkeypatch.setattr(os, "execve", lambda *arguments: made.append(arguments))
    monkeypatch.delenv("GLIBC_TUNABLES", raising=False)
    monkeypatch.setattr(platform, "libc_ver", lambda: ("glibc", "2.36"))
    return made


def run(script: str, *words: str) -> str:
    environment = {name: value for name, value in os.environ.items() if name != "GLIBC_TUNABLES"}
    return subprocess.run(
        [sys.executable, "-c", script, *words], env=environment, capture_output=True, text=True, check=True
    ).stdout


def test_the_process_starts_again_with_the_settings_added(monkeypatch, restarts):
    monkeypatch.setenv("GLIBC_TUNABLES", "glibc.malloc.check=1")
    host_memory.restart_with_lasting_memory()
    [(program, words, environment)] = restarts
    assert (program, words[1:]) == (sys.executable, sys.orig_argv[1:])
    assert environment["GLIBC_TUNABLES"] == f"glibc.malloc.check=1:{ASKED}"


@pytest.mark.parametrize("library", [("", ""), ("glibc", "2.25"), ("glibc", "odd"), ("musl", "1.2")])
def test_nothing_happens_with_another_library(monkeypatch, restarts, library):
    monkeypatch.setattr(platform, "libc_ver", lambda: library)
    host_memory.restart_with_lasting_memory()
    assert not restarts


@pytest.mark.parametrize("setting", ["glibc.malloc.hugetlb=0", "glibc.malloc.arena_max=4"])
def test_what_the_user_has_set_stays(monkeypatch, restarts, setting):
    monkeypatch.setenv("GLIBC_TUNABLES", setting)
    host_memory.restart_with_lasting_memory()
    assert not restarts


glibc_only = pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="these are settings of glibc's")


@glibc_only
def test_a_process_restarts_once_and_keeps_number_and_arguments():
    before, after = run(SCRIPT, "train", "a b", "--out").splitlines()
    assert after == before.replace("unset", ASKED)


@glibc_only
def test_memory_that_was_freed_is_not_fetched_again():
    # Fetched anew, each of the four arrays would take 20 pages of 2 MiB or 10,000 of 4 KiB.
    assert int(run(WORK)) < 20


PEAK = "from jaxmap.host.memory import peak_resident_mib; print(peak_resident_mib())"


def test_the_peak_is_that_of_the_program_not_of_the_one_that_started_it():
    large = f"import subprocess, sys; kept = b'x' * (600 << 20); subprocess.run([sys.executable, '-c', {PEAK!r}])"
    told = [
        float(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout)
        for code in (PEAK, large)
    ]
    assert 0.8 < told[1] / told[0] < 1.25

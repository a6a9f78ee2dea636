"""The process restarts once, where the C library has the settings, and keeps its command line; its peak memory."""

from __future__ import annotations

import os
import platform
import subprocess
import sys

import pytest

from jaxmap.host import memory as host_memory

ASKED = f"glibc.malloc.hugetlb=1:glibc.malloc.mmap_max=0:glibc.malloc.trim_threshold={1 << 62}:glibc.malloc.arena_max=1"
SCRIPT = """
import os, resource, sys
from jaxmap.host import memory as host_memory
print(os.getpid(), sys.argv[1:], os.environ.get("GLIBC_TUNABLES", "unset"), flush=True)
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


def test_the_process_starts_again_with_the_settings_added(monkeypatch, restarts):
    monkeypatch.setenv("GLIBC_TUNABLES", "glibc.malloc.check=1")
    host_memory.restart_with_lasting_memory()
    [(program, words, environment)] = restarts
    assert (program, words[1:]) == (sys.executable, sys.orig_argv[1:])
    assert environment["GLIBC_TUNABLES"] == f"glibc.malloc.check=1:{ASKED}"


def test_nothing_happens_with_another_library(monkeypatch, restarts):
    for library in (("", ""), ("glibc", "2.25"), ("glibc", "odd"), ("musl", "1.2")):
        monkeypatch.setattr(platform, "libc_ver", lambda library=library: library)
        host_memory.restart_with_lasting_memory()
        assert not restarts, library


def test_settings_of_the_user_are_kept(monkeypatch, restarts):
    for setting in ("glibc.malloc.hugetlb=0", "glibc.malloc.arena_max=4"):
        monkeypatch.setenv("GLIBC_TUNABLES", setting)
        host_memory.restart_with_lasting_memory()
        assert not restarts, setting


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="these are settings of glibc's")
def test_a_process_restarts_once_with_its_arguments_and_reuses_freed_memory():
    environment = {name: value for name, value in os.environ.items() if name != "GLIBC_TUNABLES"}
    words = [sys.executable, "-c", SCRIPT, "train", "a b", "--out"]
    done = subprocess.run(words, env=environment, capture_output=True, text=True, check=True)
    before, after, faults = done.stdout.splitlines()
    assert after == before.replace("unset", ASKED)
    # Fetched again, each of the four arrays would take 20 pages of 2 MiB or 10,000 of 4 KiB.
    assert int(faults) < 20


PEAK = "from jaxmap.host.memory import peak_resident_mib; print(peak_resident_mib())"


def test_the_peak_is_that_of_the_program_not_of_the_one_that_started_it():
    large = f"import subprocess, sys; kept = b'x' * (600 << 20); subprocess.run([sys.executable, '-c', {PEAK!r}])"
    peaks = [
        float(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout)
        for code in (PEAK, large)
    ]
    assert 0.8 < peaks[1] / peaks[0] < 1.25

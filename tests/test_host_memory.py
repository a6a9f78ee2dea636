"""Large pages are asked for once, where they help, and the command line stays what it was."""

from __future__ import annotations

import os
import platform
import subprocess
import sys

import pytest

from jaxmap import host_memory

SCRIPT = """
import os, sys
from jaxmap import host_memory
host_memory._would_help = lambda: True
print(os.getpid(), sys.argv[1:], os.environ.get("GLIBC_TUNABLES", "unset"), flush=True)
host_memory.restart_with_large_pages()
"""


@pytest.fixture
def restarts(monkeypatch):
    """What the process would have been replaced by."""
    made = []
    monkeypatch.setattr(os, "execve", lambda *arguments: made.append(arguments))
    monkeypatch.delenv("GLIBC_TUNABLES", raising=False)
    return made


def granting(monkeypatch, tmp_path, text, library=("glibc", "2.36")):
    (tmp_path / "enabled").write_text(text)
    monkeypatch.setattr(host_memory, "_SYSTEM", tmp_path / "enabled")
    monkeypatch.setattr(platform, "libc_ver", lambda: library)


def test_the_process_starts_again_with_the_setting_added(monkeypatch, tmp_path, restarts):
    granting(monkeypatch, tmp_path, "always [madvise] never\n")
    monkeypatch.setenv("GLIBC_TUNABLES", "glibc.malloc.check=1")
    host_memory.restart_with_large_pages()
    [(program, words, environment)] = restarts
    assert (program, words[1:]) == (sys.executable, sys.orig_argv[1:])
    assert environment["GLIBC_TUNABLES"] == "glibc.malloc.check=1:glibc.malloc.hugetlb=1"


@pytest.mark.parametrize("text", ["[always] madvise never\n", "always madvise [never]\n", ""])
def test_nothing_happens_where_the_system_decides(monkeypatch, tmp_path, restarts, text):
    granting(monkeypatch, tmp_path, text)
    host_memory.restart_with_large_pages()
    assert not restarts


@pytest.mark.parametrize("library", [("", ""), ("glibc", "2.34"), ("glibc", "odd"), ("musl", "1.2")])
def test_nothing_happens_with_another_library(monkeypatch, tmp_path, restarts, library):
    granting(monkeypatch, tmp_path, "always [madvise] never\n", library)
    host_memory.restart_with_large_pages()
    assert not restarts


def test_nothing_happens_where_the_system_says_nothing(monkeypatch, tmp_path, restarts):
    granting(monkeypatch, tmp_path, "")
    monkeypatch.setattr(host_memory, "_SYSTEM", tmp_path / "absent")
    host_memory.restart_with_large_pages()
    assert not restarts


def test_what_the_user_has_set_stays(monkeypatch, tmp_path, restarts):
    granting(monkeypatch, tmp_path, "always [madvise] never\n")
    monkeypatch.setenv("GLIBC_TUNABLES", "glibc.malloc.hugetlb=0")
    host_memory.restart_with_large_pages()
    assert not restarts


@pytest.mark.skipif(os.name == "nt", reason="the process is replaced in place only on POSIX systems")
def test_a_process_restarts_once_and_keeps_number_and_arguments():
    environment = {name: value for name, value in os.environ.items() if name != "GLIBC_TUNABLES"}
    run = subprocess.run(
        [sys.executable, "-c", SCRIPT, "train", "a b", "--out"], env=environment, capture_output=True, text=True
    )
    before, after = run.stdout.splitlines()
    assert after == before.replace("unset", "glibc.malloc.hugetlb=1")
    assert run.returncode == 0

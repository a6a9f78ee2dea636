"""The kernel is compiled once and kept whole; where that is not possible, networks run without it and say so."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import numpy as np
import pytest

from jaxmap.models.layers import ConvBlock
from jaxmap.native import build

FAKE = """#!/bin/sh
case "$*" in *-dM*) echo "$MACROS"; exit 0;; esac
echo x >> "$CALLS"
for last; do :; done
echo "a library" > "$last"
"""


@pytest.fixture
def compiler(tmp_path, monkeypatch):
    """A compiler that takes no time, as the only one on PATH; its calls are lines of `calls`."""
    path = tmp_path / "bin" / "c++"
    path.parent.mkdir()
    path.write_text(FAKE)
    path.chmod(0o755)
    monkeypatch.setenv("PATH", f"{path.parent}{os.pathsep}/usr/bin{os.pathsep}/bin")
    monkeypatch.setenv("CALLS", str(tmp_path / "calls"))
    monkeypatch.setenv("MACROS", "one processor")
    monkeypatch.setenv("JAXMAP_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("CXX", raising=False)
    return path


@pytest.fixture
def afresh(monkeypatch):
    """As in a process that has not asked for the kernel yet."""
    monkeypatch.setattr(build, "_registered", build.cache(build._registered.__wrapped__))


def calls(compiler: Path) -> int:
    return len((compiler.parent.parent / "calls").read_text().splitlines())


def test_a_library_is_compiled_once_for_each_processor(compiler, monkeypatch):
    first = build._compiled()
    assert first == build._compiled() and first.read_text() == "a library\n" and calls(compiler) == 1
    monkeypatch.setenv("MACROS", "another processor")
    assert build._compiled() != first and calls(compiler) == 2


def test_many_at_once_leave_one_whole_library(compiler):
    with ThreadPoolExecutor(4) as pool:
        libraries = {*pool.map(lambda _: build._compiled(), range(4))}
    assert [path.read_text() for path in libraries] == ["a library\n"]
    assert [*libraries.pop().parent.iterdir()] == [build._compiled()]


@pytest.mark.parametrize("fault", ["none on PATH", "fails", "damaged"])
def test_without_a_kernel_a_note_says_why_and_networks_run(compiler, afresh, monkeypatch, caplog, fault):
    if fault == "none on PATH":
        monkeypatch.setenv("PATH", "/nowhere")
    if fault == "fails":
        compiler.write_text("#!/bin/sh\necho 'cannot do that' >&2\nexit 1\n")
    block = ConvBlock(4, 4, norm="bias")
    images = np.ones((1, 9, 9, 4), np.float32)
    with caplog.at_level(logging.WARNING):
        np.testing.assert_array_equal(jax.jit(lambda images: block(images))(images), 0)
        assert not build.has_kernel()
    told = {"none on PATH": "no C++ compiler", "fails": "cannot do that", "damaged": "blocks-"}[fault]
    assert len(caplog.records) == 1 and told in caplog.text and "slower" in caplog.text
    # What cannot be loaded is made anew the next time.
    assert not [*compiler.parent.parent.glob("cache/native/*")]


def test_turned_off_nothing_is_compiled_or_said(compiler, afresh, monkeypatch, caplog):
    monkeypatch.setenv("JAXMAP_NATIVE", "0")
    assert not build.has_kernel() and not caplog.records and not (compiler.parent.parent / "calls").exists()


PROGRAM = """
import jax, numpy as np
from jaxmap.host.cache import keep_compiled_programs
from jaxmap.models.layers import ConvBlock
keep_compiled_programs()
block = ConvBlock(4, 4, norm="bias")
images = np.ones((1, 9, 9, 4), np.float32)
assert "jaxmap_block" in jax.jit(lambda images: block(images)).lower(images).as_text()
jax.monitoring.register_event_listener(lambda name, **_: name.endswith("cache_hits") and print("kept"))
print(float(jax.jit(lambda images: block(images))(images).sum()))
"""


@pytest.mark.slow
def test_a_program_that_was_kept_runs_in_another_process(tmp_path):
    if not build.has_kernel():
        pytest.skip("no C++ compiler, or no CPU")
    said = []
    for _ in range(2):
        environment = {**os.environ, "JAXMAP_CACHE": str(tmp_path)}
        environment.pop("JAX_COMPILATION_CACHE_DIR", None)
        done = subprocess.run([sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        said.append(done.stdout.split())
    assert said[0][-1] == said[1][-1] == "0.0" and "kept" in said[1]

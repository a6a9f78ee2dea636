"""LLVM's library: each one is tried out in a child process before it is used."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from fixtures import Run, cli  # noqa: F401

from jaxmap.errors import JaxmapError
from jaxmap.simulation import llvm
from jaxmap.simulation.tracer import load_mitsuba

# What stands in for the trial: the library decides by its content how it ends, and each trial is counted.
TRIAL = """
import os, pathlib, sys, time
library = pathlib.Path(os.environ["DRJIT_LIBLLVM_PATH"])
with open(library.with_suffix(".tried"), "a") as file:
    file.write("x")
exec(library.read_text())
"""
WORKS, DIES = "", "print('LLVM ERROR: no', file=sys.stderr, flush=True); os.abort()"
HANGS_ONCE = "time.sleep(60 if library.with_suffix('.tried').read_text() == 'x' else 0)"


@pytest.fixture
def libraries(monkeypatch, tmp_path):
    """Makes libraries, given how each ends; they are the only ones to be found."""

    def make(**contents: str) -> dict[str, Path]:
        paths = {name: tmp_path / f"libLLVM-{name.removeprefix('v')}.so" for name in contents}
        for name, path in paths.items():
            path.write_text(contents[name])
        return paths

    monkeypatch.setattr(llvm, "_PLACES", (f"{tmp_path}/libLLVM[-.]*so*",))
    monkeypatch.setattr(llvm, "_TRIAL", f"exec({TRIAL!r})")
    monkeypatch.setattr(llvm, "_TRIAL_S", 20.0)
    monkeypatch.setattr(llvm.ctypes.util, "find_library", lambda name: None)
    monkeypatch.setenv("JAXMAP_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
    load_mitsuba.cache_clear()
    yield make
    load_mitsuba.cache_clear()


def tries(library: Path) -> int:
    record = library.with_suffix(".tried")
    return len(record.read_text()) if record.exists() else 0


def test_the_version_is_read_from_the_path():
    versions = {"x/libLLVM.so.19.1": 19, "x/libLLVM-14.so.1": 14, "llvm-17/lib/libLLVM.so": 17, "lib/libLLVM.so": 0}
    assert {path: llvm.llvm_version(Path(f"/usr/lib/{path}")) for path in versions} == versions


def test_the_working_library_nearest_to_version_19_is_taken_and_remembered(libraries):
    made = libraries(v20=DIES, v19=DIES, v18=WORKS, v15=WORKS)
    (made["v19"].parent / "libLLVM.so.19").symlink_to(made["v19"])
    assert llvm.find_llvm() == [str(made[name]) for name in ("v19", "v20", "v18", "v15")]
    for _ in range(2):
        assert llvm.working_llvm() == str(made["v18"])
        assert {name: tries(path) for name, path in made.items()} == {"v20": 1, "v19": 1, "v18": 1, "v15": 0}
    # A new file of the same name is another library.
    made["v19"].write_text(WORKS + "\n")
    assert llvm.working_llvm() == str(made["v19"]) and tries(made["v19"]) == 2


@pytest.mark.slow
def test_a_library_that_hangs_is_left_out_for_this_time(libraries, monkeypatch):
    made = libraries(v19=HANGS_ONCE, v18=WORKS)
    monkeypatch.setattr(llvm, "_TRIAL_S", 3.0)
    assert llvm.working_llvm() == str(made["v18"])
    # The machine may have been busy: it is tried again.
    assert llvm.working_llvm() == str(made["v19"])


@pytest.mark.parametrize("content", [None, "not a folder"], ids=["damaged verdicts", "no folder"])
def test_a_broken_cache_costs_another_trial_and_no_more(libraries, monkeypatch, tmp_path, content):
    made = libraries(v19=WORKS)
    llvm.working_llvm()
    if content is None:
        (verdict,) = (tmp_path / "cache" / "llvm").iterdir()
        verdict.write_text("{")
    else:
        (tmp_path / "file").write_text(content)
        monkeypatch.setenv("JAXMAP_CACHE", str(tmp_path / "file"))
    assert llvm.working_llvm() == str(made["v19"]) and tries(made["v19"]) == 2


def test_two_processes_may_try_at_once(libraries, tmp_path):
    made = libraries(v19="time.sleep(0.5)")
    code = (
        f"from jaxmap.simulation import llvm; llvm._TRIAL = {llvm._TRIAL!r}; print(llvm.fault_of({str(made['v19'])!r}))"
    )
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    started = [
        subprocess.Popen([sys.executable, "-c", code], env=environment, stdout=subprocess.PIPE, text=True)
        for _ in range(2)
    ]
    assert [process.communicate(timeout=60)[0].strip() for process in started] == ["None", "None"]
    assert len(list((tmp_path / "cache" / "llvm").iterdir())) == 1
    before = tries(made["v19"])
    assert llvm.fault_of(str(made["v19"])) is None and tries(made["v19"]) == before


def test_a_machine_without_a_working_library_is_told_why(libraries, cli, tmp_path):
    pytest.importorskip("mitsuba")
    outcome = cli("simulate", "--out", tmp_path / "out", "--preview")
    assert outcome.status == 1 and "no LLVM library" in outcome.error and "libllvm19" in outcome.error
    made = libraries(v19=DIES)
    outcome = cli("simulate", "--out", tmp_path / "out", "--preview")
    assert outcome.status == 1 and f"{made['v19']}: killed by SIGABRT, LLVM ERROR: no" in outcome.error
    assert not (tmp_path / "out").exists()


def test_a_named_library_that_does_not_work_is_named(libraries, cli, monkeypatch, tmp_path):
    pytest.importorskip("mitsuba")
    libraries(v19=WORKS)
    monkeypatch.undo()
    for named in (tmp_path / "absent.so", __file__):
        monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(named))
        outcome = cli("simulate", "--out", tmp_path / "out", "--training", 1)
        assert outcome.status == 1 and str(named) in outcome.error and "DRJIT_LIBLLVM_PATH" in outcome.error
        assert len(outcome.err.strip().splitlines()) == 1 and not (tmp_path / "out").exists()


def test_variants_that_trace_rays_one_by_one_are_refused(libraries, monkeypatch):
    pytest.importorskip("mitsuba")
    monkeypatch.setenv("JAXMAP_MITSUBA_VARIANT", "scalar_rgb")
    with pytest.raises(JaxmapError, match="scalar_rgb"):
        load_mitsuba()


def test_a_missing_mitsuba_says_what_to_install(libraries, monkeypatch):
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    with pytest.raises(JaxmapError, match="pip install"):
        load_mitsuba()

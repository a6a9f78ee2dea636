"""Settings of the whole suite: hypothesis profiles, checked annotations, `--all`, compiled programs, recorded data."""

from __future__ import annotations

import ctypes
import gc
import os
import resource
import shutil
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import settings
from jaxtyping import install_import_hook

# One cache folder for all processes of a run, and for the next run; never the user's. JAX knows its programs by what
# they are compiled from, by its version and by its flags. `--cache-clear` empties it.
CACHE = Path(__file__).resolve().parents[1] / ".pytest_cache" / "d" / "jaxmap"
MOST_CACHED_BYTES = 2 << 30
os.environ["JAXMAP_CACHE"] = str(CACHE)
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(CACHE / "compiled"))
# Small programs, too: a test compiles dozens of them.
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")

# Made-up observations are shared with the benchmarks; at the end, that names of the tests go first.
sys.path.append(str(Path(__file__).resolve().parents[1] / "scripts" / "benchmarks"))

# `types`, `fusion.params` and `models.network` stay out: JAX rebuilds their dataclasses with stacked arrays,
# placeholders for leaves, and shapes without arrays.
FUSION_MODULES = ("fusion.carve", "fusion.integrate", "fusion.query", "fusion.sensor_model", "fusion.splat")
NETWORK_MODULES = tuple(
    f"models.{name}"
    for name in (
        "backbones",
        "convolutions",
        "fcn",
        "heads",
        "layers",
        "pixelwise",
        "resizing",
        "segnet",
        "unet",
        "unpooling",
    )
)
CHECKED_MODULES = (
    *FUSION_MODULES,
    *NETWORK_MODULES,
    "evaluation.geometry_scores",
    "evaluation.segmentation_scores",
    "geometry",
    "labellers.deeplab",
    "labellers.files",
    "labellers.plane",
    "labels",
    "localisation",
    "mapping.step",
    "simulation",
    "stereo",
)
# A float annotation takes an int, as PEP 484 has it.
CHECKER = "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))"
install_import_hook([f"jaxmap.{name}" for name in CHECKED_MODULES], CHECKER)

for name, examples in {"quick": 8, "all": 25}.items():
    settings.register_profile(name, deadline=None, max_examples=examples)
    settings.register_profile(f"ci-{name}", deadline=None, max_examples=examples, derandomize=True, database=None)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--all", action="store_true", help="run the tests marked slow, too")


MOST_RESIDENT_MB, MOST_GROWN_MB = 900, 300
"""Compiled programs are dropped after a file that leaves more than the first, and the second more than was left when
they were dropped last: libraries, which stay, may take the first by themselves. A file adds up to 1 GB."""

LEFT_MB = pytest.StashKey[float]()
PEAK = pytest.StashKey[tuple[float, str]]()
PEAKS = pytest.StashKey[dict[str, tuple[float, str]]]()


def pytest_configure(config: pytest.Config) -> None:
    if not config.getoption("--all"):
        # Most programs of the quick tests run once: compiling them in full would take longer than they do.
        os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
    settings.load_profile(("ci-" if os.environ.get("CI") else "") + ("all" if config.getoption("--all") else "quick"))
    config.stash[LEFT_MB], config.stash[PEAK] = 0.0, (0.0, "")
    config.stash[PEAKS] = {}
    if not is_worker(config):
        size = sum(path.stat().st_size for path in CACHE.rglob("*") if path.is_file())
        if size > MOST_CACHED_BYTES:
            shutil.rmtree(CACHE, ignore_errors=True)


def is_worker(config: pytest.Config) -> bool:
    return hasattr(config, "workerinput")


@pytest.fixture(scope="module", autouse=True)
def _memory(request: pytest.FixtureRequest) -> Iterator[None]:
    """Gives back what the programs of a test file hold, hundreds of MB, and notes the peak."""
    yield
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1 << 20 if sys.platform == "darwin" else 1 << 10)
    if peak_mb > request.config.stash[PEAK][0]:
        request.config.stash[PEAK] = (peak_mb, request.node.nodeid)
    enough_mb = max(MOST_RESIDENT_MB, request.config.stash[LEFT_MB] + MOST_GROWN_MB)
    if (jax := sys.modules.get("jax")) is not None and resident_mb() > enough_mb:
        jax.clear_caches()
        gc.collect()
        # The C library keeps what is freed in pieces, unless it is asked.
        with suppress(AttributeError):
            ctypes.CDLL(None).malloc_trim(0)
        request.config.stash[LEFT_MB] = resident_mb()


def resident_mb() -> float:
    """The resident size of this process; infinite where the system does not say."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / (1 << 20)
    except (OSError, ValueError, IndexError):
        return float("inf")


def pytest_sessionfinish(session: pytest.Session) -> None:
    if is_worker(session.config):
        session.config.workeroutput["peak"] = session.config.stash[PEAK]


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node) -> None:
    if (peak := getattr(node, "workeroutput", {}).get("peak")) is not None:
        node.config.stash[PEAKS][node.gateway.id] = peak


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    terminalreporter.section("peak resident memory")
    for name, (peak_mb, file) in sorted((config.stash[PEAKS] or {"main": config.stash[PEAK]}).items()):
        terminalreporter.write_line(f"{name}: {peak_mb:.0f} MB, in {file}")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if config.getoption("--all"):
        return
    skip = pytest.mark.skip(reason="slow; run with --all")
    for item in items:
        if item.get_closest_marker("slow"):
            item.add_marker(skip)


@pytest.fixture(scope="session")
def realdata() -> Path:
    """The folder of recorded data (`JAXMAP_REALDATA`, or `shared/realdata` beside the repository)."""
    folder = Path(os.environ.get("JAXMAP_REALDATA", Path(__file__).parents[2] / "shared" / "realdata"))
    if not folder.is_dir():
        pytest.skip(f"no recorded data at {folder}; set JAXMAP_REALDATA")
    return folder

"""Settings of the whole suite: hypothesis profiles, checked annotations, `--all`, the recorded data."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import settings
from jaxtyping import install_import_hook

# `types`, `fusion.params` and `models.deeplab` stay out: JAX rebuilds their dataclasses with stacked arrays,
# placeholders for leaves, and shapes without arrays.
FUSION_MODULES = ("fusion.carve", "fusion.integrate", "fusion.query", "fusion.sensor_model", "fusion.splat")
NETWORK_MODULES = tuple(
    f"models.{name}" for name in ("backbones", "convolutions", "heads", "layers", "pixelwise", "resizing")
)
CHECKED_MODULES = (
    *FUSION_MODULES,
    *NETWORK_MODULES,
    "evaluation.pose_scores",
    "evaluation.segmentation_scores",
    "geometry",
    "labellers",
    "labels",
    "localisation",
    "mapping.step",
    "simulation",
    "stereo",
)
# A float annotation takes an int, as PEP 484 has it.
CHECKER = "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))"
install_import_hook([f"jaxmap.{name}" for name in CHECKED_MODULES], CHECKER)

settings.register_profile("local", deadline=None, max_examples=25)
settings.register_profile("ci", deadline=None, max_examples=25, derandomize=True, database=None)
settings.load_profile("ci" if os.environ.get("CI") else "local")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--all", action="store_true", help="run the tests marked slow, too")


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

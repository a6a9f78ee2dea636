"""What the package declares agrees with what it holds."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
import tomllib
from functools import cache
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import jaxmap

ROOT = Path(__file__).resolve().parent.parent
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
PROJECT = PYPROJECT["project"]

DISTRIBUTIONS = {
    "annotated_types": "annotated-types",
    "cv2": "opencv-python-headless",
    "google": "protobuf",
    "mc_cnn": "mccnn",
    "mcap_protobuf": "mcap-protobuf-support",
    "octomap": "octomap-python",
    "PIL": "pillow",
    "mpl_toolkits": "matplotlib",
    "orbax": "orbax-checkpoint",
    "skimage": "scikit-image",
    "yaml": "pyyaml",
}
"""The distributions that are named otherwise than what they are imported as."""

CORE = {"jax", "flax", "optax", "numpy", "opencv-python-headless", "scikit-image"}
"""What jaxmap stands on, imported yet or not."""

EXECUTABLES = ("scripts/demo", "scripts/test", ".ci/run")


def requirements(lines: list[str]) -> dict[str, Requirement]:
    return {canonicalize_name(one.name): one for one in map(Requirement, lines)}


DEPENDENCIES = requirements(PROJECT["dependencies"])
EXTRAS = {name: requirements(lines) for name, lines in PROJECT["optional-dependencies"].items()}


@cache
def third_party_imports(folder: Path) -> dict[str, str]:
    """Distribution -> a file that imports it, for all that is neither Python's nor ours."""
    own = {"jaxmap"} | {path.stem for path in folder.rglob("*.py")}
    found = {}
    for path in sorted(folder.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            names = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.level == 0:
                names = [node.module or ""]
            for name in {name.split(".")[0] for name in names} - own - sys.stdlib_module_names:
                found[canonicalize_name(DISTRIBUTIONS.get(name, name))] = path.relative_to(ROOT).as_posix()
    return found


def constraints() -> dict[str, str]:
    lines = (ROOT / "constraints.txt").read_text("utf-8").splitlines()
    return {canonicalize_name(name): version for name, version in (line.split("==") for line in lines)}


def test_the_version_is_that_of_the_package():
    assert "version" in PROJECT["dynamic"]
    assert PYPROJECT["tool"]["hatch"]["version"]["path"] == "jaxmap/__init__.py"
    assert re.fullmatch(r"\d+\.\d+\.\d+(\.dev\d+|rc\d+)?", jaxmap.__version__)


def test_the_wheel_carries_every_config():
    included = PYPROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["force-include"]
    assert included["configs"] == "jaxmap/configs"
    assert list((ROOT / "configs").glob("*.yaml")), "configs/ is empty"


def test_the_command_is_there():
    assert PROJECT["scripts"] == {"jaxmap": "jaxmap.commands.main:main"}
    tree = ast.parse((ROOT / "jaxmap" / "commands" / "main.py").read_text("utf-8"))
    assert "main" in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}


def test_every_import_is_declared():
    imported = third_party_imports(ROOT / "jaxmap")
    optional = {name for extra, names in EXTRAS.items() if extra != "test" for name in names}
    missing = {name: path for name, path in imported.items() if name not in DEPENDENCIES.keys() | optional}
    assert not missing, f"add to the dependencies in pyproject.toml: {missing}"


def test_every_import_of_the_tests_is_declared():
    # packaging comes with pytest; folders of the tests and scripts are local; only tests/golden wants the peers of the
    # benchmarks.
    local = {folder.name for part in ("tests", "scripts") for folder in (ROOT / part).iterdir() if folder.is_dir()}
    local |= {file.stem.replace("_", "-") for file in (ROOT / "scripts" / "benchmarks").glob("*.py")}
    declared = DEPENDENCIES.keys() | EXTRAS["test"].keys() | EXTRAS["bench"].keys() | {"packaging"} | local
    missing = {name: path for name, path in third_party_imports(ROOT / "tests").items() if name not in declared}
    assert not missing, f"add to the test extra in pyproject.toml: {missing}"


def test_nothing_is_declared_in_vain():
    unused = DEPENDENCIES.keys() - third_party_imports(ROOT / "jaxmap").keys() - CORE
    assert not unused, f"nothing imports {sorted(unused)}"


def test_every_dependency_has_a_lower_bound():
    declared = [*DEPENDENCIES.values(), *(one for extra in EXTRAS.values() for one in extra.values())]
    loose = [one.name for one in declared if not any(part.operator in (">=", "==") for part in one.specifier)]
    assert not loose


def test_constraints_are_names_and_versions_in_order():
    lines = (ROOT / "constraints.txt").read_text("utf-8").splitlines()
    odd = [line for line in lines if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]*==[A-Za-z0-9.+!]+", line)]
    assert not odd
    assert lines == sorted(lines, key=str.lower)
    assert "jaxmap" not in constraints()


@pytest.mark.parametrize("extra", ["", *EXTRAS])
def test_constraints_cover_what_is_declared(extra: str):
    declared = EXTRAS[extra] if extra else DEPENDENCIES
    pinned = constraints()
    assert not declared.keys() - pinned.keys(), "constraints.txt lacks some"
    unmet = [str(one) for name, one in declared.items() if not one.specifier.contains(pinned[name], prereleases=True)]
    assert not unmet, "constraints.txt contradicts pyproject.toml"


@pytest.mark.parametrize("name", EXECUTABLES)
def test_scripts_are_executable(name: str):
    assert os.access(ROOT / name, os.X_OK)


@pytest.mark.parametrize("name", [*EXECUTABLES, "scripts/lib.sh"])
def test_scripts_parse(name: str):
    parsed = subprocess.run(["bash", "-n", str(ROOT / name)], capture_output=True, timeout=30)
    assert parsed.returncode == 0, parsed.stderr


def test_the_licence_is_declared_and_there():
    assert PROJECT["license"] == "Apache-2.0"
    assert all((ROOT / name).is_file() for name in PROJECT["license-files"])
    assert "Apache License" in (ROOT / "LICENSE").read_text("utf-8")

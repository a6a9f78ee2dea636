"""The floors of the code: a file imports only from lower floors, and nothing imports in a circle."""

from __future__ import annotations

import ast
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parent.parent / "jaxmap"

FLOORS = {
    # 0: values
    "jaxmap.errors": 0,
    "jaxmap.types": 0,
    "jaxmap.labels": 0,
    "jaxmap.files": 0,
    "jaxmap.cache": 0,
    "jaxmap.prefetch": 0,
    "jaxmap.precision": 0,
    "jaxmap.stages": 0,
    # 1: pure geometry, host stereo, networks
    "jaxmap.geometry": 1,
    "jaxmap.localisation": 1,
    "jaxmap.stereo": 1,
    "jaxmap.models": 1,
    # 2: evidence
    "jaxmap.fusion": 2,
    "jaxmap.ensemble": 2,
    # 3: the step and what feeds and keeps it
    "jaxmap.labellers": 3,
    "jaxmap.deeplab_labeller": 3,
    "jaxmap.mapper": 3,
    "jaxmap.datasets": 3,
    "jaxmap.map_arrays": 3,
    "jaxmap.map_store": 3,
    "jaxmap.sequence": 3,
    # 4: what is built on maps
    "jaxmap.training": 4,
    "jaxmap.tuning": 4,
    "jaxmap.evaluation": 4,
    "jaxmap.refinement": 4,
    "jaxmap.simulation": 4,
    "jaxmap.export": 4,
    # 5: what is shown
    "jaxmap.report": 5,
    # 6: settings
    "jaxmap.settings": 6,
    "jaxmap.training_config": 6,
    "jaxmap.tuning_config": 6,
    "jaxmap.config": 6,
    "jaxmap.host_memory": 6,
    "jaxmap.profiling": 6,
    # 7: runs
    "jaxmap.output_folder": 7,
    "jaxmap.training_folder": 7,
    "jaxmap.training_log": 7,
    "jaxmap.training_plan": 7,
    "jaxmap.map_training_data": 7,
    "jaxmap.map_training_plan": 7,
    "jaxmap.training_run": 7,
    "jaxmap.tuning_plan": 7,
    "jaxmap.tuning_run": 7,
    "jaxmap.run_folder": 7,
    "jaxmap.run_log": 7,
    "jaxmap.run_outputs": 7,
    "jaxmap.mapping": 7,
    "jaxmap.mapping_grid": 7,
    "jaxmap.mapping_labels": 7,
    "jaxmap.mapping_plan": 7,
    "jaxmap.segmentation": 7,
    "jaxmap.refine_folder": 7,
    "jaxmap.refine_run": 7,
    "jaxmap.map_evaluation": 7,
    "jaxmap.weight_files": 7,
    # 8: the command line
    "jaxmap.commands": 8,
    "jaxmap.cli": 8,
    "jaxmap.__main__": 8,
}
"""Floor of each module or package; a package's modules share its floor."""

SAME_FLOOR = {
    ("jaxmap.types", "jaxmap.errors"),
    ("jaxmap.labels", "jaxmap.errors"),
    ("jaxmap.files", "jaxmap.errors"),
    ("jaxmap.ensemble", "jaxmap.fusion"),
    ("jaxmap.map_store", "jaxmap.map_arrays"),
    ("jaxmap.mapper", "jaxmap.labellers"),
    ("jaxmap.deeplab_labeller", "jaxmap.labellers"),
    ("jaxmap.sequence", "jaxmap.mapper"),
    ("jaxmap.sequence", "jaxmap.labellers"),
    ("jaxmap.sequence", "jaxmap.datasets"),
    ("jaxmap.config", "jaxmap.settings"),
    ("jaxmap.training_config", "jaxmap.settings"),
    ("jaxmap.training_config", "jaxmap.config"),
    ("jaxmap.training", "jaxmap.evaluation"),
    ("jaxmap.refinement", "jaxmap.evaluation"),
    ("jaxmap.tuning", "jaxmap.evaluation"),
    ("jaxmap.tuning", "jaxmap.training"),
    ("jaxmap.tuning_config", "jaxmap.config"),
    ("jaxmap.training_folder", "jaxmap.output_folder"),
    ("jaxmap.training_folder", "jaxmap.training_log"),
    ("jaxmap.training_folder", "jaxmap.training_plan"),
    ("jaxmap.training_run", "jaxmap.training_folder"),
    ("jaxmap.training_run", "jaxmap.training_log"),
    ("jaxmap.training_run", "jaxmap.training_plan"),
    ("jaxmap.map_training_data", "jaxmap.map_evaluation"),
    ("jaxmap.map_training_data", "jaxmap.mapping_plan"),
    ("jaxmap.map_training_plan", "jaxmap.map_training_data"),
    ("jaxmap.map_training_plan", "jaxmap.mapping_plan"),
    ("jaxmap.map_training_plan", "jaxmap.segmentation"),
    ("jaxmap.map_training_plan", "jaxmap.training_plan"),
    ("jaxmap.run_folder", "jaxmap.output_folder"),
    ("jaxmap.run_folder", "jaxmap.run_log"),
    ("jaxmap.mapping", "jaxmap.run_log"),
    ("jaxmap.mapping", "jaxmap.output_folder"),
    ("jaxmap.map_evaluation", "jaxmap.output_folder"),
    ("jaxmap.tuning_run", "jaxmap.output_folder"),
    ("jaxmap.tuning_run", "jaxmap.map_evaluation"),
    ("jaxmap.tuning_run", "jaxmap.mapping_plan"),
    ("jaxmap.tuning_plan", "jaxmap.mapping_plan"),
    ("jaxmap.tuning_run", "jaxmap.tuning_plan"),
    ("jaxmap.run_outputs", "jaxmap.run_folder"),
    ("jaxmap.mapping_plan", "jaxmap.mapping_grid"),
    ("jaxmap.mapping_plan", "jaxmap.mapping_labels"),
    ("jaxmap.mapping", "jaxmap.mapping_plan"),
    ("jaxmap.mapping", "jaxmap.run_folder"),
    ("jaxmap.run_folder", "jaxmap.mapping_plan"),
    ("jaxmap.mapping", "jaxmap.run_outputs"),
    ("jaxmap.map_evaluation", "jaxmap.run_folder"),
    ("jaxmap.refine_run", "jaxmap.output_folder"),
    ("jaxmap.refine_run", "jaxmap.refine_folder"),
    ("jaxmap.refine_folder", "jaxmap.output_folder"),
    ("jaxmap.refine_run", "jaxmap.map_evaluation"),
    ("jaxmap.cli", "jaxmap.commands"),
    ("jaxmap.__main__", "jaxmap.cli"),
}
"""Who may import whom on one floor, apart from modules of one package."""


def module_name(path: Path) -> str:
    """`jaxmap/fusion/carve.py` -> `jaxmap.fusion.carve`."""
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_name(path): path for path in sorted(PACKAGE.rglob("*.py"))}


def unit_of(module: str) -> str | None:
    """The entry of `FLOORS` that a module belongs to."""
    parts = module.split(".")
    prefixes = (".".join(parts[:length]) for length in range(len(parts), 1, -1))
    return next((prefix for prefix in prefixes if prefix in FLOORS), None)


def absolute(node: ast.ImportFrom, module: str) -> str:
    """The module that a `from` import names, its leading dots resolved."""
    if node.level == 0:
        return node.module or ""
    is_package = MODULES[module].name == "__init__.py"
    parts = module.split(".")
    parents = parts[: len(parts) - node.level + is_package]
    return ".".join(parents + ([node.module] if node.module else []))


def imports_of(module: str) -> set[str]:
    """The modules of this package that one of them imports, also inside functions."""
    found = set()
    for node in ast.walk(ast.parse(MODULES[module].read_text("utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names if alias.name.split(".")[0] == "jaxmap"}
        elif isinstance(node, ast.ImportFrom):
            base = absolute(node, module)
            if base.split(".")[0] != "jaxmap":
                continue
            for alias in node.names:
                name = f"{base}.{alias.name}"
                found.add(name if name in MODULES else base)
    return found - {module}


def complaint(module: str, imported: str) -> str | None:
    """Why one module must not import another, or None."""
    if imported not in MODULES:
        return f"{module} imports {imported}, which is not there"
    # Whatever the package itself may come to import, test_no_import_is_circular keeps it off the floors below.
    if "jaxmap" in (module, imported):
        return None
    source, target = unit_of(module), unit_of(imported)
    if source is None or target is None:
        return f"{module} imports {imported}, and one of them is on no floor: add it to FLOORS"
    if source == target or (source, target) in SAME_FLOOR or FLOORS[source] > FLOORS[target]:
        return None
    return f"{module} (floor {FLOORS[source]}) imports {imported} (floor {FLOORS[target]})"


def test_every_module_has_a_floor():
    homeless = [module for module in MODULES if module != "jaxmap" and unit_of(module) is None]
    assert not homeless, f"add {homeless} to FLOORS in {Path(__file__).name}"


@pytest.mark.parametrize("module", MODULES)
def test_imports_go_down(module):
    complaints = [text for imported in sorted(imports_of(module)) if (text := complaint(module, imported))]
    assert not complaints, "\n".join(complaints)


def test_no_import_is_circular():
    graph = {module: imports_of(module) for module in MODULES}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail("circular import: " + " -> ".join(error.args[1]))


def test_a_module_on_no_floor_is_found():
    assert unit_of("jaxmap.fusion.carve") == "jaxmap.fusion"
    assert unit_of("jaxmap.elsewhere") is None


def test_upward_imports_are_refused():
    assert complaint("jaxmap.geometry.camera", "jaxmap.fusion.carve") is not None
    assert complaint("jaxmap.labellers", "jaxmap.mapper") is not None
    assert complaint("jaxmap.mapper", "jaxmap.labellers") is None
    assert complaint("jaxmap.fusion.carve", "jaxmap.geometry.camera") is None

"""The rooms of the house: a folder imports only from folders on lower floors, and nothing imports in a circle."""

from __future__ import annotations

import ast
from graphlib import TopologicalSorter
from pathlib import Path

PACKAGE = Path(__file__).resolve().parent.parent / "jaxmap"

FLOORS = (
    # values
    "errors types labels",
    # the host's files, threads, memory and settings
    "host",
    # pure geometry; what is compiled from C++
    "geometry localisation native",
    "models fusion profiling",
    # stereo matching in JAX, and the host's front end, which offers it beside OpenCV's
    "matching",
    "stereo",
    # what labels points, what doubts a map, what reads logs
    "labellers ensemble datasets",
    # the compiled step, what feeds it, and the map on disk
    "mapping",
    # what is built on maps
    "evaluation export simulation checks planning",
    "training refinement",
    "tuning",
    "report",
    # what a command does with files, and the commands
    "runs",
    "commands",
    "__main__",
)
FLOOR_OF = {room: floor for floor, rooms in enumerate(FLOORS) for room in rooms.split()}
VALUES = FLOORS[0].split()
MODULES = {".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts): path for path in PACKAGE.rglob("*.py")}


def imports_of(module: str) -> set[str]:
    """The modules of this package that one of them imports, also inside functions."""
    named: set[str] = set()
    for node in ast.walk(ast.parse(MODULES[module].read_text("utf-8"))):
        if isinstance(node, ast.Import):
            named |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}: import by full names"
            named |= {node.module or "", *(f"{node.module}.{alias.name}" for alias in node.names)}
    return named & MODULES.keys() - {module}


def room_of(module: str) -> str:
    return module.split(".")[1]


def is_upward(module: str, imported: str) -> bool:
    here, there = room_of(module), room_of(imported)
    return here != there and FLOOR_OF[here] <= FLOOR_OF[there] and not (here in VALUES and there in VALUES)


def test_every_room_has_a_floor():
    rooms = {room_of(module) for module in MODULES} - {"__init__"}
    assert rooms == FLOOR_OF.keys()


def test_only_values_and_entry_points_stand_loose():
    assert {path.name for path in PACKAGE.glob("*.py")} == {"__init__.py", "__main__.py", *(f"{v}.py" for v in VALUES)}


def test_imports_go_down():
    upward = [
        f"{module} imports {other}" for module in MODULES for other in imports_of(module) if is_upward(module, other)
    ]
    assert not upward, "\n".join(upward)


def test_no_import_is_circular():
    order = TopologicalSorter({module: imports_of(module) for module in MODULES}).static_order()
    assert set(order) >= set(MODULES)


def test_upward_imports_are_found():
    assert is_upward("jaxmap.geometry.camera", "jaxmap.fusion.carve")
    assert is_upward("jaxmap.fusion.carve", "jaxmap.stereo.match")
    assert not is_upward("jaxmap.fusion.carve", "jaxmap.geometry.camera")

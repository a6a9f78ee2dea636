"""Conventions of the code that no linter checks."""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
SOURCES = sorted((ROOT / "jaxmap").rglob("*.py"))

MAX_FILE_LINES = 500
MAX_FUNCTION_LINES = 70

PRINTERS = ("jaxmap/commands/main.py", "jaxmap/commands/")
"""Where the command line talks to the user."""

FORBIDDEN_CALLS = {
    "eval": "parse the text instead",
    "exec": "write the code out",
    "yaml.load": "use yaml.safe_load",
    "yaml.full_load": "use yaml.safe_load",
    "yaml.unsafe_load": "use yaml.safe_load",
    "torch.load": "it unpickles; read safetensors",
}
FORBIDDEN_MODULES = {"pickle", "cPickle", "dill", "cloudpickle", "joblib", "marshal", "shelve"}

MACHINE_PATH = re.compile(r"(?<![\w.:/])(?:/(?:home|Users|root|work|mnt|opt)/|[A-Z]:\\Users\\)\w")

FunctionNode = ast.FunctionDef | ast.AsyncFunctionDef
Definition = FunctionNode | ast.ClassDef


def relative(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


@cache
def trees() -> dict[str, ast.Module]:
    return {relative(path): ast.parse(path.read_text("utf-8")) for path in SOURCES}


def public_definitions(body: list[ast.stmt], prefix: str = "") -> Iterator[tuple[str, Definition]]:
    """Public classes and functions of a module and public methods of those classes, not what functions hold."""
    for node in body:
        if isinstance(node, Definition) and not node.name.startswith("_"):
            yield prefix + node.name, node
            if isinstance(node, ast.ClassDef):
                yield from public_definitions(node.body, f"{node.name}.")


def functions(tree: ast.AST) -> Iterator[FunctionNode]:
    return (node for node in ast.walk(tree) if isinstance(node, FunctionNode))


def dotted(node: ast.expr) -> str:
    """`yaml.load` for the expression that says so; empty for any other kind of expression."""
    if isinstance(node, ast.Name):
        return node.id
    if isinstance(node, ast.Attribute) and (base := dotted(node.value)):
        return f"{base}.{node.attr}"
    return ""


def own_lines(function: FunctionNode) -> int:
    """Lines of a function without its docstring and without the functions inside it."""
    count = function.end_lineno - function.lineno + 1
    if ast.get_docstring(function) is not None:
        count -= function.body[0].end_lineno - function.body[0].lineno + 1
    inner = [node for node in functions(function) if node is not function]
    nested = [node for other in inner for node in functions(other) if node is not other]
    return count - sum(node.end_lineno - node.lineno + 1 for node in inner if node not in nested)


def missing_docstrings(tree: ast.Module, path: str) -> Iterator[str]:
    if ast.get_docstring(tree) is None:
        yield "the module has no docstring"
    for name, node in public_definitions(tree.body):
        if ast.get_docstring(node) is None:
            yield f"{name} has no docstring"


def missing_annotations(tree: ast.Module, path: str) -> Iterator[str]:
    for name, node in public_definitions(tree.body):
        if isinstance(node, ast.ClassDef):
            continue
        arguments = node.args
        every = [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs, arguments.vararg, arguments.kwarg]
        for argument in every:
            if argument and argument.annotation is None and argument.arg not in ("self", "cls"):
                yield f"{name} does not annotate {argument.arg}"
        if node.returns is None:
            yield f"{name} does not annotate what it returns"


def mutable_defaults(tree: ast.Module, path: str) -> Iterator[str]:
    mutable = (ast.List, ast.Dict, ast.Set, ast.ListComp, ast.DictComp, ast.SetComp)
    for node in functions(tree):
        for default in [*node.args.defaults, *node.args.kw_defaults]:
            is_call = isinstance(default, ast.Call) and dotted(default.func) in ("list", "dict", "set")
            if isinstance(default, mutable) or is_call:
                yield f"{node.name} (line {node.lineno}) has a mutable default"


def stray_prints(tree: ast.Module, path: str) -> Iterator[str]:
    if path.startswith(PRINTERS):
        return
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and dotted(node.func) == "print":
            yield f"print on line {node.lineno}: only the command line prints"


def unsafe_loading(tree: ast.Module, path: str) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else [alias.name for alias in node.names]
            for name in {name.split(".")[0] for name in names} & FORBIDDEN_MODULES:
                yield f"line {node.lineno} imports {name}: nothing is ever pickled"
        elif isinstance(node, ast.Call):
            if advice := FORBIDDEN_CALLS.get(dotted(node.func)):
                yield f"line {node.lineno} calls {dotted(node.func)}: {advice}"
            for keyword in node.keywords:
                if keyword.arg == "allow_pickle" and getattr(keyword.value, "value", True) is not False:
                    yield f"line {node.lineno} allows pickles"


def long_functions(tree: ast.Module, path: str) -> Iterator[str]:
    for node in functions(tree):
        if own_lines(node) > MAX_FUNCTION_LINES:
            yield f"{node.name} has {own_lines(node)} lines of its own, at most {MAX_FUNCTION_LINES}"


def long_files(tree: ast.Module, path: str) -> Iterator[str]:
    lines = max((node.end_lineno or 0 for node in tree.body), default=0)
    if lines > MAX_FILE_LINES:
        yield f"{lines} lines, at most {MAX_FILE_LINES}: more than one idea"


Rule = Callable[[ast.Module, str], Iterator[str]]
RULES: list[Rule] = [
    missing_docstrings,
    missing_annotations,
    mutable_defaults,
    stray_prints,
    unsafe_loading,
    long_functions,
    long_files,
]


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.__name__)
def test_sources_keep_the_rule(rule: Rule):
    complaints = [f"{path}: {text}" for path, tree in trees().items() for text in rule(tree, path)]
    assert not complaints, "\n".join(complaints)


@pytest.mark.parametrize(
    ("rule", "source"),
    [
        (missing_docstrings, "'''Module.'''\ndef f(): pass"),
        (missing_docstrings, "'''Module.'''\nclass A:\n    '''A.'''\n    def f(self): pass"),
        (missing_annotations, "def f(points) -> None: pass"),
        (missing_annotations, "def f(points: int): pass"),
        (mutable_defaults, "def f(*, a=[]): pass"),
        (mutable_defaults, "def _f(a=dict()): pass"),
        (stray_prints, "print(1)"),
        (unsafe_loading, "from pickle import loads"),
        (unsafe_loading, "np.load(f, allow_pickle=True)"),
        (unsafe_loading, "yaml.load(f, Loader)"),
        (unsafe_loading, "eval('1')"),
        (long_functions, "def f():\n" + "    x = 1\n" * MAX_FUNCTION_LINES),
    ],
)
def test_each_rule_finds_its_fault(rule: Rule, source: str):
    assert list(rule(ast.parse(source), "jaxmap/other.py"))


def project_texts() -> Iterator[Path]:
    """The project's own text files."""
    yield from (path for path in ROOT.iterdir() if path.suffix in {".md", ".toml", ".txt", ".yaml"})
    for folder in ("jaxmap", "tests", "scripts", "configs", ".ci"):
        for path in (ROOT / folder).rglob("*"):
            if path.is_file() and path.suffix in {"", ".py", ".sh", ".md", ".txt", ".yaml", ".html", ".css", ".js"}:
                yield path


def test_no_file_names_a_folder_of_one_machine():
    found = []
    for path in sorted(project_texts()):
        for number, line in enumerate(path.read_text("utf-8").splitlines(), start=1):
            if MACHINE_PATH.search(line):
                found.append(f"{relative(path)}:{number}: {line.strip()}")
    assert not found, "\n".join(found)

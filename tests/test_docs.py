"""What README and docs show runs, and what they name exists."""

from __future__ import annotations

import dataclasses
import importlib
import pkgutil
import re
import runpy
import shlex
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tyro
from fixtures import named_options, options_of, shared_cache  # noqa: F401
from golden.seeded_weights import seeded_image, seeded_weights
from PIL import Image
from test_layers import FLOORS

import jaxmap
from jaxmap.commands import COMMANDS
from jaxmap.commands.main import main
from jaxmap.datasets import READERS

ROOT = Path(__file__).parents[1]
PAGES = ("README.md", "CONTRIBUTING.md", *sorted(f"docs/{page.name}" for page in (ROOT / "docs").glob("*.md")))
TEXTS = {page: (ROOT / page).read_text(encoding="utf8") for page in PAGES}


def blocks(page: str, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", TEXTS[page], re.DOTALL)


def prose(page: str) -> str:
    return re.sub(r"```.*?```", "", TEXTS[page], flags=re.DOTALL)


def command_lines(page: str) -> list[list[str]]:
    """The words of each `jaxmap` line in the shell blocks of a page."""
    text = "\n".join(blocks(page, "sh")).replace("\\\n", " ")
    lines = [shlex.split(line, comments=True) for line in text.splitlines()]
    return [words[1:] for words in lines if words[:1] == ["jaxmap"]]


def all_lines() -> list[tuple[str, list[str]]]:
    return [(page, words) for page in PAGES for words in command_lines(page)]


@pytest.fixture(scope="module")
def materials(tmp_path_factory) -> Path:
    """Small files that the examples read."""
    folder = tmp_path_factory.mktemp("materials")
    architecture = replace(jaxmap.torch_architecture("resnet18", ("sand", "rock")), head_channels=4)
    jaxmap.save_model(folder / "model.safetensors", architecture, seeded_weights(architecture))
    Image.fromarray(seeded_image(20, 30)).save(folder / "left.png")
    for name in ("fusion", "stereo"):
        (folder / f"{name}.yaml").write_text("depth: {max_m: 8}\n")
    return folder


@pytest.fixture
def workshop(materials, tmp_path, monkeypatch) -> Path:
    """The current folder of the examples."""
    monkeypatch.chdir(tmp_path)
    for path in (*materials.iterdir(), ROOT / "jaxmap"):
        Path(path.name).symlink_to(path)
    return tmp_path


class ParsedError(BaseException):
    """Carries the options of a command line, in place of running it; no handler of errors takes it."""


def parsed(words: list[str], monkeypatch) -> Any:
    """The options of a command line, by the command's own parser; a wrong one fails."""
    parse = tyro.cli

    def stop(*arguments: Any, **options: Any) -> None:
        raise ParsedError(parse(*arguments, **options))

    with monkeypatch.context() as patched, pytest.raises(ParsedError) as caught:
        patched.setattr(tyro, "cli", stop)
        main(words)
    return caught.value.args[0]


def inputs(options: Any) -> Iterator[Path]:
    """The files and folders that a command reads."""
    for field in dataclasses.fields(options):
        value = getattr(options, field.name)
        if dataclasses.is_dataclass(value):
            yield from inputs(value)
        elif field.name == "sequence":
            yield from (Path(name) for name in np.atleast_1d(value) if not name.startswith("sample:"))
        elif field.name != "out":
            yield from (path for path in (value if isinstance(value, tuple) else (value,)) if isinstance(path, Path))


PRINTED = {
    "README.md": r"motorcycle_left \d+ voxels hit\n\(120, 120\)",
    "docs/architecture.md": r"kitti.*my_rover",
    "docs/fusion_and_tuning.md": r"0\.\d+, d loss / d occupancy_hit 0\.\d+",
    "docs/matching.md": r"\d{3,} points in \d+ voxels",
    "docs/networks.md": r"\{'sand': .*, 'rock': .*\}\n$",
    "docs/large_maps.md": r"\d+ voxels observed in \d+ blocks of \(2, 2, 2\)",
    "docs/outputs.md": r"\('sand',\) \(2, 2, 2, 2\) None",
}


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, marks=[] if page == "README.md" else [pytest.mark.slow])
        for page in PAGES
        if blocks(page, "python")
    ],
)
def test_python_blocks_run(page, workshop, capsys):
    grid = jaxmap.make_grid([0, 0, 0], [1, 1, 1], 0.5)
    Path("runs/motorcycle").mkdir(parents=True)
    jaxmap.save_map("runs/motorcycle/map.zarr", jaxmap.make_voxel_map(grid, ("sand",)), jaxmap.MapAttributes())
    registry = importlib.import_module("jaxmap.datasets.registry")
    before = dict(READERS)
    scope: dict[str, Any] = {}
    try:
        for block in blocks(page, "python"):
            exec(compile(block, page, "exec", dont_inherit=True), scope)
    finally:
        registry.READERS.clear()
        registry.READERS.update(before)
    assert re.search(PRINTED[page], capsys.readouterr().out)


def test_shell_lines_are_accepted_by_the_commands_parsers(workshop, monkeypatch):
    assert len(all_lines()) > 30
    for _, words in all_lines():
        parsed(words, monkeypatch)


def test_a_wrong_option_is_found(workshop, monkeypatch):
    with pytest.raises(SystemExit):
        parsed(["map", "sample:traverse", "--out", "run", "--voxel-size", "1"], monkeypatch)


RUNNABLE = {"README.md": 4, "docs/fusion_and_tuning.md": 2, "docs/outputs.md": 4}
"""How many shell lines of a page find all they read: samples, what comes with jaxmap, or what lines above have made.

Lines of other pages that could run are among these.
"""


@pytest.mark.slow
@pytest.mark.parametrize("page", RUNNABLE)
def test_shell_lines_on_samples_run(page, workshop, monkeypatch, capsys):
    ran = 0
    for words in command_lines(page):
        needs_network = words[:2] == ["weights", "fetch"]
        if not needs_network and all(path.exists() for path in inputs(parsed(words, monkeypatch))):
            assert main(words) == 0, words
            ran += 1
    assert ran == RUNNABLE[page]
    assert "wrote" in capsys.readouterr().out


def test_the_readme_is_one_page():
    assert len(TEXTS["README.md"].splitlines()) <= 150


def test_the_settings_page_is_what_the_code_generates():
    generated = runpy.run_path(str(ROOT / "scripts" / "make_settings_page.py"))["page"]()
    assert generated == TEXTS["docs/settings.md"], "run python scripts/make_settings_page.py"


def test_the_architecture_page_has_the_floors_of_the_house():
    rows = re.findall(r"^\| \d+ \| ((?:`\w+` ?)+)\|", TEXTS["docs/architecture.md"], re.MULTILINE)
    assert [set(re.findall(r"\w+", row)) for row in rows] == [set(floor.split()) for floor in FLOORS[:-1]]


def test_paths_and_links_lead_somewhere():
    missing = []
    for page in PAGES:
        for path in re.findall(r"(?<![\w/.])(?:scripts|docs|tests|configs|jaxmap)/[\w./-]*[\w/]", TEXTS[page]):
            if not (ROOT / path).exists():
                missing.append(f"{page}: {path}")
        for target, anchor in re.findall(r"\]\((?!\w+://)([\w./]*)#?([\w-]*)\)", TEXTS[page]):
            path = (ROOT / page).parent / target if target else ROOT / page
            if not path.exists() or (anchor and anchor not in anchors(path.read_text(encoding="utf8"))):
                missing.append(f"{page}: link {target}#{anchor}")
    assert not missing, "\n".join(missing)


def test_the_index_lists_every_page():
    listed = set(re.findall(r"\((\w+\.md)\)", TEXTS["docs/README.md"]))
    assert listed == {page.name for page in (ROOT / "docs").glob("*.md")} - {"README.md"}


def anchors(text: str) -> set[str]:
    """The anchors of the headings of a page, as GitHub makes them."""
    headings = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def test_commands_options_readers_and_presets_that_are_named_exist():
    options = {option for command in COMMANDS for option in options_of(command)} | {"--help", "--version", "--all"}

    def known(name: str) -> bool:
        return name in options or any(option.startswith(f"{name}.") for option in options)

    scripts = "\n".join(path.read_text(encoding="utf8") for path in (ROOT / "scripts").rglob("*.py"))
    unknown = []
    for page in PAGES:
        text = prose(page)
        unknown += [f"{page}: {name}" for name in re.findall(r"`jaxmap (\w+)", text) if name not in COMMANDS]
        unknown += [f"{page}: {name}" for name in named_options(text) if f'"{name}"' not in scripts and not known(name)]
        for script, rest in re.findall(r"`python (scripts/[\w/]+\.py)([^`]*)`", text):
            beside = "".join(path.read_text(encoding="utf8") for path in (ROOT / script).parent.glob("*.py"))
            unknown += [f"{page}: {script} {name}" for name in named_options(rest) if f'"{name}"' not in beside]
        unknown += [
            f"{page}: config {name}"
            for name in re.findall(r"--config (\w+)(?!\w*\.)", TEXTS[page])
            if not name.isupper() and not list((ROOT / "configs").rglob(f"{name}.yaml"))
        ]
    assert not unknown, "\n".join(unknown)
    assert set(re.findall(r"^\| `(\w+)` \|", TEXTS["docs/data.md"], re.MULTILINE)) == set(READERS)


def test_python_names_that_are_named_exist():
    missing = []
    for page in PAGES:
        for name in re.findall(r"`(jaxmap(?:\.\w+)+)", prose(page)):
            try:
                pkgutil.resolve_name(name)
            except (AttributeError, ImportError):
                missing.append(f"{page}: {name}")
        missing += [
            f"{page}: jm.{name}" for name in re.findall(r"\bjm\.(\w+)", TEXTS[page]) if not hasattr(jaxmap, name)
        ]
    assert not missing, "\n".join(missing)


def test_every_command_is_documented():
    for command in COMMANDS:
        assert any(f"jaxmap {command}" in text or f"scripts/{command}" in text for text in TEXTS.values()), command

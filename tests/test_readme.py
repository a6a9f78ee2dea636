"""What the README shows runs, and what it names exists."""

from __future__ import annotations

import re
from pathlib import Path

from jaxmap.commands import COMMANDS
from jaxmap.datasets import READERS
from jaxmap.files import config_folder

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf8")


def test_the_python_example_runs(capsys):
    (example,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    exec(compile(example, "README.md", "exec"), {})
    assert re.search(r"motorcycle_left \d+ voxels hit\n\(120, 120\)", capsys.readouterr().out)


def test_commands_readers_and_files_that_are_named_exist():
    named = re.findall(r"(?:`|^)jaxmap (\w+)", README, re.MULTILINE)
    assert named and set(named) <= set(COMMANDS)
    assert set(re.findall(r"^\| `(\w+)` \|", README, re.MULTILINE)) >= set(READERS)
    for name in re.findall(r"^- `(\w+)` is", README, re.MULTILINE):
        assert (config_folder() / f"{name}.yaml").is_file()
    for path in re.findall(r"(?:scripts|docs)/[\w.]+\w", README):
        assert (ROOT / path).exists(), path


def test_every_command_is_told_in_the_readme():
    for command in COMMANDS:
        assert f"jaxmap {command}" in README or f"scripts/{command}" in README, command

"""What the README shows runs, and what it names exists."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

from golden.seeded_weights import seeded_image, seeded_weights
from PIL import Image

import jaxmap
from jaxmap.commands import COMMANDS
from jaxmap.datasets import READERS
from jaxmap.host.files import config_folder

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf8")


def example(with_name: str) -> str:
    (found,) = (text for text in re.findall(r"```python\n(.*?)```", README, re.DOTALL) if with_name in text)
    return found


def test_the_example_of_mapping_runs(capsys):
    exec(compile(example("run_sequence"), "README.md", "exec"), {})
    assert re.search(r"motorcycle_left \d+ voxels hit\n\(120, 120\)", capsys.readouterr().out)


def test_the_example_of_a_network_runs(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    architecture = replace(jaxmap.torch_architecture("mobilenet_v2", ("sand", "rock")), head_channels=4)
    jaxmap.save_model("model.safetensors", architecture, seeded_weights(architecture))
    Image.fromarray(seeded_image(20, 30)).save("left.png")
    scope: dict = {}
    exec(compile(example("load_network"), "README.md", "exec"), scope)
    assert scope["logits"].shape == (1, 20, 30, 2)
    assert re.match(r"\{'sand': .*, 'rock': .*\}\n$", capsys.readouterr().out)


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

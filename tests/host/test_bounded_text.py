"""YAML and JSON of unknown origin: whatever they hold, the answer is plain values or one line, at once."""

from __future__ import annotations

import json
import os
import time

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from jaxmap.errors import JaxmapError
from jaxmap.host.bounded_text import parse_json, parse_yaml, read_json, read_text, read_yaml


def growing(levels: int = 9, width: int = 9) -> str:
    """Aliases of aliases, which stand for width**levels values."""
    lines = ["a0: &a0 [x]"]
    lines += [f"a{level}: &a{level} [{', '.join([f'*a{level - 1}'] * width)}]" for level in range(1, levels)]
    return "\n".join(lines)


HOSTILE_YAML = {
    "aliases of aliases": growing(),
    "merges of merges": "\n".join(
        ["a0: &a0 {x: 1}", *(f"a{i}: &a{i} {{<<: [{', '.join([f'*a{i - 1}'] * 9)}], b{i}: 1}}" for i in range(1, 9))]
    ),
    "a list within itself": "a: &a [*a]",
    "an alias of nothing": "a: *b",
    "many aliases": "a: &a 1\nb: [" + ", ".join(["*a"] * 200) + "]",
    "depth by aliases": "\n".join(["a0: &a0 [x]", *(f"a{i}: &a{i} [*a{i - 1}]" for i in range(1, 60))]),
    "brackets": "[" * 10_000,
    "braces": "a: " + "{b: " * 5_000,
    "dashes": "- " * 10_000 + "x",
    "questions": "? " * 10_000 + "x",
    "many values": "[" + "1," * 60_000 + "1]",
    "a long whole number": "a: " + "9" * 5_000,
    "a long hexadecimal number": "a: 0x" + "f" * 100_000,
    "a long fraction": "a: 1." + "0" * 5_000,
    "a date that its tag demands": "a: !!timestamp x",
    "no fraction": "a: !!float 'x'",
    "no whole number": "a: !!int 'x'",
    "no truth value": "a: !!bool 'x'",
    "no nothing": "a: !!binary '%'",
    "an object": "a: !!python/object/apply:os.system [ls]",
    "a key that is a list": "{[1]: 2}",
    "a bell": "a: \x07",
    "two documents": "a: 1\n---\nb: 2",
    "no end": "a: 'b",
}


@pytest.mark.parametrize("text", HOSTILE_YAML.values(), ids=HOSTILE_YAML.keys())
def test_hostile_yaml_is_refused_at_once(text):
    started_s = time.perf_counter()
    with pytest.raises(JaxmapError, match=r"malformed YAML|deeper|more") as caught:
        parse_yaml(text, "camera.yaml")
    assert "camera.yaml" in str(caught.value) and len(str(caught.value)) < 300
    assert time.perf_counter() - started_s < 10


def test_what_people_write_is_read():
    text = "a: &a [1, 2.5, true, ~, x]\nb: *a\nc: {<<: {d: 1}, e: 2001-99-99}\nf: 12:30"
    values = [1, 2.5, True, None, "x"]
    assert parse_yaml(text, "x") == {"a": values, "b": values, "c": {"d": 1, "e": "2001-99-99"}, "f": 750}


TEXT = st.text(st.characters(min_codepoint=32, max_codepoint=126) | st.sampled_from("äß中"))
NUMBER = st.integers(-(2**63), 2**63) | st.floats(allow_nan=False, allow_infinity=False)
PLAIN = st.recursive(
    st.none() | st.booleans() | NUMBER | TEXT,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(TEXT, inner, max_size=4),
    max_leaves=20,
)


@given(PLAIN)
def test_plain_values_come_back(tree):
    assert parse_yaml(yaml.safe_dump(tree, allow_unicode=True), "x") == tree
    assert parse_json(json.dumps(tree), "x") == tree


def test_numbers_that_json_has_not_are_nothing():
    assert parse_json("[NaN, -Infinity, 1]", "x") == [None, None, 1]


@given(st.text())
def test_any_text_is_plain_values_or_one_line(text):
    for parse in (parse_yaml, parse_json):
        try:
            parse(text, "x")
        except JaxmapError as fault:
            assert "\n" not in str(fault)


HOSTILE_JSON = {
    "brackets": "[" * 100_000 + "]" * 100_000,
    "a deep list that is whole": "[" * 60 + "]" * 60,
    "a long whole number": "9" * 5_000,
    "beyond float64": "1e999",
    "cut off": '{"a": ',
}


@pytest.mark.parametrize("text", HOSTILE_JSON.values(), ids=HOSTILE_JSON.keys())
def test_hostile_json_is_refused(text):
    with pytest.raises(JaxmapError, match=r"JSON|deeper") as caught:
        parse_json(text, "metrics.json")
    assert "metrics.json" in str(caught.value) and len(str(caught.value)) < 300


@pytest.mark.parametrize("read", [read_text, read_yaml, read_json])
@pytest.mark.parametrize("kind", ["pipe", "device", "folder", "loop", "nothing", "large", "binary"])
def test_regular_files_of_text_alone_are_read(tmp_path, read, kind):
    path = tmp_path / "file"
    match kind:
        case "pipe":
            os.mkfifo(path)
        case "device":
            path.symlink_to("/dev/zero")
        case "folder":
            path.mkdir()
        case "loop":
            path.symlink_to(path)
        case "large":
            path.touch()
            os.truncate(path, 1 << 40)
        case "binary":
            path.write_bytes(b"a: 1\n\0")
    with pytest.raises(JaxmapError, match="file"):
        read(path)

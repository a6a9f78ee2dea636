"""Weight files that mean harm, or have been damaged, cost an error and nothing else: no crash, no hour, no memory."""

from __future__ import annotations

import json
import struct
import zipfile
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from golden.seeded_weights import seeded_weights
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from safetensors.numpy import save_file

from jaxmap.errors import JaxmapError
from jaxmap.models import torch_files
from jaxmap.models.architecture import torch_architecture
from jaxmap.models.checkpoint import load_model, save_model
from jaxmap.models.importers import import_weights
from jaxmap.models.tensor_files import read_tensors
from jaxmap.models.torch_files import read_torch_file

GOLDEN = Path(__file__).parent.parent / "golden"
SMALL = replace(
    torch_architecture("mobilenet_v2", ("sand", "rock")),
    top_conv=False,
    head_channels=2,
    low_level_channels=2,
    atrous_rates=(),
)
many = settings(max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])


def refusal(path: Path) -> str:
    with pytest.raises(JaxmapError) as caught:
        import_weights(path)
    line = str(caught.value)
    assert str(path) in line and ";" in line and len(line) < 1000
    return line


def write_zip(path: Path, program: bytes, storages: dict[str, bytes] | None = None) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("archive/data.pkl", program)
        for key, content in (storages or {}).items():
            archive.writestr(f"archive/data/{key}", content)
    return path


def word(text: str) -> bytes:
    return b"X" + struct.pack("<I", len(text.encode())) + text.encode()


def number(value: int) -> bytes:
    return b"\x8a\x08" + struct.pack("<q", value)


def tensor(count: int, key: str = "0", storage: str = "FloatStorage") -> bytes:
    reference = b"(" + word("storage") + f"ctorch\n{storage}\n".encode() + word(key) + word("cpu") + number(count)
    return (
        b"ctorch._utils\n_rebuild_tensor_v2\n("
        + reference
        + b"tQ"
        + number(0)
        + b"("
        + number(count)
        + b"t("
        + number(1)
        + b"ttR"
    )


DOUBLING = b"K\x01q\x00" + b"".join(
    b"h" + bytes([n]) + b"h" + bytes([n]) + b"\x86q" + bytes([n + 1]) for n in range(80)
)
"""Pairs of pairs of pairs: a value that is small to keep and endless to walk through."""

HOSTILE = {
    "an endless key": b"}" + DOUBLING + b"K\x01s.",
    "an endless function": DOUBLING + b")R.",
    "an endless name": DOUBLING + word("x") + b"\x93.",
    "an endless shape": b"}" + word("w") + tensor(4).removesuffix(b"ttR") + DOUBLING + b"tR" + b"s.",
    "an endless storage": DOUBLING + b"Q.",
    "lists that are copied": b"ccollections\nOrderedDict\n" + b"]q\x00" + b"(h\x00h\x00eh\x00\x85R.",
    "a shape that is a list": b"}" + word("w") + tensor(4).removesuffix(b"(" + number(1) + b"ttR") + b"]tRs.",
    "a mountain of axes": b"}" + word("w") + b"ctorch._utils\n_rebuild_tensor_v2\n(" + b"K\x01" * 3 + b"tRs.",
    "no function": b"K\x01)R.",
    "a name without end": b"ctorch\n" + b"x" * 10000 + b"\n.",
    "a key without end": b"}" + word("w") + tensor(4, "k" * 10000) + b"s.",
}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_program_is_refused(name, tmp_path):
    assert len(refusal(write_zip(tmp_path / "a.pth", b"\x80\x02" + HOSTILE[name], {"0": bytes(16)}))) < 500


def test_one_storage_cannot_have_two_sizes(tmp_path):
    program = b"\x80\x02}" + word("a") + tensor(6, storage="HalfStorage") + b"s" + word("b") + tensor(60) + b"s."
    assert "storage 0 holds 12 bytes" in refusal(write_zip(tmp_path / "a.pth", program, {"0": bytes(12)}))


def test_members_that_share_their_bytes_are_refused(tmp_path):
    program = b"\x80\x02}" + b"".join(word(f"w{n}") + tensor(1000, str(n)) + b"s" for n in range(50)) + b"."
    path = write_zip(tmp_path / "a.pth", program, {"0": bytes(4000)})
    with zipfile.ZipFile(path, "a") as archive:
        (first,) = (info for info in archive.infolist() if info.filename.endswith("data/0"))
        for n in range(1, 50):
            twin = zipfile.ZipInfo(f"archive/data/{n}")
            for field in ("header_offset", "compress_size", "file_size", "CRC", "compress_type", "flag_bits"):
                setattr(twin, field, getattr(first, field))
            archive.filelist.append(twin)
            archive.NameToInfo[twin.filename] = twin
        archive._didModify = True
    assert "share its bytes" in refusal(path)


def test_a_description_that_is_too_long_is_refused(tmp_path):
    path = write_zip(tmp_path / "a.pth", b"\x80\x02" + b")" * torch_files.MAX_PROGRAM_BYTES)
    assert "too large" in refusal(path)


def test_a_folder_and_an_unreadable_file_are_refused(tmp_path, monkeypatch):
    assert "no such file" in refusal(tmp_path)
    (tmp_path / "a.pth").write_bytes((GOLDEN / "tiny.pth").read_bytes())

    def denied(*_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "open", denied)
    assert "cannot be read (Permission denied)" in refusal(tmp_path / "a.pth")


INSTRUCTIONS = [
    *(b"}", b"]", b")", b"(", b"N", b"\x88", b"\x89", b"s", b"u", b"a", b"e", b"t", b"\x85", b"\x86", b"\x87", b"R"),
    *(b"Q", b"b", b"\x93", b"\x94", b"q\x00", b"h\x00", b"q\x01", b"h\x01", b"K\x02", number(-1), number(1 << 40)),
    *(word("w"), word("storage"), word("0"), b"ctorch\nFloatStorage\n", b"ccollections\nOrderedDict\n"),
    *(b"ctorch._utils\n_rebuild_tensor_v2\n", b"ctorch._utils\n_rebuild_parameter\n", tensor(4), tensor(4) + b"s"),
]


@many
@given(program=st.lists(st.sampled_from(INSTRUCTIONS), max_size=30), wrapped=st.booleans())
def test_any_program_is_refused_or_gives_tensors(program, wrapped, tmp_path):
    body = b"".join(program)
    body = b"\x80\x02}" + word("w") + body + b"s." if wrapped else b"\x80\x02" + body + b"."
    with suppress(JaxmapError):
        tensors = read_torch_file(write_zip(tmp_path / "a.pth", body, {"0": bytes(16)}))
        assert all(array.nbytes <= 16 for array in tensors.values())


@st.composite
def damages(draw) -> list[tuple[str, float, int]]:
    """What is done to a file: kind, place as a share of its length, and a byte."""
    kinds = st.sampled_from(["flip", "set", "cut", "drop", "insert", "repeat"])
    places = st.one_of(st.floats(0, 1), st.sampled_from([0.0, 1.0]))
    return draw(st.lists(st.tuples(kinds, places, st.integers(0, 255)), min_size=1, max_size=4))


def damaged(content: bytes, steps: list[tuple[str, float, int]], within: int | None = None) -> bytes:
    data = bytearray(content)
    for kind, share, value in steps:
        place = int(share * (min(within or len(data), len(data)) - 1)) if data else 0
        if kind == "cut":
            del data[place:]
        elif kind == "drop":
            del data[place : place + 1 + value]
        elif kind == "insert":
            data[place:place] = bytes([value] * (1 + value % 16))
        elif kind == "repeat":
            data[place:place] = data[place : place + value]
        elif data:
            data[place] = data[place] ^ (1 << value % 8) if kind == "flip" else value
    return bytes(data)


@pytest.fixture(scope="module")
def model_bytes(tmp_path_factory) -> bytes:
    path = tmp_path_factory.mktemp("model") / "model.safetensors"
    save_model(path, SMALL, seeded_weights(SMALL))
    return path.read_bytes()


@many
@given(steps=damages(), name=st.sampled_from(["tiny.pth", "tiny_legacy.pth"]))
def test_a_damaged_torch_file_is_refused_or_read(steps, name, tmp_path):
    (tmp_path / "a.pth").write_bytes(damaged((GOLDEN / name).read_bytes(), steps))
    with suppress(JaxmapError):
        assert all(array.size <= 24 for array in read_tensors(tmp_path / "a.pth").values())


@many
@given(steps=damages())
def test_a_damaged_model_is_refused_or_read(steps, model_bytes, tmp_path):
    """The damage lies in the header, where nearly every byte means something."""
    header = 8 + struct.unpack("<Q", model_bytes[:8])[0]
    (tmp_path / "a.safetensors").write_bytes(damaged(model_bytes, steps, header))
    with suppress(JaxmapError):
        saved = load_model(tmp_path / "a.safetensors")
        assert all(np.isfinite(value).all() for value in saved.weights.values())


def with_header(path: Path, text: bytes, body: bytes = b"") -> Path:
    path.write_bytes(struct.pack("<Q", len(text)) + text + body)
    return path


@pytest.mark.parametrize(
    "text",
    [
        b"[" * 100_000,
        b'{"a":' * 100_000,
        b'{"__metadata__":' + b'{"a":' * 50_000 + b"}" * 50_001,
        b'{"w":{"dtype":"F32","shape":[' + b"1," * 100_000 + b'1],"data_offsets":[0,4]}}',
        b'{"w":{"dtype":"F32","shape":[4294967296,4294967296],"data_offsets":[0,0]}}',
        b'{"w":{"dtype":"F32","shape":[-1],"data_offsets":[0,4]}}',
        b'{"w":{"dtype":"F32","shape":[1e300],"data_offsets":[0,4]}}',
        b'{"' + b"w" * 100_000 + b'":{"dtype":"BF16","shape":[2],"data_offsets":[0,4]}}',
        b'{"' + b"w" * 100_000 + b'":{"dtype":"F32","shape":[1],"data_offsets":[0,4]}}',
        b"\xff\xfe",
        b"",
        b"{}",
    ],
)
def test_a_strange_safetensors_header_is_refused(text, tmp_path):
    assert refusal(with_header(tmp_path / "a.safetensors", text, bytes(4)))


@pytest.mark.parametrize(
    "record",
    [
        "[" * 100_000,
        '{"a":' * 100_000,
        "1" * 10_000,
        json.dumps({"format_version": 10**400}),
        json.dumps({"format_version": 0}),
        "null",
    ],
)
def test_a_strange_record_is_refused(record, tmp_path):
    save_file({"w": np.zeros(1, np.float32)}, tmp_path / "a.safetensors", metadata={"jaxmap": record})
    with pytest.raises(JaxmapError) as caught:
        load_model(tmp_path / "a.safetensors")
    assert len(str(caught.value)) < 500


def test_numbers_beyond_float32_are_reported_as_not_finite(tmp_path):
    weights = {name: value.astype(np.float64) for name, value in seeded_weights(SMALL).items()}
    weights["classifier.bias"] = np.full(2, 1e300)
    with pytest.raises(JaxmapError, match="1 not finite: classifier.bias"):
        save_model(tmp_path / "a.safetensors", SMALL, weights)
    save_model(tmp_path / "a.safetensors", SMALL, seeded_weights(SMALL))
    metadata = load_header(tmp_path / "a.safetensors")["__metadata__"]
    save_file(weights, tmp_path / "a.safetensors", metadata=metadata)
    with pytest.raises(JaxmapError, match="1 not finite: classifier.bias"):
        load_model(tmp_path / "a.safetensors")


def load_header(path: Path) -> dict:
    content = path.read_bytes()
    return json.loads(content[8 : 8 + struct.unpack("<Q", content[:8])[0]])


@pytest.mark.parametrize(
    "change",
    [
        {"classes": ("sand", "rock\x1b[31m")},
        {"classes": ("sand", "\ud800")},
        {"classes": ("sand", " ")},
        {"classes": ("sand", "x" * 10**6, "\n")},
        {"mean": (float("nan"), 0.0, 0.0)},
        {"std": (float("inf"), 1.0, 1.0)},
        {"std": ()},
        {"head_eps": float("inf")},
        {"decoder_convs": 4096},
        {"dropout": float("nan")},
    ],
)
def test_a_strange_architecture_is_refused(change, tmp_path):
    with pytest.raises(JaxmapError) as caught:
        save_model(tmp_path / "a.safetensors", replace(SMALL, **change), {})
    assert len(str(caught.value)) < 600

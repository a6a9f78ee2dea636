"""PyTorch's files are read without running anything that they hold."""

from __future__ import annotations

import argparse
import collections
import datetime
import pickle
import zipfile
from pathlib import Path

import numpy as np
import pytest
from torch_legacy import legacy_bytes
from torch_zip import write_torch

from jaxmap.errors import JaxmapError
from jaxmap.models.torch_files import read_torch_file

GOLDEN = Path(__file__).parent.parent / "golden"


def write_zip(path: Path, program: bytes, compression: int = zipfile.ZIP_STORED, **members: bytes) -> Path:
    with zipfile.ZipFile(path, "w", compression) as archive:
        archive.writestr("archive/data.pkl", program)
        for name, content in members.items():
            archive.writestr(f"archive/data/{name.removeprefix('s')}", content)
    return path


def tensor_program(
    shape: tuple[int, ...], strides: tuple[int, ...], count: int, storage: str = "FloatStorage"
) -> bytes:
    """A state dict of one tensor `w`, as PyTorch pickles it."""

    def word(text: str) -> bytes:
        return b"X" + len(text).to_bytes(4, "little") + text.encode()

    def number(value: int) -> bytes:
        return b"\x8a\x08" + value.to_bytes(8, "little", signed=True)

    def numbers(values: tuple[int, ...]) -> bytes:
        return b"(" + b"".join(map(number, values)) + b"t"

    reference = (
        b"(" + word("storage") + f"ctorch\n{storage}\n".encode() + word("0") + word("cpu") + number(count) + b"tQ"
    )
    hooks = b"ccollections\nOrderedDict\n)R"
    tensor = b"ctorch._utils\n_rebuild_tensor_v2\n(" + reference + number(0) + numbers(shape) + numbers(strides)
    return b"\x80\x02}" + word("w") + tensor + b"\x89" + hooks + b"tRs."


def refusal(path: Path) -> str:
    with pytest.raises(JaxmapError) as caught:
        read_torch_file(path)
    assert str(path) in str(caught.value) and ";" in str(caught.value) and len(str(caught.value)) < 500
    return str(caught.value)


@pytest.mark.parametrize("name", ["tiny.pth", "tiny_legacy.pth"])
def test_what_torch_writes_is_read(name):
    tensors = {key.removeprefix("state_dict."): value for key, value in read_torch_file(GOLDEN / name).items()}
    base = np.arange(24, dtype=np.float32)
    assert set(tensors) == {"plain", "turned", "part", "half", "double", "parameter", "empty"}
    np.testing.assert_array_equal(tensors["plain"], base.reshape(2, 3, 4))
    np.testing.assert_array_equal(tensors["turned"], base.reshape(4, 6).T)
    np.testing.assert_array_equal(tensors["part"], base[5:9])
    np.testing.assert_array_equal(tensors["half"], [0.5, -2])
    assert tensors["double"] == 1.25 and tensors["double"].shape == ()
    assert tensors["empty"].shape == (0, 3)


def test_a_tensor_by_hand_is_read(tmp_path):
    path = write_zip(tmp_path / "a.pth", tensor_program((2, 3), (3, 1), 6), s0=np.arange(6, dtype="<f4").tobytes())
    np.testing.assert_array_equal(read_torch_file(path)["w"], np.arange(6.0).reshape(2, 3))


def test_what_trainers_keep_beside_the_tensors_is_passed_over(tmp_path):
    """Objects of known libraries are blanks: neither made nor looked at."""
    beside = {
        "path": Path("/runs"),
        "counts": collections.Counter("aab"),
        "factory": collections.defaultdict(list, a=[1]),
        "options": argparse.Namespace(lr=0.1),
        "when": datetime.datetime(2020, 1, 1),
        "scalar": np.float64(0.5),
        "array": np.arange(3),
        "dtype": np.dtype("f4"),
    }
    programs = {name: pickle.dumps(value, protocol=2)[2:-1] for name, value in beside.items()}
    path = write_torch(tmp_path / "a.ckpt", {"hyper_parameters": programs, "state_dict": {"w": np.ones(3, np.float32)}})
    assert set(read_torch_file(path)) == {"state_dict.w"}


class Bomb:
    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self):
        return Path.touch, (self.marker,)


@pytest.mark.parametrize("protocol", [0, 2, 4])
def test_a_bomb_is_refused_by_name_and_does_not_go_off(tmp_path, protocol):
    content = {"state_dict": {"w": Bomb(tmp_path / "gone_off")}}
    assert "refused" in refusal(write_zip(tmp_path / "bomb.pth", pickle.dumps(content, protocol=protocol)))
    assert "refused" in refusal(write(tmp_path / "old.pth", legacy_bytes({}, content=content)))
    assert refusal(write(tmp_path / "alone.pth", pickle.dumps(content, protocol=protocol)))
    assert not (tmp_path / "gone_off").exists()


@pytest.mark.parametrize(
    "program",
    [
        b"cos\nsystem\n(X\x04\x00\x00\x00truetR.",
        b"cbuiltins\neval\n.",
        b"(X\x04\x00\x00\x00trueios\nsystem\n.",
        b"ctorch\nload\n.",
        b"\x80\x04\x8c\x02os\x8c\x06system\x93.",
    ],
)
def test_other_names_and_instructions_are_refused(tmp_path, program):
    assert "refused" in refusal(write_zip(tmp_path / "a.pth", program))


@pytest.mark.parametrize(
    ("program", "size"),
    [
        (tensor_program((1 << 40,), (1,), 6), 24),
        (tensor_program((1 << 40,), (0,), 6), 24),
        (tensor_program((1 << 30, 1 << 34), (0, 0), 6), 24),
        (tensor_program((2, 3), (3, 1), 1 << 50), 24),
        (tensor_program((2, 3), (3, 1), 6), 20),
        (tensor_program((2, 3), (-3, 1), 6), 24),
        (tensor_program((2, 3), (3,), 6), 24),
        (tensor_program((2, 3), (3, 1), 6, "StrangeStorage"), 24),
    ],
)
def test_shapes_that_the_file_does_not_hold_are_refused(tmp_path, program, size):
    assert refusal(write_zip(tmp_path / "a.pth", program, s0=bytes(size)))


def test_compressed_members_are_refused(tmp_path):
    path = write_zip(
        tmp_path / "a.pth", tensor_program((1 << 22,), (1,), 1 << 22), zipfile.ZIP_DEFLATED, s0=bytes(1 << 24)
    )
    assert "compressed" in refusal(path)


TWO = {"a": np.arange(6, dtype=np.float32).reshape(2, 3), "b": np.asfortranarray(np.ones((2, 2), np.float32))}


def write(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


def test_the_old_format_by_hand_is_read(tmp_path):
    tensors = read_torch_file(write(tmp_path / "a.pth", legacy_bytes(TWO)))
    assert set(tensors) == {"a", "b"}
    for name, value in TWO.items():
        np.testing.assert_array_equal(tensors[name], value)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"magic": 7}, "no file of PyTorch's"),
        ({"version": 1002}, "no file of PyTorch's"),
        ({"keys": ["1000"]}, "a list of storages"),
        ({"keys": ["1000", "1000"]}, "a list of storages"),
        ({"keys": ["1000", "1001", "1002"]}, "a list of storages"),
        ({"keys": ["1000", 1001]}, "a list of storages"),
        ({"keys": {"1000": 0, "1001": 0}}, "a list of storages"),
        ({"keys": ["1001", "1000"]}, "storage 1001 should hold 16 bytes"),
        ({"counts": {"1000": 7}}, "storage 1000 should hold 24 bytes"),
        ({"counts": {"1000": -1}}, "storage 1000 should hold 24 bytes"),
        ({"content": Path("/")}, "refused"),
    ],
)
def test_a_wrong_part_of_the_old_format_is_refused(changes, reason, tmp_path):
    assert reason in refusal(write(tmp_path / "a.pth", legacy_bytes(TWO, **changes)))


def test_storages_of_the_old_format_end_with_the_file(tmp_path):
    whole = legacy_bytes(TWO)
    assert refusal(write(tmp_path / "a.pth", whole + b"0"))
    lying = whole.replace(b"K\x06", b"M\xff\xff").replace((6).to_bytes(8, "little"), (0xFFFF).to_bytes(8, "little"))
    assert "storage 1000 should hold 262140 bytes" in refusal(write(tmp_path / "a.pth", lying))
    half = whole.replace(b"1001", b"1000")
    assert "storage 1000 has two sizes" in refusal(write(tmp_path / "a.pth", half))


@pytest.mark.parametrize("name", ["tiny.pth", "tiny_legacy.pth"])
def test_a_truncated_file_is_an_error(name, tmp_path):
    whole = (GOLDEN / name).read_bytes()
    for length in (0, 10, 15, 100, len(whole) // 2, len(whole) - 50, len(whole) - 1):
        (tmp_path / "cut.pth").write_bytes(whole[:length])
        assert refusal(tmp_path / "cut.pth")

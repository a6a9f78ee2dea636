"""Saved models load unchanged, and every fault of a model file is one line."""

from __future__ import annotations

import json
import struct
from dataclasses import replace

import jax
import numpy as np
import pytest
from golden.seeded_weights import seeded_weights
from safetensors.numpy import load_file, save_file

from jaxmap.errors import JaxmapError
from jaxmap.models.architecture import torch_architecture
from jaxmap.models.checkpoint import load_model, load_network, save_model

SMALL = replace(
    torch_architecture("mobilenet_v2", ("sand", "rock")),
    top_conv=False,
    head_channels=8,
    low_level_channels=4,
    atrous_rates=(2, 3),
    mean=(0.1, 0.2, 0.3),
)


@pytest.fixture(scope="module")
def weights():
    return seeded_weights(SMALL)


@pytest.fixture
def path(tmp_path, weights):
    save_model(tmp_path / "model.safetensors", SMALL, weights)
    return tmp_path / "model.safetensors"


def refusal(path) -> str:
    with pytest.raises(JaxmapError) as caught:
        load_model(path)
    line = str(caught.value)
    assert str(path) in line and ";" in line and len(line) < 800
    return line


def header_of(path) -> tuple[dict, bytes]:
    content = path.read_bytes()
    size = struct.unpack("<Q", content[:8])[0]
    return json.loads(content[8 : 8 + size]), content[8 + size :]


def rewrite(path, header: dict, body: bytes) -> None:
    text = json.dumps(header).encode()
    path.write_bytes(struct.pack("<Q", len(text)) + text + body)


def with_record(path, change) -> None:
    header, body = header_of(path)
    record = json.loads(header["__metadata__"]["jaxmap"])
    change(record)
    header["__metadata__"]["jaxmap"] = json.dumps(record)
    rewrite(path, header, body)


def test_a_model_comes_back(path, weights):
    saved = load_model(path)
    assert saved.architecture == SMALL and saved.holds == "network"
    assert all(isinstance(value, jax.Array) for value in saved.weights.values())
    for name, value in weights.items():
        np.testing.assert_array_equal(saved.weights[name], value)


def test_half_a_file_holds_three_digits_of_each_number(tmp_path, path, weights):
    half = tmp_path / "half.safetensors"
    save_model(half, SMALL, weights, half=True)
    assert half.stat().st_size < 0.55 * path.stat().st_size
    saved = load_model(half)
    assert saved.architecture == SMALL and all(value.dtype == np.float32 for value in saved.weights.values())
    for name, value in weights.items():
        np.testing.assert_allclose(saved.weights[name], value, rtol=1e-3, atol=1e-7)
    content = half.read_bytes()
    for share in (0.001, 0.5, 0.999):
        half.write_bytes(content[: int(len(content) * share)])
        assert "truncated" in refusal(half)


def test_numbers_too_large_for_half_a_file_are_refused(tmp_path, weights):
    changed = {**weights, "classifier.bias": np.asarray([1, 7e4], np.float32)}
    with pytest.raises(JaxmapError, match="beyond 65504, too large for half precision: classifier.bias"):
        save_model(tmp_path / "m.safetensors", SMALL, changed, half=True)
    assert not list(tmp_path.iterdir())


def test_the_record_is_plain_json(path):
    record = json.loads(header_of(path)[0]["__metadata__"]["jaxmap"])
    assert record["format_version"] == 1
    assert record["classes"] == ["sand", "rock"]
    assert record["normalisation"]["mean"] == [0.1, 0.2, 0.3]
    assert record["architecture"]["padding"] == "torch"


def test_files_from_before_relief_see_none(path):
    with_record(path, lambda record: record["architecture"].pop("relief_channels"))
    assert load_model(path).architecture == SMALL


def test_a_backbone_alone_is_no_network(tmp_path, weights):
    backbone = {name: value for name, value in weights.items() if name.startswith("backbone.")}
    save_model(tmp_path / "b.safetensors", SMALL, backbone, holds="backbone")
    assert load_model(tmp_path / "b.safetensors").holds == "backbone"
    with pytest.raises(JaxmapError, match="only a backbone"):
        load_network(tmp_path / "b.safetensors")


def test_all_differences_are_reported_together(tmp_path, weights):
    changed = dict(weights)
    del changed["backbone.stem.kernel"]
    changed["extra"] = np.zeros(3, np.float32)
    changed["classifier.bias"] = np.zeros(5, np.float32)
    changed["aspp.point.kernel"] = np.full_like(changed["aspp.point.kernel"], np.nan)
    with pytest.raises(JaxmapError) as caught:
        save_model(tmp_path / "m.safetensors", SMALL, changed)
    for word in (
        "1 missing: backbone.stem.kernel",
        "left over: extra",
        "classifier.bias is [5], not [2]",
        "not finite",
    ):
        assert word in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_weights_of_another_architecture_are_refused(path):
    with_record(path, lambda record: record["architecture"].update(backbone="resnet18"))
    assert "not those of resnet18" in refusal(path)


@pytest.mark.parametrize("share", [0.0, 0.0001, 0.01, 0.5, 0.999])
def test_a_truncated_file_is_refused(path, share):
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * share)])
    assert "truncated" in refusal(path)


def test_a_huge_declared_shape_is_refused_before_anything_is_allocated(path):
    header, body = header_of(path)
    for shape, offsets in (([1 << 40], [0, 4 << 40]), ([1 << 62, 4], [0, 64]), ([4], [0, 1 << 62])):
        header["classifier.bias"] = {"dtype": "F32", "shape": shape, "data_offsets": offsets}
        rewrite(path, header, body)
        assert "not a whole safetensors file" in refusal(path)
    path.write_bytes(struct.pack("<Q", 1 << 60) + b"{}")
    assert refusal(path)


def test_a_wrong_type_is_refused(path, weights):
    metadata = {"jaxmap": header_of(path)[0]["__metadata__"]["jaxmap"]}
    save_file({**load_file(path), "classifier.bias": np.zeros(2, np.int8)}, path, metadata=metadata)
    assert "missing: classifier.bias" in refusal(path)
    header, body = header_of(path)
    header["classifier.bias"].update(dtype="BOOL")
    rewrite(path, header, body)
    assert "classifier.bias is BOOL" in refusal(path)


@pytest.mark.parametrize(
    "change",
    [
        lambda record: record.update(format_version=99),
        lambda record: record.update(format_version="1"),
        lambda record: record.pop("architecture"),
        lambda record: record.update(architecture=[1]),
        lambda record: record.update(classes="sand"),
        lambda record: record.update(classes=[]),
        lambda record: record.update(holds="nothing"),
        lambda record: record["architecture"].update(colour="red"),
        lambda record: record["architecture"].update(head_channels=10**9),
        lambda record: record["architecture"].update(head_channels="many"),
        lambda record: record["architecture"].update(output_stride=3),
        lambda record: record["architecture"].update(relief_channels=65),
        lambda record: record["architecture"].update(relief_channels=6, decoder=False),
        lambda record: record["normalisation"].update(std=[0, 0, 0]),
    ],
)
def test_a_damaged_record_is_refused(path, change):
    with_record(path, change)
    assert "fault of jaxmap" not in refusal(path)


def test_no_json_and_no_record_are_refused(path, weights):
    save_file(dict(weights), path, metadata={"jaxmap": "{"})
    assert "not readable as JSON" in refusal(path)
    save_file(dict(weights), path)
    assert "weights import" in refusal(path)
    path.unlink()
    assert "no such model file" in refusal(path)

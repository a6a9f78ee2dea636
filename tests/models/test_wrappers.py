"""A network is found behind whatever trainers and compilers put around it; a part of another network is not taken."""

from __future__ import annotations

import json

import numpy as np
import pytest
from golden.seeded_weights import exported
from hypothesis import given
from hypothesis import strategies as st
from safetensors.numpy import save_file
from torch_zip import bfloat16, write_torch

from jaxmap.errors import JaxmapError
from jaxmap.models import import_tables as tables
from jaxmap.models.architecture import torch_architecture
from jaxmap.models.importers import import_weights
from jaxmap.models.wrappers import choose_network

ARCHITECTURE = torch_architecture("mobilenet_v2", ("background", "rock"))
ROWS = [*tables.torchvision_backbone("mobilenet_v2", "encoder."), *tables.smp_head(ARCHITECTURE)]
NET = {"encoder.stem.weight": 100_000, "encoder.bn.bias": 32, "head.weight": 50_000}
MORE = {"mean": 3, "loss.weight": 3, "loss.vgg.conv.weight": 10**6, "optimizer.state.0.exp_avg": 10**5}


def known(names):
    return {"encoder.stem.weight", "head.weight"} <= set(names)


def under(prefix: str, sizes: dict[str, int] = NET) -> dict[str, int]:
    return {prefix + name: size for name, size in sizes.items()}


part = st.sampled_from(["model", "net", "module", "_orig_mod", "state_dict", "segmenter", "encoder", "head", "mean"])


@given(st.lists(part, max_size=5), st.booleans())
def test_any_common_prefix_is_taken_off(parts, more):
    prefix = "".join(f"{name}." for name in parts)
    choice = choose_network(under(prefix) | (MORE if more else {}), known)
    assert choice.names == {name: prefix + name for name in NET}
    assert len(choice.notes) == bool(prefix) + more and not choice.fault


@pytest.mark.parametrize("copy", ["ema.", "ema_model.module.", "averaged_model.", "model_ema.", "teacher."])
def test_a_copy_of_the_network_is_left_out_and_told(copy):
    for sizes in (under(copy) | under("model."), under("model.") | under(copy)):
        choice = choose_network(sizes, known)
        assert choice.names == {name: f"model.{name}" for name in NET}
        assert "left out: " in choice.notes[1] and copy.split(".")[0] in choice.notes[1]
    assert choose_network(under(copy), known).names.keys() == NET.keys(), "alone, it is the network"


def test_parts_that_were_compiled_or_wrapped_by_themselves():
    sizes = {name.replace("encoder.", "encoder._orig_mod.module."): size for name, size in NET.items()}
    assert choose_network(sizes, known).names.keys() == NET.keys()


def test_a_part_of_another_network_is_not_taken_for_the_whole():
    choice = choose_network(under("backbone.") | {"decode_head.weight": 10**5}, known)
    assert "backbone.head.weight" in choice.names and "'backbone.'" in choice.fault and "decode_head" in choice.fault


@pytest.fixture(scope="module")
def state() -> dict[str, np.ndarray]:
    """What segmentation_models_pytorch would save of a network of two classes."""
    return exported(ARCHITECTURE, ROWS, tables.TORCH)


@pytest.fixture(scope="module")
def plain(state, tmp_path_factory):
    path = tmp_path_factory.mktemp("plain") / "a.safetensors"
    save_file(state, path)
    return import_weights(path, classes=ARCHITECTURE.classes)


def wrapped(state, prefix):
    return {prefix + name: value for name, value in state.items()}


def lightning(state):
    beside = {"mean": np.zeros((1, 3, 1, 1), np.float32), "std": np.ones((1, 3, 1, 1), np.float32)}
    return {"epoch": 9, "state_dict": wrapped(state, "model.") | beside, "hyper_parameters": {"arch": "DeepLabV3Plus"}}


FORMS = {
    "lightning": lightning,
    "compiled": lambda state: wrapped(state, "_orig_mod."),
    "lightning, compiled": lambda state: {"state_dict": wrapped(state, "model._orig_mod.")},
    "trainer": lambda state: {"model_state_dict": state, "optimizer_state_dict": {"state": {0: {"exp_avg": state}}}},
    "nested": lambda state: {"checkpoint": {"model": wrapped(state, "module.")}, "epoch": 3},
    "averaged": lambda state: {"ema": wrapped(state, "module."), "model": state},
}


@pytest.mark.parametrize("form", FORMS)
def test_wrapped_networks_give_the_same_model(form, state, plain, tmp_path):
    imported = import_weights(write_torch(tmp_path / "a.ckpt", FORMS[form](state)), classes=ARCHITECTURE.classes)
    assert imported.architecture == plain.architecture and "the network is what lies under" in imported.notes[0]
    assert all(np.array_equal(imported.weights[name], value) for name, value in plain.weights.items())


def test_bfloat16_is_read(state, plain, tmp_path):
    path = write_torch(tmp_path / "a.pth", {name: bfloat16(value) for name, value in state.items()})
    for name, value in import_weights(path).weights.items():
        np.testing.assert_allclose(value, plain.weights[name], rtol=2**-7)


def write_bfloat16(path, tensors):
    """A safetensors file of bfloat16, by hand."""
    header, data = {}, b""
    for name, value in tensors.items():
        bits = bfloat16(value).tobytes()
        header[name] = {"dtype": "BF16", "shape": value.shape, "data_offsets": [len(data), len(data) + len(bits)]}
        data += bits
    text = json.dumps(header).encode()
    path.write_bytes(len(text).to_bytes(8, "little") + text + data)


def write_shards(folder, state, write=save_file):
    names, shards = sorted(state), ("model-00001-of-00002.safetensors", "model-00002-of-00002.safetensors")
    places = {name: shards[index % 2] for index, name in enumerate(names)}
    for shard in shards:
        write({name: state[name] for name in names if places[name] == shard}, folder / shard)
    index = folder / "model.safetensors.index.json"
    index.write_text(json.dumps({"metadata": {}, "weight_map": places}))
    return index


def test_shards_and_bfloat16_in_safetensors(state, plain, tmp_path):
    index = write_shards(tmp_path, state, lambda tensors, path: write_bfloat16(path, tensors))
    for path in (index, tmp_path, tmp_path / "model-00002-of-00002.safetensors"):
        for name, value in import_weights(path).weights.items():
            np.testing.assert_allclose(value, plain.weights[name], rtol=2**-7)
    (tmp_path / "model-00001-of-00002.safetensors").unlink()
    with pytest.raises(JaxmapError, match="1 of 2 shards are missing: model-00001"):
        import_weights(index)


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"weight_map": {"a": "../b"}}', '{"weight_map": {}}', "[" * 10**5])
def test_a_damaged_index_is_one_line(text, tmp_path):
    index = tmp_path / "model.safetensors.index.json"
    index.write_text(text)
    with pytest.raises(JaxmapError, match="no index of shards|not readable as JSON"):
        import_weights(index)

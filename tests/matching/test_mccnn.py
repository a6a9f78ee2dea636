"""The cost network: it is MC-CNN's fast one, its costs are cosines, and other files are refused."""

from __future__ import annotations

import builtins
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from safetensors.numpy import save_file
from torch_zip import write_torch

from jaxmap.errors import JaxmapError, UsageError
from jaxmap.matching import mccnn
from jaxmap.matching.correlation import correlate
from jaxmap.matching.mccnn import (
    CostNetwork,
    cost_network,
    feature_costs,
    image_features,
    load_cost_network,
    save_cost_network,
)

RNG = np.random.default_rng(4)
IMAGE = RNG.integers(0, 255, (23, 31)).astype(np.uint8)


def random_tensors(*, depthwise: bool = False, channels: int = 4, layers: int = 3) -> dict[str, np.ndarray]:
    """Weights of a small network, under the names of the package."""
    shapes: dict[str, tuple[int, ...]] = {}
    for layer in range(layers):
        inputs = 1 if layer == 0 else channels
        if depthwise:
            shapes[f"conv_blocks.{3 * layer}"] = (inputs, 1, 3, 3)
            shapes[f"conv_blocks.{3 * layer + 1}"] = (channels, inputs, 1, 1)
        else:
            shapes[f"conv_blocks.{2 * layer}"] = (channels, inputs, 3, 3)
    weights = {f"{name}.weight": RNG.normal(size=shape).astype(np.float32) for name, shape in shapes.items()}
    return weights | {f"{name}.bias": RNG.normal(size=shape[0]).astype(np.float32) for name, shape in shapes.items()}


def reference_features(network: CostNetwork, image: np.ndarray) -> np.ndarray:
    """The features by the definition, pixel by pixel, where the network sees nothing beyond the image."""
    grey = image.astype(np.float64)
    values = ((grey - grey.mean()) / grey.std())[..., None]
    for number, layer in enumerate(network):
        values = np.maximum(values, 0.0) if number else values
        for kernel, bias in (map(np.asarray, part) for part in layer):
            edge, inputs = kernel.shape[0], values.shape[-1]
            dense = kernel if kernel.shape[2] == inputs else np.eye(inputs)[None, None] * kernel
            windows = np.lib.stride_tricks.sliding_window_view(values, (edge, edge), axis=(0, 1))
            values = np.einsum("hwcij,ijco->hwo", windows, dense) + bias
    return values / np.linalg.norm(values, axis=-1, keepdims=True)


def same(ours: CostNetwork, other: CostNetwork) -> bool:
    return jax.tree.structure(ours) == jax.tree.structure(other) and all(
        np.array_equal(one, two) for one, two in zip(jax.tree.leaves(ours), jax.tree.leaves(other), strict=True)
    )


@pytest.mark.parametrize("depthwise", [False, True])
def test_features_are_those_of_the_definition(depthwise):
    network = cost_network(random_tensors(depthwise=depthwise), "test")
    features = np.asarray(image_features(network, jnp.asarray(IMAGE)))
    assert features.shape == (*IMAGE.shape, 4)
    np.testing.assert_allclose(features[3:-3, 3:-3], reference_features(network, IMAGE), atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(features, axis=-1), 1.0, atol=1e-5)


def test_brightness_and_contrast_do_not_matter():
    network = cost_network(random_tensors(), "test")
    features = image_features(network, jnp.asarray(IMAGE, jnp.float32))
    np.testing.assert_allclose(image_features(network, jnp.asarray(IMAGE * 0.3 + 40.0)), features, atol=1e-4)


@pytest.mark.slow
def test_a_blank_image_has_features_and_gradients():
    network = cost_network(random_tensors(), "test")
    gradient = jax.jit(jax.grad(lambda net, image: image_features(net, image)[..., 0].sum(), argnums=(0, 1)))
    for leaf in jax.tree.leaves(gradient(network, jnp.full((9, 12), 7.0))):
        assert np.isfinite(leaf).all()


@pytest.mark.parametrize("least", [0, -7, 5])
@pytest.mark.parametrize("width", [30, pytest.param(150, marks=pytest.mark.slow)])
def test_products_are_those_of_the_definition(width, least):
    left, right = (RNG.normal(size=(3, width, 5)).astype(np.float32) for _ in range(2))
    products = correlate(jnp.asarray(left), jnp.asarray(right), least, 12)
    for column, step in np.ndindex(width, 12):
        other = np.clip(column - step - least, 0, width - 1)
        expected = (left[:, column] * right[:, other]).sum(-1)
        np.testing.assert_allclose(products[:, column, step], expected, atol=1e-5)


def test_costs_are_least_where_the_images_agree():
    network = cost_network(random_tensors(), "test")
    shifted = np.roll(IMAGE, -3, axis=1)
    costs = np.asarray(feature_costs(network, jnp.asarray(IMAGE), jnp.asarray(shifted), 0, 6))
    assert ((costs >= 0) & (costs <= 1)).all()
    np.testing.assert_allclose(costs[3:-3, 9:-6, 3], 0.0, atol=1e-6)
    assert (costs[3:-3, 9:-6].argmin(-1) == 3).mean() > 0.95


@pytest.mark.parametrize("depthwise", [False, True])
def test_files_of_pytorch_and_safetensors_are_read(tmp_path, depthwise):
    tensors = random_tensors(depthwise=depthwise)
    network = cost_network(tensors, "test")
    save_file(tensors, tmp_path / "plain.safetensors")
    nested = {"epoch": 3, "model": {f"module.{name}": value for name, value in tensors.items()}}
    write_torch(tmp_path / "checkpoint.pt", nested | {"optimizer": {"conv_blocks.0": RNG.normal(size=3)}})
    save_cost_network(network, tmp_path / "saved.safetensors")
    assert same(load_cost_network(tmp_path / "saved.safetensors"), network)
    assert same(load_cost_network(tmp_path / "plain.safetensors"), network)
    assert same(load_cost_network(tmp_path / "checkpoint.pt"), network)


def test_a_file_of_onnx_is_read(tmp_path):
    onnx = pytest.importorskip("onnx", reason="no onnx")
    tensors = random_tensors(depthwise=True)
    held = [onnx.numpy_helper.from_array(value, name) for name, value in tensors.items()]
    held.append(onnx.numpy_helper.from_array(np.array([2]), "axes"))
    onnx.save(onnx.helper.make_model(onnx.helper.make_graph([], "g", [], [], held)), tmp_path / "net.onnx")
    assert same(load_cost_network(tmp_path / "net.onnx"), cost_network(tensors, "test"))
    (tmp_path / "cut.onnx").write_bytes((tmp_path / "net.onnx").read_bytes()[:200])
    for name in ("cut", "absent"):
        with pytest.raises(JaxmapError, match=rf"{name}\.onnx"):
            load_cost_network(tmp_path / f"{name}.onnx")


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (lambda held: held.clear(), "0 convolutions"),
        (lambda held: held.pop("conv_blocks.2.bias"), r"no conv_blocks\.2\.bias"),
        (lambda held: [held.pop(f"conv_blocks.2.{part}") for part in ("weight", "bias")], "nothing between"),
        (lambda held: held.update({"conv_blocks.0.weight": np.zeros((4, 3, 3, 3), np.float32)}), "from 1 channels"),
        (lambda held: held["conv_blocks.2.weight"].fill(np.nan), r"conv_blocks\.2\.weight is not finite"),
    ],
)
def test_other_networks_are_refused(spoil, told):
    tensors = random_tensors()
    spoil(tensors)
    with pytest.raises(JaxmapError, match=f"{told}.* in somewhere"):
        cost_network(tensors, "somewhere")


def test_without_the_package_it_says_how_to_get_it(monkeypatch):
    monkeypatch.setattr(mccnn, "_MODULE", "no_such_module_anywhere")
    with pytest.raises(UsageError, match=r"jaxmap\[mccnn\].*--stereo.cost-network"):
        load_cost_network()


def test_without_onnx_it_says_how_to_get_it(monkeypatch, tmp_path):
    real = builtins.__import__

    def without(name, *rest, **more):
        if name.split(".")[0] == "onnx":
            raise ImportError(name)
        return real(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(UsageError, match=r"jaxmap\[mccnn\]"):
        load_cost_network(tmp_path / "net.onnx")


def packaged(name: str) -> Path:
    weights = pytest.importorskip("mc_cnn.weights", reason="the package mccnn is not installed")
    return Path(weights.__file__).parent / name


@pytest.mark.slow
@pytest.mark.parametrize("name", ["mc_cnn_fast_dw.onnx", "mc_cnn_fast_mb_weights.pt"])
def test_features_are_those_of_the_package(name):
    path = packaged(name)
    if path.suffix == ".pt":
        pytest.importorskip("torch", reason="the package reads this file with PyTorch, which is not installed")
    from mc_cnn.inference_engine import inference_engine_onnx, inference_engine_pytorch  # noqa: F401
    from mc_cnn.inference_engine.inference_engine_base import AbstractInferenceEngine

    kind = {"inference_method": path.suffix[1:], "model_path": str(path), "device": "cpu", "window_size": 11}
    engine: AbstractInferenceEngine = AbstractInferenceEngine(kind)  # type: ignore[abstract]
    theirs = engine.inference_func(engine.normalize(IMAGE.astype(np.float32)))
    ours = image_features(load_cost_network(path), jnp.asarray(IMAGE))
    np.testing.assert_allclose(np.asarray(ours)[5:-5, 5:-5], np.moveaxis(theirs, 0, -1), atol=1e-4)


@pytest.mark.slow
def test_the_packages_network_in_small_integers_is_refused():
    path = packaged("mc_cnn_fast_int8_excl_01.onnx")
    pytest.importorskip("onnx", reason="no onnx")
    with pytest.raises(JaxmapError, match=r"no conv_blocks\.4\.weight"):
        load_cost_network(path)

"""Every public form of weights is recognised and converted; all that does not fit is one error."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from golden.seeded_weights import exported, seeded_weights
from safetensors.numpy import save_file
from torch_legacy import legacy_bytes

from jaxmap.errors import JaxmapError
from jaxmap.models import import_tables as tables
from jaxmap.models.architecture import (
    Architecture,
    tf_architecture,
    torch_architecture,
    torchvision_architecture,
)
from jaxmap.models.importers import VOC_CLASSES, convert, import_weights
from jaxmap.models.network import weight_shapes

DEEP, DEEPEST = (pytest.param(name, marks=pytest.mark.slow) for name in ("resnet50", "resnet101"))


def same(ours: dict[str, np.ndarray], architecture: Architecture, holds: str) -> bool:
    expected = seeded_weights(architecture)
    names = [name for name in expected if holds == "network" or name.startswith("backbone.")]
    return set(ours) == set(names) and all(np.array_equal(ours[name], expected[name]) for name in names)


@pytest.mark.parametrize("backbone", ["mobilenet_v2", "resnet18", DEEP, DEEPEST])
def test_torchvision_backbones(backbone, tmp_path):
    architecture = torch_architecture(backbone, ("background", "sand", "rock"))
    source = exported(architecture, list(tables.torchvision_backbone(backbone)), tables.TORCH)
    source["classifier.1.weight" if backbone == "mobilenet_v2" else "fc.weight"] = np.zeros((10, 4), np.float32)
    save_file({f"module.{name}": value for name, value in source.items()}, tmp_path / "a.safetensors")
    imported = import_weights(tmp_path / "a.safetensors")
    assert imported.architecture == architecture and imported.holds == "backbone"
    assert same(imported.weights, architecture, "backbone")


def timm_mobilenet_names() -> dict[str, tuple[int, ...]]:
    """Names and shapes of timm's `mobilenetv2_100`, written from its published layout, not from our table."""
    shapes: dict[str, tuple[int, ...]] = {}

    def add(convolution: str, norm: str, *shape: int) -> None:
        shapes[f"{convolution}.weight"] = shape
        for leaf in ("weight", "bias", "running_mean", "running_var"):
            shapes[f"{norm}.{leaf}"] = (shape[0],)
        shapes[f"{norm}.num_batches_tracked"] = ()

    add("conv_stem", "bn1", 32, 3, 3, 3)
    add("blocks.0.0.conv_dw", "blocks.0.0.bn1", 32, 1, 3, 3)
    add("blocks.0.0.conv_pw", "blocks.0.0.bn2", 16, 32, 1, 1)
    before = 16
    for stage, (after, units) in enumerate(((24, 2), (32, 3), (64, 4), (96, 3), (160, 3), (320, 1)), start=1):
        for unit in range(units):
            block, wide = f"blocks.{stage}.{unit}", 6 * before
            add(f"{block}.conv_pw", f"{block}.bn1", wide, before, 1, 1)
            add(f"{block}.conv_dw", f"{block}.bn2", wide, 1, 3, 3)
            add(f"{block}.conv_pwl", f"{block}.bn3", after, wide, 1, 1)
            before = after
    add("conv_head", "bn2", 1280, 320, 1, 1)
    return shapes | {"classifier.weight": (1000, 1280), "classifier.bias": (1000,)}


def test_the_names_of_timm_are_covered():
    shapes = timm_mobilenet_names()
    architecture = torch_architecture("mobilenet_v2", ("a",))
    state = {name: np.zeros(shape, np.float32) for name, shape in shapes.items()}
    rows = list(tables.timm_mobilenet_v2())
    converted = convert(
        state, rows, tables.TORCH, architecture, holds="backbone", where="timm", ignored=("classifier.",)
    )
    assert all(name.startswith("backbone.") for name in converted)
    with pytest.raises(JaxmapError, match=r"2 left over: classifier\.weight, classifier\.bias"):
        convert(state, rows, tables.TORCH, architecture, holds="backbone", where="timm")


def test_timm_calls_resnets_as_torchvision_does_and_names_what_is_missing(tmp_path):
    backbone = "resnet18"
    architecture = torch_architecture(backbone, ("background", "sand", "rock"))
    source = exported(architecture, list(tables.torchvision_backbone(backbone)), tables.TORCH)
    source |= {"fc.weight": np.zeros((10, 4), np.float32), "fc.bias": np.zeros(10, np.float32)}
    save_file(source, tmp_path / "a.safetensors")
    assert same(import_weights(tmp_path / "a.safetensors").weights, architecture, "backbone")
    # resnet50d of timm has a stem of three convolutions.
    stem = source.pop("conv1.weight")
    source |= {"conv1.0.weight": stem[:32, :, :3, :3], "conv1.3.weight": np.zeros((32, 32, 3, 3), np.float32)}
    save_file({name: np.ascontiguousarray(value) for name, value in source.items()}, tmp_path / "d.safetensors")
    with pytest.raises(JaxmapError, match=r"1 missing: conv1\.weight; 2 left over: conv1\.0\.weight, conv1\.3\.weight"):
        import_weights(tmp_path / "d.safetensors")


@pytest.mark.parametrize(
    ("backbone", "stride"), [("resnet50", None), pytest.param("resnet101", 16, marks=pytest.mark.slow)]
)
def test_torchvision_networks(backbone, stride, tmp_path):
    architecture = torchvision_architecture(backbone, VOC_CLASSES, output_stride=stride or 8)
    rows = [*tables.torchvision_backbone(backbone, "backbone."), *tables.torchvision_head(architecture)]
    source = exported(architecture, rows, tables.TORCH)
    source["aux_classifier.0.weight"] = np.zeros((256, 1024, 3, 3), np.float32)
    save_file(source, tmp_path / "a.safetensors")
    imported = import_weights(tmp_path / "a.safetensors", output_stride=stride)
    assert imported.architecture == architecture and same(imported.weights, architecture, "network")
    assert imported.architecture.atrous_rates == ((12, 24, 36) if stride is None else (6, 12, 18))


def exported_shapes(architecture: Architecture, rows: list[tables.Row]) -> dict[str, tuple[int, ...]]:
    zeros = {name: np.zeros(shape, np.float32) for name, shape in weight_shapes(architecture).items()}
    return {name: value.shape for name, value in exported(architecture, rows, tables.TORCH, zeros).items()}


@pytest.mark.realdata
def test_torchvision_names_agree_with_the_published_list(realdata):
    file = realdata / "weights" / "state_dict_names" / "torchvision_deeplabv3_resnet50.txt"
    if not file.exists():
        pytest.skip(f"no {file}")
    architecture = torchvision_architecture("resnet50", VOC_CLASSES)
    rows = [*tables.torchvision_backbone("resnet50", "backbone."), *tables.torchvision_head(architecture)]
    ours = {name: str(shape) for name, shape in exported_shapes(architecture, rows).items()}
    lines = [line.split("\t") for line in file.read_text().splitlines()]
    assert ours == {name: shape for name, shape, _ in lines if not name.startswith("aux_classifier.")}


def test_timm_mobilenet(tmp_path):
    architecture = torch_architecture("mobilenet_v2", ("background", "sand", "rock"))
    save_file(exported(architecture, list(tables.timm_mobilenet_v2()), tables.TORCH), tmp_path / "a.safetensors")
    imported = import_weights(tmp_path / "a.safetensors")
    assert "timm" in imported.source and same(imported.weights, architecture, "backbone")


def efficientnet_names() -> dict[str, tuple[int, ...]]:
    """Names and shapes of the published EfficientNet-Lite0, written from its design, not from our table."""
    shapes: dict[str, tuple[int, ...]] = {}

    def add(convolution: str, norm: str, *shape: int) -> None:
        shapes[f"{convolution}.weight"] = shape
        shapes.update({f"{norm}.{leaf}": shape[:1] for leaf in ("weight", "bias", "running_mean", "running_var")})
        shapes[f"{norm}.num_batches_tracked"] = ()

    add("_conv_stem", "_bn0", 32, 3, 3, 3)
    before, unit = 32, 0
    for after, units, size in (
        *((16, 1, 3), (24, 2, 3), (40, 2, 5), (80, 3, 3), (112, 3, 5), (192, 4, 5), (320, 1, 3)),
    ):
        for _ in range(units):
            block, wide = f"_blocks.{unit}", before * (6 if unit else 1)
            if unit:
                add(f"{block}._expand_conv", f"{block}._bn0", wide, before, 1, 1)
            add(f"{block}._depthwise_conv", f"{block}._bn1", wide, 1, size, size)
            add(f"{block}._project_conv", f"{block}._bn2", after, wide, 1, 1)
            before, unit = after, unit + 1
    add("_conv_head", "_bn1", 1280, 320, 1, 1)
    return shapes | {"_fc.weight": (1000, 1280), "_fc.bias": (1000,)}


def test_efficientnet_lite0_in_the_old_format_of_torch(tmp_path):
    state = {name: np.full(shape, 0.5, np.float32) for name, shape in efficientnet_names().items()}
    state["_fc.weight"] = np.zeros((4, 1280), np.float32)
    state["_conv_stem.weight"][3, 2, 1, 0] = 7
    (tmp_path / "a.pth").write_bytes(legacy_bytes(state))
    imported = import_weights(tmp_path / "a.pth", classes=("sand", "rock"), output_stride=8)
    assert imported.architecture == torch_architecture("efficientnet_lite0", ("sand", "rock"), output_stride=8)
    assert imported.holds == "backbone" and imported.weights["backbone.stem.kernel"][1, 0, 2, 3] == 7


@pytest.mark.parametrize("backbone", ["mobilenet_v2", "resnet18"])
def test_smp_networks(backbone, tmp_path):
    architecture = torch_architecture(backbone, ("a", "b"), output_stride=8)
    rows = [*tables.torchvision_backbone(backbone, "encoder."), *tables.smp_head(architecture)]
    save_file(exported(architecture, rows, tables.TORCH), tmp_path / "a.safetensors")
    imported = import_weights(tmp_path / "a.safetensors", classes=("a", "b"), output_stride=8)
    assert imported.architecture == architecture and same(imported.weights, architecture, "network")
    assert import_weights(tmp_path / "a.safetensors").architecture.classes == ("class_0", "class_1")
    with pytest.raises(JaxmapError, match="3 classes are named, the network has 2"):
        import_weights(tmp_path / "a.safetensors", classes=("a", "b", "c"))


def test_tensorflow_networks(tmp_path):
    voc = replace(tf_architecture("mobilenet_v2", VOC_CLASSES, decoder=False), backbone_norm=False, head_norm=False)
    rows = [*tables.tf_folded_mobilenet_v2(top=False), *tables.tf_folded_head()]
    save_file(exported(voc, rows, tables.TENSORFLOW), tmp_path / "a.safetensors")
    imported = import_weights(tmp_path / "a.safetensors")
    assert imported.architecture == voc and same(imported.weights, voc, "network")


@pytest.mark.slow
def test_names_agree_with_the_published_lists(realdata):
    folder = realdata / "weights" / "state_dict_names"
    if not folder.is_dir():
        pytest.skip(f"no {folder}")
    for backbone in ("mobilenet_v2", "resnet18", "resnet50"):
        architecture = torch_architecture(backbone, ("a", "b", "c"))
        for prefix, head, file in (
            ("", [], f"torchvision_{backbone}.txt"),
            ("encoder.", tables.smp_head(architecture), f"smp060_DeepLabV3Plus_{backbone}.txt"),
        ):
            rows = [*tables.torchvision_backbone(backbone, prefix), *head]
            ours = exported_shapes(architecture, rows)
            lines = [line.split("\t") for line in (folder / file).read_text().splitlines()]
            theirs = {name: shape for name, shape, _ in lines if not name.startswith(("fc.", "classifier."))}
            assert {name: str(shape) for name, shape in ours.items()} == theirs


def test_everything_wrong_is_one_error(tmp_path):
    architecture = torch_architecture("resnet18", ("a",))
    source = exported(architecture, list(tables.torchvision_backbone("resnet18")), tables.TORCH)
    del source["bn1.running_mean"]
    source["conv1.weight"] = np.zeros((64, 1, 7, 7), np.float32)
    source["layer9.weight"] = np.zeros(2, np.float32)
    save_file(source, tmp_path / "a.safetensors")
    with pytest.raises(JaxmapError) as caught:
        import_weights(tmp_path / "a.safetensors")
    for word in (
        "missing: bn1.running_mean",
        "left over: layer9.weight",
        "conv1.weight gives [7, 7, 1, 64], not [7, 7, 3, 64]",
    ):
        assert word in str(caught.value)


def test_unknown_networks_are_refused(tmp_path):
    save_file({"a.weight": np.zeros(3, np.float32)}, tmp_path / "a.safetensors")
    with pytest.raises(JaxmapError, match="no known kind"):
        import_weights(tmp_path / "a.safetensors")
    names = [f"layer{stage}.{unit}.conv1.weight" for stage in (1, 2, 3, 4) for unit in range(3)]
    save_file({name: np.zeros(1, np.float32) for name in names}, tmp_path / "a.safetensors")
    with pytest.raises(JaxmapError, match=r"3\+3\+3\+3 basic units"):
        import_weights(tmp_path / "a.safetensors")


@pytest.mark.slow
def test_tables_name_every_block_once():
    for backbone in ("mobilenet_v2", "resnet18", "resnet50", "resnet101"):
        architecture = torch_architecture(backbone, ("a",))
        rows = [*tables.torchvision_backbone(backbone), *tables.smp_head(architecture)]
        blocks = {name.rpartition(".")[0].removesuffix(".norm") for name in weight_shapes(architecture)}
        assert sorted(row.block for row in rows) == sorted(blocks)

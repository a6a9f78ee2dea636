"""Files of weights that are not read say what they are, and what to do."""

from __future__ import annotations

import zipfile

import pytest

from jaxmap.errors import JaxmapError
from jaxmap.models.checkpoint import load_model
from jaxmap.models.importers import import_weights

CONTENTS = {
    "model.h5": (b"\x89HDF\r\n\x1a\n" + bytes(50), "HDF5 file"),
    "renamed.safetensors": (b"\x89HDF\r\n\x1a\n" + bytes(50), "HDF5 file"),
    "renamed.pth": (b"\x89HDF\r\n\x1a\n" + bytes(50), "HDF5 file"),
    "net.onnx": (b"\x08\x08\x12\x07pytorch", "ONNX"),
    "frozen.pb": (b"\n\x0c\n\x05input", "TensorFlow graph"),
    "net.tflite": (b"\x1c\0\0\0TFL3" + bytes(40), "TensorFlow Lite"),
    "model.ckpt.data-00000-of-00001": (bytes(100), "TensorFlow checkpoint"),
    "net.engine": (b"ftrt" + bytes(40), "TensorRT"),
    "pointer.safetensors": (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n", "git lfs pull"),
    "page.pth": (b"<!DOCTYPE html><html>404</html>", "web page"),
    "packed.pth": (b"\x1f\x8b\x08" + bytes(50), "gzip"),
}


@pytest.mark.parametrize("name", CONTENTS)
@pytest.mark.parametrize("read", [import_weights, load_model])
def test_what_is_not_read_is_named(read, name, tmp_path):
    content, what = CONTENTS[name]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(JaxmapError) as caught:
        read(tmp_path / name)
    assert what in str(caught.value) and "truncated" not in str(caught.value) and len(str(caught.value)) < 400


@pytest.mark.parametrize(
    ("members", "what"),
    [
        (("metadata.json", "config.json", "model.weights.h5"), "Keras"),
        (("net/data.pkl", "net/constants.pkl", "net/code/__torch__.py"), "TorchScript"),
        (("conv.npy", "bias.npy"), "NumPy arrays"),
    ],
)
def test_archives_that_are_no_state_dicts_are_named(members, what, tmp_path):
    with zipfile.ZipFile(tmp_path / "net.pt", "w") as archive:
        for name in members:
            archive.writestr(name, b"")
    with pytest.raises(JaxmapError, match=what):
        import_weights(tmp_path / "net.pt")


def test_a_saved_model_of_tensorflow_is_named(tmp_path):
    (tmp_path / "saved_model.pb").write_bytes(b"\x08\x01")
    with pytest.raises(JaxmapError, match="SavedModel"):
        import_weights(tmp_path)


def test_a_pytorch_file_is_no_model_yet(tmp_path):
    (tmp_path / "net.pth").write_bytes(b"\x80\x02}.")
    with pytest.raises(JaxmapError, match="jaxmap weights import"):
        load_model(tmp_path / "net.pth")

"""`jaxmap weights`: public checkpoints are fetched, checked, kept and converted."""

from __future__ import annotations

import hashlib
import re
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest
from fixtures import cli, shared_cache  # noqa: F401
from golden.seeded_weights import exported
from PIL import Image
from safetensors.numpy import save_file

from jaxmap.models import import_tables as tables
from jaxmap.models.architecture import torch_architecture
from jaxmap.models.checkpoint import load_model
from jaxmap.runs import weights as weight_files


@pytest.fixture
def server(tmp_path):
    """A folder that is served, and its URL."""
    folder = tmp_path / "served"
    folder.mkdir()

    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, *words):
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(folder))) as running:
        threading.Thread(target=running.serve_forever, daemon=True).start()
        yield folder, f"http://127.0.0.1:{running.server_port}"
        running.shutdown()


def test_weights_are_fetched_checked_and_kept(cli, server, tmp_path, monkeypatch):
    pytest.importorskip("pooch")
    monkeypatch.setenv("JAXMAP_CACHE", str(tmp_path / "cache"))
    folder, url = server
    architecture = torch_architecture("resnet18", ("background", "sand", "rock"))
    source = folder / "resnet18.safetensors"
    save_file(exported(architecture, list(tables.torchvision_backbone("resnet18")), tables.TORCH), source)
    digest = hashlib.sha256(source.read_bytes()).hexdigest()
    public = {
        name: weight_files.PublicWeights(f"https://no.invalid/{file}", checksum, "")
        for name, file, checksum in (
            ("good", source.name, digest[:8]),
            ("whole", source.name, digest),
            ("wrong", source.name, "0" * 8),
            ("gone", "nothing.pth", digest),
        )
    }
    monkeypatch.setattr(weight_files, "PUBLIC", public)
    words = ("--out", tmp_path / "m.safetensors", "--mirror", url)
    outcome = cli("weights", "fetch", "good", *words)
    assert outcome.status == 0 and "downloading" in outcome.err
    assert load_model(tmp_path / "m.safetensors").holds == "backbone"
    source.write_bytes(b"changed")
    assert "downloading" not in cli("weights", "fetch", "whole", *words).err, "the cache is used"
    assert "should start with 00000000" in cli("weights", "fetch", "wrong", *words).error
    assert not (tmp_path / "cache" / "weights" / source.name).exists()
    assert "download failed" in cli("weights", "fetch", "whole", *words).error
    assert "download failed" in cli("weights", "fetch", "gone", *words).error
    assert "known are good" in cli("weights", "fetch", "other", *words).error


def test_the_table_of_public_weights_is_well_formed():
    for public in weight_files.PUBLIC.values():
        assert public.url.startswith("https://") and re.fullmatch("[0-9a-f]{64}", public.sha256)
        assert public.url.endswith(f"-{public.sha256[:8]}.pth")


@pytest.mark.slow
@pytest.mark.realdata
def test_weights_import_and_segment_label_the_cat(cli, realdata, tmp_path):
    import skimage

    source = realdata / "weights" / "deeplabv3_mnv2_voc_trainval_folded.safetensors"
    if not source.exists():
        pytest.skip(f"no {source}")
    assert cli("weights", "import", source, "--out", tmp_path / "voc.safetensors").status == 0
    Image.fromarray(skimage.data.chelsea()).save(tmp_path / "chelsea.png")
    words = ("segment", tmp_path / "chelsea.png", "--model", tmp_path / "voc.safetensors", "--out", tmp_path / "out")
    assert cli(*words).status == 0
    assert 0.75 <= (np.asarray(Image.open(tmp_path / "out" / "chelsea.png")) == 8).mean() <= 0.83

"""Options of workers that do not go together are refused in one line, before anything is read or written."""

from __future__ import annotations

import sys

import pytest
from fixtures import cli, scene_folder, shared_cache  # noqa: F401


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (("--resume", "--update"), "--resume and --update exclude each other; give one of them"),
        (
            ("--workers", "2", "--scheduler", "tcp://x:1"),
            "--workers and --scheduler exclude each other; ",
        ),
        (("--workers", "0"), "--workers is 0: "),
        (("--workers", "2", "--profile"), "workers are not profiled in --profile; "),
        (("--update",), "--update brings a map of observations up to date in "),
        (
            ("--workers", "2", "--poses", "odometry"),
            "poses from images are found one frame after the other in ",
        ),
    ],
)
def test_options_that_do_not_go_together(cli, scene_folder, tmp_path, words, line):
    done = cli("map", scene_folder, "--out", tmp_path / "run", *words)
    assert done.status == 2
    assert f"error: {line}" in done.err
    assert not (tmp_path / "run").exists()


def test_perceiving_refuses_poses_of_the_images_and_asks_for_dask(cli, scene_folder, tmp_path, monkeypatch):
    words = ("perceive", scene_folder, "--labeller", "plane", "--out", tmp_path / "seen")
    done = cli(*words, "--workers", "2", "--poses", "odometry")
    assert done.status == 2 and "poses from images" in done.err
    monkeypatch.setitem(sys.modules, "distributed", None)
    done = cli(*words, "--scheduler", "tcp://127.0.0.1:1")
    assert done.status == 1 and "pip install 'jaxmap[cluster]'" in done.err

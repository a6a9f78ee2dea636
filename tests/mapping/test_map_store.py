"""The map on disk: what is saved is loaded, and nothing that goes wrong loses the map before."""

from __future__ import annotations

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import jaxmap
from jaxmap.errors import JaxmapError
from jaxmap.host.files import atomic_path
from jaxmap.mapping import store as map_store
from jaxmap.mapping.store import MapAttributes, load_map, save_map
from jaxmap.types import GridSpec, VoxelMap


class Killed(BaseException):
    """Stands for the death of the process: nothing handles it."""


def small_map(
    value: float = 1.0, classes: tuple[str, ...] = ("sand", "rock"), shape=(5, 4, 3), frames: int = 7
) -> VoxelMap:
    grid = GridSpec(
        lattice_m=jnp.array([-1.1, 0.3, 1e-3], jnp.float32),
        voxel_size_m=jnp.array([0.1, 0.2, 0.3], jnp.float32),
        shape=shape,
    )
    log_odds = np.zeros((1 + len(classes), *shape), np.float32)
    log_odds[:, 1:3, 2, 1] = value
    return VoxelMap(jnp.asarray(log_odds), jnp.asarray(frames, jnp.int32), grid, classes)


def assert_equal(first: VoxelMap, second: VoxelMap) -> None:
    assert first.classes == second.classes and first.grid.shape == second.grid.shape
    assert int(first.frames_fused) == int(second.frames_fused)
    for a, b in (
        (first.log_odds, second.log_odds),
        (first.grid.origin_m, second.grid.origin_m),
        (first.grid.voxel_size_m, second.grid.voxel_size_m),
    ):
        assert a.dtype == b.dtype and np.asarray(a).tobytes() == np.asarray(b).tobytes()


def leftovers(folder: Path) -> list[str]:
    return sorted(p.name for p in folder.iterdir() if p.name != "map.zarr")


finite = st.floats(-1e6, 1e6, width=32)


@settings(max_examples=25, deadline=None)
@given(
    shape=st.tuples(*[st.integers(1, 6)] * 3),
    classes=st.lists(st.text(min_size=1, max_size=5), max_size=4, unique=True),
    origin=st.tuples(finite, finite, finite),
    size=st.tuples(*[st.floats(2**-10, 10, width=32)] * 3),
    site=st.tuples(*[st.floats(-1e7, 1e7)] * 3),
    crs=st.none() | st.just("EPSG:32631"),
    seed=st.integers(0, 2**31),
)
def test_what_is_saved_is_loaded(tmp_path_factory, shape, classes, origin, size, site, crs, seed) -> None:
    rng = np.random.default_rng(seed)
    log_odds = rng.normal(size=(1 + len(classes), *shape)) * (rng.random(shape) < 0.3)
    grid = GridSpec(jnp.array(origin, jnp.float32), jnp.array(size, jnp.float32), shape)
    voxel_map = VoxelMap(jnp.asarray(log_odds, jnp.float32), jnp.asarray(seed % 1000, jnp.int32), grid, tuple(classes))
    attributes = MapAttributes(
        crs=crs,
        site_origin=np.array(site),
        T_world_source=rng.normal(size=(4, 4)),
        fusion={"params": {"class_prior": [0.5, 0.25]}, "rule": {"carve": True}},
        progress={"complete": False, "next_frame": 12},
    )
    path = tmp_path_factory.mktemp("maps") / "map.zarr"
    save_map(path, voxel_map, attributes)
    loaded, read = load_map(path)
    assert_equal(voxel_map, loaded)
    assert read.crs == crs and read.fusion == attributes.fusion and read.progress == attributes.progress
    assert read.site_origin.tobytes() == attributes.site_origin.tobytes()
    assert read.T_world_source.tobytes() == attributes.T_world_source.tobytes()
    assert leftovers(path.parent) == []


def test_the_group_is_laid_out_as_documented(tmp_path) -> None:
    import zarr

    save_map(tmp_path / "map.zarr", small_map(), MapAttributes())
    group = zarr.open_group(tmp_path / "map.zarr", mode="r")
    assert group.metadata.zarr_format == 3
    assert group["log_odds"].shape == (3, 5, 4, 3) and group["log_odds"].dtype == np.float32
    documented = "format_version classes voxel_size_m origin_m shape crs site_origin T_world_source frames_fused fusion"
    assert set(documented.split()) <= set(group.attrs)
    assert group.attrs["format_version"] == 1 and group.attrs["crs"] is None


def test_saving_again_replaces(tmp_path) -> None:
    path = tmp_path / "run" / "map.zarr"
    for value in (1.0, 2.0, 3.0):
        save_map(path, small_map(value), MapAttributes())
        assert_equal(load_map(path)[0], small_map(value))
    assert leftovers(path.parent) == []


@pytest.mark.parametrize("step", range(6))
@pytest.mark.parametrize("again", [True, False])
def test_a_death_at_any_step_leaves_a_map(tmp_path, monkeypatch, step, again) -> None:
    """Dies at the n-th call that changes the folder; what follows a death (cleaning up) does not happen."""
    path = tmp_path / "map.zarr"
    save_map(path, small_map(1.0), MapAttributes())
    calls = 0

    def deadly(function):
        def call(*args, **kwargs):
            nonlocal calls
            calls += 1
            if calls > step:
                raise Killed
            return function(*args, **kwargs)

        return call

    with monkeypatch.context() as patch:
        patch.setattr(map_store, "_write_group", deadly(map_store._write_group))
        patch.setattr(map_store, "sync_tree", deadly(map_store.sync_tree))
        patch.setattr(map_store.os, "rename", deadly(os.rename))
        patch.setattr(map_store.shutil, "rmtree", deadly(shutil.rmtree))
        with suppress(Killed):
            save_map(path, small_map(2.0), MapAttributes())
    loaded, _ = load_map(path)
    assert float(loaded.log_odds.max()) in ((1.0,) if step < 4 else (2.0,))
    if again:
        save_map(path, small_map(3.0), MapAttributes())
        assert_equal(load_map(path)[0], small_map(3.0))
        assert leftovers(tmp_path) == []


def test_a_real_kill_leaves_a_map(tmp_path) -> None:
    program = (
        "import sys; sys.path[:0] = sys.argv[2:]\n"
        "from test_map_store import small_map\n"
        "from jaxmap.mapping.store import MapAttributes, save_map\n"
        "for value in range(1, 100000):\n"
        "    save_map(sys.argv[1], small_map(float(value)), MapAttributes())\n"
        "    print(value, flush=True)\n"
    )
    path = tmp_path / "map.zarr"
    folders = [str(Path(__file__).parent), str(Path(jaxmap.__file__).parents[1])]
    command = [sys.executable, "-c", program, str(path), *folders]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None and process.stdout.readline() == "1\n"
        time.sleep(0.3)
        process.send_signal(signal.SIGKILL)
        last = ["1", *process.stdout.read().split()][-1]
    value = float(load_map(path)[0].log_odds.max())
    assert int(last) <= value <= int(last) + 1
    save_map(path, small_map(0.5), MapAttributes())
    assert leftovers(tmp_path) == []


@pytest.mark.parametrize(
    ("number", "message"),
    [(errno.ENOSPC, "disk full"), (errno.EROFS, "no permission to write"), (errno.EIO, "writing failed")],
)
def test_a_refusing_disk_keeps_the_old_map(tmp_path, monkeypatch, number, message) -> None:
    path = tmp_path / "map.zarr"
    save_map(path, small_map(1.0), MapAttributes())

    def refuse(*_args, **_kwargs):
        raise OSError(number, os.strerror(number))

    for place in (map_store.os, "rename"), (map_store, "sync_tree"), (map_store, "_write_group"):
        with monkeypatch.context() as patch:
            patch.setattr(*place, refuse)
            with pytest.raises(JaxmapError, match=message) as caught:
                save_map(path, small_map(2.0), MapAttributes())
        assert str(path) in str(caught.value) and "\n" not in str(caught.value)
        assert_equal(load_map(path)[0], small_map(1.0))
        assert leftovers(tmp_path) == []


def test_a_failed_second_rename_is_undone(tmp_path, monkeypatch) -> None:
    path = tmp_path / "map.zarr"
    save_map(path, small_map(1.0), MapAttributes())
    rename = os.rename

    def rename_but_not_in(source, target):
        if ".new-" in str(source):
            raise OSError(errno.EIO, "no")
        rename(source, target)

    monkeypatch.setattr(map_store.os, "rename", rename_but_not_in)
    with pytest.raises(JaxmapError):
        save_map(path, small_map(2.0), MapAttributes())
    assert path.exists() and leftovers(tmp_path) == []


@pytest.fixture
def small_disk(tmp_path):
    disk = tmp_path / "disk"
    disk.mkdir()
    mounted = shutil.which("mount") and subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=256k", "tmpfs", str(disk)], capture_output=True, check=False
    )
    if not mounted or mounted.returncode:
        pytest.skip("cannot mount a small tmpfs here")
    yield disk
    subprocess.run(["umount", str(disk)], check=True)


def test_a_full_disk(small_disk) -> None:
    path = small_disk / "map.zarr"
    save_map(path, small_map(1.0), MapAttributes())
    noise = np.random.default_rng(0).normal(size=(3, 64, 64, 64))
    large = VoxelMap(
        jnp.asarray(noise, jnp.float32), jnp.asarray(1), GridSpec(*[jnp.ones(3)] * 2, (64, 64, 64)), ("a", "b")
    )
    with pytest.raises(JaxmapError, match="disk full"):
        save_map(path, large, MapAttributes())
    assert leftovers(small_disk) == []
    assert_equal(load_map(path)[0], small_map(1.0))
    with pytest.raises(JaxmapError, match="disk full"), atomic_path(small_disk / "a.bin") as temporary:
        temporary.write_bytes(bytes(2**20))
    assert leftovers(small_disk) == []


def edit_attributes(path: Path, **changes: object) -> None:
    file = path / "zarr.json"
    content = json.loads(file.read_text())
    for name, value in changes.items():
        if value is KeyError:
            del content["attributes"][name]
        else:
            content["attributes"][name] = value
    file.write_text(json.dumps(content))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"format_version": 2}, "written by a newer jaxmap: format 2, this one reads 1"),
        ({"format_version": KeyError}, "no attribute format_version"),
        ({"format_version": "x"}, "format_version is 'x'"),
        ({"classes": KeyError}, "attribute 'classes' is missing"),
        ({"site_origin": KeyError}, "attribute 'site_origin' is missing"),
        ({"frames_fused": "many"}, "frames_fused is 'many'"),
        ({"voxel_size_m": [0.1, 0.1]}, r"voxel_size_m is \[0.1, 0.1\]"),
        ({"voxel_size_m": [0.1, 0, 0.1]}, "voxel_size_m or shape"),
        ({"crs": 3}, "crs is 3"),
        ({"fusion": []}, "fusion is"),
        ({"shape": [5, 4, 9]}, r"float32 \(3, 5, 4, 3\), its attributes say float32 \(3, 5, 4, 9\)"),
        ({"classes": ["sand"]}, r"its attributes say float32 \(2, 5, 4, 3\)"),
        ({"frames_fused": 2**40}, "frames_fused is 1099511627776"),
        ({"frames_fused": 1.5}, "frames_fused is 1.5"),
        ({"frames_fused": 10**400}, "frames_fused is 1000"),
        ({"voxel_size_m": [1e300, 0.1, 0.1]}, "voxel_size_m is"),
        ({"voxel_size_m": [1e-300, 0.1, 0.1]}, "voxel_size_m or shape"),
        ({"site_origin": [1e300, 0, 0]}, "site_origin is"),
        ({"shape": [10**15, 4, 3]}, "shape is|or shape"),
        ({"classes": ["x"] * 100_000}, "classes is"),
    ],
)
def test_wrong_attributes_are_named(tmp_path, changes, message) -> None:
    path = tmp_path / "map.zarr"
    save_map(path, small_map(), MapAttributes())
    edit_attributes(path, **changes)
    with pytest.raises(JaxmapError, match=message) as caught:
        load_map(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("shape", [3, 10**15, 4, 3], "GiB, there are"),
        ("chunk_shape", [1, 10**6, 10**6, 10**6], "GiB, there are"),
        ("chunk_shape", [0, 1, 1, 1], "chunks of 0 x 1 x 1 x 1"),
        ("shape", [-3, 5, 4, 3], "no readable Zarr group"),
    ],
)
def test_an_array_is_known_by_its_form_before_it_is_read(tmp_path, field, value, message) -> None:
    path = tmp_path / "map.zarr"
    save_map(path, small_map(), MapAttributes())
    file = path / "log_odds" / "zarr.json"
    content = json.loads(file.read_text())
    place = content["chunk_grid"]["configuration"] if field == "chunk_shape" else content
    place[field] = value
    file.write_text(json.dumps(content))
    with pytest.raises(JaxmapError, match=message):
        load_map(path)


def test_chunks_of_one_number_each_are_not_counted_for_ever(tmp_path) -> None:
    path = tmp_path / "map.zarr"
    save_map(path, small_map(), MapAttributes())
    file = path / "log_odds" / "zarr.json"
    content = json.loads(file.read_text())
    content["shape"] = [3, 500, 400, 300]
    content["chunk_grid"]["configuration"]["chunk_shape"] = [1, 1, 1, 1]
    file.write_text(json.dumps(content))
    edit_attributes(path, shape=[500, 400, 300])
    with pytest.raises(JaxmapError, match="180,000,000 chunks"):
        load_map(path)


@pytest.mark.parametrize("name", ["zarr.json", "log_odds/c/0/0/0/0"])
@pytest.mark.parametrize("kind", ["pipe", "device", "loop"])
def test_a_map_is_made_of_regular_files(tmp_path, name, kind) -> None:
    path = tmp_path / "map.zarr"
    save_map(path, small_map(), MapAttributes())
    file = path / name
    file.unlink()
    if kind == "pipe":
        os.mkfifo(file)
    else:
        file.symlink_to(file if kind == "loop" else "/dev/zero")
    with pytest.raises(JaxmapError, match="cannot be read"):
        load_map(path)


def test_a_map_without_progress_is_complete(tmp_path) -> None:
    path = tmp_path / "map.zarr"
    save_map(path, small_map(), MapAttributes(progress={"complete": False}))
    edit_attributes(path, progress=KeyError)
    assert load_map(path)[1].progress == {"complete": True}


def test_what_is_no_map(tmp_path) -> None:
    with pytest.raises(JaxmapError, match="no such map"):
        load_map(tmp_path / "nothing.zarr")
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").write_text("x")
    for name in ("empty", "file"):
        with pytest.raises(JaxmapError, match="not a jaxmap map"):
            load_map(tmp_path / name)
    path = tmp_path / "map.zarr"
    save_map(path, small_map(), MapAttributes())
    (path / "zarr.json").write_text("{")
    with pytest.raises(JaxmapError, match="not a jaxmap map"):
        load_map(path)


def test_a_folder_that_is_no_map_is_not_replaced(tmp_path) -> None:
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "a.txt").write_text("mine")
    with pytest.raises(JaxmapError, match="in the way"):
        save_map(tmp_path / "notes", small_map(), MapAttributes())
    assert (tmp_path / "notes" / "a.txt").read_text() == "mine"


@pytest.mark.parametrize("damage", ["truncate", "flip", "delete"])
def test_damaged_chunks_are_found(tmp_path, damage) -> None:
    path = tmp_path / "map.zarr"
    save_map(path, small_map(), MapAttributes())
    chunk = next(p for p in sorted((path / "log_odds" / "c").rglob("*")) if p.is_file())
    content = chunk.read_bytes()
    if damage == "truncate":
        chunk.write_bytes(content[: len(content) // 2])
    elif damage == "flip":
        chunk.write_bytes(content[:-6] + bytes(byte ^ 0xFF for byte in content[-6:]))
    else:
        chunk.unlink()
    with pytest.raises(JaxmapError, match="chunk"):
        load_map(path)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_numbers_that_are_not_finite_are_refused(tmp_path, monkeypatch, value) -> None:
    path = tmp_path / "map.zarr"
    with pytest.raises(JaxmapError, match="6 of the log-odds are not finite"):
        save_map(path, small_map(value), MapAttributes())
    with monkeypatch.context() as patch:
        patch.setattr(map_store, "check_finite", lambda *_: None)
        save_map(path, small_map(value), MapAttributes())
    with pytest.raises(JaxmapError, match="6 of the log-odds are not finite"):
        load_map(path)


def test_atomic_path_keeps_the_old_file_when_the_block_fails(tmp_path) -> None:
    path = tmp_path / "made" / "a.json"
    with atomic_path(path) as temporary:
        assert temporary.suffix == ".json" and temporary.parent == path.parent
        temporary.write_text("old")
    with suppress(ValueError), atomic_path(path) as temporary:
        temporary.write_text("new")
        raise ValueError
    assert path.read_text() == "old" and [p.name for p in path.parent.iterdir()] == ["a.json"]
    with pytest.raises(JaxmapError, match="writing failed"), atomic_path(path / "below" / "b.json"):
        pass

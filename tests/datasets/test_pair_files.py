"""Which right image belongs to which left one, and the folders that hold them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from jaxmap.datasets import open_sequence
from jaxmap.datasets.pair_files import pair_files
from jaxmap.errors import JaxmapError

START_NS = 1_700_000_000_000_000_000


def files(side: str, names: list[str], suffix: str = ".png") -> list[Path]:
    return [Path(side) / f"{name}{suffix}" for name in names]


def paired(left: list[str], right: list[str]) -> list[str | None]:
    found = pair_files(files("left", left), files("right", right))
    return [None if path is None else path.stem for path in found.right]


def test_equal_names_decide_whatever_their_suffix():
    found = pair_files(files("left", ["f0", "f1"]), files("right", ["f1", "f0"], ".jpg"))
    assert found.right == (Path("right/f0.jpg"), Path("right/f1.jpg")) and found.notes == ()
    lone = pair_files(files("left", ["f0", "f1"]), files("right", ["f0"]))
    assert lone.right[1] == Path("right/f1.png") and lone.notes == ()


@pytest.mark.parametrize(
    ("left", "right"),
    [
        ("left_{}", "right_{}"),
        ("{}_left", "{}_right"),
        ("Left{}", "Right{}"),
        ("{}L", None),
        ("frame_{}_l", "frame_{}_r"),
        ("cam0_{}", "cam1_{}"),
        ("LocCam_{}_0", "LocCam_{}_1"),
    ],
)
def test_words_for_the_side_do_not_matter(left, right):
    names = [[pattern.format(f"{index:03d}") for index in range(3)] for pattern in (left, right or left)]
    assert paired(*names) == names[1]
    if right:
        assert paired(names[0], names[1][1:]) == [None, *names[1][1:]]
        found = pair_files(files("left", names[0]), files("right", names[1][1:]))
        assert found.notes == ("1 left and 0 right images have no partner and are left out",)
        assert found.keys[0].strip("_").endswith("000")


def test_folders_that_share_no_name_are_refused():
    with pytest.raises(JaxmapError, match=r"share no name: a\.png and b\.png are the first in right; name the two"):
        paired(["a"], ["b"])


@given(
    offset_ns=st.integers(-40_000_000, 40_000_000),
    lost=st.tuples(st.sets(st.integers(0, 9), max_size=4), st.sets(st.integers(0, 9), max_size=4)),
    prefix=st.sampled_from(["", "left_"]),
)
def test_times_are_paired_by_the_nearest(offset_ns, lost, prefix):
    """At 10 Hz, up to half a period apart; what has lost its partner is left out."""
    left, right = ([index for index in range(10) if index not in gone] for gone in lost)
    expected = [str(START_NS + index * 10**8 + offset_ns) if index in right else None for index in left]
    names = [f"{prefix}{START_NS + index * 10**8}" for index in left]
    theirs = [str(START_NS + index * 10**8 + offset_ns) for index in right]
    if not any(expected):
        with pytest.raises(JaxmapError, match="no left and right images lie within"):
            paired(names, theirs)
        return
    assert paired(names, theirs) == expected


def test_what_pairing_by_time_did_is_told():
    left = [f"{1700000000 + index / 10:.6f}" for index in range(4)]
    right = [f"{1700000000 + index / 10 + 0.012:.6f}" for index in (0, 1, 3, 4)]
    found = pair_files(files("left", left), files("right", right))
    assert found.right[2] is None and found.right[0] == Path("right") / f"{right[0]}.png"
    assert found.notes == (
        "left and right images are paired by the times in their names, up to 12 ms apart",
        "the two cameras did not expose together: what they saw while moving gives wrong depths",
        "1 left and 1 right images have no partner and are left out",
    )
    with pytest.raises(JaxmapError, match=r"lie within 50 ms .* the nearest are 99.7 s apart in right; check that"):
        paired(left, [f"{float(name) + 100:.6f}" for name in left])


def write_images(folder: Path, names: list[str]) -> None:
    folder.mkdir(parents=True)
    for name in names:
        Image.fromarray(np.random.default_rng(0).integers(0, 255, (6, 9), np.uint8)).save(folder / f"{name}.png")


def made_folder(root: Path, sides: tuple[str, str], left: list[str], right: list[str]) -> Path:
    write_images(root / sides[0], left)
    write_images(root / sides[1], right)
    (root / "camera.yaml").write_text("{image_size_px: [9, 6], fx_px: 8, cx_px: 4, cy_px: 2.5, baseline_m: 0.1}")
    (root / "poses.tum").write_text(
        "".join(f"{1700000000 + index / 10:.6f} {index} 0 0 0 0 0 1\n" for index in range(4))
    )
    return root


@pytest.mark.parametrize(
    "sides",
    [
        ("left", "right"),
        ("image_left", "image_right"),
        ("image_0", "image_1"),
        ("cam0", "cam1"),
        ("cam0/data", "cam1/data"),
    ],
)
def test_folders_of_other_names_are_read(tmp_path, sides):
    left = [str(START_NS + index * 10**8) for index in range(3)]
    right = [str(int(name) + 31_000) for name in left[1:]]
    opened = open_sequence(made_folder(tmp_path / "seq", sides, left, right))
    assert opened.dataset == "folder"
    assert [(frame.left.stem, frame.right.stem) for frame in opened.frames] == list(zip(left[1:], right, strict=True))
    np.testing.assert_allclose([frame.timestamp_s for frame in opened.frames], [1.7e9 + 0.1, 1.7e9 + 0.2])
    assert "1 left and 0 right images have no partner and are left out" in opened.notes
    opened.read_pair(opened.frames[0])


def test_poses_without_times_stay_with_their_images_where_some_are_left_out(tmp_path):
    left = [str(START_NS + index * 10**8) for index in range(4)]
    folder = made_folder(tmp_path / "seq", ("left", "right"), left, [str(int(name) + 9) for name in left[2:]])
    poses = np.tile(np.eye(4)[:3], (4, 1, 1))
    poses[:, 0, 3] = range(4)
    np.savetxt(folder / "poses.tum", poses.reshape(4, 12))
    positions = open_sequence(folder).T_world_camera[:, :3, 3]
    np.testing.assert_allclose(np.linalg.norm(np.diff(positions, axis=0), axis=1), [1.0])


def test_times_of_a_file_go_with_all_left_images(tmp_path):
    folder = made_folder(tmp_path / "seq", ("left", "right"), ["left_0", "left_1", "left_2"], ["right_1", "right_2"])
    (folder / "times.txt").write_text("1700000000\n1700000000.1\n1700000000.2\n")
    np.testing.assert_allclose(
        [frame.timestamp_s for frame in open_sequence(folder).frames], [1.7e9 + 0.1, 1.7e9 + 0.2]
    )

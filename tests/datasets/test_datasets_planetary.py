"""The reader of planetary archives: a scene of known geometry written in each form is read back in its place."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import planetary_scenes as scenes
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from jaxmap.datasets import ReadOptions, open_sequence
from jaxmap.datasets.pds_labels import read_label
from jaxmap.datasets.planetary import T_ENU_SITE
from jaxmap.datasets.poses import write_tum
from jaxmap.errors import FrameError, JaxmapError, UsageError
from jaxmap.runs.config import MapConfig
from jaxmap.runs.labelling import choose_label_folder
from jaxmap.stereo.front_end import StereoFrontEnd
from jaxmap.stereo.match import StereoOptions

YAW = Rotation.from_euler("ZYX", [2.0, 0.05, -0.03])
QUATERNION = tuple(YAW.as_quat()[[3, 0, 1, 2]])
OFFSET = (12.0, -5.0, 0.3)

T_SITE_ROVER = np.eye(4)
T_SITE_ROVER[:3, :3], T_SITE_ROVER[:3, 3] = YAW.as_matrix(), OFFSET

BLANK = np.zeros((24, 32), np.uint8)


def write_pair(folder: Path, suffix=".IMG", kind="CAHVOR", clock_s=127168010.0, pixels=None, pan=0.0, **more) -> None:
    """Left and right of one exposure; blank, small images unless `pixels` are given."""
    for side, model in zip(("left", "right"), scenes.rig(kind, pan), strict=True):
        groups = scenes.keywords(model, kind, side, clock_s, OFFSET, QUATERNION, more.get("site", 3))
        for name in more.get("without", ()):
            groups[name] = {}
        image = pixels[side] if pixels else np.zeros(scenes.SIZE_PX[::-1], np.uint8)
        scenes.WRITERS[suffix](folder / f"{side[0].upper()}{clock_s:.0f}{suffix}", image, groups, more.get("image"))


def rendered(kind: str, top: int, dtype: str) -> dict[str, np.ndarray]:
    return {
        side: scenes.render(model, top, dtype) for side, model in zip(("left", "right"), scenes.rig(kind), strict=True)
    }


def true_points(sequence, index: int) -> tuple[np.ndarray, np.ndarray]:
    """For each rectified pixel of a frame: the point it shows in the rover frame, and the depth of it."""
    camera = sequence.camera
    T_rover_camera = np.linalg.inv(T_SITE_ROVER) @ np.linalg.inv(T_ENU_SITE) @ sequence.T_world_camera[index]
    v, u = np.mgrid[: camera.height_px, : camera.width_px].astype(float)
    ahead = np.stack([(u - float(camera.cx_px)) / float(camera.fx_px), (v - float(camera.cy_px)) / float(camera.fy_px),
                      np.ones_like(u)], -1)  # fmt: skip
    directions = ahead @ T_rover_camera[:3, :3].T
    points = scenes.hits(np.broadcast_to(T_rover_camera[:3, 3], directions.shape), directions)
    return points, (points - T_rover_camera[:3, 3]) @ T_rover_camera[:3, 2]


@pytest.mark.parametrize(
    ("suffix", "kind", "top", "dtype"),
    [(".IMG", "CAHVOR", 4095, "uint16"), (".LBL", "CAHV", 255, "uint8"), (".VIC", "CAHVORE", 4095, "uint16"),
     (".xml", "CAHVORE", 255, "uint8"), (".xml", "CAHVOR", 30000, "uint16")],
)  # fmt: skip
def test_a_scene_is_read_back_in_its_place(tmp_path, suffix, kind, top, dtype):
    write_pair(tmp_path, suffix, kind, pixels=rendered(kind, top, dtype))
    sequence = open_sequence(tmp_path)
    assert sequence.dataset == "planetary"
    assert float(sequence.camera.baseline_m) == pytest.approx(0.3, abs=1e-6)
    pair = sequence.read_pair(sequence.frames[0])
    assert pair.left.dtype == np.uint8
    assert pair.left.max() > 200
    points, depth_m = true_points(sequence, 0)
    true_px = float(sequence.camera.fx_px * sequence.camera.baseline_m) / depth_m

    # Rows: the right image, moved by the true disparity, lies on the left one.
    v, u = np.mgrid[: pair.left.shape[0], : pair.left.shape[1]].astype(np.float32)
    moved = cv2.remap(pair.right, (u - true_px).astype(np.float32), v, cv2.INTER_LINEAR)
    for rows, columns in ((slice(100, 164), slice(60, 124)), (slice(160, 224), slice(200, 264))):
        (du, dv), _ = cv2.phaseCorrelate(pair.left[rows, columns].astype(float), moved[rows, columns].astype(float))
        assert abs(dv) < 0.3
        assert abs(du) < 0.3

    disparity_px = StereoFrontEnd(sequence.camera, StereoOptions(num_disparities=96))(
        pair.left, pair.right
    ).disparity_px
    near = np.isfinite(disparity_px) & (depth_m < 6)
    assert near.mean() > 0.35
    error_px = (disparity_px - true_px)[near]
    assert abs(np.median(error_px)) < 0.15
    assert np.quantile(np.abs(error_px), 0.8) < 0.5
    assert np.nanmin(points[..., 2]) < -0.4, "the box is in view"


def test_poses_are_those_of_the_labels_for_every_pan_of_the_mast(tmp_path):
    for index, pan in enumerate((0.0, 0.8, -1.9)):
        write_pair(tmp_path, clock_s=127168010.0 + 30 * index, pan=pan)
    sequence = open_sequence(tmp_path)
    assert len(sequence.frames) == 3
    np.testing.assert_allclose(np.diff([frame.timestamp_s for frame in sequence.frames]), 30)
    for index, pan in enumerate((0.0, 0.8, -1.9)):
        left, _ = scenes.rig(pan=pan)
        T_site_camera = np.linalg.inv(T_ENU_SITE) @ sequence.T_world_camera[index]
        np.testing.assert_allclose(T_site_camera[:3, 3], (T_SITE_ROVER @ [*left.C, 1])[:3], atol=1e-9)
        assert T_site_camera[:3, 2] @ YAW.as_matrix() @ left.A > 0.999
    # One look-up serves them all.
    assert sequence.read_pair._rectify._maps_of == [0, 0, 0]


def test_poses_of_a_file_are_those_that_a_run_writes_or_those_of_the_rover(tmp_path):
    for index in range(2):
        write_pair(tmp_path, clock_s=127168010.0 + 30 * index)
    own = open_sequence(tmp_path)
    times_s = np.array([frame.timestamp_s for frame in own.frames])
    write_tum(tmp_path / "poses.tum", times_s, own.T_world_camera)
    given = open_sequence(tmp_path, ReadOptions(poses=tmp_path / "poses.tum", poses_world="z_up"))
    np.testing.assert_allclose(given.T_world_camera, own.T_world_camera, atol=1e-6)
    assert any("rectified left camera" in note for note in given.notes)
    T = T_ENU_SITE @ T_SITE_ROVER
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
    rows = [",".join(map(str, [int(time_s) * 10**9, *T[:3, 3], w, x, y, z])) for time_s in times_s]
    (tmp_path / "rover.csv").write_text("#timestamp,px,py,pz,qw,qx,qy,qz\n" + "\n".join(rows) + "\n")
    given = open_sequence(tmp_path, ReadOptions(poses=tmp_path / "rover.csv", poses_world="z_up"))
    np.testing.assert_allclose(given.T_world_camera, own.T_world_camera, atol=1e-6)


def test_labels_of_raw_images_are_rectified_with_them(tmp_path):
    write_pair(tmp_path)
    sequence = open_sequence(tmp_path)
    assert sequence.rectify_labels is not None
    columns = np.broadcast_to(np.arange(scenes.SIZE_PX[0]), scenes.SIZE_PX[::-1])
    ((_, product),) = sequence.read_pair._rows.values()
    raw = product.pair.raw_pixels(product.left.model, np.array([[200.0, 150.0], [33.0, 77.0]]))
    found = sequence.rectify_labels(sequence.frames[0], (columns // 2).astype(np.uint8))
    np.testing.assert_allclose(found[[150, 77], [200, 33]], raw[:, 0] / 2, atol=0.75)
    soft = np.stack([columns / 400] * 5, -1).astype(np.float32)
    found = sequence.rectify_labels(sequence.frames[0], soft)
    np.testing.assert_allclose(found[[150, 77], [200, 33]], np.tile(raw[:, :1] / 400, 5), atol=1e-3)


@pytest.mark.parametrize("of_frame", [True, False])
@pytest.mark.parametrize("suffix", [".IMG", ".xml"])
def test_a_part_of_the_frame_sees_what_the_frame_sees(tmp_path, suffix, of_frame):
    """Rows 41 to 200, columns 61 to 260, with the model of the full frame, and with that of the part."""
    (tmp_path / "whole").mkdir()
    (tmp_path / "part").mkdir()
    write_pair(tmp_path / "whole", suffix)
    for side, model in zip(("left", "right"), scenes.rig(), strict=True):
        stored = model if of_frame else model.cropped((60, 40))
        groups = scenes.keywords(stored, "CAHVOR", side, 127168010.0, OFFSET, QUATERNION)
        scenes.WRITERS[suffix](
            tmp_path / "part" / f"{side[0].upper()}127168010{suffix}",
            np.zeros((160, 200), np.uint8),
            groups,
            {"FIRST_LINE": 41, "FIRST_LINE_SAMPLE": 61},
        )
    whole, part = open_sequence(tmp_path / "whole"), open_sequence(tmp_path / "part")
    np.testing.assert_allclose(part.T_world_camera, whole.T_world_camera, atol=1e-9)
    # Both look-ups lead to the same place: the part's, 60 columns and 40 rows further.
    pixel = np.array([[100.0, 80.0]])
    ((_, product),) = part.read_pair._rows.values()
    raw = product.pair.raw_pixels(product.left.model, pixel)
    ((_, frame),) = whole.read_pair._rows.values()
    _, ray = frame.left.model.rays(raw + np.array([60, 40]))
    _, same = product.left.model.rays(raw)
    np.testing.assert_allclose(ray, same, atol=1e-9)
    assert any("full frame" in note for note in part.notes) == of_frame


@pytest.mark.parametrize(
    ("left", "right", "camera"),
    [
        ("2N126644134EFF0100P1506L0M1", "2N126644134EFF0100P1506R0M1", "navcam"),
        ("NLA_397586934EDR_F0010008AUT_04096M1", "NRA_397586934EDR_F0010008AUT_04096M1", "navcam"),
        ("FLB_397586934EDR_F0010008FHAZ00214M1", "FRB_397586934EDR_F0010008FHAZ00214M1", "front_hazcam"),
        ("ZL0_0047_0671113936_000ECM_N0040048ZCAM00402_11J01", "ZR0_0047_0671113936_000ECM_N0040048ZCAM00402_11J01",
         "mastcam_z"),
    ],
)  # fmt: skip
def test_eyes_and_clocks_are_read_from_the_names_of_missions(tmp_path, left, right, camera):
    for name, model in zip((left, right), scenes.rig(), strict=True):
        groups = scenes.keywords(model, "CAHVOR", "left", 127168010.0)
        groups[""] = {}
        # All that is needed; the frames have no names.
        rover = groups["ROVER_COORDINATE_SYSTEM"]
        groups["ROVER_COORDINATE_SYSTEM"] = {key: rover[key] for key in rover if key.startswith("ORIGIN")}
        groups["GEOMETRIC_CAMERA_MODEL"].pop("REFERENCE_COORD_SYSTEM_NAME")
        scenes.write_pds3(tmp_path / f"{name}.IMG", np.zeros((48, 64), np.uint8), groups)
    sequence = open_sequence(tmp_path, ReadOptions(camera=camera))
    assert sequence.frames[0].name == left
    clock_s = re.findall("[0-9]{9,10}", left)[0]
    assert sequence.frames[0].timestamp_s == float(clock_s)


def test_plain_names_and_times_do_where_labels_say_no_more(tmp_path):
    for side, model in zip(("left", "right"), scenes.rig(), strict=True):
        groups = scenes.keywords(model, "CAHVOR", side, 127168010.0)
        groups[""] = {"START_TIME": "2004-012T08:31:57.705"}
        scenes.write_pds3(tmp_path / f"rock_{side}.IMG", np.zeros((48, 64), np.uint8), groups)
    sequence = open_sequence(tmp_path)
    assert (sequence.frames[0].name, sequence.frames[0].timestamp_s) == ("rock_left", 1073896317.705)


def test_of_an_exposure_the_kind_that_both_eyes_have_is_taken(tmp_path):
    """Eyes whose clocks read a little apart; a thumbnail, an older version, and a kind that one eye has."""
    rig = scenes.rig()
    for stem, shape, eyes in (
        ("N{}A_397586934EDR_F0010008AUT_04096M1", (48, 64), "LR"),
        ("N{}A_397586934EDR_F0010008AUT_04096M2", (48, 64), "LR"),
        ("N{}A_397586934EDR_T0010008AUT_04096M1", (12, 16), "LR"),
        ("N{}A_397586934RASLF0010008AUT_04096M1", (48, 64), "L"),
    ):
        for eye in eyes:
            side = {"L": "left", "R": "right"}[eye]
            groups = scenes.keywords(rig["LR".index(eye)], "CAHVOR", side, 127168010.9 + 0.2 * (eye == "R"))
            scenes.write_pds3(tmp_path / f"{stem.format(eye)}.IMG", np.zeros(shape, np.uint8), groups)
    sequence = open_sequence(tmp_path)
    (frame,) = sequence.frames
    assert (frame.left.stem, frame.right.stem) == (
        "NLA_397586934EDR_F0010008AUT_04096M2",
        "NRA_397586934EDR_F0010008AUT_04096M2",
    )
    assert any(note.startswith("5 further products") for note in sequence.notes)


def test_pairs_half_a_second_apart_stay_apart(tmp_path):
    for index in range(4):
        write_pair(tmp_path, clock_s=127168010.0 + index)
        for file in tmp_path.glob(f"*{127168010 + index}.IMG"):
            half = file.read_bytes().replace(b"10.000", b"10.500") if index == 0 else None
            if half:
                (tmp_path / f"{file.stem}b.IMG").write_bytes(half)
    assert len(open_sequence(tmp_path).frames) == 5


def test_deep_pixels_are_scaled_by_one_number_for_the_sequence(tmp_path):
    bright = {side: np.full(scenes.SIZE_PX[::-1], 3000, np.uint16) for side in ("left", "right")}
    bright["left"][0, 0] = 30000
    write_pair(tmp_path, pixels=bright)
    write_pair(tmp_path, clock_s=127168040.0, pixels={side: image // 2 for side, image in bright.items()})
    sequence = open_sequence(tmp_path)
    first, second = (sequence.read_pair(frame).left[100, 100] for frame in sequence.frames)
    assert (first, second) == (255, 127)


def test_what_is_dark_stays_dark(tmp_path):
    dim = {side: np.full(scenes.SIZE_PX[::-1], 40, np.uint16) for side in ("left", "right")}
    write_pair(tmp_path, pixels=dim)
    sequence = open_sequence(tmp_path)
    assert sequence.read_pair(sequence.frames[0]).left[100, 100] == 40


def test_a_cut_image_is_a_frame_that_cannot_be_used(tmp_path):
    write_pair(tmp_path)
    sequence = open_sequence(tmp_path)
    file = tmp_path / "R127168010.IMG"
    file.write_bytes(file.read_bytes()[:-20000])
    with pytest.raises(FrameError, match="not a whole"):
        sequence.read_pair(sequence.frames[0])


def refused(folder: Path, options: ReadOptions | None = None) -> str:
    with pytest.raises(JaxmapError) as caught:
        open_sequence(folder, options)
    return str(caught.value)


def test_labels_without_a_camera_model_are_counted_or_refused(tmp_path):
    write_pair(tmp_path, without=("GEOMETRIC_CAMERA_MODEL",))
    assert "none of 2 products can be used: the label has no camera model" in refused(tmp_path)
    write_pair(tmp_path, clock_s=127168100.0)
    (note,) = [note for note in open_sequence(tmp_path).notes if "left out" in note]
    assert note.startswith("2 of 4 images are left out: the label has no camera model")


def test_lone_eyes_other_sizes_and_other_sites_are_left_out(tmp_path):
    for clock_s in (127168010.0, 127168040.0, 127168070.0):
        write_pair(tmp_path, clock_s=clock_s)
    small = dict.fromkeys(("left", "right"), BLANK)
    write_pair(tmp_path, clock_s=127168100.0, pixels=small)
    write_pair(tmp_path, clock_s=127168130.0, site=4)
    (tmp_path / "R127168040.IMG").unlink()
    sequence = open_sequence(tmp_path)
    assert [frame.name for frame in sequence.frames] == ["L127168010", "L127168070"]
    notes = " / ".join(sequence.notes)
    assert "1 exposures have one eye only" in notes
    assert "other sites than 3 (4)" in notes
    assert "another size" in notes
    (tmp_path / "lone").mkdir()
    (tmp_path / "L127168010.IMG").rename(tmp_path / "lone" / "L127168010.IMG")
    assert "no pair among 1 images" in refused(tmp_path / "lone")


def test_no_poses_are_refused_with_the_way_out(tmp_path):
    write_pair(tmp_path, without=("ROVER_COORDINATE_SYSTEM",))
    assert "no pose of ROVER_FRAME" in refused(tmp_path)
    assert "--poses FILE" in refused(tmp_path)


def test_pupils_that_move_too_far_are_refused_in_pixels(tmp_path):
    for side, side_m in (("left", -0.15), ("right", 0.15)):
        model = scenes.eye(side_m, kind="CAHVORE", E=(0.4, 0.1, 0.0))
        groups = scenes.keywords(model, "CAHVORE", side, 127168010.0)
        scenes.write_pds3(tmp_path / f"{side}.IMG", np.zeros(scenes.SIZE_PX[::-1], np.uint8), groups)
    assert "px between 1 m and far away" in refused(tmp_path)


def test_damaged_files_are_one_line_each(tmp_path):
    write_pair(tmp_path)
    (tmp_path / "junk.IMG").write_bytes(b"PDS_VERSION_ID = PDS3\r\n" + b"\xff" * 4000)
    (tmp_path / "junk.xml").write_text("<Product_Observational><unclosed>")
    (tmp_path / "cut.VIC").write_bytes(b"LBLSIZE=4096  FORMAT='BYTE'")
    (tmp_path / "away.LBL").write_text('PDS_VERSION_ID = PDS3\n^IMAGE = "/vsicurl/http://example.org/a.img"\nEND\n')
    sequence = open_sequence(tmp_path)
    assert len(sequence.frames) == 1
    assert sum("left out" in note for note in sequence.notes) >= 2


def test_two_cameras_are_chosen_between(tmp_path):
    write_pair(tmp_path)
    for file in sorted(tmp_path.glob("*.IMG")):
        content = (
            file.read_bytes().replace(b'"NAVCAM_LEFT"', b'"PANCAM_LEFT"').replace(b"NAVCAM_RIGHT", b"PANCAM_RIGHT")
        )
        (tmp_path / f"P{file.name}").write_bytes(content)
    assert "navcam (2 images), pancam (2 images)" in refused(tmp_path)
    assert open_sequence(tmp_path, ReadOptions(camera="pancam")).frames[0].name == "PL127168010"


@pytest.mark.realdata
@pytest.mark.parametrize(
    ("name", "lines", "samples"),
    [("1664MR0086340000802438C00_DRCL", 1180, 1323), ("2264ML0121141200805116C00_DRCL", 1193, 1338)],
)
def test_real_labels_agree_with_themselves(tmp_path, realdata, name, lines, samples):
    """The camera looks where the mast's frame points, and down in the rover frame is what its accelerometers felt."""
    text = (realdata / "pds" / f"{name}_pds3.lbl").read_bytes()
    (tmp_path / f"{name}.lbl").write_bytes(text)
    (tmp_path / f"{name}.IMG").write_bytes(bytes(3 * lines * samples))
    label = read_label(tmp_path / f"{name}.lbl")
    assert label is not None
    assert (label.rig, label.eye) == ("MAST_*", "left" if "ML" in name else "right")
    assert label.size_px == (samples, lines)
    # The label's model is one of the 1338 px that are stored, not of the detector's 1648.
    assert not label.model_is_of_frame
    np.testing.assert_allclose(label.frames["RSM_HEAD_FRAME"][1][:3, 0], label.model.A, atol=0.03)
    felt = re.search(rb"DEV_VECTOR\s*=\s*\(\s*([-0-9.]+),\s*([-0-9.]+),\s*([-0-9.]+)", text)
    assert felt
    down_rover = label.frames["ROVER_NAV_FRAME"][1][2, :3]
    np.testing.assert_allclose(down_rover, [float(number) for number in felt.groups()], atol=1e-3)


def test_labels_must_say_on_which_pixels_they_lie(tmp_path):
    write_pair(tmp_path)
    sequence = open_sequence(tmp_path)
    (tmp_path / "labels").mkdir()
    Image.fromarray(np.zeros(scenes.SIZE_PX[::-1], np.uint8)).save(tmp_path / "labels" / "L127168010.png")
    config = MapConfig(labeller="files", labels=tmp_path / "labels")
    with pytest.raises(UsageError, match="--labels-are raw"):
        choose_label_folder(config, sequence)
    folder = choose_label_folder(replace(config, labels_are="raw"), sequence)
    labels = folder.read(sequence.frames[0], StereoFrontEnd(sequence.camera, StereoOptions()))["labels"]
    assert (labels == 0).all()


def test_mutated_labels_end_in_one_line(tmp_path):
    rng = np.random.default_rng(11)
    tokens = (b"1e308", b"nan", b"-1", b"9" * 400, b"(((((", b'"', b"\xff\xfe", b"\0", b"", b"END_GROUP", b"<", b"=")
    small = dict.fromkeys(("left", "right"), BLANK)
    outcomes = set()
    for case in range(20):
        suffix = list(scenes.WRITERS)[case % 4]
        folder = tmp_path / str(case)
        folder.mkdir()
        write_pair(folder, suffix, "CAHVORE", pixels=small)
        for file in folder.glob(f"*{suffix}"):
            content = file.read_bytes()
            words = [word.span() for word in re.finditer(rb"[-\w.]+", content[:3000])]
            for start, stop in sorted((words[row] for row in rng.integers(0, len(words), 2)), reverse=True):
                content = content[:start] + tokens[rng.integers(len(tokens))] + content[stop:]
            file.write_bytes(content)
        try:
            sequence = open_sequence(folder, ReadOptions(dataset="planetary"))
            sequence.read_pair(sequence.frames[0])
            outcomes.add("read")
        except JaxmapError:
            outcomes.add("refused")
    assert outcomes == {"read", "refused"}

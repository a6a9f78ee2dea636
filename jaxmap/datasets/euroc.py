"""EuRoC MAV: a folder that holds `mav0` with raw pairs, `sensor.yaml` files and a ground-truth csv."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from jaxmap.datasets.base import FrameRef, Reader, StereoSequence, assemble, read_pose_track
from jaxmap.datasets.calibration import pinhole_matrix, read_camera_yaml
from jaxmap.datasets.options import ReadOptions
from jaxmap.datasets.pairing import nearest_pairs
from jaxmap.datasets.poses import parse_ns
from jaxmap.datasets.text_files import data_lines, image_size, load_yaml, number_list
from jaxmap.errors import JaxmapError
from jaxmap.stereo.rectify import StereoRig, make_stereo_rig

PAIR_TOLERANCE_NS = 5_000_000
"""Left and right images this close in time make a pair."""


def recognises(folder: Path) -> bool:
    """Whether the folder holds `mav0/cam0` and `mav0/cam1`."""
    return all((folder / "mav0" / camera).is_dir() for camera in ("cam0", "cam1"))


def open_euroc(folder: Path, options: ReadOptions) -> StereoSequence:
    """Opens one recording; its images are raw, so its camera is a `StereoRig`.

    The ground truth holds poses of the body (the IMU); `T_BS` of cam0 takes them to the left camera.
    Poses given as TUM text are already those of the left camera.

    Raises:
        JaxmapError: a file is missing or malformed, the camera model is not supported, or no images
            pair up.
    """
    mav0 = folder / "mav0"
    frames, dropped = _paired_frames(mav0)
    camera = read_camera_yaml(options.calibration) if options.calibration else read_rig(folder)
    track = read_pose_track(options, mav0 / "state_groundtruth_estimate0" / "data.csv", allow_body=True)
    return assemble(
        name=Path(os.path.abspath(folder)).name,
        dataset="euroc",
        where=folder,
        frames=frames,
        track=track,
        camera=camera,
        options=options,
        T_child_camera=_sensor(mav0 / "cam0" / "sensor.yaml")[0] if track.child == "body" else None,
        notes=[f"{dropped} images have no partner within 5 ms and are left out"] * bool(dropped),
    )


def read_rig(folder: Path) -> StereoRig:
    """The raw calibration of a recording, from the `sensor.yaml` of both cameras.

    Raises:
        JaxmapError: a file is missing or malformed, the model is not supported, or the sizes differ.
    """
    mav0 = folder / "mav0"
    T_body_left, left = _sensor(mav0 / "cam0" / "sensor.yaml")
    T_body_right, right = _sensor(mav0 / "cam1" / "sensor.yaml")
    if left["size_px"] != right["size_px"]:
        raise JaxmapError("the cameras differ in resolution", where=mav0, fix="give a --calibration of one size")
    T_right_left = np.linalg.inv(T_body_right) @ T_body_left
    return make_stereo_rig(
        K_left=left["K"],
        distortion_left=left["distortion"],
        K_right=right["K"],
        distortion_right=right["distortion"],
        R_right_left=T_right_left[:3, :3],
        t_right_left_m=T_right_left[:3, 3],
        size_px=left["size_px"],
        where=mav0,
    )


def _sensor(path: Path) -> tuple[np.ndarray, dict]:
    """T_body_camera and the intrinsics of one camera."""
    content = load_yaml(path)
    needed = ("T_BS", "resolution", "intrinsics", "distortion_model", "distortion_coefficients")
    missing = [key for key in needed if key not in content]
    if missing:
        raise JaxmapError(f"keys are missing: {', '.join(missing)}", where=path, fix="restore the file")
    model = (content.get("camera_model", "pinhole"), content["distortion_model"])
    if model != ("pinhole", "radial-tangential"):
        raise JaxmapError(
            f"the camera model is {model[0]} with {model[1]} distortion",
            where=path,
            fix="only pinhole with radial-tangential is supported; rectify the images and use a plain folder",
        )
    pose = content["T_BS"]
    T_body_camera = number_list(pose.get("data") if isinstance(pose, dict) else pose, "T_BS.data", path, count=16)
    T_body_camera = T_body_camera.reshape(4, 4)
    R = T_body_camera[:3, :3]
    if not (np.isfinite(T_body_camera).all() and np.allclose(R @ R.T, np.eye(3), atol=1e-3) and np.linalg.det(R) > 0):
        raise JaxmapError("T_BS is not a rigid transform", where=path, fix="correct the extrinsics")
    return T_body_camera, {
        "K": pinhole_matrix(*number_list(content["intrinsics"], "intrinsics", path, count=4)),
        "distortion": number_list(content["distortion_coefficients"], "distortion_coefficients", path),
        "size_px": image_size(content["resolution"], "resolution", path),
    }


def _image_times_ns(camera: Path) -> tuple[np.ndarray, list[Path]]:
    """Times and files of one camera, as `data.csv` lists them."""
    path = camera / "data.csv"
    times_ns, images = [], []
    for line, text in data_lines(path):
        words = [word.strip() for word in text.split(",")]
        if len(words) != 2 or not words[1]:
            raise JaxmapError("not a time and a file name", where=f"{path} line {line}", fix="restore the file")
        times_ns.append(parse_ns(words[0], path, line))
        if len(times_ns) > 1 and times_ns[-1] <= times_ns[-2]:
            raise JaxmapError("timestamps go back or repeat", where=f"{path} line {line}", fix="sort the file by time")
        images.append(camera / "data" / words[1])
    if not images:
        raise JaxmapError("no images are listed", where=path, fix="restore the file")
    return np.array(times_ns, np.int64), images


def _paired_frames(mav0: Path) -> tuple[list[FrameRef], int]:
    """The pairs that are each other's nearest in time, and how many images are left over."""
    left_ns, left_images = _image_times_ns(mav0 / "cam0")
    right_ns, right_images = _image_times_ns(mav0 / "cam1")
    paired, partner, _ = nearest_pairs(left_ns, right_ns, PAIR_TOLERANCE_NS)
    if not len(paired):
        raise JaxmapError(
            "no left and right images lie within 5 ms of each other", where=mav0, fix="check both data.csv files"
        )
    frames = [
        FrameRef(left_images[i].stem, int(left_ns[i]) / 1e9, left_images[i], right_images[j])
        for i, j in zip(paired, partner, strict=True)
    ]
    return frames, len(left_ns) + len(right_ns) - 2 * len(paired)


READER = Reader("euroc", "EuRoC MAV, a folder holding mav0/cam0 and mav0/cam1", recognises, open_euroc)

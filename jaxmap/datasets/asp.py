"""Pairs with the cameras of NASA's Ames Stereo Pipeline: images and `.tsai` files."""

from __future__ import annotations

import os
import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from jaxmap.datasets.base import (
    FrameRef,
    Reader,
    StereoPair,
    StereoSequence,
    assemble,
    read_pose_track,
    read_stereo_pair,
)
from jaxmap.datasets.images import image_size_px, list_images
from jaxmap.datasets.options import ReadOptions
from jaxmap.datasets.planetary import T_ENU_SITE, poses_of_rectified
from jaxmap.datasets.poses import PoseTrack, make_pose_track
from jaxmap.datasets.text_files import data_lines
from jaxmap.errors import FrameError, JaxmapError
from jaxmap.geometry.tsai import TsaiCamera
from jaxmap.stereo.linearise import PairRectifier, SharedView, linearise, share_view

_LENSES = {
    "NULL": (),
    "TSAI": ("k1", "k2", "p1", "p2", "k3"),
    "BROWNCONRADY": ("xp", "yp", "k1", "k2", "k3", "p1", "p2", "phi"),
}
_VECTORS = {"C": 3, "R": 9, "u_direction": 3, "v_direction": 3, "w_direction": 3}
_EYE = re.compile(r"(?<![A-Za-z])(left|right|l|r)(?![A-Za-z])", re.IGNORECASE)
_PLANET_M = 1e6


def read_tsai(path: Path) -> TsaiCamera:
    """Reads a camera of version 1 (without header, pixels, TSAI) to 4.

    Raises:
        JaxmapError: a number is missing or out of its bounds, the lens is another, or the axes make no rotation.
    """
    values: dict[str, np.ndarray] = {}
    words: list[str] = []
    for line, text in data_lines(path):
        name, equals, rest = text.partition("=")
        if not equals:
            words.append(text.strip().upper())
            continue
        try:
            numbers = np.array([float(word) for word in rest.split()])
        except ValueError as fault:
            raise JaxmapError(f"{fault}"[:120], where=f"{path} line {line}", fix="correct the line") from fault
        if len(numbers) != _VECTORS.get(name.strip(), 1) or not (np.abs(numbers) < 1e12).all():
            raise JaxmapError(
                f"{name.strip()[:40]} is not what it holds", where=f"{path} line {line}", fix="correct it"
            )
        values[name.strip()] = numbers
    kinds = [word for word in words if not word.startswith("VERSION") and word != "PINHOLE"]
    lens = kinds[0] if kinds else "TSAI" if "k1" in values else "NULL"
    if lens not in _LENSES or len(kinds) > 1:
        raise JaxmapError(
            f"the lens is of type {' '.join(kinds)[:60]}",
            where=path,
            fix="NULL, TSAI and BROWNCONRADY are read; ASP's convert_pinhole_model makes TSAI of the others",
        )
    missing = [key for key in ("fu", "fv", "cu", "cv", "C", "R") if key not in values]
    missing += [key for key in _LENSES[lens] if key not in values and key != "k3"]
    if missing:
        raise JaxmapError(f"{', '.join(missing)} missing", where=path, fix="restore the file")
    scalars = {key: float(value[0]) for key, value in values.items() if len(value) == 1}
    focal, pitch = np.array([scalars["fu"], scalars["fv"]]), scalars.get("pitch", 1.0)
    directions = np.stack([values.get(f"{u}_direction", unit) for u, unit in zip("uvw", np.eye(3), strict=True)])
    R_world_camera = values["R"].reshape(3, 3) @ directions.T
    rigid = np.allclose(R_world_camera @ R_world_camera.T, np.eye(3), atol=1e-3) and np.linalg.det(R_world_camera) > 0
    if not (rigid and focal.min() > 0 and pitch > 0):
        raise JaxmapError(
            "R with its u, v, w directions is no rotation, or a focal length or pitch is not positive",
            where=path,
            fix="correct the camera",
        )
    U, _, Vt = np.linalg.svd(R_world_camera)
    terms = np.array([scalars.get(key, 0.0) for key in _LENSES[lens]])
    return TsaiCamera(values["C"], U @ Vt, focal, np.array([scalars["cu"], scalars["cv"]]), pitch, lens, terms)  # pyright: ignore[reportArgumentType]


def recognises(folder: Path) -> bool:
    """Whether the folder holds `.tsai` cameras and no `camera.yaml`."""
    try:
        return not (folder / "camera.yaml").exists() and any(file.suffix == ".tsai" for file in folder.iterdir())
    except OSError:
        return False


def open_asp(folder: Path, options: ReadOptions) -> StereoSequence:
    """Opens pairs of images with `.tsai` cameras.

    Either each image has its camera beside it (`NAME_left.tif`, `NAME_left.tsai` and the same with `right`, or `l` and
    `r`), or the images are `left/NAME` and `right/NAME`, and the folder holds one camera for each side, which
    `--calibration LEFT.tsai` may name. Poses are those of the left cameras, R and C; a world in which they stand upside
    down is taken for z down. Frames are numbered 0, 1, 2 ... s.

    Raises:
        JaxmapError: a camera is missing or malformed, no images pair up, or the cameras are in planetocentric
            coordinates and no poses are given.
    """
    notes: list[str] = []
    paired = _paired_files(folder, options.calibration)
    cameras = {path: read_tsai(path) for path in {camera for pair in paired for camera in pair[2:]}}
    size_px = image_size_px(paired[0][0])
    pairs = [linearise(cameras[left], cameras[right], size_px, where=left) for *_, left, right in paired]
    shared = share_view(pairs)
    if others := len(pairs) - len(shared.kept):
        notes.append(f"{others} of {len(pairs)} pairs have another zoom or baseline and are left out")
    frames = [FrameRef(paired[index][0].stem, float(row), *paired[index][:2]) for row, index in enumerate(shared.kept)]
    notes.append("frames numbered 0, 1, 2 ... s, as no times are known")
    rows = {frame.name: row for row, frame in enumerate(frames)}
    rectify = PairRectifier(shared)

    def read_pair(frame: FrameRef) -> StereoPair:
        raw = read_stereo_pair(frame)
        if raw.left.shape[:2] != size_px[::-1]:
            raise FrameError(f"not {size_px[0]}x{size_px[1]} px like the first image", where=frame.left)
        return StereoPair(*rectify(rows[frame.name], raw.left, raw.right))

    def rectify_labels(frame: FrameRef, labels: np.ndarray) -> np.ndarray:
        return rectify.labels(rows[frame.name], labels)

    track = _poses(shared, folder, options, notes)
    # The world of the cameras' own poses is found out already.
    world = "z_up" if options.poses is None and options.poses_world == "auto" else options.poses_world
    camera = shared.pairs[0].camera
    sequence = assemble(
        name=Path(os.path.abspath(folder)).name,
        dataset="asp",
        where=folder,
        frames=frames,
        track=track,
        camera=camera,
        options=replace(options, calibration=None, poses_world=world),
        notes=notes,
        read_pair=read_pair,
        size_px=(camera.width_px, camera.height_px),
    )
    return replace(sequence, rectify_labels=rectify_labels)


def _poses(shared: SharedView, folder: Path, options: ReadOptions, notes: list[str]) -> PoseTrack:
    if options.poses is not None:
        notes.append(poses_of_rectified(shared.pairs[0]))
        return read_pose_track(options, options.poses)
    T = np.stack([pair.T_frame_left for pair in shared.pairs])
    if np.abs(T[:, :3, 3]).max() > _PLANET_M:
        raise JaxmapError(
            "the cameras are in planetocentric coordinates",
            where=folder,
            fix="give poses in a local frame, z up, with --poses FILE",
        )
    # Up is -y of a camera; the world's z points down where cameras would hang upside down.
    if options.poses_world == "auto" and -T[:, 2, 1].mean() < -0.3:
        T = T_ENU_SITE @ T
        notes.append("the cameras' world is taken for z down and turned z-up")
    return make_pose_track(np.arange(float(len(T))), T, where=folder)


def _paired_files(folder: Path, calibration: Path | None) -> list[tuple[Path, Path, Path, Path]]:
    """Left image, right image, left camera, right camera of each pair."""
    if (folder / "left").is_dir() and (folder / "right").is_dir():
        left, right = _two_cameras(folder, calibration)
        images = list_images(folder / "left")
        return [(image, folder / "right" / image.name, left, right) for image in images]
    if calibration is not None:
        raise JaxmapError("each image has its own camera beside it", where="--calibration", fix="leave the option out")
    by_key: dict[str, dict[str, Path]] = {}
    for image in list_images(folder):
        eye = _EYE.search(image.stem)
        if eye and image.with_suffix(".tsai").is_file():
            key = image.stem[: eye.start()] + image.stem[eye.end() :]
            by_key.setdefault(key, {}).setdefault(eye[0][0].lower(), image)
    pairs = [both for both in by_key.values() if len(both) == 2]
    if not pairs:
        raise JaxmapError(
            "no pairs of images with cameras",
            where=folder,
            fix="name them NAME_left.png, NAME_left.tsai, NAME_right.png, NAME_right.tsai, or put images in left and "
            "right, with one camera for each",
        )
    return [(b["l"], b["r"], b["l"].with_suffix(".tsai"), b["r"].with_suffix(".tsai")) for b in pairs]


def _two_cameras(folder: Path, calibration: Path | None) -> tuple[Path, Path]:
    files = sorted((calibration.parent if calibration else folder).glob("*.tsai"))
    eyes = {file: match[0][0].lower() for file in files if (match := _EYE.search(file.stem))}
    lefts = [file for file in files if eyes.get(file) == "l" and calibration in (None, file)]
    for left in lefts:
        eye = _EYE.search(left.stem)
        assert eye is not None
        rest = left.stem[: eye.start()], left.stem[eye.end() :]
        for right in (file for file in files if eyes.get(file) == "r"):
            other = _EYE.search(right.stem)
            assert other is not None
            if len(lefts) == 1 and (right.stem[: other.start()], right.stem[other.end() :]) == rest:
                return left, right
    raise JaxmapError(
        f"{len(lefts)} left cameras with a right one of the same name",
        where=calibration or folder,
        fix="name them NAME_left.tsai and NAME_right.tsai, and choose with --calibration NAME_left.tsai",
    )


READER = Reader("asp", "images with .tsai cameras of the Ames Stereo Pipeline", recognises, open_asp)

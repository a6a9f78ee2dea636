"""Planetary archives: a folder of stereo images with PDS3, PDS4 or VICAR labels that hold camera models and poses.

Each pair is linearised to one pinhole pair that the whole sequence shares; a mast may turn the eyes between pairs.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from jaxmap.datasets.base import FrameRef, Reader, StereoPair, StereoSequence, assemble, read_pose_track
from jaxmap.datasets.options import ReadOptions
from jaxmap.datasets.pds_groups import is_label, opened_product
from jaxmap.datasets.pds_labels import ProductLabel
from jaxmap.datasets.planetary_pairs import (
    CAMERAS,
    StereoProduct,
    linearised,
    of_one_camera,
    of_one_site,
    paired,
    read_labels,
)
from jaxmap.datasets.poses import PoseTrack, make_pose_track
from jaxmap.errors import FrameError, JaxmapError
from jaxmap.stereo.linearise import NEAR_M, LinearPair, PairRectifier, SharedView

T_ENU_SITE = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])
"""From a site frame (x north, y east, z down) to x east, y north, z up."""

MAX_RESIDUAL_PX = 2.0
"""Pairs whose entrance pupils move images by more than this, near against far, are refused."""

_TOLD_RESIDUAL_PX = 0.2


def recognises(folder: Path) -> bool:
    """Whether the folder holds a file that starts like a PDS3, PDS4 or VICAR label."""
    try:
        return any(is_label(file) for file in folder.iterdir())
    except OSError:
        return False


def open_planetary(folder: Path, options: ReadOptions) -> StereoSequence:
    """Opens a folder of images with labels (`NAME.IMG`, `NAME.LBL` + `NAME.IMG`, `NAME.xml` + `NAME.img`, `NAME.VIC`).

    Left and right are told by INSTRUMENT_ID or the product's name, and pair up by the spacecraft clock. Images whose
    label has no camera model, eyes without partner, and pairs of another size, zoom or site than most are left out
    and counted. The poses are the labels' own, rover in site: x east, y north, z up; `--poses` replaces them, as
    T_world_camera of the rectified left camera (what a run's poses.tum holds) or, as EuRoC csv, of the rover's frame.

    Raises:
        JaxmapError: no pair can be used, several cameras, no poses, or models that no linear pair holds.
    """
    if options.calibration is not None:
        raise JaxmapError("the camera models come from the labels", where="--calibration", fix="leave the option out")
    notes: list[str] = []
    labels = of_one_camera(read_labels(folder, notes), options.camera, folder)
    pairs = paired(labels, folder, notes)
    if options.poses is None:
        pairs = of_one_site(pairs, notes)
    products, shared = linearised(pairs, notes)
    _check_residual(shared, folder, notes)
    times_s, note = _times_s(products)
    notes.append(note)
    frames = [
        FrameRef(product.left.path.stem, float(time_s), product.left.path, product.right.path)
        for product, time_s in zip(products, times_s, strict=True)
    ]
    camera = products[0].pair.camera
    read_pair = _PairReader(products, shared)
    track, T_child_camera = _poses(products, times_s, options, folder, notes)
    sequence = assemble(
        name=Path(os.path.abspath(folder)).name,
        dataset="planetary",
        where=folder,
        frames=frames,
        track=track,
        camera=camera,
        # The world of a label's poses is known; guessing by the cameras' up axes fails where a mast looks down.
        options=options if options.poses else replace(options, poses_world="z_up"),
        T_child_camera=T_child_camera,
        notes=notes,
        read_pair=read_pair,
        size_px=(camera.width_px, camera.height_px),
    )
    sequence = replace(sequence, rectify_labels=read_pair.rectify_labels)
    return sequence if options.poses else replace(sequence, T_world_source=T_ENU_SITE)


def poses_of_rectified(pair: LinearPair) -> str:
    """A note on which camera a file's poses are taken for, and how far it is turned from the raw left one."""
    turn = Rotation.from_matrix(pair.T_frame_left[:3, :3].T @ pair.left.axes).magnitude()
    return (
        "the poses are taken for those of the rectified left camera, as a run's poses.tum holds them; it is turned by "
        f"{np.degrees(turn):.2f} degrees from the left camera as it stands"
    )


class _PairReader:
    """Reads and rectifies the pair of a frame; may be called from several threads."""

    def __init__(self, products: Sequence[StereoProduct], shared: SharedView) -> None:
        self._rows = {product.left.path.stem: (row, product) for row, product in enumerate(products)}
        self._rectify = PairRectifier(shared)
        self._white = _white_level([product.left for product in products if product.left.depth != "uint8"])

    def __call__(self, frame: FrameRef) -> StereoPair:
        row, product = self._rows[frame.name]
        left, right = (_to_8_bits(_read_pixels(eye), self._white) for eye in (product.left, product.right))
        return StereoPair(*self._rectify(row, left, right))

    def rectify_labels(self, frame: FrameRef, labels: np.ndarray) -> np.ndarray:
        """Labels or probabilities of a frame's raw left image, rectified."""
        return self._rectify.labels(self._rows[frame.name][0], labels)


def _read_pixels(label: ProductLabel) -> np.ndarray:
    """(H, W) or (H, W, 3), of the type they are stored in."""
    try:
        with opened_product(label.path) as product:
            bands = product.read()
            if product.nodata is not None and bands.dtype != np.uint8:
                bands[bands == product.nodata] = 0
    except JaxmapError as fault:
        raise FrameError(fault.what, where=fault.where, fix=fault.fix) from fault
    return bands[0] if len(bands) == 1 else np.ascontiguousarray(np.moveaxis(bands, 0, -1))


def _to_8_bits(pixels: np.ndarray, white: float) -> np.ndarray:
    if pixels.dtype == np.uint8:
        return pixels
    return np.clip(np.nan_to_num(pixels.astype(np.float32)) * (255 / white), 0, 255).astype(np.uint8)


def _white_level(labels: Sequence[ProductLabel], count: int = 8) -> float:
    """What becomes 255 in deep images: one number for the sequence, or pixels of a frame would not match the next's.

    It is the 99.9th percentile of several images, so that no hot pixel decides it.
    """
    brightest: list[float] = []
    for index in np.unique(np.linspace(0, len(labels) - 1, count).astype(int)) if labels else ():
        try:
            pixels = _read_pixels(labels[index])[::2, ::2]
        except FrameError:
            continue
        white = float(np.quantile(np.nan_to_num(pixels.astype(np.float32)), 0.999))
        # Eight bits of a dark image stay as dark as they are; radiances have no such scale.
        brightest.append(white if pixels.dtype.kind == "f" else max(white, 255.0))
    return max((white for white in brightest if white > 0), default=1.0)


def _check_residual(shared: SharedView, folder: Path, notes: list[str]) -> None:
    residual_px = max(shared.pairs[row].residual_px() for row in set(shared.maps_of))
    what = f"the entrance pupils of these CAHVORE cameras move: {residual_px:.1f} px between {NEAR_M:g} m and far away"
    if residual_px > MAX_RESIDUAL_PX:
        raise JaxmapError(
            f"{what}, of which a linear pair can hold {MAX_RESIDUAL_PX:g}",
            where=folder,
            fix="take linearised products (GEOMETRY_PROJECTION_TYPE = LINEARIZED), or a smaller part of the images",
        )
    if residual_px > _TOLD_RESIDUAL_PX:
        notes.append(f"{what}, which the linearised pair does not follow")


def _times_s(products: Sequence[StereoProduct]) -> tuple[np.ndarray, str]:
    utc_s = [product.left.time_s for product in products]
    known = np.array([time_s for time_s in utc_s if time_s is not None])
    if len(known) == len(utc_s) and len(np.unique(known)) == len(known):
        return known, "times of the frames from START_TIME, UTC in s since 1970"
    return np.array(
        [product.left.clock_s for product in products]
    ), "times of the frames from the spacecraft clock, in s"


def _poses(
    products: Sequence[StereoProduct], times_s: np.ndarray, options: ReadOptions, folder: Path, notes: list[str]
) -> tuple[PoseTrack, np.ndarray | None]:
    """The track, and the rectified left camera in its child frame where that is another one."""
    if options.poses is not None:
        track = read_pose_track(options, options.poses, allow_body=True)
        if track.child == "body":
            return track, np.stack([product.pair.T_frame_left for product in products])
        notes.append(poses_of_rectified(products[0].pair))
        return track, None
    T_site_left = [_T_site_left(product) for product in products]
    known = [index for index, T in enumerate(T_site_left) if T is not None]
    if not known:
        raise JaxmapError(
            f"the labels have no pose of {products[0].left.model_frame or 'the rover'} in its site",
            where=folder,
            fix="give poses with --poses FILE (TUM text, T_world_camera of the left camera)",
        )
    T = T_ENU_SITE @ np.stack([T for T in T_site_left if T is not None])
    return make_pose_track(times_s[known], T, where=folder), None


def _T_site_left(product: StereoProduct) -> np.ndarray | None:
    """The rectified left camera in the site frame, by the frames of the label; None where they do not reach it."""
    name, T = product.left.model_frame, product.pair.T_frame_left
    for _ in range(8):
        if _is_level(name):
            return T
        if name not in product.left.frames and "ROVER" in name:
            name = next((other for other in product.left.frames if "ROVER" in other), name)
        if name not in product.left.frames:
            return None
        name, T_parent_frame = product.left.frames[name]
        T = T_parent_frame @ T
    return None


def _is_level(frame: str) -> bool:
    return "SITE" in frame or "LOCAL_LEVEL" in frame


READER = Reader(
    "planetary",
    "a folder of PDS3, PDS4 or VICAR stereo images with camera models in their labels",
    recognises,
    open_planetary,
    tuple(name for name, _ in CAMERAS),
)

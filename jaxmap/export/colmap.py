"""Camera, poses and occupied voxels as a COLMAP model in text, as splatting and photogrammetry programs read it."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float64, UInt8
from scipy.spatial.transform import Rotation

from jaxmap.errors import JaxmapError
from jaxmap.host.files import atomic_path
from jaxmap.types import Pinhole

FILES = ("cameras.txt", "images.txt", "points3D.txt")


def write_colmap(
    folder: str | os.PathLike[str],
    camera: Pinhole,
    size_px: tuple[int, int],
    names: Sequence[str],
    T_world_camera: Float64[np.ndarray, "N 4 4"],
    points_world: Float[np.ndarray, "P 3"],
    colours: UInt8[np.ndarray, "P 3"],
    site_origin: Float64[np.ndarray, "3"],
) -> None:
    """Writes `FILES` into a folder.

    COLMAP's poses are world to camera, its quaternions begin with the real part, and the centre of its first pixel is
    (0.5, 0.5), where ours is (0, 0). Coordinates stay relative to the site origin, which a comment names: float32,
    which most readers hold them in, resolves half a metre of a UTM northing.

    Args:
        folder: made where it is missing.
        camera: the rectified left camera, one for all images.
        size_px: width and height of the images.
        names: of the image files, one for each pose.
        T_world_camera: poses of the rectified left camera, relative to the site origin.
        points_world: metres, relative to the site origin.
        colours: of the points.
        site_origin: told in comments.

    Raises:
        JaxmapError: a name that a line cannot hold, or the disk is full or refuses.
    """
    for name in names:
        if not name or name.split() != [name]:
            raise JaxmapError(f"COLMAP takes no image name with spaces: {name!r}", where=folder, fix="rename the image")
    T_camera_world = np.linalg.inv(T_world_camera)
    quaternions_wxyz = np.roll(Rotation.from_matrix(T_camera_world[:, :3, :3]).as_quat(canonical=True), 1, axis=-1)
    note = f"# by jaxmap; metres, x east, y north, z up, relative to {' '.join(map(repr, site_origin.tolist()))}"
    numbers = (camera.fx_px, camera.fy_px, camera.cx_px + 0.5, camera.cy_px + 0.5)
    cameras = [f"1 PINHOLE {size_px[0]} {size_px[1]} {' '.join(map(repr, numbers))}"]
    # The second line of an image holds its features: none.
    images = [
        f"{index} {' '.join(map(repr, [*turn, *place]))} 1 {name}\n"
        for index, (turn, place, name) in enumerate(
            zip(quaternions_wxyz.tolist(), T_camera_world[:, :3, 3].tolist(), names, strict=True), start=1
        )
    ]
    # An error of -1 is not known, and the track is empty.
    points = [
        f"{index} {x:.4f} {y:.4f} {z:.4f} {red} {green} {blue} -1"
        for index, ((x, y, z), (red, green, blue)) in enumerate(
            zip(points_world.tolist(), colours.tolist(), strict=True), start=1
        )
    ]
    for name, columns, lines in (
        (FILES[0], "CAMERA_ID, MODEL, WIDTH, HEIGHT, fx, fy, cx, cy", cameras),
        (FILES[1], "IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME; features", images),
        (FILES[2], "POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK", points),
    ):
        with atomic_path(Path(folder) / name) as temporary:
            temporary.write_text("\n".join([note, f"# {columns}", *lines]) + "\n", encoding="utf-8")

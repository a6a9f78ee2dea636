"""A drive and its map as a recording of rerun (https://rerun.io): into its viewer, or into a file."""

from __future__ import annotations

import importlib
import importlib.util
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float64, UInt8

from jaxmap.errors import JaxmapError, UsageError
from jaxmap.host.files import atomic_path
from jaxmap.labels import IGNORE, class_colours
from jaxmap.types import Pinhole

PICTURE_PX = 640
"""Width of the pictures that are logged."""
_AHEAD_M, _AWAY_M = 4.0, 5.0
"""So far before the camera its ground begins to be the map; how much farther than that is wide the eye is away."""
_SINCE_1970_S = 1e8
"""Smaller times count from some start of their own."""
_SHOWN = {"left": "Left image", "labels": "Labels", "disparity": "Disparity"}


def load_rerun() -> Any:
    """The package rerun.

    Raises:
        JaxmapError: it is not installed.
    """
    if importlib.util.find_spec("rerun") is None:
        raise JaxmapError("rerun is not installed", where="the viewer", fix="pip install 'jaxmap[view]'")
    return importlib.import_module("rerun")


class Recording:
    """Logs into a recording, on the time lines `frame` (index in the sequence) and `time`.

    The world is z-up, metres, relative to the site origin; `world/camera` is the rectified left camera.
    """

    def __init__(self, stream: Any, classes: Sequence[str]) -> None:
        """Begins with what holds all the time: axes, names and colours of the classes.

        Args:
            stream: a `rerun.RecordingStream`.
            classes: of the map.
        """
        self._rr, self._stream = load_rerun(), stream
        colours = class_colours(classes)
        named = [*enumerate(classes), (IGNORE, "no label")]
        context = [self._rr.AnnotationInfo(id=i, label=name, color=colours[i].tolist()) for i, name in named]
        self._static("world", self._rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        self._static("world", self._rr.AnnotationContext(context))

    def at(self, frame: int, timestamp_s: float) -> None:
        """Where on the time lines what follows is logged."""
        self._stream.set_time("frame", sequence=frame)
        kind = "timestamp" if timestamp_s > _SINCE_1970_S else "duration"
        self._stream.set_time("time", **{kind: timestamp_s})

    def pose(self, T_world_camera: Float64[np.ndarray, "4 4"]) -> None:
        """Moves the camera."""
        pose = self._rr.Transform3D(translation=T_world_camera[:3, 3], mat3x3=T_world_camera[:3, :3])
        self._stream.log("world/camera", pose)

    def path(self, positions: Float64[np.ndarray, "N 3"]) -> None:
        """The whole path, at all times."""
        self._static("world/path", self._rr.LineStrips3D([positions], colors=[[37, 99, 235]]))

    def left(self, picture: Path | UInt8[np.ndarray, "H W *rgb"], camera: Pinhole | None, width_px: int) -> None:
        """The left image, seen by the camera where that is known.

        Args:
            picture: a file, or pixels.
            camera: that of the image at its own size.
            width_px: that size.
        """
        encoded, size = _encoded(picture)
        if camera is not None:
            share = size[0] / width_px
            pinhole = self._rr.Pinhole(
                focal_length=[camera.fx_px * share, camera.fy_px * share],
                # The centre of rerun's first pixel is (0.5, 0.5).
                principal_point=[(camera.cx_px + 0.5) * share, (camera.cy_px + 0.5) * share],
                resolution=list(size),
                camera_xyz=self._rr.ViewCoordinates.RDF,
                image_plane_distance=0.6,
            )
            self._stream.log("world/camera/left", pinhole)
        self._stream.log("world/camera/left", encoded)

    def no_left(self) -> None:
        """From here on there is no left image: an earlier one would stand beside what is of another frame."""
        self._stream.log("world/camera/left", self._rr.Clear(recursive=False))

    def picture(self, kind: str, picture: Path | UInt8[np.ndarray, "H W *rgb"]) -> None:
        """Labels or disparity in colour; `kind` is `labels` or `disparity`."""
        self._stream.log(kind, _encoded(picture)[0])

    def voxels(
        self,
        part: str,
        centres_world: Float[np.ndarray, "N 3"],
        labels: UInt8[np.ndarray, "N"],
        size_m: Float[np.ndarray, "3"],
    ) -> None:
        """Voxels, which stay from now on; those of an earlier time under the same name go."""
        half = np.tile(np.asarray(size_m, np.float32) / 2, (len(labels), 1))
        boxes = self._rr.Boxes3D(
            half_sizes=half, centers=centres_world, class_ids=labels.astype(np.uint16), fill_mode="solid"
        )
        self._stream.log(f"world/voxels/{part}", boxes)

    def note(self, text: str) -> None:
        """A line for the one who looks."""
        self._stream.log("notes", self._rr.TextLog(text))

    def _static(self, entity: str, content: Any) -> None:
        self._stream.log(entity, content, static=True)


@contextmanager
def recording(
    name: str, classes: Sequence[str], T_world_camera: Float64[np.ndarray, "N 4 4"], save: Path | None
) -> Iterator[Recording]:
    """A recording that streams into a viewer, which is started, or into a file, which is there when the block ends.

    A block that is interrupted (Ctrl-C) leaves a file of what came so far; one that fails leaves none.

    Args:
        name: of what is shown.
        classes: of the map.
        T_world_camera: of all frames; at first one sees what they looked at.
        save: the file, or None for a viewer.

    Raises:
        JaxmapError: what `check_viewer` refuses, or the file cannot be written.
    """
    rr, layout = check_viewer(save), _layout(T_world_camera)
    if save is None:
        with rr.RecordingStream("jaxmap") as stream:
            stream.spawn(default_blueprint=layout)
            stream.send_recording_name(name)
            yield Recording(stream, classes)
        return
    stopped = None
    with atomic_path(save) as temporary:
        with rr.RecordingStream("jaxmap") as stream:
            stream.save(temporary, default_blueprint=layout)
            stream.send_recording_name(name)
            try:
                yield Recording(stream, classes)
            except KeyboardInterrupt as stop:
                stopped = stop
        stream.disconnect()
    if stopped is not None:
        raise stopped


def check_viewer(save: Path | None) -> Any:
    """The package rerun, where there is all that a recording needs: long work need not begin without.

    Raises:
        JaxmapError: rerun is not installed, or there is no display for a window.
        UsageError: the file is no `.rrd`.
    """
    rr = load_rerun()
    if save is not None and save.suffix != ".rrd":
        raise UsageError(f"{save} is no .rrd file", fix="name one: rerun knows its files by it")
    if save is None and sys.platform == "linux" and not {"DISPLAY", "WAYLAND_DISPLAY"} & os.environ.keys():
        raise JaxmapError(
            "there is no display for the viewer's window",
            fix="write a file instead (jaxmap view RUN --save F.rrd, jaxmap map --view-save F.rrd), and open it "
            "elsewhere with: rerun F.rrd",
        )
    return rr


def _layout(T_world_camera: Float64[np.ndarray, "N 4 4"]) -> Any:
    """The world from above the drive, beside the pictures; the time line counts frames, and begins at the last."""
    blueprint = importlib.import_module("rerun.blueprint")
    places = {"left": "world/camera/left", "labels": "labels", "disparity": "disparity"}
    pictures = [blueprint.Spatial2DView(origin=place, name=_SHOWN[kind]) for kind, place in places.items()]
    positions, ahead = T_world_camera[:, :3, 3], T_world_camera[:, :3, 2]
    seen = np.concatenate([positions, positions + _AHEAD_M * ahead])
    low, high = seen.min(axis=0), seen.max(axis=0)
    middle, away_m = (low + high) / 2, _AWAY_M + float(np.linalg.norm(high - low))
    eye = blueprint.EyeControls3D(
        kind=blueprint.Eye3DKind.Orbital,
        position=middle + away_m * np.array([-0.3, -0.8, 0.8]),
        look_target=middle,
        eye_up=[0, 0, 1],
    )
    world = blueprint.Spatial3DView(origin="world", name="Map", eye_controls=eye, line_grid=False)
    return blueprint.Blueprint(
        blueprint.Horizontal(world, blueprint.Vertical(*pictures), column_shares=[2, 1]),
        blueprint.TimePanel(state="collapsed", timeline="frame", fps=5.0, play_state="following"),
        blueprint.BlueprintPanel(state="collapsed"),
        blueprint.SelectionPanel(state="collapsed"),
    )


def _encoded(picture: Path | np.ndarray) -> tuple[Any, tuple[int, int]]:
    """A picture as rerun takes it, at most `PICTURE_PX` wide, and its size."""
    from PIL import Image

    from jaxmap.host.pictures import open_picture

    if isinstance(picture, Path):
        with open_picture(picture) as opened:
            image = opened.convert("RGB")
    else:
        image = Image.fromarray(picture).convert("RGB")
    image.thumbnail((PICTURE_PX, PICTURE_PX))
    buffer = BytesIO()
    image.save(buffer, "jpeg", quality=88)
    return load_rerun().EncodedImage(contents=buffer.getvalue(), media_type="image/jpeg"), image.size

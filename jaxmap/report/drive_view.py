"""The drive on a page: the map in 3D and from above, and the key frames, moved together by a slider under them."""

from __future__ import annotations

import base64
import gzip
import io
import json
from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxmap.errors import FrameError, JaxmapError
from jaxmap.host.bounded_text import parse_json
from jaxmap.host.pictures import open_picture
from jaxmap.report.detail import detail_section
from jaxmap.report.image_colours import SeenFrame, image_colours
from jaxmap.report.page import figure, inline_image, script_text, section
from jaxmap.report.run_contents import PICTURES, RunContents
from jaxmap.report.top_down import PLACE, PLACE_KEY
from jaxmap.report.voxel_view import voxel_view
from jaxmap.report.wording import value_text

MAX_KEY_FRAMES = 24
PICTURE_WIDTH_PX = 640
_MAP_WIDTH_PX = 900
_SIDE_POINTS = 9
"""Points along each side of the image whose rays outline what a camera sees of the ground."""
_RAISED_M = 0.05


def drive_section(contents: RunContents, page: Path) -> str:
    """The section of the drive; a page holds one at most. What cannot be read is left out, with a remark.

    A map that is too large for one view has a section more, of its parts in detail, which may lie beside the page.
    """
    rows = {frame: row for frame in _chosen(contents) if (row := key_frame_row(contents, frame))}
    seen = seen_frames(contents.pictures, contents.group("camera"))
    around = _map_from_above(contents)
    parts, merged = _in_3d(contents, seen)
    if around:
        parts = f'<div class="stage">{parts}{_from_above(around[0])}</div>'
    shown = "".join(f'<div class="frame"><h3>Frame {escape(name)}</h3>{row}</div>' for name, row in rows.items())
    if len(rows) > 1:
        views = [_view(contents, name, seen.get(name), around and around[1]) for name in rows]
        slider = f'<input type="range" min="0" max="{len(rows) - 1}" value="0" aria-label="Key frame">'
        parts += (
            '<div class="scrubber" hidden title="also by the arrow keys"><button type="button" aria-label="Play">▶'
            f"</button>{slider}<output></output></div>"
            f'<script type="application/json" id="drive-data">{script_text(json.dumps(views))}</script>'
        )
    if shown:
        parts += f'<div class="frames">{shown}</div>'
    if len(rows) < len(contents.pictures):
        parts += f"<p>{len(rows)} of {len(contents.pictures)} key frames.</p>"
    detail = detail_section(contents.source, page, *around) if around and merged > 1 else ""
    return section("The drive", f'<div id="drive">{parts}</div>') + detail


def _chosen(contents: RunContents) -> list[str]:
    """The key frames of the page, evenly spaced where there are too many."""
    frames = list(contents.pictures)
    if len(frames) > MAX_KEY_FRAMES:
        frames = [frames[i] for i in np.linspace(0, len(frames) - 1, MAX_KEY_FRAMES).round().astype(int)]
    return frames


def _in_3d(contents: RunContents, seen: dict[str, SeenFrame]) -> tuple[str, int]:
    """The interactive view with its caption, and how many voxels along an edge it draws as one."""
    if not len(contents.voxels.label):
        return "<p>No voxel is occupied.</p>", 1
    frames = list(seen.values())
    view = voxel_view(
        contents.voxels,
        contents.classes,
        contents.trajectory_world,
        (lambda points_world: image_colours(points_world, frames)) if frames else None,
        merged=contents.merged,
        count=contents.occupied,
    )
    return (
        '<figure class="in3d"><div id="view3d" class="view3d" role="figure" '
        f'aria-label="Occupied voxels of {escape(contents.name)} in 3D, to turn by dragging"></div>'
        f"<figcaption>{escape(view.caption)} Drag to turn, scroll to zoom.</figcaption></figure>"
        f'<script type="text/plain" id="view3d-data">{_packed(str(view.figure.to_json()))}</script>'
    ), view.merged


def _packed(text: str) -> str:
    """A text as page.js unpacks it."""
    return base64.b64encode(gzip.compress(text.encode(), 6, mtime=0)).decode("ascii")


def seen_frames(pictures: Mapping[str, Mapping[str, Path]], camera: Mapping[str, Any]) -> dict[str, SeenFrame]:
    """The key frames with their cameras, by name; those that are not whole are left out.

    Args:
        pictures: of `find_pictures`.
        camera: that of `metrics.json`.
    """
    frames, poses = {}, camera.get("key_frames")
    for name, pose in poses.items() if isinstance(poses, dict) else ():
        try:
            with open_picture(pictures[name]["left"]) as image:
                pixels = np.asarray(image)
            # Most pictures are smaller than the images that the camera is of.
            share = pixels.shape[1] / camera["width_px"]
            frames[name] = SeenFrame(
                pixels,
                np.array(pose, np.float64).reshape(4, 4),
                (camera["fx_px"] * share, camera["fy_px"] * share),
                ((camera["cx_px"] + 0.5) * share - 0.5, (camera["cy_px"] + 0.5) * share - 0.5),
            )
        except (FrameError, KeyError, ValueError, TypeError):
            continue
    return frames


def key_frame_row(contents: RunContents, frame: str) -> str:
    """The pictures of a key frame side by side; those that cannot be read are left out with a remark."""
    figures = ""
    for kind, caption in PICTURES.items():
        if path := contents.pictures[frame].get(kind):
            try:
                figures += figure(inline_image(path, f"{caption}, frame {frame}", width_px=PICTURE_WIDTH_PX), caption)
            except JaxmapError:
                contents.remarks.append(f"pictures/{path.name} could not be read and is left out.")
    return f'<div class="row">{figures}</div>' if figures else ""


def _map_from_above(contents: RunContents) -> tuple[str, Float[np.ndarray, "3 3"]] | None:
    """The map itself, cut from the picture of the top-down map, and the matrix from metres of the world to its pixels.

    None where there is no picture, or none that says where the map lies on it.
    """
    try:
        with open_picture(contents.path / "bev.png") as picture:
            place: dict[str, Any] = parse_json(getattr(picture, "text", {})[PLACE_KEY], picture)
            left, top, width, height, west, south, east, north = (float(place[name]) for name in PLACE)
            image = picture.convert("RGB").crop((round(left), round(top), round(left + width), round(top + height)))
        per_m = np.array([width / (east - west), height / (north - south)])
        image.thumbnail((_MAP_WIDTH_PX, _MAP_WIDTH_PX))
    except (JaxmapError, OSError, ValueError, KeyError, TypeError, ZeroDivisionError):
        return None
    share = image.width / width
    buffer = io.BytesIO()
    image.save(buffer, "webp", quality=86)
    data = base64.b64encode(buffer.getvalue()).decode("ascii")
    svg = (
        f'<svg viewBox="0 0 {image.width} {image.height}" role="img" aria-label="The map from above"><image '
        f'href="data:image/webp;base64,{data}" width="{image.width}" height="{image.height}"/></svg>'
    )
    sx, sy = (per_m * share).tolist()
    return svg, np.array([[sx, 0, -west * sx], [0, -sy, north * sy], [0, 0, 1]])


def _from_above(svg: str) -> str:
    """The map with what drive.js moves over it."""
    moved = '<path class="seen"/><circle class="camera" r="0"/></svg>'
    caption = "From above, north up; outlined, the ground that the camera has in its image."
    return f'<figure class="above">{svg.replace("</svg>", moved)}<figcaption>{caption}</figcaption></figure>'


def _view(
    contents: RunContents, name: str, seen: SeenFrame | None, T_map_world: Float[np.ndarray, "3 3"] | None
) -> dict[str, Any]:
    """What the slider shows of one key frame besides its pictures: numbers for drive.js."""
    if seen is None:
        return {"name": name}
    outline = ground_outline(seen, _ground_m(contents, seen), _range_m(contents))
    camera = seen.T_world_camera[:3, 3]
    view: dict[str, Any] = {"name": name, "camera": _rounded(camera), "outline": _rounded(outline)}
    path = contents.trajectory_world
    if path is not None and len(path):
        nearest = int(np.linalg.norm(path - camera, axis=1).argmin())
        driven_m = float(np.linalg.norm(np.diff(path[: nearest + 1], axis=0), axis=1).sum())
        view["driven"] = f"{value_text(round(driven_m, 1), 'm')} driven".replace("&nbsp;", "\N{NO-BREAK SPACE}")
    if T_map_world is not None:
        for key, places in (("camera_px", camera[None]), ("outline_px", outline)):
            view[key] = _rounded(places[:, :2] @ T_map_world[:2, :2].T + T_map_world[:2, 2])
    return view


def ground_outline(seen: SeenFrame, ground_m: float, range_m: float) -> Float[np.ndarray, "P 3"]:
    """The outline of what a camera sees of level ground, from the lower left of its image round to the upper left.

    Args:
        seen: the image with its camera.
        ground_m: height of the ground, world.
        range_m: greatest depth; a ray that meets no ground before ends there, and is laid on the ground.
    """
    height, width = seen.image.shape[:2]
    across, up = np.linspace(-0.5, width - 0.5, _SIDE_POINTS), np.linspace(height - 0.5, -0.5, _SIDE_POINTS)
    u = np.concatenate([across, np.full(_SIDE_POINTS, width - 0.5), across[::-1], np.full(_SIDE_POINTS, -0.5)])
    v = np.concatenate([np.full(_SIDE_POINTS, height - 0.5), up, np.full(_SIDE_POINTS, -0.5), up[::-1]])
    rays = np.stack(
        [(u - seen.centre_px[0]) / seen.focal_px[0], (v - seen.centre_px[1]) / seen.focal_px[1], np.ones_like(u)], -1
    )
    rays_world = rays @ seen.T_world_camera[:3, :3].T
    position = seen.T_world_camera[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        depth_m = (ground_m - position[2]) / rays_world[:, 2]
    depth_m = np.where((depth_m > 0) & (depth_m < range_m), depth_m, range_m)
    outline = position + depth_m[:, None] * rays_world
    outline[:, 2] = ground_m
    return outline


def _ground_m(contents: RunContents, seen: SeenFrame) -> float:
    """Height of the ground about a camera: that of the middle of the voxels near it, and a little more to be seen."""
    centres = contents.voxels.centres_world
    position = seen.T_world_camera[:3, 3]
    near = np.linalg.norm(centres[:, :2] - position[:2], axis=1) < _range_m(contents) / 2
    if not near.any():
        return float(position[2] - 1)
    return float(np.median(centres[near, 2])) + float(contents.voxels.voxel_size_m[2]) / 2 + _RAISED_M


def _range_m(contents: RunContents) -> float:
    """The greatest depth that was mapped; 10 m where it is not known."""
    depths_m = contents.group("grid").get("depth_range_m")
    return float(depths_m[1]) if isinstance(depths_m, list) and len(depths_m) == 2 else 10.0


def _rounded(numbers: np.ndarray) -> list[Any]:
    return np.asarray(numbers, np.float64).round(3).tolist()

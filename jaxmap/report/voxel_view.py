"""Occupied voxels as a 3D figure to turn around: their visible faces, of coarser voxels where there are too many."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt8

from jaxmap.export.voxels import OccupiedVoxels
from jaxmap.labels import IGNORE, class_colours
from jaxmap.report.wording import value_text

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

MAX_FACES, _PATH_POINTS = 100_000, 5000
_PALETTE = 64
"""Colours that are left of the images': one number a face, where colours would be text."""

# The corners of a face, for each axis it can be normal to, counter-clockwise.
_SQUARE = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])


class Faces(NamedTuple):
    """Square faces of voxels: corners on the voxel grid, two triangles for each face, and the voxel it belongs to."""

    corner: Int[np.ndarray, "P 3"]
    triangle: Int[np.ndarray, "2F 3"]
    voxel: Int[np.ndarray, "F"]


def exposed_faces(index: Int[np.ndarray, "N 3"], *, undersides: bool = True) -> Faces:
    """The faces between a voxel of `index` (each given once) and a neighbour that is not in it."""
    index = np.asarray(index, np.int64).reshape(-1, 3)
    low = index.min(axis=0, initial=np.iinfo(np.int32).max) - 1
    local = index - low
    shape = tuple((local.max(axis=0, initial=0) + 2).tolist())
    # Looked up by their numbers: an array of all voxels between those of a long drive would fill the memory.
    solid = np.sort(np.ravel_multi_index(tuple(local.T), shape))
    corners, voxels = [], []
    for axis in range(3):
        for side in (0, 1):
            if (axis, side) == (2, 0) and not undersides:
                continue
            step = (2 * side - 1) * np.eye(3, dtype=np.int64)[axis]
            beside = np.ravel_multi_index(tuple((local + step).T), shape)
            at = np.searchsorted(solid, beside).clip(max=len(solid) - 1)
            voxel = np.flatnonzero(solid[at] != beside) if len(solid) else np.zeros(0, np.int64)
            square = np.insert(_SQUARE, axis, side, axis=1)
            # Seen from outside, corners go round counter-clockwise (y is the one axis whose plane is left-handed).
            square = square if (side == 1) != (axis == 1) else square[::-1]
            corners.append((local[voxel, None] + square[None]).reshape(-1, 3))
            voxels.append(voxel)
    keys = np.ravel_multi_index(tuple(np.concatenate(corners).T), shape)
    shared, quads = np.unique(keys, return_inverse=True)
    return Faces(
        corner=(np.stack(np.unravel_index(shared, shape), axis=-1) + low).astype(np.int32),
        triangle=quads.reshape(-1, 4)[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3).astype(np.int32),
        voxel=np.concatenate(voxels).astype(np.int32),
    )


def merge_voxels(
    index: Int[np.ndarray, "N 3"], label: UInt8[np.ndarray, "N"]
) -> tuple[Int[np.ndarray, "M 3"], UInt8[np.ndarray, "M"]]:
    """Merges 2 x 2 x 2 voxels into one, with the label of most of them (the lowest among equals)."""
    parents, place = np.unique(np.asarray(index, np.int64) // 2, axis=0, return_inverse=True)
    pairs, counts = np.unique(place.ravel() * 256 + label, return_counts=True)
    # Sorted by parent, then by falling count: the first of each parent wins.
    order = np.lexsort((pairs, -counts, pairs // 256))
    first = order[np.unique(pairs[order] // 256, return_index=True)[1]]
    return parents.astype(np.int32), (pairs[first] % 256).astype(np.uint8)


class VoxelView(NamedTuple):
    """A plotly figure, what its caption has to say of it, and how many voxels along an edge are drawn as one."""

    figure: Figure
    caption: str
    merged: int


def voxel_view(
    voxels: OccupiedVoxels,
    classes: Sequence[str],
    trajectory_world: Float[np.ndarray, "N 3"] | None = None,
    colours_of: Callable[[Float[np.ndarray, "M 3"]], UInt8[np.ndarray, "M 3"]] | None = None,
    *,
    merged: int = 1,
    count: int | None = None,
) -> VoxelView:
    """Draws the visible faces of voxels by class, height or the images' colours (its buttons), with the rover's path.

    Undersides are left out. Voxels are merged 2 x 2 x 2 until at most `MAX_FACES` faces are left.

    Args:
        voxels: of the map.
        classes: their names.
        trajectory_world: the path.
        colours_of: gives the images' colours at centres of voxels (world); without it there is no such button.
        merged: how many voxels of the map along an edge were merged into one of these.
        count: of the map's voxels; by default of these.
    """
    from plotly.graph_objects import Figure

    size_m = np.asarray(voxels.voxel_size_m, np.float64)
    index, label, count = voxels.index, voxels.label, len(voxels.label) if count is None else count
    # The corner of voxel (0, 0, 0), from the centre of the first voxel there is.
    origin_m = np.zeros(3)
    if len(index):
        origin_m = voxels.centres_world[0].astype(np.float64) - (index[0] + 0.5) * size_m
    faces = exposed_faces(index, undersides=False)
    while len(faces.voxel) > MAX_FACES:
        index, label = merge_voxels(index, label)
        size_m, merged = size_m * 2, merged * 2
        faces = exposed_faces(index, undersides=False)
    corners_world = (origin_m + faces.corner * size_m).astype(np.float32)
    path_world = np.zeros((0, 3)) if trajectory_world is None else np.asarray(trajectory_world, np.float64)
    path_world = path_world[np.isfinite(path_world).all(axis=-1)]

    figure, buttons = Figure(), []
    if len(label):
        face_voxel = np.repeat(faces.voxel, 2)
        by_class = _class_colours(label, face_voxel, classes)
        centres_world = origin_m + (index + 0.5) * size_m
        by_height = _height_colours(centres_world[face_voxel, 2].astype(np.float32))
        colourings = {"Classes": by_class, "Height": by_height}
        if colours_of is not None:
            colourings["Images"] = _image_colours(colours_of(centres_world), face_voxel)
        colourings = {name: colouring for name, colouring in colourings.items() if colouring is not None}
        buttons = [_buttons(colourings)] if len(colourings) > 1 else []
        figure.add_mesh3d(
            **{axis: corners_world[:, i] for i, axis in enumerate("xyz")},
            **{corner: faces.triangle[:, i] for i, corner in enumerate("ijk")},
            **(by_class or by_height),
            intensitymode="cell",
            flatshading=True,
            # Without an epsilon of 0 plotly takes faces as small as these for degenerate, and leaves them unlit.
            lighting=dict(ambient=0.65, diffuse=0.5, specular=0.03, roughness=0.9, fresnel=0.0)
            | dict(facenormalsepsilon=0, vertexnormalsepsilon=0),
            lightposition=dict(x=-6e4, y=-2e4, z=1e5),
            hovertemplate="east %{x:.1f} m, north %{y:.1f} m, height %{z:.1f} m<extra></extra>",
            name="voxels",
        )
    _add_path(figure, path_world)
    figure.update_layout(
        scene=_scene(np.concatenate([corners_world.astype(np.float64), path_world]), path_world),
        margin=dict(l=0, r=0, t=0, b=0),
        paper_bgcolor="rgba(0,0,0,0)",
        showlegend=False,
        updatemenus=buttons,
    )
    size = " × ".join(f"{edge_m:g}" for edge_m in size_m.astype(np.float32).tolist())
    caption = f"{value_text(count)} occupied voxels of {size} m."
    if merged > 1:
        caption = (
            f"{value_text(count)} occupied voxels, drawn as {value_text(len(label))} of {size} m: "
            f"{merged} × {merged} × {merged} voxels merged into one, with the label of most of them."
        )
    return VoxelView(figure, caption, merged)


_BAR: dict[str, Any] = dict(thickness=10, len=0.55, x=1.0, xanchor="right", y=0.5, outlinewidth=0)


def _height_colours(z_m: Float[np.ndarray, "F"]) -> dict[str, Any]:
    low, high = np.percentile(z_m, [1, 99]).tolist()
    look = dict(colorscale="Viridis", cmin=low, cmax=max(high, low + 1e-3))
    return dict(look, intensity=z_m, colorbar=dict(_BAR, title=dict(text="height, m")))


def _class_colours(label: np.ndarray, face_voxel: np.ndarray, classes: Sequence[str]) -> dict[str, Any] | None:
    """Colours by class; None where no voxel has one."""
    present = np.unique(label)
    if (present == IGNORE).all():
        return None
    colours = [f"rgb({r},{g},{b})" for r, g, b in class_colours(classes)[present].tolist()]
    steps = np.linspace(0, 1, len(present) + 1).tolist()
    names = ["no label" if index == IGNORE else classes[index] for index in present.tolist()]
    return dict(
        intensity=np.searchsorted(present, label)[face_voxel].astype(np.uint8),
        colorscale=[[edge, colour] for i, colour in enumerate(colours) for edge in steps[i : i + 2]],
        cmin=-0.5,
        cmax=len(present) - 0.5,
        colorbar=dict(_BAR, title=dict(text=""), tickvals=list(range(len(present))), ticktext=names),
    )


def _image_colours(colours: UInt8[np.ndarray, "M 3"], face_voxel: np.ndarray) -> dict[str, Any]:
    """Colours of their own for voxels, by a palette."""
    from PIL import Image

    picture = Image.fromarray(colours[None]).quantize(_PALETTE)
    palette = np.array(picture.getpalette(), np.uint8).reshape(-1, 3)
    # From dark to bright, so that neighbours in the palette look alike.
    order = palette.sum(axis=-1, dtype=int).argsort(kind="stable")
    rank = np.empty(len(order), np.uint8)
    rank[order] = np.arange(len(order))
    last = max(len(order) - 1, 1)
    scale = [[step / last, f"rgb({r},{g},{b})"] for step, (r, g, b) in enumerate(palette[order].tolist())]
    return dict(
        intensity=rank[np.asarray(picture)[0]][face_voxel],
        colorscale=scale if len(scale) > 1 else [scale[0], [1.0, scale[0][1]]],
        cmin=0,
        cmax=last,
        showscale=False,
    )


def _buttons(colourings: dict[str, dict[str, Any]]) -> dict[str, Any]:
    def button(text: str, colouring: dict[str, Any]) -> dict[str, Any]:
        # What one colouring does not set, another may have set.
        bar = dict(tickvals=None, ticktext=None) | colouring.get("colorbar", {})
        values = dict(dict(showscale=True) | colouring, colorbar=bar)
        # One value for one trace: the mesh is the first.
        return dict(label=text, method="restyle", args=[{name: [value] for name, value in values.items()}, [0]])

    return dict(
        type="buttons",
        direction="right",
        x=0.01,
        xanchor="left",
        y=0.99,
        yanchor="top",
        pad=dict(l=4, t=4),
        showactive=True,
        buttons=[button(text, colouring) for text, colouring in colourings.items()],
    )


def _add_path(figure: Figure, path_world: Float[np.ndarray, "N 3"]) -> None:
    if not len(path_world):
        return
    path_world = path_world[np.unique(np.linspace(0, len(path_world) - 1, _PATH_POINTS).round().astype(int))]
    xyz = {axis: path_world[:, i].astype(np.float32) for i, axis in enumerate("xyz")}
    figure.add_scatter3d(**xyz, mode="lines", line=dict(color="#2563eb", width=6), hoverinfo="skip", name="path")
    ends = {axis: values[[0, -1]] for axis, values in xyz.items()}
    figure.add_scatter3d(
        **ends,
        mode="markers",
        marker=dict(color=["#ffffff", "#2563eb"], size=6, line=dict(color="#2563eb", width=2)),
        text=["start", "end"],
        hovertemplate="%{text}<extra></extra>",
        name="ends of the path",
    )


def _scene(points_world: Float[np.ndarray, "N 3"], path_world: Float[np.ndarray, "P 3"]) -> dict[str, Any]:
    """A scene of equal metres on all axes, seen at a slant from behind the rover, as it saw the faces of rocks.

    Without a path, or with one that turns back, it is seen across its shorter side.
    """
    low, high = (points_world.min(axis=0), points_world.max(axis=0)) if len(points_world) else (-np.ones(3), np.ones(3))
    span_m = np.maximum(high - low, 1e-2)
    longest_m = span_m[:2].max()
    turn = np.deg2rad(-66.0 if span_m[0] >= span_m[1] else -24.0)
    slant, distance = np.deg2rad(36.0), 1.5
    across = np.array([np.cos(turn), np.sin(turn), 0.0])
    steps_m = np.diff(path_world[:, :2], axis=0)
    way_m, length_m = steps_m.sum(axis=0), np.linalg.norm(steps_m, axis=-1).sum()
    if np.linalg.norm(way_m) > max(0.5 * length_m, 0.5):
        across = np.append(-way_m / np.linalg.norm(way_m), 0.0)
    # What is near looks larger: looking at the ground a little before the middle fills the view evenly.
    centre = 0.3 * across
    if len(points_world):
        centre[2] = 1.6 * (np.median(points_world[:, 2]) - (low[2] + high[2]) / 2) / longest_m
    eye = centre + distance * (np.cos(slant) * across + np.sin(slant) * np.array([0.0, 0.0, 1.0]))
    axes = {
        f"{axis}axis": dict(visible=False, range=[float(low[i]), float(low[i] + span_m[i])])
        for i, axis in enumerate("xyz")
    }
    ratio = (1.6 * span_m / longest_m).tolist()
    return dict(
        **axes,
        aspectmode="manual",
        aspectratio=dict(zip("xyz", ratio, strict=True)),
        camera=dict(
            eye=dict(zip("xyz", eye.tolist(), strict=True)), center=dict(zip("xyz", centre.tolist(), strict=True))
        ),
        dragmode="orbit",
        domain=dict(x=[0.0, 0.92]),
    )

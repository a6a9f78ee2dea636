"""Occupied voxels as a 3D figure to turn around."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float, UInt8

from jaxmap.export.voxels import OccupiedVoxels
from jaxmap.labels import IGNORE, class_colours
from jaxmap.report.faces import Faces, exposed_faces, merge_voxels

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

MAX_FACES = 40_000
HEIGHT_COLOURS = "Viridis"


class VoxelView(NamedTuple):
    """A plotly figure, and what its caption has to say of it."""

    figure: Figure
    caption: str


class _Shape(NamedTuple):
    """What is drawn: the faces of voxels of `size_m`, and a label for each voxel."""

    faces: Faces
    label: UInt8[np.ndarray, "N"]
    centre_z_m: Float[np.ndarray, "N"]
    corners_world: Float[np.ndarray, "P 3"]
    size_m: Float[np.ndarray, "3"]
    merged: int


def voxel_view(
    voxels: OccupiedVoxels, classes: Sequence[str], trajectory_world: Float[np.ndarray, "N 3"] | None = None
) -> VoxelView:
    """Draws the visible faces of voxels by class (or height, by its buttons) with the rover's path.

    Undersides are left out. Voxels are merged 2 x 2 x 2 until at most `MAX_FACES` faces are left.
    """
    from plotly.graph_objects import Figure

    shape = _shape(voxels)
    path_world = np.zeros((0, 3)) if trajectory_world is None else np.asarray(trajectory_world, np.float64)
    path_world = path_world[np.isfinite(path_world).all(axis=-1)]
    figure = Figure()
    by_class, by_height = _colourings(shape, classes)
    start = by_class if by_class else by_height
    if len(shape.label):
        figure.add_mesh3d(
            **{axis: shape.corners_world[:, i] for i, axis in enumerate("xyz")},
            **{corner: shape.faces.triangle[:, i] for i, corner in enumerate("ijk")},
            **start,
            intensitymode="cell",
            flatshading=True,
            # Without an epsilon of 0 plotly takes faces as small as these for degenerate, and leaves them unlit.
            lighting=dict(
                ambient=0.55,
                diffuse=0.6,
                specular=0.03,
                roughness=0.9,
                fresnel=0.0,
                facenormalsepsilon=0,
                vertexnormalsepsilon=0,
            ),
            lightposition=dict(x=-6e4, y=-2e4, z=1e5),
            hovertemplate="east %{x:.1f} m, north %{y:.1f} m, height %{z:.1f} m<extra></extra>",
            name="voxels",
        )
    _add_path(figure, path_world)
    points_world = np.concatenate([shape.corners_world.astype(np.float64), path_world])
    figure.update_layout(
        scene=_scene(points_world),
        margin=dict(l=0, r=0, t=0, b=0),
        paper_bgcolor="rgba(0,0,0,0)",
        showlegend=False,
        updatemenus=[_buttons(by_class, by_height)] if by_class and len(shape.label) else [],
    )
    return VoxelView(figure, _caption(voxels, shape))


def _shape(voxels: OccupiedVoxels) -> _Shape:
    size_m = np.asarray(voxels.voxel_size_m, np.float64)
    index, label, merged = voxels.index, voxels.label, 1
    # The corner of voxel (0, 0, 0), told from the centre of the first voxel there is.
    origin_m = np.zeros(3)
    if len(index):
        origin_m = voxels.centres_world[0].astype(np.float64) - (index[0] + 0.5) * size_m
    faces = exposed_faces(index, undersides=False)
    while len(faces.voxel) > MAX_FACES:
        index, label = merge_voxels(index, label)
        size_m, merged = size_m * 2, merged * 2
        faces = exposed_faces(index, undersides=False)
    return _Shape(
        faces=faces,
        label=label,
        centre_z_m=origin_m[2] + (index[:, 2] + 0.5) * size_m[2],
        corners_world=(origin_m + faces.corner * size_m).astype(np.float32),
        size_m=size_m,
        merged=merged,
    )


def _colourings(shape: _Shape, classes: Sequence[str]) -> tuple[dict[str, Any] | None, dict[str, Any]]:
    """The mesh's colours by class (none where no voxel has one) and by height."""
    face_voxel = np.repeat(shape.faces.voxel, 2)
    bar = dict(thickness=10, len=0.55, x=1.0, xanchor="right", y=0.5, outlinewidth=0)
    z_m = shape.centre_z_m[face_voxel].astype(np.float32)
    low, high = np.percentile(z_m, [1, 99]).tolist() if len(z_m) else (0.0, 1.0)
    by_height = dict(
        intensity=z_m,
        colorscale=HEIGHT_COLOURS,
        cmin=low,
        cmax=max(high, low + 1e-3),
        colorbar=dict(bar, title=dict(text="height, m")),
    )
    present = np.unique(shape.label)
    if (present == IGNORE).all():
        return None, by_height
    colours = [f"rgb({r},{g},{b})" for r, g, b in class_colours(classes)[present].tolist()]
    steps = np.linspace(0, 1, len(present) + 1).tolist()
    return dict(
        intensity=np.searchsorted(present, shape.label)[face_voxel].astype(np.uint8),
        colorscale=[[edge, colour] for i, colour in enumerate(colours) for edge in steps[i : i + 2]],
        cmin=-0.5,
        cmax=len(present) - 0.5,
        colorbar=dict(
            bar,
            title=dict(text=""),
            tickvals=list(range(len(present))),
            ticktext=["no label" if label == IGNORE else classes[label] for label in present.tolist()],
        ),
    ), by_height


def _buttons(by_class: dict[str, Any], by_height: dict[str, Any]) -> dict[str, Any]:
    def button(text: str, colouring: dict[str, Any]) -> dict[str, Any]:
        # One value for one trace: the mesh is the first.
        return dict(label=text, method="restyle", args=[{name: [value] for name, value in colouring.items()}, [0]])

    plain = dict(by_height, colorbar=dict(by_height["colorbar"], tickvals=None, ticktext=None))
    return dict(
        type="buttons",
        direction="right",
        x=0.01,
        xanchor="left",
        y=0.99,
        yanchor="top",
        pad=dict(l=4, t=4),
        showactive=True,
        buttons=[button("Classes", by_class), button("Height", plain)],
    )


def _add_path(figure: Figure, path_world: Float[np.ndarray, "N 3"]) -> None:
    if not len(path_world):
        return
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


def _scene(points_world: Float[np.ndarray, "N 3"]) -> dict[str, Any]:
    """A scene of equal metres on all axes, seen at a slant across its shorter side."""
    low, high = (points_world.min(axis=0), points_world.max(axis=0)) if len(points_world) else (-np.ones(3), np.ones(3))
    span_m = np.maximum(high - low, 1e-2)
    longest_m = span_m[:2].max()
    turn = np.deg2rad(-66.0 if span_m[0] >= span_m[1] else -24.0)
    slant, distance = np.deg2rad(40.0), 1.65
    across = np.array([np.cos(turn), np.sin(turn), 0.0])
    # What is near looks larger: looking a little before the middle fills the view evenly.
    centre = 0.16 * across
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


def _caption(voxels: OccupiedVoxels, shape: _Shape) -> str:
    size = " × ".join(f"{size_m:g}" for size_m in shape.size_m.astype(np.float32).tolist())
    if shape.merged == 1:
        return f"{_count(voxels.label)} occupied voxels of {size} m."
    return (
        f"{_count(voxels.label)} occupied voxels, drawn as {_count(shape.label)} of {size} m: "
        f"{shape.merged} × {shape.merged} × {shape.merged} voxels merged into one, with the label of most of them."
    )


def _count(values: np.ndarray) -> str:
    return f"{len(values):,}".replace(",", "\N{NARROW NO-BREAK SPACE}")

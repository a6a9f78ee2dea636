"""The page of a refinement: consistency before and after, the trajectory, and how certain each parameter is."""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from jaxmap.host.files import atomic_path
from jaxmap.refinement.refine import Refinement
from jaxmap.report.page import inline_image, page, svg_of
from jaxmap.report.wording import number_text

CONSISTENCY, TRAJECTORY = "consistency.png", "trajectory.png"
_BEFORE, _AFTER = "#d55e00", "#0072b2"
_MAX_ROWS = 60


def write_refine_report(out: Path, name: str, state: Refinement, content: dict[str, Any]) -> Path:
    """Writes the pictures and `report.html` of a refinement, and returns the page's path.

    Args:
        out: the folder.
        name: of the sequence.
        state: the finished refinement.
        content: what is in refine.json.

    Raises:
        JaxmapError: the disk is full or refuses.
    """
    for file, figure in ((CONSISTENCY, _consistency_figure(state)), (TRAJECTORY, _trajectory_figure(state))):
        with atomic_path(out / file) as temporary:
            figure.savefig(temporary)
    sections = [
        _header(name, content),
        _picture(out / CONSISTENCY, "Spread of heights between frames, column by column, before and after"),
        _picture(out / TRAJECTORY, "Camera positions, top-down and in height, before and after"),
        '<section><h2>Median match residual, step by step</h2><div class="paper">'
        f"{svg_of(_residual_figure(state), 'Median match residual, step by step')}</div></section>",
        _parameters("What was refined", content["parameters"]),
        _parameters("The map as a whole", content["whole_map"]),
        _frames(content),
        _notes(content),
    ]
    target = out / "report.html"
    with atomic_path(target) as temporary:
        temporary.write_text(
            page(f"{name}, refined", "".join(sections), drawn=False), encoding="utf-8", errors="backslashreplace"
        )
    return target


def _header(name: str, content: dict[str, Any]) -> str:
    spread, residual = content["map_height_spread_m"], content["match_residual_px"]
    stats = {
        "frames": len(content["frames"]),
        "pairs compared": content["matches"]["pairs"],
        "matches": content["matches"]["count"],
        "height spread, before": _length(spread["before"]),
        "height spread, after": _length(spread["after"]),
        "match residual, before": f"{residual['before']:.2f} px",
        "match residual, after": f"{residual['after']:.2f} px",
    }
    body = "".join(f"<div><dt>{key}</dt><dd>{value}</dd></div>" for key, value in stats.items())
    return (
        f'<header><p class="kind">Refined poses</p><h1>{escape(name)}</h1><dl class="stats">{body}</dl></header>'
        "<section><p>Matches determine how frames lie relative to each other. Where the map as a whole lies is "
        "unobservable from them and stays with the given poses, unless an elevation model or labelled rocks tie the "
        "map to the ground.</p></section>"
    )


def _length(metres: float | None) -> str:
    return "-" if metres is None else f"{100 * metres:.2f} cm"


def _picture(path: Path, caption: str) -> str:
    return f'<section><h2>{caption}</h2><div class="paper">{inline_image(path, caption)}</div></section>'


def _parameters(title: str, rows: list[dict[str, Any]]) -> str:
    if not rows:
        return ""
    head = "".join(f'<th scope="col">{name}</th>' for name in ("", "found", "± 1 σ", "prior ± 1 σ", "observable"))
    body = "".join(
        f'<tr><th scope="row">{escape(row["name"].replace("_", " "))}</th>'
        + "".join(f"<td>{number_text(row[key])}</td>" for key in ("value", "sigma", "prior_sigma"))
        + f"<td>{'yes' if row['observable'] else 'no: prior kept'}</td></tr>"
        for row in rows
    )
    return (
        f'<section><h2>{title}</h2><div class="list"><table><thead><tr>{head}</tr></thead>'
        f"<tbody>{body}</tbody></table></div></section>"
    )


def _frames(content: dict[str, Any]) -> str:
    poses = content["poses"]
    head = "".join(
        f'<th scope="col">{name}</th>' for name in ("Frame", "moved, m", "± m", "turned, deg", "± deg", "matched")
    )
    alone = set(content["matches"]["frames_without"])
    rows = []
    for index, name in enumerate(content["frames"][:_MAX_ROWS]):
        cells = (poses[key][index] for key in ("moved_m", "sigma_m", "turned_deg", "sigma_deg"))
        numbers = "".join(f"<td>{number_text(value)}</td>" for value in cells)
        matched = "no" if index in alone else "yes"
        rows.append(f'<tr><th scope="row">{escape(name)}</th>{numbers}<td>{matched}</td></tr>')
    more = len(content["frames"]) - len(rows)
    rest = f"<p>and {more} more, in refine.json</p>" if more > 0 else ""
    return (
        '<section><h2>Frames</h2><details><summary>How far each frame was moved</summary><div class="list"><table>'
        f"<thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table></div>{rest}</details></section>"
    )


def _notes(content: dict[str, Any]) -> str:
    notes = [*content["notes"], *(f"skipped {one['frame']}: {one['reason']}" for one in content["skipped"])]
    items = "".join(f"<li>{escape(str(note))}</li>" for note in notes)
    return f"<section><h2>Notes</h2><ul>{items}</ul></section>" if items else ""


def _residual_figure(state: Refinement) -> Figure:
    figure = Figure(figsize=(8, 3.2), layout="constrained")
    axes = figure.subplots()
    axes.plot(state.residuals_px, "o-", color=_AFTER, markersize=3, linewidth=1.4)
    for step, name in state.rounds:
        axes.axvline(step, color="0.7", linewidth=0.8, linestyle=":")
        place = (step + 0.15, 0.98)
        axes.annotate(name, place, xycoords=("data", "axes fraction"), rotation=90, va="top", fontsize=7, color="0.4")
    axes.set(xlabel="step", ylabel="match residual, px")
    if min(state.residuals_px) > 0:
        axes.set_yscale("log")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.spines[["top", "right"]].set_visible(False)
    return figure


def _consistency_figure(state: Refinement) -> Figure:
    figure = Figure(figsize=(10, 4.6), layout="constrained", dpi=130)
    axes = figure.subplots(1, 2, sharex=True, sharey=True)
    maps = [(name, one) for name, one in (("before", state.before), ("after", state.after)) if one is not None]
    spreads_m = np.concatenate([one.spread_m[np.isfinite(one.spread_m)] for _, one in maps])
    top_cm = max(100 * float(np.percentile(spreads_m, 95)), 0.1) if len(spreads_m) else 1.0
    for axis, (name, consistency) in zip(axes, maps, strict=False):
        lower = np.asarray(consistency.grid.origin_m, np.float64)
        upper = lower + np.asarray(consistency.grid.voxel_size_m, np.float64) * consistency.grid.shape
        image = axis.imshow(
            100 * consistency.spread_m.T,
            origin="lower",
            extent=(lower[0], upper[0], lower[1], upper[1]),
            vmin=0,
            vmax=top_cm,
            cmap="magma_r",
        )
        axis.set(title=f"{name}: {100 * consistency.height_m:.2f} cm", xlabel="east, m")
        if axis is axes[0]:
            axis.set_ylabel("north, m")
            figure.colorbar(image, ax=axes, label="spread of heights between frames, cm", shrink=0.8)
    return figure


def _trajectory_figure(state: Refinement) -> Figure:
    figure = Figure(figsize=(10, 4.2), layout="constrained", dpi=130)
    top_down, beside = figure.subplots(1, 2)
    before, after = state.given.T_world_camera[:, :3, 3], state.rig.T_world_camera[:, :3, 3]
    path_m = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(after[:, :2], axis=0), axis=1)))
    for name, place, colour in (("before", before, _BEFORE), ("after", after, _AFTER)):
        top_down.plot(place[:, 0], place[:, 1], "o-", color=colour, label=name, markersize=3, linewidth=1)
        beside.plot(path_m, place[:, 2], "o-", color=colour, label=name, markersize=3, linewidth=1)
    top_down.set(xlabel="east, m", ylabel="north, m", aspect="equal", adjustable="datalim")
    beside.set(xlabel="distance along the path, m", ylabel="height, m")
    beside.legend(frameon=False)
    return figure

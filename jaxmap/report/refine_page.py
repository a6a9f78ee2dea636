"""The page of a refinement: how the frames agree before and after, where they went, and what the data could tell."""

from __future__ import annotations

from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from jaxmap.host.files import atomic_path
from jaxmap.refinement.consistency import Consistency
from jaxmap.refinement.refine import Refinement
from jaxmap.report.charts import Chart, Mark, Series, line_chart
from jaxmap.report.inline import inline_image
from jaxmap.report.page import page
from jaxmap.report.wording import number_text

SPREAD, TRAJECTORY = "consistency.png", "trajectory.png"
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
    _draw_consistency(out / SPREAD, state)
    _draw_trajectory(out / TRAJECTORY, state)
    style = files("jaxmap.report").joinpath("training_page.css").read_text(encoding="utf-8")
    sections = [
        f"<style>{style}</style>",
        _header(name, content),
        _picture(out / SPREAD, "How much frames differ in the height of a column, before and after"),
        _picture(out / TRAJECTORY, "The cameras from above and from the side, before and after"),
        _curve(state),
        _parameters("What was refined", content["parameters"]),
        _parameters("The map as a whole", content["whole_map"]),
        _frames(content),
        _notes(content),
    ]
    target = out / "report.html"
    with atomic_path(target) as temporary:
        temporary.write_text(page(f"{name}, refined", "".join(sections), drawn=False), encoding="utf-8")
    return target


def _header(name: str, content: dict[str, Any]) -> str:
    spread, residual = content["map_height_spread_m"], content["match_residual_px"]
    stats = {
        "frames": len(content["frames"]),
        "pairs compared": content["matches"]["pairs"],
        "matches": content["matches"]["count"],
        "height spread, before": _length(spread["before"]),
        "and after": _length(spread["after"]),
        "matches off, before": f"{number_text(residual['before'])} px",
        "and now": f"{number_text(residual['after'])} px",
    }
    body = "".join(f"<div><dt>{key}</dt><dd>{value}</dd></div>" for key, value in stats.items())
    return (
        f'<header><p class="kind">Refined poses</p><h1>{escape(name)}</h1><dl class="stats">{body}</dl></header>'
        "<section><p>Matches between frames make the frames agree with each other. Where the map as a whole lies they "
        "cannot tell: that stays with the given poses, unless an elevation model or labelled rocks say otherwise.</p>"
        "</section>"
    )


def _length(metres: float | None) -> str:
    return "-" if metres is None else f"{100 * metres:.2f} cm"


def _picture(path: Path, caption: str) -> str:
    return f'<section><h2>{caption}</h2><div class="paper">{inline_image(path, caption)}</div></section>'


def _curve(state: Refinement) -> str:
    values = state.residuals_px
    points = [(float(step), value) for step, value in enumerate(values)]
    last = state.rounds[-1]
    chart = Chart(
        "Median distance of matches from where they should be, step by step",
        "step",
        "match residual, px",
        mark=Mark(float(last[0]), last[1]) if 0 < last[0] < len(values) - 1 else None,
    )
    drawn = line_chart(chart, [Series("", points, "var(--accent)", strong=True)])
    return f'<section><h2>Residual</h2><div class="tables"><figure>{drawn}</figure></div></section>'


def _parameters(title: str, rows: list[dict[str, Any]]) -> str:
    if not rows:
        return ""
    head = "".join(f'<th scope="col">{name}</th>' for name in ("", "found", "± 1 σ", "given ± 1 σ", "told by the data"))
    body = "".join(
        f'<tr><th scope="row">{escape(row["name"].replace("_", " "))}</th>'
        + "".join(f"<td>{number_text(row[key])}</td>" for key in ("value", "sigma", "prior_sigma"))
        + f"<td>{'yes' if row['observable'] else 'no: as given'}</td></tr>"
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
    told = f"<p>and {more} more, in refine.json</p>" if more > 0 else ""
    return (
        '<section><h2>Frames</h2><details><summary>How far each went</summary><div class="list"><table>'
        f"<thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table></div>{told}</details></section>"
    )


def _notes(content: dict[str, Any]) -> str:
    told = [*content["notes"], *(f"skipped {one['frame']}: {one['reason']}" for one in content["skipped"])]
    items = "".join(f"<li>{escape(str(note))}</li>" for note in told)
    return f"<section><h2>Notes</h2><ul>{items}</ul></section>" if items else ""


def _draw_consistency(path: Path, state: Refinement) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 4.6), layout="constrained", dpi=130)
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, 2, sharex=True, sharey=True)
    found = [("before", state.before), ("after", state.after)]
    spreads = [one.spread_m[np.isfinite(one.spread_m)] for _, one in found if one is not None]
    top_cm = max(100 * float(np.percentile(np.concatenate(spreads), 95)), 0.1) if len(np.concatenate(spreads)) else 1.0
    image = None
    for axis, (name, consistency) in zip(axes, found, strict=True):
        if consistency is None:
            continue
        extent = _extent(consistency)
        image = axis.imshow(
            100 * consistency.spread_m.T, origin="lower", extent=extent, vmin=0, vmax=top_cm, cmap="magma_r"
        )
        axis.set_title(f"{name}: {100 * consistency.height_m:.2f} cm")
        axis.set_xlabel("east, m")
    axes[0].set_ylabel("north, m")
    if image is not None:
        figure.colorbar(image, ax=axes, label="spread of heights between frames, cm", shrink=0.8)
    with atomic_path(path) as temporary:
        figure.savefig(temporary)


def _extent(consistency: Consistency) -> tuple[float, float, float, float]:
    grid = consistency.grid
    lower = np.asarray(grid.origin_m, np.float64)
    upper = lower + np.asarray(grid.voxel_size_m, np.float64) * grid.shape
    return float(lower[0]), float(upper[0]), float(lower[1]), float(upper[1])


def _draw_trajectory(path: Path, state: Refinement) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 4.2), layout="constrained", dpi=130)
    FigureCanvasAgg(figure)
    above, beside = figure.subplots(1, 2)
    before, after = state.given.T_world_camera[:, :3, 3], state.rig.T_world_camera[:, :3, 3]
    way_m = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(after[:, :2], axis=0), axis=1)))
    for name, place, colour in (("before", before, "#d55e00"), ("after", after, "#0072b2")):
        above.plot(place[:, 0], place[:, 1], "o-", color=colour, label=name, markersize=3, linewidth=1)
        beside.plot(way_m, place[:, 2], "o-", color=colour, label=name, markersize=3, linewidth=1)
    above.set(xlabel="east, m", ylabel="north, m", aspect="equal")
    beside.set(xlabel="way, m", ylabel="height, m")
    above.legend(frameon=False)
    with atomic_path(path) as temporary:
        figure.savefig(temporary)

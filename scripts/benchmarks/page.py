"""The page of a benchmark run: targets, growth, and all figures; it needs no other file and no network."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from benchmarks.gate import Verdict
from benchmarks.growth import growth_of, growth_picture
from benchmarks.wording import count_text, rate_text, short, short_speed, speed_text, time_text
from jaxmap.report.page import page

Case = Mapping[str, Any]

_TITLE = "Beside the programs people would use instead"
_HEADLINES = (
    ("sequence large", "SGBM 3WAY", "whole sequence, of SGBM's rate"),
    ("sequence_fine large", "SGBM 3WAY", "the same, default voxels"),
    ("fuse medium", "OctoMap, ray casting", "fusion, beside OctoMap's rays"),
    ("fuse medium", "OctoMap, discretised", "beside OctoMap discretised"),
    ("mlesac medium", "Open3D segment_plane, 512", "MLESAC, beside Open3D"),
)


def bench_page(report: Mapping[str, Any], found: Sequence[Verdict]) -> str:
    """The whole page as HTML.

    Args:
        report: what the JSON holds.
        found: what the gate says.
    """
    style = Path(__file__).with_name("page.css").read_text("utf-8")
    by_group = {name: [case for case in report["cases"].values() if case["group"] == name] for name in report["groups"]}
    sections = [
        f"<style>{style}</style>",
        _header(report, found),
        _targets(report["cases"], found),
        _growth(report["groups"], by_group),
        _figures(report["groups"], by_group),
        _machine(report),
        "<footer>Made by jaxmap's scripts/bench.py.</footer>",
    ]
    return page("Benchmarks", "".join(sections), drawn=False)


def _header(report: Mapping[str, Any], found: Sequence[Verdict]) -> str:
    machine = report["machine"]
    kept = sum(verdict.passed for verdict in found)
    stats = [(told, speed) for case, peer, told in _HEADLINES if (speed := _speed(report["cases"], case, peer))]
    stats.append(("gates kept", f"{kept} of {len(found)}"))
    shown = "".join(f"<div><dt>{escape(told)}</dt><dd>{escape(value)}</dd></div>" for told, value in stats)
    line = f"{machine['cores']} cores of {machine['processor']}; medians of interleaved runs in one process"
    return (
        f'<header><p class="kind">Benchmarks</p><h1>{_TITLE}</h1><p>{escape(line)}</p>'
        f'<dl class="stats">{shown}</dl></header>'
    )


def _speed(cases: Mapping[str, Case], name: str, peer: str) -> str:
    """How fast a case is beside the peer whose name begins so; empty where it was not measured."""
    for beside, figures in cases.get(name, {}).get("peers", {}).items():
        if beside.startswith(peer):
            return short_speed(figures["ratio"])
    return ""


def _targets(cases: Mapping[str, Case], found: Sequence[Verdict]) -> str:
    bounds = {(verdict.case, verdict.peer): verdict for verdict in found}
    rows = ""
    for name, case in cases.items():
        for peer, beside in case["peers"].items():
            if "limit" not in beside:
                continue
            met = beside["ratio"] <= beside["limit"]
            verdict = bounds.get((name, peer))
            ratio = f"{beside['ratio']:.3g}" + (f" of {verdict.bound:.3g}" if verdict is not None else "")
            rows += (
                f'<tr><th scope="row">{escape(name)}</th><td class="text">{escape(peer)}</td>'
                f"<td>{time_text(case['median_ms'])}</td><td>{time_text(beside['median_ms'])}</td>"
                f"<td>{short_speed(beside['ratio'])}</td><td>{short_speed(beside['limit'])}</td>"
                f"<td{'' if met else ' class=missed'}>{'met' if met else 'not met'}</td>"
                f"<td{' class=missed' if verdict and not verdict.passed else ''}>{ratio}</td></tr>"
            )
    if not rows:
        return ""
    names = ("", "beside", "jaxmap", "the other", "speed", "target", "", "ratio, gate")
    head = "".join(f'<th scope="col"{" class=text" if name == "beside" else ""}>{name}</th>' for name in names)
    return (
        f'<section><h2>Targets</h2><div class="figures"><figure><table><thead><tr>{head}</tr></thead>'
        f"<tbody>{rows}</tbody></table></figure></div><p>Speed is jaxmap's beside the other's, a ratio jaxmap's time "
        "over the other's. A gate is the ratio that fails the run; without one, the target is only told.</p></section>"
    )


def _growth(told: Mapping[str, str], by_group: Mapping[str, Sequence[Case]]) -> str:
    figures = ""
    for name, cases in by_group.items():
        if (growth := growth_of(cases)) is None:
            continue
        data = base64.b64encode(growth_picture(growth)).decode("ascii")
        alt = f"{name}: time over {growth.unit}"
        figures += (
            f"<figure><figcaption>{escape(name)}<span>{escape(told[name])}</span></figcaption>"
            f'<img src="data:image/png;base64,{data}" alt="{escape(alt)}"></figure>'
        )
    if not figures:
        return ""
    return (
        f'<section><h2>Growth</h2><div class="growth">{figures}</div><p>Both axes are logarithmic: the dotted line '
        "through jaxmap's last point is growth in proportion to the size. Over frames, the time of one is drawn, which "
        "should stay. Bands are as wide as the distance of the quartiles.</p></section>"
    )


def _figures(told: Mapping[str, str], by_group: Mapping[str, Sequence[Case]]) -> str:
    tables = "".join(_group_table(name, told[name], cases) for name, cases in by_group.items() if cases)
    return f'<section><h2>All figures</h2><div class="figures">{tables}</div></section>'


def _group_table(name: str, told: str, cases: Sequence[Case]) -> str:
    columns = ("", "median", "spread", "runs", "rate, or jaxmap beside it", "compiled in", "temporary")
    head = "".join(f'<th scope="col">{column}</th>' for column in columns)
    body = "".join(_case_rows(case) for case in cases)
    return (
        f"<figure><figcaption>{escape(name)}<span>{escape(told)}</span></figcaption>"
        f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></figure>"
    )


def _case_rows(case: Case) -> str:
    rate = rate_text(case["work_per_s"], case["work"]["unit"])
    compile_text = f"{case['compile_s']:.2f} s" if "compile_s" in case else ""
    temporary = f"{case['temporary_mib']:.1f} MiB" if "temporary_mib" in case else ""
    rows = _row("own", count_text(**case["grown"]), case, rate, compile_text, temporary)
    for peer, beside in case["peers"].items():
        rows += _row("beside", peer, beside, speed_text(beside["ratio"]), "", "")
    facts = [f"{fact}: {short(value)}" for fact, value in case["facts"].items()]
    facts += [f"{peer} left out: {', '.join(lacks)} is not installed" for peer, lacks in case["missing"].items()]
    if facts:
        rows += f'<tr class="told"><td colspan="7">{"<br>".join(map(escape, facts))}</td></tr>'
    return rows


def _row(kind: str, name: str, figures: Mapping[str, Any], *rest: str) -> str:
    cells = (time_text(figures["median_ms"]), time_text(figures["spread_ms"]), str(figures["runs"]), *rest)
    shown = "".join(f"<td>{escape(cell)}</td>" for cell in cells)
    return f'<tr class="{kind}"><th scope="row">{escape(name)}</th>{shown}</tr>'


def _machine(report: Mapping[str, Any]) -> str:
    machine = report["machine"]
    values = {
        "Processor": f"{machine['processor']}, {machine['cores']} cores used",
        "Device": machine["device"],
        "Python": machine["python"],
        **machine["versions"],
        "Peak resident": f"{report['peak_resident_mib']} MiB, all cases and peers in one process",
    }
    rows = "".join(
        f'<tr><th scope="row">{escape(name)}</th><td>{escape(told)}</td></tr>' for name, told in values.items()
    )
    return f'<section><h2>Machine</h2><div class="list"><table><tbody>{rows}</tbody></table></div></section>'

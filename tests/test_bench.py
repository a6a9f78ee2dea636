"""The harness of the benchmarks: its clock, its gate, and what it does without its peers; nothing is timed."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.command import chosen, run
from benchmarks.gate import bound, merged, verdicts
from benchmarks.groups import Group, all_groups
from benchmarks.growth import growth_of, growth_picture
from benchmarks.harness import LEAST_ROUNDS, MOST_ROUNDS, TURNS, Amount, Case, Peer, measure, summary
from benchmarks.network_peers import NetworkPeers
from benchmarks.page import bench_page
from benchmarks.peers import memory_pass
from benchmarks.plane_cases import plane_errors, tilted_cloud
from benchmarks.wording import case_lines, speed_text, time_text

ROOT = Path(__file__).resolve().parent.parent
RATIOS = st.floats(1e-4, 1e2)


class Clock:
    """Time that passes only in what is run."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.calls: list[str] = []

    def __call__(self) -> float:
        return self.now_s

    def taking(self, name: str, *seconds: float):
        """A run that takes these seconds in turn, the last ones for ever."""
        left = list(seconds)

        def run() -> None:
            self.calls.append(name)
            self.now_s += left.pop(0) if len(left) > 1 else left[0]

        return run


def measured(clock: Clock, case: Case, budget_s: float = 1.0) -> dict:
    return measure(case, budget_s, clock=clock, pause=lambda: None)


def voxel_case(clock: Clock, own_s: float, peers: list[Peer], voxels: int = 1000, **rest) -> Case:
    return Case(clock.taking("own", own_s), Amount(voxels, "voxels"), Amount(500, "points"), peers, **rest)


def test_a_ratio_is_our_time_over_the_peers():
    clock = Clock()
    peer = Peer("slow", lambda: clock.taking("peer", 0.4), limit=0.5)
    figures = measured(clock, voxel_case(clock, 0.1, [peer], compile_s=1.5, temporary_bytes=3 << 20))
    assert figures["median_ms"] == pytest.approx(100) and figures["spread_ms"] == pytest.approx(0, abs=1e-9)
    assert figures["work_per_s"] == pytest.approx(5000)
    assert figures["peers"]["slow"]["ratio"] == pytest.approx(0.25)
    assert (figures["peers"]["slow"]["limit"], figures["peers"]["slow"]["gated"]) == (0.5, True)
    assert (figures["compile_s"], figures["temporary_mib"]) == (1.5, 3.0)


def test_what_comes_first_does_not_count():
    clock = Clock()
    case = Case(clock.taking("own", 0.9, 0.2, 0.1), Amount(1, "voxels"), Amount(1, "points"))
    figures = measured(clock, case)
    assert figures["median_ms"] == pytest.approx(100) and figures["spread_ms"] == pytest.approx(0, abs=1e-9)


def test_runs_are_interleaved_and_the_fast_have_more_turns():
    clock = Clock()
    figures = measured(clock, voxel_case(clock, 0.01, [Peer("slow", lambda: clock.taking("peer", 0.9))]), budget_s=0.1)
    assert figures["peers"]["slow"]["runs"] == LEAST_ROUNDS
    assert figures["runs"] == TURNS * LEAST_ROUNDS
    counted = clock.calls[-(TURNS + 1) * LEAST_ROUNDS :]
    assert counted == ([*["own"] * TURNS, "peer"] * LEAST_ROUNDS)


def test_rounds_are_bounded():
    clock = Clock()
    assert measured(clock, voxel_case(clock, 1e-6, []), budget_s=60)["runs"] == MOST_ROUNDS


@given(st.lists(st.floats(1e-6, 1e3), min_size=1, max_size=30))
def test_the_median_lies_between_the_extremes(times_s: list[float]):
    told = summary(times_s)
    assert 0.999e3 * min(times_s) <= told["median_ms"] <= 1.001e3 * max(times_s)
    # Differences of nearly equal numbers keep few digits.
    assert 0 <= told["spread_ms"] <= 1.001e3 * (max(times_s) - min(times_s)) + 1e-9 * max(times_s)


def test_a_peer_that_is_not_installed_is_left_out_and_named():
    clock = Clock()

    def never() -> None:
        raise AssertionError

    absent = Peer("absent", never, limit=0.1, modules=("json", "no_such_module_anywhere"))
    figures = measured(clock, voxel_case(clock, 0.1, [absent]))
    assert figures["peers"] == {} and figures["missing"] == {"absent": ["no_such_module_anywhere"]}
    assert verdicts({"case": figures}, {}) == []
    assert any("no_such_module_anywhere is not installed" in line for line in case_lines("case", figures, []))


@given(RATIOS, RATIOS)
def test_the_bound_lies_between_nine_tenths_of_the_limit_and_the_limit(limit: float, ratio: float):
    assert bound(limit, None) == limit
    assert 0.9 * limit <= bound(limit, min(ratio, limit)) <= limit


@given(RATIOS, RATIOS)
def test_where_the_baseline_misses_the_limit_it_must_get_no_worse(limit: float, ratio: float):
    missed = max(ratio, 1.001 * limit)
    assert missed < bound(limit, missed) < 1.3 * missed


@given(RATIOS, RATIOS, RATIOS)
def test_a_better_baseline_never_loosens_the_bound(limit: float, one: float, other: float):
    better, worse = sorted((one, other))
    assert bound(limit, better) <= bound(limit, worse)


@pytest.mark.parametrize(("ratio", "expected"), [(0.1, 0.9), (0.62, 0.93), (0.8, 1.0), (1.2, 1.5)])
def test_the_bound_follows_the_baseline(ratio: float, expected: float):
    assert bound(1.0, ratio) == pytest.approx(expected)


def case_figures(ratio: float, *, count: float = 1000, gated: bool = True, size: str = "small") -> dict:
    peer = {"median_ms": 10.0, "spread_ms": 1.0, "runs": 3, "ratio": ratio, "limit": 1.0, "gated": gated}
    own = {"median_ms": 10 * ratio, "spread_ms": 0.5, "runs": 9, "work_per_s": 5e7}
    amounts = {"grown": {"count": count, "unit": "voxels"}, "work": {"count": 500, "unit": "points"}}
    rest = {"missing": {"<gone>": ["gone"]}, "facts": {"angle": 0.1}}
    return {"group": "fuse", "size": size, **amounts, **own, "peers": {"the <other>": peer}, **rest}


def test_verdicts_are_of_gated_peers_alone():
    cases = {"kept": case_figures(0.85), "passed": case_figures(0.95), "told": case_figures(9.0, gated=False)}
    baseline = {"kept": case_figures(0.5), "passed": case_figures(0.5)}
    found = {verdict.case: verdict for verdict in verdicts(cases, baseline)}
    assert found.keys() == {"kept", "passed"}
    assert found["kept"].passed and not found["passed"].passed
    assert found["passed"].bound == pytest.approx(0.9)


def test_a_part_of_the_cases_leaves_the_rest_of_the_baseline():
    assert merged({"a": {"x": 1}, "b": {"x": 2}}, {"b": {"x": 3}}) == {"a": {"x": 1}, "b": {"x": 3}}


def bench_report(ratio: float) -> dict:
    machine = {"processor": "a & b", "cores": 2, "device": "cpu", "python": "3.11", "versions": {"jax": "0.10"}}
    cases = {
        "fuse small": case_figures(0.1),
        "fuse medium": case_figures(ratio, count=8000, size="medium"),
        "fuse large": case_figures(0.3, count=64000, size="large", gated=False),
    }
    return {"machine": machine, "peak_resident_mib": 900, "groups": {"fuse": "carving & more"}, "cases": cases}


def arguments_of(folder: Path, **changed) -> argparse.Namespace:
    given = {"list": False, "from_json": folder / "in.json", "json": None, "report": None, "write_baseline": False}
    return argparse.Namespace(**given | changed)


@pytest.mark.parametrize(("ratio", "status"), [(0.2, 0), (1.2, 1)])
def test_the_exit_status_is_that_of_the_gates(tmp_path: Path, capsys: pytest.CaptureFixture, ratio: float, status: int):
    (tmp_path / "in.json").write_text(json.dumps(bench_report(ratio)))
    given = arguments_of(tmp_path, json=tmp_path / "out.json", report=tmp_path / "out.html")
    assert run(given, tmp_path / "baseline.json") == status
    assert ("TOO SLOW: fuse medium" in capsys.readouterr().out) == bool(status)
    assert json.loads((tmp_path / "out.json").read_text()) == bench_report(ratio)
    assert not (tmp_path / "baseline.json").exists()


def test_the_baseline_is_written_and_then_binds(tmp_path: Path):
    (tmp_path / "in.json").write_text(json.dumps(bench_report(0.5)))
    baseline = tmp_path / "baseline.json"
    assert run(arguments_of(tmp_path, write_baseline=True), baseline) == 0
    (tmp_path / "in.json").write_text(json.dumps(bench_report(0.95)))
    # 0.95 is within the limit, and too far from the baseline.
    assert run(arguments_of(tmp_path), baseline) == 1


def test_the_committed_baseline_is_of_cases_that_there_are():
    cases = json.loads((ROOT / "scripts" / "bench_baseline.json").read_text())["cases"]
    names = {f"{group.name} {size}" for group in all_groups() for size in ("small", "medium", "large")}
    assert cases and cases.keys() <= names
    assert all(figures["median_ms"] > 0 for figures in cases.values())


@pytest.mark.slow
@pytest.mark.parametrize("group", all_groups(), ids=lambda group: group.name)
def test_every_case_runs_with_the_functions_of_now(group: Group):
    case = group.build("small")
    case.run()
    assert case.grown.count > 0 and case.work.count > 0
    assert len({peer.name for peer in case.peers}) == len(case.peers)
    assert not any(peer.gated and peer.limit is not None for peer in case.peers), "targets are set for larger sizes"


def test_networks_of_libraries_that_are_not_installed_are_left_out(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert NetworkPeers("mobilenet_v2", {}, np.zeros((1, 8, 8, 3), np.uint8), 1).installed() == {}


def test_a_pass_over_memory_reads_all_and_writes_what_it_is_told():
    read = [np.zeros((7, 3), np.float32), np.ones(5, bool), np.array([0, 0, 0, 9], np.int32)]
    once = memory_pass(read, 10, threads=3)
    once()
    shares = once()
    assert max(greatest for greatest, _ in shares) == 9
    np.testing.assert_array_equal(np.concatenate([updated for _, updated in shares]), np.full(10, 2.0))


def test_groups_are_found_by_name():
    groups = [Group(name, name, lambda size: None) for name in ("one", "two")]
    assert [group.name for group in chosen(groups, ["two"])] == ["two"]
    assert chosen(groups, None) == groups
    with pytest.raises(SystemExit, match="no group three; there are one, two"):
        chosen(groups, ["three"])


def test_the_page_holds_every_figure_and_escapes_names():
    report = bench_report(0.2)
    page = bench_page(report, verdicts(report["cases"], {}))
    assert "the &lt;other&gt;" in page and "<other>" not in page and "a &amp; b" in page
    assert page.count("data:image/png;base64,") == 1
    assert all(f">{count} voxels<" in page for count in ("1,000", "8,000", "64,000"))
    assert "http" not in page.replace("http-equiv", "")


def test_growth_needs_two_sizes():
    cases = list(bench_report(0.2)["cases"].values())
    assert growth_of(cases[:1]) is None
    growth = growth_of(cases)
    assert [line.name for line in growth.lines] == ["jaxmap", "the <other>"]
    assert growth.lines[0].sizes == (1000, 8000, 64000) and not growth.flat
    assert growth_picture(growth).startswith(b"\x89PNG")


def test_of_a_sequence_the_time_of_a_frame_is_drawn():
    frames = {"count": 5, "unit": "frames"}
    cases = [case_figures(0.5) | {"work": frames, "grown": {"count": count, "unit": "frames"}} for count in (5, 10)]
    growth = growth_of(cases)
    assert growth.flat and growth.lines[0].times_ms == (1.0, 1.0)


@pytest.mark.parametrize(
    ("text", "expected"),
    [(speed_text(0.02), "50 x as fast"), (speed_text(1 / 0.45), "45 % of its speed"), (time_text(1234.0), "1.23 s")],
)
def test_figures_as_text(text: str, expected: str):
    assert text == expected


def test_the_true_plane_has_no_error():
    points, truth = tilted_cloud(2000)
    angle_deg, height_mm = plane_errors(-2 * truth, truth)
    assert angle_deg == pytest.approx(0, abs=1e-6) and height_mm == pytest.approx(0, abs=1e-6)
    assert plane_errors(truth + np.array([0, 0, 0, 0.01]), truth)[1] == pytest.approx(10, rel=0.02)
    near = abs(points @ truth[:3] + truth[3]) < 0.1
    # Outliers fall near the plane by chance, too.
    assert 0.6 <= near.mean() <= 0.68

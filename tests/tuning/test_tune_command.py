"""`jaxmap tune` from files to files, on the small scene."""

from __future__ import annotations

import errno
import json
import re
from html import escape
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from fixtures import GRID, cli, map_words, scene_folder, shared_cache  # noqa: F401
from html_tables import tables_of
from killed import SLOW_DISK, fill_disk, kill_when
from tune_faults import tune_words, write_truth

import jaxmap.host.output_folder
import jaxmap.runs.tuning
from jaxmap.errors import JaxmapError
from jaxmap.fusion.params import make_fusion_params
from jaxmap.host.output_folder import locked
from jaxmap.mapping.store import load_map
from jaxmap.runs.config import MapConfig, load_config
from jaxmap.runs.tuning import descent_notes, tuned_config
from jaxmap.tuning.descent import Losses, Step
from jaxmap.tuning.parametrisation import TunedParams

SHORT = ("--steps", "6", "--held-out-share", "0.4")


@pytest.fixture(scope="module")
def truth(tmp_path_factory):
    return write_truth(tmp_path_factory.mktemp("truth") / "truth.tif")


def test_it_writes_a_configuration_its_scores_and_a_page(cli, scene_folder, truth, tmp_path):
    out = tmp_path / "fusion.yaml"
    outcome = cli(*tune_words(scene_folder, truth, out, *SHORT, "--frozen", "disparity_sigma_px"))
    assert outcome.status == 0, outcome
    assert "rock, tuned, best after" in outcome.out
    assert "wrote" in outcome.out

    tree = yaml.safe_load(out.read_text())
    assert not {"labels", "poses", "calibration", "start", "stop", "stride"} & tree.keys()
    assert tree["depth"]["max_m"] and len(tree["grid"]["voxel_size_m"]) == 3
    config = load_config(str(out))
    assert config.fusion.disparity_sigma_px == 0.5
    assert config.fusion.occupancy_hit != 0.85

    (stage,) = check_told(out)
    assert stage["name"] == "tuned"
    page = out.with_suffix(".html").read_text()
    assert page.startswith("<!doctype html>")
    assert page.count("<svg") == 3
    assert not re.search(r'(src|href)="(?!data:|#)', page)


@pytest.mark.slow
def test_what_is_tuned_with_a_kernel_is_what_map_reads(cli, scene_folder, truth, tmp_path):
    out, run = tmp_path / "fusion.yaml", tmp_path / "run"
    outcome = cli(*tune_words(scene_folder, truth, out, *SHORT, "--kernel", "3"))
    assert outcome.status == 0, outcome
    assert "rock, tuned, best after" in outcome.out and "rock, with kernel, best after" in outcome.out
    config = load_config(str(out))
    assert np.shape(config.fusion.class_kernel) == (3, 3, 3)
    assert [stage["name"] for stage in check_told(out)] == ["tuned", "with kernel"]
    assert out.with_suffix(".html").read_text().count("<svg") == 6

    labels = ("--labels", scene_folder / "labels", "--config", out)
    outcome = cli(*map_words(scene_folder, run, *labels))
    assert outcome.status == 0, outcome
    _, attributes = load_map(run / "map.zarr")
    np.testing.assert_allclose(attributes.fusion["params"]["class_kernel"], config.fusion.class_kernel)
    assert cli("evaluate", run, truth).status == 0


def check_told(out: Path) -> list[dict[str, Any]]:
    """The JSON of a tuning is whole, and its page says the same; returns the stages."""
    told = json.loads(out.with_suffix(".json").read_text())
    stages = told["stages"]
    assert told["notes"] == [note for one in stages for note in descent_notes(one)]
    for stage in stages:
        held_out = [row["held_out"] for row in stage["history"]]
        assert min(held_out) == held_out[stage["best_step"]]
        assert stage["scores"]["held_out"]["nll"]["after"] is not None
    assert told["traverses"][0]["held_out_cells"] < told["traverses"][0]["cells"]
    assert told["before"]["occupancy_hit"] == pytest.approx(0.85)

    held_out, tuned_on, *_, numbers, traverses = tables_of(out.with_suffix(".html").read_text())
    assert held_out.headings == tuned_on.headings == ["", "before", "after", "change"]
    row, scores = held_out.row("IoU"), stages[0]["scores"]["held_out"]["iou"]
    assert [text.split(" ")[0] for text in row] == [f"{scores[when]:.3f}" for when in ("before", "after", "change")]
    assert numbers.headings == ["", "before", *(stage["name"] for stage in stages)]
    first, *others = (told["before"], *(one["parameters"] for one in stages))
    assert [float(text) for text in numbers.row("occupancy hit")] == pytest.approx(
        [first["occupancy_hit"], *(one["occupancy_hit"] for one in others)], rel=0.01
    )
    assert traverses.headings == ["Sequence", "frames", "cells", "held out"]
    (one,) = told["traverses"]
    assert [int(text.replace(",", "")) for text in traverses.row(one["sequence"])] == [
        one[key] for key in ("frames", "cells", "held_out_cells")
    ]
    return stages


@pytest.mark.slow
def test_what_was_best_is_on_disk_when_it_breaks(cli, scene_folder, truth, tmp_path, monkeypatch):
    real, out = jaxmap.runs.tuning.descend, tmp_path / "fusion.yaml"

    def breaking(loss, start, options, *, data, moves, on_step):
        def stop_later(step):
            on_step(step)
            if step.number == 2:
                raise JaxmapError("the loss diverges", where="tuning", fix="take a lower --learning-rate")

        return real(loss, start, options, data=data, moves=moves, on_step=stop_later)

    monkeypatch.setattr(jaxmap.runs.tuning, "descend", breaking)
    outcome = cli(*tune_words(scene_folder, truth, out, *SHORT))
    assert outcome.status == 1
    assert "the loss diverges" in outcome.error
    assert load_config(str(out)).fusion.class_increments is not None
    assert not out.with_suffix(".json").exists()


@pytest.mark.slow
def test_what_is_assumed_of_the_ground_truth_is_told(cli, scene_folder, truth, tmp_path):
    words = ("--steps", "1", "--held-out-share", "0.4", "--crs", "EPSG:32631")
    outcome = cli(*tune_words(scene_folder, truth, tmp_path / "fusion.yaml", *words))
    assert outcome.status == 0, outcome
    assert "truth.tif has no CRS" in outcome.err


def test_a_run_that_breaks_leaves_the_files_of_an_earlier_one(cli, scene_folder, truth, tmp_path, monkeypatch):
    out = tmp_path / "fusion.yaml"
    for suffix in (".yaml", ".json", ".html"):
        out.with_suffix(suffix).write_text("of an earlier run")

    def breaking(loss, start, options, *, data, moves, on_step):
        on_step(Step(0, Losses(1.0, 1.0), start, best=True))
        raise JaxmapError("the loss diverges", where="tuning", fix="take a lower --learning-rate")

    monkeypatch.setattr(jaxmap.runs.tuning, "descend", breaking)
    outcome = cli(*tune_words(scene_folder, truth, out, *SHORT, "--overwrite"))
    best = tmp_path / ".fusion.new" / "fusion.yaml"
    assert outcome.status == 1 and f"the best so far is in {best.parent}" in outcome.err
    assert load_config(str(best)).fusion.class_increments is not None
    assert all(out.with_suffix(suffix).read_text() == "of an earlier run" for suffix in (".yaml", ".json", ".html"))


@pytest.mark.slow
def test_a_descent_that_leads_nowhere_is_told(cli, scene_folder, truth, tmp_path):
    out = tmp_path / "fusion.yaml"
    # An even prior and mild votes are near the best for a scene that is half rock.
    start = ("--fusion.class-prior", "0.5", "--fusion.class-threshold", "0.5")
    start += ("--fusion.class-hit", "0.9", "--fusion.class-miss", "-0.9")
    words = (*SHORT, "--learning-rate", "100", *start)
    outcome = cli(*tune_words(scene_folder, truth, out, *words))
    assert outcome.status == 0, outcome
    (note,) = json.loads(out.with_suffix(".json").read_text())["notes"]
    assert f"note: {note}" in outcome.err and "take a lower --learning-rate" in note
    assert escape(note) in out.with_suffix(".html").read_text()


def stage(best: int, *losses: float) -> dict:
    history = [{"step": step, "loss": loss, "held_out": loss} for step, loss in enumerate(losses)]
    return {"name": "tuned", "best_step": best, "history": history}


def test_only_descents_that_lead_nowhere_are_told():
    assert descent_notes(stage(2, 1.0, 0.9, 0.8)) == []
    (stuck,) = descent_notes(stage(0, 1.0, 0.9))
    assert "nothing better than the start" in stuck and "--learning-rate" not in stuck
    (up,) = descent_notes(stage(0, 1.0, 9.0))
    assert "nothing better than the start" in up and "from 1.000 to 9.000 in 1 steps: take a lower" in up
    (past,) = descent_notes(stage(1, 1.0, 0.9, 5.0))
    assert "what is kept is of step 1: take a lower --learning-rate" in past


def test_two_runs_do_not_share_a_folder(cli, scene_folder, truth, tmp_path):
    with locked(tmp_path):
        outcome = cli(*tune_words(scene_folder, truth, tmp_path / "fusion.yaml", *SHORT))
    assert (outcome.status, "another run is writing here" in outcome.error) == (1, True)
    assert list(tmp_path.iterdir()) == []


def test_what_cannot_be_written_is_told_before_the_work(cli, scene_folder, truth, tmp_path, monkeypatch):
    def refused(**_):
        raise PermissionError(errno.EACCES, "refused")

    monkeypatch.setattr(jaxmap.runs.tuning.TuningRun, "cache", lambda *_: pytest.fail("it reads first"))
    (tmp_path / "fusion.html").mkdir()
    outcome = cli(*tune_words(scene_folder, truth, tmp_path / "fusion.yaml", *SHORT, "--overwrite"))
    assert (outcome.status, "it is a folder" in outcome.error) == (2, True)
    monkeypatch.setattr(jaxmap.host.output_folder, "TemporaryFile", refused)
    outcome = cli(*tune_words(scene_folder, truth, tmp_path / "new" / "fusion.yaml", *SHORT))
    assert (outcome.status, "no permission to write" in outcome.error) == (1, True)
    assert not (tmp_path / "new").exists(), "nothing is left of it"


@pytest.mark.parametrize(
    ("option", "suffix"),
    [(f"--{name}", "yaml") for name in ("calibration", "poses", "palette", "config")] + [("--poses-of", "json")],
)
def test_an_input_is_not_overwritten(option, suffix, cli, scene_folder, truth, tmp_path):
    mine = tmp_path / f"mine.{suffix}"
    mine.write_text("stride: 1")
    words = (*SHORT, "--overwrite", option, mine)
    outcome = cli(*tune_words(scene_folder, truth, tmp_path / "mine.yaml", *words))
    assert (outcome.status, "would be overwritten" in outcome.error) == (2, True)
    assert [path.name for path in tmp_path.iterdir()] == [mine.name] and mine.read_text() == "stride: 1"


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".yaml", ".json", ".html"])
def test_a_full_disk_is_one_line_and_leaves_nothing_half_written(
    suffix, cli, scene_folder, truth, tmp_path, monkeypatch
):
    out, words = tmp_path / "fusion.yaml", ("--steps", "1", "--held-out-share", "0.4")
    with monkeypatch.context() as patch:
        fill_disk(patch, f"fusion{suffix}")
        outcome = cli(*tune_words(scene_folder, truth, out, *words))
    assert (outcome.status, "disk full" in outcome.error) == (1, True)
    order = [".yaml", ".json", ".html"]
    assert {path.suffix for path in tmp_path.iterdir()} == set(order[: order.index(suffix)])
    if suffix != ".yaml":
        assert load_config(str(out)).fusion.class_increments is not None
    assert cli(*tune_words(scene_folder, truth, out, *words, "--overwrite")).status == 0
    assert {path.suffix for path in tmp_path.iterdir()} == set(order), "no leftovers"


@pytest.mark.slow
def test_a_killed_process_leaves_the_best_so_far_and_is_begun_anew(cli, scene_folder, truth, tmp_path):
    out = tmp_path / "fusion.yaml"
    words = tune_words(scene_folder, truth, out, *SHORT)
    kill_when(lambda: out.exists() and list(tmp_path.glob(".fusion.tmp-*")), SLOW_DISK, words)
    assert load_config(str(out)).fusion.class_increments is not None
    assert not out.with_suffix(".json").exists() and not out.with_suffix(".html").exists()
    assert cli(*words).status == 2, "it is not replaced unasked"
    assert cli(*words, "--overwrite").status == 0
    assert {path.name for path in tmp_path.iterdir()} == {"fusion.yaml", "fusion.json", "fusion.html"}


@pytest.mark.slow
def test_two_traverses_and_the_plane_with_a_soft_threshold(cli, scene_folder, truth, tmp_path):
    out = tmp_path / "plane.yaml"
    words = ["tune", scene_folder, scene_folder, "--ground-truth", truth, truth, "--out", out, *SHORT]
    grid = tune_words(scene_folder, truth, out)[10:]
    fit = ("--labeller", "plane", "--plane.hypotheses", "32", "--plane.sample-points", "512")
    outcome = cli(*words, *grid, *fit)
    assert outcome.status == 0, outcome
    config, told = load_config(str(out)), json.loads(out.with_suffix(".json").read_text())
    assert config.plane.softness_m > 0
    assert len(told["traverses"]) == 2
    assert told["before"]["softness_m"] == 0.0 and told["stages"][0]["parameters"]["softness_m"] > 0
    assert {"sigma_m", "threshold_m"} <= told["before"].keys()


@pytest.mark.parametrize(("labeller", "own"), [("deeplab", {"temperature": 2.0}), ("files", {}), ("relief", {})])
def test_tuned_numbers_go_to_the_options_they_are_of(labeller, own):
    """Relief beside another labeller has numbers of its own, and so may the other have."""
    fusion = make_fusion_params(("sand", "rock"))
    numbers = {name: jnp.float32(value) for name, value in {**own, "bias": -1.5, "softness_m": 0.04}.items()}
    config = tuned_config(MapConfig(labeller=labeller), TunedParams(fusion, numbers))
    assert (config.relief.bias, config.relief.softness_m) == (-1.5, 0.04)
    assert config.deeplab.temperature == own.get("temperature", 1.0)
    assert config.plane == MapConfig().plane


@pytest.mark.slow
def test_observations_are_tuned_on_as_their_sequence_is(cli, scene_folder, truth, tmp_path):
    labels = ("--labeller", "files", "--labels", scene_folder / "labels")
    assert cli("perceive", scene_folder, "--out", tmp_path / "seen", *labels).status == 0
    told = []
    for name, source in (("direct", scene_folder), ("seen", tmp_path / "seen")):
        words = ("tune", source, "--ground-truth", truth, "--out", tmp_path / f"{name}.yaml", *GRID, *SHORT)
        assert cli(*words, *(labels if name == "direct" else ())).status == 0
        told.append(json.loads((tmp_path / f"{name}.json").read_text()))
    assert told[0]["stages"] == told[1]["stages"] and told[0]["before"] == told[1]["before"]
    assert cli(*map_words(tmp_path / "seen", tmp_path / "run", "--config", tmp_path / "direct.yaml")).status == 0

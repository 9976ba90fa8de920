"""Every table of the pages by one command: its plan, its pictures and its pages."""

from __future__ import annotations

import json
import shutil
import sys
from argparse import Namespace
from pathlib import Path

import numpy as np
import pose_refinement
import pytest
import results
from PIL import Image
from small_runs import SMALL_BENCH

from enerf_ns.bench.runner import Bench
from enerf_ns.bench.settings import BenchSettings

ROOT = Path(__file__).parents[2]


def test_every_experiment_of_the_plan_can_be_run_and_every_table_of_a_page_is_planned(tmp_path: Path):
    weights = tmp_path / "weights.pth"
    weights.touch()
    arguments = Namespace(
        only=list(results.PLAN), output_dir=tmp_path, slider_depth=tmp_path, reconstruction_weights=weights
    )
    benches = results.benches(arguments, 3)
    assert list(benches) == list(results.PLAN)
    assert max(cell.seed for cell in benches["shake"].cells) == 2
    committed = {file.stem for file in (ROOT / "benchmarks" / "results").glob("*.json")}
    assert committed <= set(results.PLAN)
    arguments.slider_depth = None
    assert set(results.PLAN) - set(results.benches(arguments, 1)) == {"slider-depth"}


def test_no_experiment_is_run_where_none_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """As where tables of the pages are written anew from the committed results."""
    page = tmp_path / "page.md"
    text = (ROOT / "docs" / "results.md").read_text()
    page.write_text(text.replace("± 0.", "± 9."))
    monkeypatch.setattr(results, "PAGES", [page])
    monkeypatch.setattr(sys, "argv", ["results.py", "--only", "--output-dir", str(tmp_path), "--pages"])
    results.main()
    assert page.read_text() == text
    assert not (tmp_path / "runs").exists() and not (tmp_path / "recordings").exists()


def test_the_figure_of_views_has_the_frame_and_the_render_of_each_row(finished: Path):
    bench = Bench("design", BenchSettings(**SMALL_BENCH, output_dir=finished))
    figure = np.asarray(results.views(bench))
    rows = len({cell.row for cell in bench.cells})
    assert results.FIGURE_WIDTH - rows <= figure.shape[1] <= results.FIGURE_WIDTH
    width = (figure.shape[1] - results.LABEL_WIDTH) // (rows + 1) - 2
    cell = bench.cells[0]
    with Image.open(bench.folder(cell) / "view" / "eval_img_0000.png") as both:
        frame = both.crop((0, 0, both.width // 2, both.height))
        shown = frame.resize((width, round(frame.height * width / frame.width)))
    top = figure.shape[0] - 2 - shown.height
    left = results.LABEL_WIDTH
    np.testing.assert_array_equal(figure[top : top + shown.height, left : left + width], np.asarray(shown))
    recorded = sorted((finished / "recordings").glob("*/images/*.png"))
    assert any(np.array_equal(np.asarray(Image.open(file).convert("RGB")), np.asarray(frame)) for file in recorded)


def test_what_is_kept_is_trained_on_no_other_machine_and_is_published(
    finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """One machine finishes a part of an experiment, another the rest, and the pages show all."""
    folders = {name: tmp_path / name.lower() for name in ("RESULTS", "FIGURES")}
    for name, folder in folders.items():
        folder.mkdir()
        monkeypatch.setattr(results, name, folder)
    monkeypatch.setattr(results, "NEXT", folders["RESULTS"] / "next")
    (tmp_path / "page.md").write_text("results-design-views.png")
    monkeypatch.setattr(results, "PAGES", [tmp_path / "page.md"])
    monkeypatch.setattr(results, "PLAN", {"design": {**SMALL_BENCH, "seeds": 1}})
    first, second = tmp_path / "first", tmp_path / "second"
    shutil.copytree(finished, first)
    rows = {"part": ("events",), "all": SMALL_BENCH["rows"]}
    for part, output_dir, flags in (("part", first, ["--keep"]), ("all", second, ["--keep"]), ("all", second, [])):
        results.PLAN["design"]["rows"] = rows[part]
        monkeypatch.setattr(sys, "argv", ["results.py", "--only", "design", "--output-dir", str(output_dir), *flags])
        results.main()
        kept = json.loads((results.NEXT / "design.json").read_text())["runs"]
        assert {run["row"] for run in kept} == set(rows[part])
        figure = results.NEXT / "results-design-views.png"
        assert figure.exists() == (part == "part")  # the second machine has not all renders
        figure.unlink(missing_ok=True)
    trained = {folder.name.partition("-seed-")[0] for folder in (second / "runs").glob("*/*/*")}
    assert trained == {"uniform-samples"}
    figure.write_bytes(b"kept")
    monkeypatch.setattr(sys, "argv", [*sys.argv, "--pages"])
    results.main()
    published = json.loads((results.RESULTS / "design.json").read_text())["runs"]
    assert sorted(run["inputs"] for run in published) == sorted(run["inputs"] for run in kept)
    assert (results.FIGURES / "results-design-views.png").read_bytes() == b"kept"
    assert not list(results.NEXT.iterdir())


def test_a_table_by_hand_is_written_over_and_the_text_around_it_stays():
    """That the pages of the repository are those that would be written, their own test says."""
    text = (ROOT / "docs" / "results.md").read_text()
    changed = text.replace("± 0.", "± 9.")
    assert changed != text
    assert results.written(changed) == text


def test_a_small_table_has_the_rows_and_the_protocol_that_its_mark_names():
    mark = "<!-- scores of filter events on slider-depth/slider_depth/raw -->"
    page = results.written(f"before\n{mark}\nby hand\n<!-- scores end -->\nafter")
    assert page.startswith(f"before\n{mark}\n\n| sequence |") and page.endswith("\n<!-- scores end -->\nafter")
    runs = json.loads((ROOT / "benchmarks" / "results" / "slider-depth.json").read_text())["runs"]
    for row in ("filter", "events"):
        psnr = np.mean([run["scores"]["raw"]["psnr"] for run in runs if run["row"] == row])
        assert f"| slider_depth | {row} | {psnr:.2f}" in page.replace("**", "")
    assert "e2vid" not in page and "by hand" not in page


def test_tables_of_wrong_poses_have_the_trainings_of_their_number_of_steps():
    """One value for each seed in what was found, in the order of the seeds; means where errors are told."""
    one = {"recording": "room", "fault": "all", "row": "refined", "steps": 10, "event_correlation": 0.5}
    ate = {"ate_before": [4.0, 0.4], "ate_after": [2.0, 0.1]}
    seeds = [
        {**one, "seed": 1, "psnr": 22.0, "clock": 10.25, "focal": 1.0, "corrected": ["clock", "rotation"], **ate},
        {**one, "seed": 0, "psnr": 20.0, "clock": 9.75, "focal": 0.97, "corrected": ["translation", "rotation"], **ate},
    ]
    seeds[0] |= {"ate_after": [3.0, 0.3], "reprojection_before": 2.0, "reprojection_after": 0.25}
    longer = {**seeds[0], "steps": 20, "psnr": 30.0}
    fixed = {**longer, "row": "fixed", "psnr": 12.0}
    trained = [*seeds, longer, fixed]
    scores = pose_refinement.scores_by_fault(trained, ["room"], ["all", "none"], 10)
    assert scores.splitlines()[2:] == ["| all | 21.00 ± 1.41, 0.50 |", "| none | - |"]
    assert scores.splitlines()[0] == "| wrong | `room` refined |"
    assert "| all | 12.00, 0.50 | 30.00, 0.50 |" in pose_refinement.scores_by_fault(trained, ["room"], ["all"], 20)
    found = pose_refinement.found_by_fault(trained, ["room", "hall"], ["all"], 10)
    assert found.splitlines()[2] == (
        "| all | clock 9.75, 10.25 ms; focal length 0.970, 1.000; rotation and translation, rotation; "
        "4.0 mm and 0.40° → 2.5 mm and 0.20°; 2.00 → 0.25 px | - |"
    )

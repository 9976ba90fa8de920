"""Every table of the pages by one command: its plan, its pictures and its pages."""

from __future__ import annotations

import shutil
from argparse import Namespace
from pathlib import Path

import numpy as np
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
    arguments = Namespace(only=[], output_dir=tmp_path, slider_depth=tmp_path, reconstruction_weights=weights)
    benches = results.benches(arguments, 3)
    assert list(benches) == list(results.PLAN)
    assert max(cell.seed for cell in benches["shake"].cells) == 2
    committed = {file.stem for file in (ROOT / "benchmarks" / "results").glob("*.json")}
    assert committed <= set(results.PLAN)
    arguments.slider_depth = None
    assert set(results.PLAN) - set(results.benches(arguments, 1)) == {"slider-depth"}


def test_the_figure_of_views_has_the_frame_and_the_render_of_each_row(finished: Path):
    bench = Bench("design", BenchSettings(**SMALL_BENCH, output_dir=finished))
    figure = np.asarray(results.views(bench))
    rows = len({cell.row for cell in bench.cells})
    assert figure.shape[1] == 90 + (rows + 1) * (results.VIEW_WIDTH + 2)
    cell = bench.cells[0]
    with Image.open(bench.folder(cell) / "view" / "eval_img_0000.png") as both:
        frame = both.crop((0, 0, both.width // 2, both.height))
        shown = frame.resize((results.VIEW_WIDTH, round(frame.height * results.VIEW_WIDTH / frame.width)))
    top = figure.shape[0] - 2 - shown.height
    np.testing.assert_array_equal(figure[top : top + shown.height, 90 : 90 + results.VIEW_WIDTH], np.asarray(shown))
    recorded = sorted((finished / "recordings").glob("*/images/*.png"))
    assert any(np.array_equal(np.asarray(Image.open(file).convert("RGB")), np.asarray(frame)) for file in recorded)


def test_the_pages_are_written_from_the_result_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The pages of the repository are those that would be written; a table by hand is written over."""
    pages = [Path(shutil.copy(page, tmp_path / f"{number}.md")) for number, page in enumerate(results.PAGES)]
    texts = [page.read_text() for page in pages]
    for page, text in zip(pages, texts, strict=True):
        page.write_text(text.replace("± 0.", "± 9."))
    monkeypatch.setattr(results, "PAGES", pages)
    results.write_pages()
    for page, text in zip(pages, texts, strict=True):
        between = page.read_text().split("<!-- ")[1:]
        assert [part for part in between if part.startswith(("enerf bench", "summary -->"))] == [
            part for part in text.split("<!-- ")[1:] if part.startswith(("enerf bench", "summary -->"))
        ]

"""The page of a report: what a reader sees first, what is folded, and what a page without frames leaves out."""

from __future__ import annotations

import base64
import json
import re
import shutil
import sys
from pathlib import Path

import pytest
import yaml
from browsers import BROWSER, Browser
from report_pages import page_of

from enerf_ns.evaluation.history import HistoryRow, append_row
from enerf_ns.method.runs import Run
from enerf_ns.report.figures import COLOURS, Curve, error_against
from enerf_ns.report.tables import HOW_TO_READ, MEANINGS
from enerf_ns.report.writing import write_report

MAIN = ["held-out frame", "render", "error", "rendered depth", "events"]
FRAME_SCORES = {"psnr": 20.0, "ssim": 0.5, "correlation": 0.5, "depth_rmse": 0.5, "depth_known": 0.25}
EVENT_SCORES = {"event_correlation": 0.9, "event_rmse": 0.5, "event_sign": 0.75}


VERDICT = "The events are explained: the correlation is high."


def scored(run: Run, home: Path, scores: dict[str, float], num_frames: int) -> Path:
    """The folder of a copy of a run, under the name of its home, with a history to its end."""
    folder = home / "enerf" / "run"
    shutil.copytree(run.config_file.parent, folder)
    config = yaml.load(run.config_file.read_text(), Loader=yaml.Loader)
    config.experiment_name, config.output_dir = home.name, home.parent
    (folder / "config.yml").write_text(yaml.dump(config))
    for step in (1, 2):
        protocol = "log-affine-set" if num_frames else "events"
        row = HistoryRow(
            step, float(step), {}, scores, num_frames, {"draw": 0.01}, step == 2, protocol=protocol, verdict=VERDICT
        )
        append_row(folder, row)
    return folder


def test_pictures_and_verdict_come_first_and_most_scores_are_folded(run: Run, tmp_path: Path, short_films: None):
    folder = scored(run, tmp_path / "shapes", FRAME_SCORES | EVENT_SCORES, 3)
    write_report([folder], tmp_path / "report")
    page = page_of(tmp_path / "report")
    seen = page.unfolded()
    summary = f"{VERDICT} Renders match held-out frames with a PSNR of {FRAME_SCORES['psnr']:.1f} dB."
    order = [summary, *MAIN, "Scores", "Error against training time", "How this was made"]
    places = [seen.index(words) for words in order]
    assert places == sorted(places)
    assert max(map(len, (row for row in page.rows if "event correlation" in row))) <= 6
    header = page.rows[0]
    assert header == ["run", "training time", "PSNR, dB", "SSIM", "depth RMSE, m", "event correlation"]
    assert all(HOW_TO_READ[name] in seen for name in header[2:])
    folded = [text for _, is_folded, text in page.words if is_folded]
    assert {"spread depth", "known depth, share", "correlation", "Error against training steps"} <= {*folded} - {*seen}
    films = {f"{name}.{kind}" for name, kind in (("video", "mp4"), ("moving", "webp"))}
    for name in films:
        assert base64.b64encode((tmp_path / "report" / name).read_bytes()).decode() in "".join(page.sources)
    assert re.search(r"<video [^>]*poster=\"data:image/webp;", (tmp_path / "report/report.html").read_text())


def test_the_box_states_how_a_run_was_made(run: Run, tmp_path: Path):
    """As origin.json and choices.json state it, which an older run lacks."""
    write_report([run], tmp_path / "report", video=False)
    origin = json.loads((run.config_file.parent / "origin.json").read_text())
    seen = page_of(tmp_path / "report").unfolded()
    for name in ("command", "version", "date", "machine"):
        assert seen[seen.index(name) + 1] == origin[name]
    assert Path(sys.argv[0]).name in origin["command"]
    assert seen[seen.index("sensor") + 1].startswith("32 x 24 pixels, pinhole; ")
    assert "The scene does not move" in seen[seen.index("assumptions") + 1]
    older = scored(run, tmp_path / "older", {}, 0)
    for name in ("origin.json", "choices.json"):
        (older / name).unlink()
    write_report([older], tmp_path / "older-report", video=False)
    seen = page_of(tmp_path / "older-report").unfolded()
    assert "command" not in seen and "machine" not in seen and "date" in seen and "sensor" in seen
    (older / "choices.json").write_text("[{")
    write_report([older], tmp_path / "older-report", video=False)
    assert "choices.json cannot be read as JSON" in page_of(tmp_path / "older-report").text()


def test_the_page_of_events_alone_is_about_events(run_without_frames: Run, tmp_path: Path, short_films: None):
    folder = scored(run_without_frames, tmp_path / "events", EVENT_SCORES, 0)
    for name, given in (("with-history", folder), ("scored-anew", run_without_frames)):
        (scores,) = write_report([given], tmp_path / name, video=given is folder).values()
        assert [scores[score] for score in ("psnr", "ssim", "lpips")] == [None] * 3
        assert scores["event_correlation"] is not None and "correlation" not in scores
        page = page_of(tmp_path / name)
        for words in (page.text("dd.command", "style."), (tmp_path / name / "report.md").read_text()):
            assert "frame" not in re.sub(r"\* command: .*", "", words).lower()
        assert "-" not in page.rows[1] and "none at this time" not in page.text()
        assert "mean threshold assumed: brightness is known up to scale" in page.text().lower()
        assert "The square is the share of their variance that is explained" in "".join(page.unfolded())


def test_several_runs_have_a_row_of_pictures_each_and_their_curves_together(run: Run, tmp_path: Path):
    folders = [scored(run, tmp_path / name, FRAME_SCORES, 3) for name in ("one", "two")]
    write_report(folders, tmp_path / "report", video=False)
    seen = page_of(tmp_path / "report").unfolded()
    for name in ("one", "two"):
        assert [text for text in seen if text.endswith(f" of {name}")] == [f"{title} of {name}" for title in MAIN]
    rows = [HistoryRow(step, float(step), scores=FRAME_SCORES, num_frames=3) for step in (1, 2)]
    figure = error_against("seconds", [Curve(name, rows, 2.0, FRAME_SCORES, True) for name in ("one", "two")])
    assert figure is not None
    for axis in figure.axes:
        assert {line.get_color() for line in axis.get_lines()} == set(COLOURS[:2])


def test_every_score_has_a_meaning():
    assert len(HOW_TO_READ) == len(MEANINGS) and all(meaning.endswith(".") for meaning in MEANINGS.values())


MEASURE = """JSON.stringify({ loaded: document.readyState == "complete",
    width: innerWidth, page: document.documentElement.scrollWidth,
    images: [...document.images].map(image => image.complete && image.naturalWidth > 0),
    words: document.body.innerText, background: getComputedStyle(document.body).backgroundColor,
    folded: [...document.querySelectorAll("details dl, details table")].map(part => part.checkVisibility(
        { contentVisibilityAuto: true }) && part.getBoundingClientRect().height > 0) })"""


@pytest.mark.skipif(BROWSER is None, reason="no chromium is installed")
def test_a_browser_shows_the_page_in_narrow_windows_and_prints_all_of_it(run: Run, tmp_path: Path, short_films: None):
    """The page is never wider than the window, and paper shows what the screen folds, on white."""
    folders = [scored(run, tmp_path / name, FRAME_SCORES | EVENT_SCORES, 3) for name in ("one", "a-long-name-" * 6)]
    write_report([*folders, tmp_path / "nothing"], tmp_path / "report")
    browser = Browser((tmp_path / "report/report.html").as_uri(), tmp_path / "browser")

    def measured(width: int, media: str) -> dict:
        size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False}
        browser.call("Emulation.setDeviceMetricsOverride", **size)
        browser.call("Emulation.setEmulatedMedia", media=media)
        while True:
            told = browser.call("Runtime.evaluate", expression=MEASURE, returnByValue=True)["result"].get("value")
            seen = json.loads(told or "{}")
            if seen.get("loaded") and seen["images"] and all(seen["images"]):
                return seen

    try:
        for width in (400, 800, 1200):
            seen = measured(width, "screen")
            assert seen["page"] <= seen["width"] == width
            assert not any(seen["folded"]) and len(seen["folded"]) > 3
        printed = measured(800, "print")
        assert all(printed["folded"]) and printed["background"] == "rgb(255, 255, 255)"
        assert HOW_TO_READ["known depth, share"] in printed["words"]
    finally:
        browser.close()

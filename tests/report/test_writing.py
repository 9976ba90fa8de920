from __future__ import annotations

import csv
import errno
import io
import json
import re
import shutil
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from PIL import Image
from report_pages import page_of
from small_runs import SMALL

from enerf_ns.dataparsers.recording.errors import FlagError, OutputError, RecordingError
from enerf_ns.evaluation.history import HistoryRow, append_row
from enerf_ns.evaluation.metrics import EVENT_SCORES
from enerf_ns.evaluation.protocols import described
from enerf_ns.evaluation.scores import summary_scores
from enerf_ns.method.held_out_views import held_out_views
from enerf_ns.method.model import EnerfModel
from enerf_ns.method.runs import Run, method_config, train
from enerf_ns.report import writing
from enerf_ns.report.figures import Curve, error_against
from enerf_ns.report.pictures import camera_path
from enerf_ns.report.scoring import Scoring
from enerf_ns.report.tables import history_csv
from enerf_ns.report.writing import write_report

PLOTS = {"error-against-seconds.png", "error-against-steps.png", "step.png"}
TEXTS = {"report.html", "report.md", "error-against-time.csv", "scores.json"}
PARTS = {"sampling events": 0.001, "forward": 0.03, "backward": 0.02}


def history(final: bool = True, better: float = 0.0) -> list[HistoryRow]:
    """Of 5 rows up to step 16, PSNR from 10 dB to 18 dB."""
    return [
        HistoryRow(
            2**n, 2.0**n, {"event_loss": 1 / 2**n}, {"psnr": 10 + 2 * n + better, "depth_rmse": 1 - n / 10}, 3, PARTS,
            final and n == 4, protocol="log-affine-set",
        )
        for n in range(5)
    ]  # fmt: skip


def copied(run: Run, home: Path, rows: list[HistoryRow], stored: bool = True, **changes: Any) -> Path:
    """The folder of a copy of the run under another name, that of `home`, with a history and changes of its config."""
    folder = home / "enerf" / "run"
    shutil.copytree(run.config_file.parent, folder, ignore=None if stored else shutil.ignore_patterns("*models"))
    config = yaml.load(run.config_file.read_text(), Loader=yaml.Loader)
    for name, value in {"experiment_name": home.name, "output_dir": home.parent, **changes}.items():
        setattr(config, name, value)
    (folder / "config.yml").write_text(yaml.dump(config))
    for row in rows:
        append_row(folder, row)
    return folder


@pytest.fixture
def moved(run: Run, tmp_path: Path) -> Path:
    """A run whose recording is not where it was, with a history to its end."""
    return copied(run, tmp_path / "moved", history(), data=tmp_path / "gone")


@pytest.fixture
def crashed(run: Run, tmp_path: Path) -> Path:
    """A run that stored nothing but a history, the last line of which is cut short."""
    folder = copied(run, tmp_path / "crashed", history(False, -1.5), stored=False, max_num_iterations=50)
    with (folder / "history.jsonl").open("a") as file:
        file.write('{"step": 32, "sec')
    return folder


def names(folder: Path) -> set[str]:
    return {str(file.relative_to(folder)) for file in folder.rglob("*") if file.is_file()}


def rows_of(folder: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO((folder / "error-against-time.csv").read_text())))


def test_a_run_without_a_history_has_scores_pictures_and_a_flight(run: Run, tmp_path: Path, short_films: None):
    """As with --evaluation-share 0."""
    folder = tmp_path / "new" / "report"
    entries = write_report([run], folder)
    assert json.loads((folder / "scores.json").read_text()) == entries
    (scores,) = entries.values()
    assert list(entries) == [run.config.experiment_name]
    assert {"psnr", "ssim", "correlation", "depth_rmse", "mean_depth", "fps"} <= set(scores)
    assert ("brightness_scale" in scores) == (scores["psnr"] is not None) == ("psnr" not in scores["not_scored"])
    assert scores["train_seconds"] > 0 and scores["lpips"] is None and scores["events"] > 0
    assert (scores["state"], scores["step"], scores["num_frames"], scores["over_all_frames"]) == ("done", 2, 3, True)
    assert json.loads((folder / "camera_path.json").read_text()) == camera_path(
        run.pipeline.datamanager.eval_dataset.cameras
    )
    assert names(folder) == TEXTS | {"side-by-side.png", "camera_path.json", "video.mp4", "moving.webp"}
    assert Image.open(folder / "side-by-side.png").size[0] > 1000
    assert rows_of(folder) == []
    kinds = [re.split("[:;]", source)[1] for source in page_of(folder).sources]
    assert kinds.count("video/mp4") == 1 and set(kinds) == {"image/webp", "video/mp4"}
    assert "| 2 steps |" in (folder / "report.md").read_text()


@pytest.mark.parametrize(
    ("supervision", "protocol", "scores", "cell"),
    [
        ("events", "log-affine-set", {"brightness_scale": 0.67, "brightness_scale_expected": 0.8}, "0.670 (0.800)"),
        ("events", "log-affine-set", {"brightness_scale": 0.67}, "0.670"),
        (
            "events+frames",
            "log-affine-set",
            {**{f"brightness_scale_{colour}": 0.5 for colour in ("red", "green")}, "brightness_scale_expected": 1.0},
            "0.500 0.500 (1.000)",
        ),
        ("events", "eventnerf", {"brightness_scale": 0.67}, None),
        ("frames", "log-affine-set", {"brightness_scale": 0.67}, None),
    ],
)
def test_the_brightness_scale_stands_beside_what_it_should_be(
    run: Run, tmp_path: Path, supervision: str, protocol: str, scores: dict[str, float], cell: str | None
):
    row = HistoryRow(16, 2.0, {}, {"psnr": 18.0, "brightness_offset": 1.0, **scores}, 3, final=True, protocol=protocol)
    folder = copied(run, tmp_path / "run", [row], stored=False)
    config = yaml.load((folder / "config.yml").read_text(), Loader=yaml.Loader)
    config.pipeline.datamanager.supervision = supervision
    (folder / "config.yml").write_text(yaml.dump(config))
    write_report([folder], tmp_path / "report")
    text, cells = (tmp_path / "report/report.md").read_text(), page_of(tmp_path / "report").cells
    assert (cell in cells) if cell else "brightness scale" not in cells
    assert ("The brightness scale is the factor" in text) == (cell is not None)


def test_the_time_of_a_run_that_was_stopped_is_that_of_its_checkpoint(run: Run, tmp_path: Path):
    """Its last row of the history is of an earlier step."""
    folder = copied(run, tmp_path / "stopped", history(False)[:1], max_num_iterations=50)
    (checkpoint,) = (folder / "nerfstudio_models").iterdir()
    (scores,) = write_report([folder], tmp_path / "report", video=False).values()
    assert scores["step"] == 2 > history()[0].step
    assert scores["train_seconds"] == torch.load(checkpoint)["error_against_time"]["seconds"] != history()[0].seconds


def test_a_run_of_no_held_out_frame_on_the_path_says_so(run: Run, tmp_path: Path):
    row = HistoryRow(16, 2.0, {}, {"psnr": 18.0, "held_out_on_path": 0.0}, 3, final=True, protocol="log-affine-set")
    write_report([copied(run, tmp_path / "run", [row], stored=False)], tmp_path / "report")
    assert "on the path" in (tmp_path / "report/report.md").read_text()


def test_scores_at_the_end_are_those_of_the_history(run: Run, tmp_path: Path):
    """Those of another step are taken anew, of the field of the newest checkpoint."""
    ended, going = copied(run, tmp_path / "ended", history()), copied(run, tmp_path / "going", history(False))
    entries = write_report([ended, going], tmp_path / "report", video=False)
    assert entries["ended"]["psnr"] == 18 and entries["ended"]["step"] == 16 and entries["ended"]["train_seconds"] == 16
    fresh = write_report([run], tmp_path / "fresh", video=False)[str(run.config.experiment_name)]
    assert entries["going"]["correlation"] == pytest.approx(fresh["correlation"], rel=1e-5)
    assert entries["going"]["step"] == 2 and entries["going"]["train_seconds"] == 2.0
    pictures = {f"{name}/{file}" for name in ("ended", "going") for file in ("side-by-side.png", "camera_path.json")}
    assert names(tmp_path / "report") == TEXTS | PLOTS | {"work-precision.png"} | pictures
    page_of(tmp_path / "report")


def test_of_a_moved_recording_there_are_curves_and_what_to_do(moved: Path, tmp_path: Path):
    (scores,) = write_report([moved], tmp_path / "report").values()
    assert scores["psnr"] == 18 and scores["state"] == "done" and "events" not in scores
    assert names(tmp_path / "report") == TEXTS | PLOTS
    words = f"The recording {tmp_path / 'gone'} is not there any more"
    assert (
        words in (tmp_path / "report/report.md").read_text() and words in (tmp_path / "report/report.html").read_text()
    )
    assert len(page_of(tmp_path / "report").sources) == 3


def test_a_crashed_run_shows_its_history_up_to_the_line_that_is_whole(crashed: Path, tmp_path: Path):
    (scores,) = write_report([crashed], tmp_path / "report").values()
    assert scores["psnr"] == 16.5 and not scores["over_all_frames"] and scores["num_frames"] == 3
    assert [row["step"] for row in rows_of(tmp_path / "report")] == ["1", "2", "4", "8", "16"]
    assert "No whole checkpoint is stored" in (tmp_path / "report/report.md").read_text()


@pytest.mark.parametrize(
    "rows", [[], [HistoryRow(1, 0.5)], [HistoryRow(0, 0.0, scores={"psnr": 5.0}, protocol="raw")], history()[:1]]
)
def test_a_run_of_no_step_or_one_has_a_report(run: Run, tmp_path: Path, rows: list[HistoryRow]):
    folder = copied(run, tmp_path / "begun", rows, stored=False, max_num_iterations=50)
    (scores,) = write_report([folder], tmp_path / "report").values()
    assert scores["state"] == f"still going, {rows[0].step if rows else 0} of 50 steps"
    assert len(rows_of(tmp_path / "report")) == len(rows)
    page_of(tmp_path / "report")


def test_the_newest_preview_stands_for_pictures_that_cannot_be_made(moved: Path, tmp_path: Path):
    (moved / "previews").mkdir()
    for step in (300, 1200):
        Image.new("RGB", (step, 10)).save(moved / f"previews/step-{step:08d}.png")
    write_report([moved], tmp_path / "report")
    assert Image.open(tmp_path / "report/preview.png").size[0] == 1200
    assert "step-00001200.png" in (tmp_path / "report/report.md").read_text()


def test_the_csv_has_each_row_of_each_run(moved: Path, crashed: Path, tmp_path: Path):
    write_report([moved, crashed, moved / "config.yml"], tmp_path / "report")
    rows = rows_of(tmp_path / "report")
    assert list(rows[0]) == [
        "run", "seconds", "step", "psnr", "ssim", "lpips", "correlation", "depth_rmse", "event_correlation",
        "event_rmse", "event_sign", "num_frames", "event_loss",
    ]  # fmt: skip
    expected = [("moved", row) for row in history()] + [("crashed", row) for row in history(False, -1.5)]
    assert len(rows) == len(expected)
    for found, (name, row) in zip(rows, expected, strict=True):
        assert found["run"] == name and found["ssim"] == found["lpips"] == ""
        assert (float(found["seconds"]), int(found["step"]), int(found["num_frames"])) == (row.seconds, row.step, 3)
        assert float(found["psnr"]) == row.scores["psnr"] and float(found["depth_rmse"]) == row.scores["depth_rmse"]
        assert float(found["event_loss"]) == row.losses["event_loss"]


def test_the_csv_has_lpips_of_vgg_where_there_is_some_and_no_number_that_is_no_score():
    """Of what a run's last row has, rendering speed, fits and places are for scores.json."""
    other = {"fps": 3.0, "mean_depth": 2.0, "brightness_scale": 1.0, "held_out_on_path": 3.0}
    one = HistoryRow(1, 2.0, {"event_loss": 0.5}, {"psnr": 9.0, **other}, 3)
    two = HistoryRow(2, 4.0, {"frame_loss": 0.25}, {"lpips_vgg": 0.75, "event_sign": 0.5}, 3)
    scores = ["psnr", "ssim", "lpips", "correlation", "depth_rmse", "event_correlation", "event_rmse", "event_sign"]
    lines = history_csv([("a", [one])]).splitlines()
    assert lines == [f"run,seconds,step,{','.join(scores)},num_frames,event_loss", "a,2.0,1,9.0,,,,,,,,3,0.5"]
    header, first, second = history_csv([("a", [one]), ("b", [two])]).splitlines()
    scores.insert(3, "lpips_vgg")
    assert header == f"run,seconds,step,{','.join(scores)},num_frames,event_loss,frame_loss"
    assert (first, second) == ("a,2.0,1,9.0,,,,,,,,,3,0.5,", "b,4.0,2,,,,0.75,,,,,0.5,3,,0.25")


@pytest.mark.parametrize(
    ("num_frames", "shown"),
    [(0, {"event correlation", "event RMSE, thresholds", "event sign, share"}), (3, {"event correlation"})],
)
def test_beside_frames_the_plots_show_of_events_the_correlation_alone(num_frames: int, shown: set[str]):
    scores = {"event_correlation": 0.5, "event_rmse": 1.5, "event_sign": 0.75}
    rows = [HistoryRow(step, float(step), scores=scores, num_frames=num_frames) for step in (1, 2)]
    figure = error_against("step", [Curve("a", rows, 2.0, scores, True)])
    assert figure is not None and {axis.get_ylabel() for axis in figure.axes} == shown


def test_the_tables_tell_the_time_to_reach_and_the_parts_of_a_step(moved: Path, crashed: Path, tmp_path: Path):
    write_report([moved, crashed], tmp_path / "report", reach=[9, 15, 17])
    text = (tmp_path / "report/report.md").read_text()
    assert "| run | 9 dB | 15 dB | 17 dB |\n| --- | --- | --- | --- |\n" in text
    assert "| moved | at most 1 s | 6 s | 12 s |\n| crashed | 1.25 s | 10 s | not reached |" in text
    assert "| moved | 1 ms (2%) | 30 ms (59%) | 20 ms (39%) | 51 ms |" in text
    assert {"12 s", "not reached", "30 ms (59%)"} <= {cell.strip() for cell in page_of(tmp_path / "report").cells}


def test_a_run_that_cannot_be_read_is_a_row_and_stops_no_other(moved: Path, tmp_path: Path):
    (tmp_path / "empty | <b>").mkdir()
    entries = write_report([tmp_path / "empty | <b>", moved, tmp_path / "nothing"], tmp_path / "report")
    assert list(entries) == ["moved", str(tmp_path / "empty | <b>"), str(tmp_path / "nothing")]
    assert "holds no config.yml" in entries[str(tmp_path / "empty | <b>")]["state"]
    cells = page_of(tmp_path / "report").cells
    assert str(tmp_path / "empty | <b>") in [cell.strip() for cell in cells]
    table = [line for line in (tmp_path / "report/report.md").read_text().splitlines() if line.startswith("|")]
    assert len({len(re.findall(r"(?<!\\)\|", line)) for line in table[:5]}) == 1, "a name breaks no row"


def test_a_run_whose_frame_is_damaged_has_a_note_and_stops_no_other(run: Run, recording: Path, tmp_path: Path):
    damaged = tmp_path / "damaged"
    shutil.copytree(recording, damaged)
    frame = damaged / "images/00006.png"
    frame.write_bytes(frame.read_bytes()[: frame.stat().st_size // 2])
    pipeline = deepcopy(run.config.pipeline)
    pipeline.datamanager.data = pipeline.datamanager.dataparser.data = damaged
    bad = copied(run, tmp_path / "bad", history(False)[:1], data=damaged, pipeline=pipeline)
    other, good = write_report([bad, run], tmp_path / "report", video=False).values()
    assert good["step"] == 2 and {"psnr", "correlation"} <= set(good)
    assert (other["step"], other["psnr"], other["train_seconds"]) == (1, 10.0, 1.0)
    text = (tmp_path / "report/report.md").read_text()
    assert re.search(rf"^{frame} .*; so pictures, video and new scores are left out\.$", text, re.MULTILINE)


def test_where_no_run_can_be_read_nothing_is_written(tmp_path: Path):
    with pytest.raises(RecordingError, match=r"^\S+ holds no config\.yml; give [^.]+\.yml\.$"):
        write_report([tmp_path], tmp_path / "report")
    with pytest.raises(RecordingError, match=r"^No run can be read: .*holds no.*does not exist"):
        write_report([tmp_path, tmp_path / "nothing"], tmp_path / "report")
    with pytest.raises(FlagError, match="No run is given"):
        write_report([], tmp_path / "report")
    assert not (tmp_path / "report").exists()


def test_a_recording_is_never_written_to(run: Run, recording: Path):
    before = names(recording)
    with pytest.raises(OutputError, match="lies within the recording"):
        write_report([run], recording / "report")
    assert names(recording) == before


def test_held_out_frames_are_scored_as_asked_for(run: Run, tmp_path: Path):
    views, summary = held_out_views(run.pipeline)
    expected = summary_scores(views, summary, False, "raw", (), (16, 20))
    (entry,) = write_report([run], tmp_path / "report", scoring=Scoring("raw", (), (16, 20)), video=False).values()
    assert entry["protocol"] == "raw" and entry["psnr"] == expected["psnr"] and "lpips" not in entry
    assert described("raw") in (tmp_path / "report" / "report.md").read_text()


def test_a_full_disk_is_one_sentence_and_leaves_what_was_there(moved: Path, run: Run, tmp_path: Path, monkeypatch):
    folder = tmp_path / "report"
    folder.mkdir()
    (folder / "scores.json").write_text("before")

    def full(path: Path, content: bytes) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    for given in (moved, run):
        with pytest.raises(OutputError, match=r"^--output-dir .* \(No space left on device\); give another folder\.$"):
            write_report([given], folder)
        assert names(folder) == {"scores.json"}
        assert (folder / "scores.json").read_text() == "before"


def test_a_folder_that_cannot_be_made_is_said_before_anything_is_rendered(run: Run, tmp_path: Path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setattr(writing, "held_out_views", lambda *_: pytest.fail("rendered"))
    with pytest.raises(OutputError, match=r"^--output-dir .*file/report could not be written to \("):
        write_report([run], tmp_path / "file" / "report")


CHANGES = pytest.mark.parametrize(
    ("output", "change"),
    [
        ("rgb", lambda rgb: 1.0 - rgb),
        ("rgb", lambda rgb: rgb * 0.0),
        ("rgb", lambda rgb: rgb * torch.nan),
        ("rgb", lambda rgb: rgb + torch.inf),
        ("depth", lambda depth: depth * torch.nan),
        ("depth", lambda depth: depth * 0.0),
    ],
    ids=["negative", "dark", "nan", "inf", "nan depth", "no depth"],
)
"""What a field may come to show."""


@pytest.mark.sweep(3)
@CHANGES
@pytest.mark.parametrize("every", [1, 2])
def test_whatever_a_field_shows_the_report_is_whole_and_json(
    run: Run, tmp_path: Path, monkeypatch, output: str, change: Any, every: int
):
    """Of all frames or of every second: every mean that is missing has its reason, and the picture is drawn."""
    model = run.pipeline.model
    rendered, calls = model.get_outputs_for_camera_ray_bundle, []

    def outputs(rays: Any) -> dict[str, torch.Tensor]:
        calls.append(rays)
        made = rendered(rays)
        return made | ({output: change(made[output])} if len(calls) % every == 0 else {})

    monkeypatch.setattr(model, "get_outputs_for_camera_ray_bundle", outputs)
    entries = write_report([run], tmp_path, video=False)
    (table,) = entries.values()
    text = (tmp_path / "scores.json").read_text()
    assert json.loads(text, parse_constant=lambda name: pytest.fail(name)) == entries
    reasons: Any = table["not_scored"]
    for name in ("psnr", "ssim", "lpips", "correlation", "depth_rmse"):
        left_out = sorted(number for numbers in reasons.get(name, {}).values() for number in numbers)
        assert (table.get(name) is None) == (left_out == [0, 1, 2])
        assert len(set(left_out)) == len(left_out)
    assert Image.open(tmp_path / "side-by-side.png").size[0] > 1000


@pytest.mark.sweep(1)
@CHANGES
def test_the_end_of_a_run_is_told_by_its_history_as_by_its_checkpoint(
    recording: Path, tmp_path: Path, monkeypatch, output: str, change: Any
):
    """With what has no score, and why."""
    rendered = EnerfModel.get_outputs_for_camera_ray_bundle

    def outputs(self: EnerfModel, rays: Any) -> dict[str, torch.Tensor]:
        made = rendered(self, rays)
        return made | {output: change(made[output])}

    monkeypatch.setattr(EnerfModel, "get_outputs_for_camera_ray_bundle", outputs)
    run = train(method_config("enerf", recording, tmp_path / "runs", SMALL))
    (by_history,) = write_report([run], tmp_path / "history", video=False).values()
    (run.config_file.parent / "history.jsonl").unlink()
    (by_checkpoint,) = write_report([run], tmp_path / "checkpoint", video=False).values()
    of_events = {*EVENT_SCORES, "verdict"}  # which the end of a run has beside the scores of frames
    assert set(by_history) - of_events == set(by_checkpoint)
    for name in set(by_checkpoint) - {"fps", "num_rays_per_sec", "train_seconds", "not_scored"}:
        value = by_checkpoint[name]
        assert by_history[name] == (pytest.approx(value, rel=1e-4) if isinstance(value, float) else value), name
    told = {name: reasons for name, reasons in by_history["not_scored"].items() if name not in of_events}
    assert told == by_checkpoint["not_scored"] and "lpips" in told
    text, page = ((tmp_path / "history" / name).read_text() for name in ("report.md", "report.html"))
    for name, reasons in by_history["not_scored"].items():
        assert f"No {name}" in text and f"No {name}" in page and all(reason in text for reason in reasons)
    scores = (tmp_path / "history" / "scores.json").read_text()
    assert json.loads(scores, parse_constant=lambda name: pytest.fail(name))


@pytest.mark.parametrize(
    ("row", "protocol"),
    [
        (HistoryRow(2, 1.0, {}, {"psnr": 9.0}, 3, protocol="gamma-affine"), "gamma-affine"),
        (HistoryRow(2, 1.0, {}, {"event_correlation": 0.5}, protocol="events"), "events"),
    ],
)
def test_a_row_says_how_it_is_scored(run: Run, tmp_path: Path, row: HistoryRow, protocol: str):
    folder = copied(run, tmp_path / "run", [row], stored=False)
    (entry,) = write_report([folder], tmp_path / "report").values()
    assert entry["protocol"] == protocol and described(protocol) in (tmp_path / "report" / "report.md").read_text()

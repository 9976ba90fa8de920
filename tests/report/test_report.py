from __future__ import annotations

import errno
import json
import math
import resource
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.scripts import render
from PIL import Image
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.errors import OutputError
from enerf_ns.evaluation import report
from enerf_ns.evaluation.report import camera_path, render_video, side_by_side, write_report
from enerf_ns.evaluation.runs import Run
from enerf_ns.evaluation.views import held_out_views


@pytest.fixture
def no_video(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report, "render_video", lambda run, path, output: output.write_text(path.read_text()))


def test_a_report_holds_scores_a_picture_and_a_flight(run: Run, tmp_path: Path, no_video: None):
    scores = write_report(run, tmp_path / "new" / "report", {"train_seconds": 1.5})
    assert json.loads((tmp_path / "new/report/scores.json").read_text()) == scores
    assert scores["protocol"] == "log-affine-set"
    assert scores["train_seconds"] == 1.5 and scores["lpips"] is None
    assert {"psnr", "ssim", "correlation", "depth_rmse", "mean_depth", "held_out_on_path", "fps"} <= set(scores)
    assert Image.open(tmp_path / "new/report/side-by-side.png").size[0] > 1000
    path = json.loads((tmp_path / "new/report/camera_path.json").read_text())
    assert path == camera_path(run.pipeline.datamanager.eval_dataset.cameras)
    names = {file.name for file in (tmp_path / "new/report").iterdir()}
    assert names == {"scores.json", "side-by-side.png", "camera_path.json", "video.mp4"}


def test_a_report_without_frames_has_no_scores_of_pictures(run_without_frames: Run, tmp_path: Path, no_video: None):
    scores = write_report(run_without_frames, tmp_path)
    assert [scores[name] for name in ("psnr", "ssim", "lpips")] == [None] * 3
    assert scores["event_correlation"] is not None and "correlation" not in scores


def test_a_full_disk_is_one_sentence_and_leaves_what_was_there(run: Run, tmp_path: Path, monkeypatch, no_video: None):
    (tmp_path / "scores.json").write_text("before")

    def full(path: Path, content: bytes) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OutputError, match=r"^--output-dir .* \(No space left on device\); give another folder\.$"):
        write_report(run, tmp_path)
    assert [file.name for file in tmp_path.iterdir()] == ["scores.json"]
    assert (tmp_path / "scores.json").read_text() == "before"


def test_a_folder_that_cannot_be_made_is_said_before_anything_is_rendered(run: Run, tmp_path: Path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setattr(report, "held_out_views", lambda _: pytest.fail("rendered"))
    with pytest.raises(OutputError, match=r"^--output-dir .*file/report could not be written to \("):
        write_report(run, tmp_path / "file" / "report")


def test_the_picture_shows_three_views_and_their_events_where_clocks_are_one(run: Run):
    recording = run.pipeline.datamanager.eval_dataset.recording
    views, _ = held_out_views(run.pipeline)
    figure = side_by_side(views + views, recording)
    titles = ["held-out frame", "render", "depth", "events"]
    assert [axis.get_title() for axis in figure.axes[:4]] == titles
    assert len(figure.axes) == 3 * 4 + 1, "and the colour bar"
    other_clock = replace(recording, held_out_frames=recording.frames)
    assert [axis.get_title() for axis in side_by_side(views[:1], other_clock).axes[:-1]] == titles[:3]


def cameras(number: int) -> Cameras:
    """Along a curve, looking about; of odd width and height."""
    turns = Rotation.from_rotvec(np.linspace(0, 1, number)[:, None] * [0.0, 1.0, 0.2]).as_matrix()
    places = np.stack([np.arange(number), np.arange(number) ** 2, np.ones(number)], axis=1)
    poses = np.concatenate([turns, places[:, :, None]], axis=2)
    return Cameras(torch.from_numpy(poses).float(), fx=30.0, fy=32.0, cx=16.5, cy=12.5, width=33, height=25)


def test_the_flight_begins_and_ends_at_held_out_cameras_and_passes_those_between():
    flown = camera_path(cameras(13))
    matrices = np.array([pose["camera_to_world"] for pose in flown["camera_path"]]).reshape(-1, 4, 4)
    assert len(matrices) == flown["fps"] * flown["seconds"] == 100
    poses = cameras(13).camera_to_worlds.numpy()
    np.testing.assert_allclose(matrices[[0, -1], :3], poses[[0, -1]], atol=1e-6)
    np.testing.assert_array_equal(matrices[:, 3], [[0, 0, 0, 1]] * 100)
    np.testing.assert_allclose(matrices[33, :3], poses[4], atol=1e-6)  # a third of the way is the third of 7 places
    np.testing.assert_allclose(matrices[:, 1, 3], matrices[:, 0, 3] ** 2, atol=0.5)


def test_the_picture_of_the_flight_has_even_sides():
    flown = camera_path(cameras(3))
    assert (flown["render_width"], flown["render_height"]) == (32, 24)
    assert flown["camera_path"][0]["fov"] == pytest.approx(math.degrees(2 * math.atan(12 / 32)))
    assert flown["camera_path"][0]["aspect"] == 32 / 24


def test_one_held_out_camera_stands_still():
    flown = camera_path(cameras(1))["camera_path"]
    assert len(flown) == 100 and flown[0]["camera_to_world"] == pytest.approx(flown[-1]["camera_to_world"])


def test_depth_is_coloured_from_the_nearest_to_the_farthest(run: Run, tmp_path: Path, monkeypatch):
    asked: dict[str, Any] = {}

    class Renderer:
        def __init__(self, **settings: Any):
            asked.update(settings)

        def main(self) -> None:
            asked["output_path"].write_text("video")

    monkeypatch.setattr(render, "RenderCameraPath", Renderer)
    render_video(run, tmp_path / "path.json", tmp_path / "video.mp4")
    near, far = run.pipeline.datamanager.eval_dataset.recording.depth_range  # type: ignore[misc]
    scale = run.pipeline.datamanager.train_dataparser_outputs.dataparser_scale
    assert asked["load_config"] == run.config_file and asked["camera_path_filename"] == tmp_path / "path.json"
    assert [(file.name, file.read_text()) for file in tmp_path.iterdir()] == [("video.mp4", "video")]
    assert asked["depth_near_plane"] == pytest.approx(run.pipeline.config.model.near_plane)
    assert asked["depth_far_plane"] == pytest.approx(far * scale) and asked["depth_near_plane"] == near * scale


@pytest.mark.parametrize(
    "failure", [OSError(errno.ENOSPC, "No space left on device"), SystemExit(1), RuntimeError("x")]
)
def test_a_video_that_breaks_off_leaves_the_one_of_before(
    run: Run, tmp_path: Path, monkeypatch, failure: BaseException
):
    class Renderer:
        def __init__(self, output_path: Path, **settings: Any):
            self.output_path = output_path

        def main(self) -> None:
            self.output_path.write_text("half")
            raise failure

    (tmp_path / "video.mp4").write_text("before")
    monkeypatch.setattr(render, "RenderCameraPath", Renderer)
    with pytest.raises(type(failure)):
        render_video(run, tmp_path / "path.json", tmp_path / "video.mp4")
    assert [(file.name, file.read_text()) for file in tmp_path.iterdir()] == [("video.mp4", "before")]


@pytest.mark.parametrize(
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
@pytest.mark.parametrize("every", [1, 2])
def test_whatever_a_field_shows_the_report_is_whole_and_json(
    run: Run, tmp_path: Path, monkeypatch, no_video: None, output: str, change: Any, every: int
):
    """Of all frames or of every second: every mean that is missing has its reason, and the picture is drawn."""
    model = run.pipeline.model
    rendered, calls = model.get_outputs_for_camera_ray_bundle, []

    def outputs(rays: Any) -> dict[str, torch.Tensor]:
        calls.append(rays)
        made = rendered(rays)
        return made | ({output: change(made[output])} if len(calls) % every == 0 else {})

    monkeypatch.setattr(model, "get_outputs_for_camera_ray_bundle", outputs)
    table = write_report(run, tmp_path)
    text = (tmp_path / "scores.json").read_text()
    assert json.loads(text, parse_constant=lambda name: pytest.fail(name)) == table
    reasons: Any = table["not_scored"]
    for name in ("psnr", "ssim", "lpips", "correlation", "depth_rmse"):
        left_out = sorted(number for numbers in reasons.get(name, {}).values() for number in numbers)
        assert (table.get(name) is None) == (left_out == [0, 1, 2])
        assert len(set(left_out)) == len(left_out)
    assert Image.open(tmp_path / "side-by-side.png").size[0] > 1000


@pytest.mark.slow
def test_a_disk_too_small_for_the_video_is_one_sentence(run: Run, tmp_path: Path):
    """By a limit of the size of files, which ffmpeg inherits."""
    (tmp_path / "video.mp4").write_text("before")
    path = tmp_path / "path.json"
    path.write_text(json.dumps(camera_path(run.pipeline.datamanager.eval_dataset.cameras)))
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    try:
        with pytest.raises((OutputError, OSError)):
            render_video(run, path, tmp_path / "video.mp4")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert (tmp_path / "video.mp4").read_text() == "before"
    assert {file.name for file in tmp_path.iterdir()} == {"video.mp4", "path.json"}

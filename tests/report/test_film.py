"""The video and the moving picture of a report: of what size and brightness they are, and of which colours."""

from __future__ import annotations

import json
import resource
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from matplotlib import colormaps
from PIL import Image

from enerf_ns.dataparsers.recording.errors import OutputError
from enerf_ns.evaluation.display import shown_numbers
from enerf_ns.evaluation.views import HeldOutView
from enerf_ns.method.held_out_views import held_out_views
from enerf_ns.method.runs import Run
from enerf_ns.report import film
from enerf_ns.report.film import Screen, render_moving, render_video
from enerf_ns.report.pictures import camera_path

PLAIN = Screen(lambda brightness: brightness, 1.0, (1.0, 3.0))


def view(rendered: torch.Tensor, recorded: torch.Tensor | None) -> HeldOutView:
    return HeldOutView(recorded, rendered, torch.ones(*rendered.shape[:2], 1), None, 0)


@pytest.mark.parametrize(
    ("median", "power", "exponent"), [(0.5**2.2, 1.2, 1 / 2.2), (0.01, 1, 1 / 2.2), (0.6, 1.2, 1.0), (0.25, 1.2, 0.5)]
)
def test_the_median_becomes_a_middle_grey_as_far_as_a_screens_gamma_goes(median: float, power: float, exponent: float):
    """Renders whose contrast is off, as events leave it open, are fitted first."""
    recorded = median * torch.exp(torch.linspace(-0.3, 0.3, 4 * 5)).reshape(4, 5, 1).expand(-1, -1, 3)
    screen = Screen.of([view(recorded**power, recorded)], (1.0, 3.0))
    assert screen.exponent == pytest.approx(exponent, rel=0.05)
    shown = screen.brightness(recorded**power)
    np.testing.assert_allclose(shown, 255 * recorded.clamp(0, 1) ** screen.exponent, atol=4)


def test_without_frames_the_brightest_is_white():
    rendered = torch.linspace(0, 7, 20 * 30).reshape(20, 30, 1).expand(-1, -1, 3)
    screen = Screen.of([view(rendered, None)], (1.0, 3.0))
    shown = screen.brightness(rendered)
    assert shown.max() == 255 and shown.min() == 0 and np.median(shown) == pytest.approx(127, abs=3)


def test_a_field_that_is_not_finite_is_shown():
    nothing = torch.full((4, 5, 3), torch.nan)
    screen = Screen.of([view(nothing, torch.rand(4, 5, 3)), view(nothing, None)], (1.0, 3.0))
    assert (screen.brightness(nothing) == 0).all()
    assert (screen.depth(nothing[..., :1]) == np.rint(255 * np.array(colormaps["viridis"](1.0)[:3]))).all()


def test_depth_is_coloured_from_the_nearest_to_the_farthest():
    shown = PLAIN.depth(torch.tensor([[[0.5], [1.0], [2.0], [3.0], [9.0]]]))[0]
    expected = np.rint(255 * colormaps["viridis"](np.array([0.0, 0.0, 0.5, 1.0, 1.0]))[:, :3])
    np.testing.assert_array_equal(shown, expected)


def test_gamma_is_told():
    assert PLAIN.gamma == "brightness"
    assert Screen(PLAIN.correct, 1 / 2.2, (1.0, 3.0)).gamma == "brightness^(1/2.2)"


def test_the_output_display_of_a_camera_is_what_the_report_shows(run: Run, capsys: pytest.CaptureFixture[str]):
    """Of this size or another; one line says what it is."""
    pipeline: Any = run.pipeline
    views, _ = held_out_views(pipeline, shown_numbers(len(pipeline.datamanager.eval_dataset)))
    screen = Screen.of(views, (1.0, 3.0))
    capsys.readouterr()
    pipeline.eval()
    for scale in (1, 2):
        camera = pipeline.datamanager.eval_dataset.cameras[:1].to(pipeline.device)
        camera.rescale_output_resolution(scale)
        outputs = pipeline.model.get_outputs_for_camera(camera)
        assert outputs["display"].shape == (scale * 24, scale * 32, 3)
        shown = (255 * outputs["display"]).round()
        np.testing.assert_allclose(shown, screen.brightness(outputs["rgb"]).astype(float), atol=1)
    (told,) = capsys.readouterr().out.splitlines()
    assert told.startswith(f"display: {screen.gamma}, as in enerf report; 32 x 24 pixels")
    assert not pipeline.training


def test_the_moving_picture_shows_events_render_and_depth(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Of 32 x 24 pixels, each 240 wide; the render is the one of the event camera at that time."""
    monkeypatch.setattr(film, "MOVING_FRAMES", 3)
    pipeline: Any = run.pipeline
    views, _ = held_out_views(pipeline)
    screen = Screen.of(views, (1.0, 3.0))
    render_moving(pipeline, screen, tmp_path / "moving.webp")
    assert [file.name for file in tmp_path.iterdir()] == ["moving.webp"]
    moving: Any = Image.open(tmp_path / "moving.webp")
    assert moving.n_frames == 3 and moving.size == (3 * 240 + 2 * 8, 180 + 54)
    moving.seek(1)
    picture = np.asarray(moving.convert("RGB")).astype(int)
    events, render, depth = (picture[:180, start : start + 240] for start in (0, 248, 496))
    assert (events.max(axis=2) - events.min(axis=2)).max() > 80  # red and blue
    assert np.abs(render - render.mean(axis=2, keepdims=True)).mean() < 3  # grey
    assert depth.std() >= 0 and picture[180:].min() < 100  # words


@pytest.mark.slow
def test_the_video_is_large_and_shows_what_the_field_renders(run: Run, tmp_path: Path):
    pipeline: Any = run.pipeline
    path = camera_path(pipeline.datamanager.eval_dataset.cameras)
    path["camera_path"] = path["camera_path"][:3]
    render_video(pipeline, PLAIN, path, tmp_path / "video.mp4")
    video = cv2.VideoCapture(str(tmp_path / "video.mp4"))
    assert (video.get(cv2.CAP_PROP_FRAME_WIDTH), video.get(cv2.CAP_PROP_FRAME_HEIGHT)) == (968, 414)
    assert (video.get(cv2.CAP_PROP_FRAME_COUNT), video.get(cv2.CAP_PROP_FPS)) == (3, 20)
    _, first = video.read()
    views, _ = held_out_views(pipeline, [0])
    expected = PLAIN.brightness(views[0].rendered)
    reduced = cv2.resize(first[:360, :480, ::-1], expected.shape[1::-1], interpolation=cv2.INTER_AREA)
    assert np.abs(reduced.astype(int) - expected).mean() < 6


def test_a_video_that_breaks_off_leaves_the_one_of_before(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def broken(*_: Any) -> None:
        raise RuntimeError("x")

    (tmp_path / "video.mp4").write_text("before")
    pipeline: Any = run.pipeline
    monkeypatch.setattr(film, "_sides", broken)
    with pytest.raises(RuntimeError, match="x"):
        render_video(pipeline, PLAIN, camera_path(pipeline.datamanager.eval_dataset.cameras), tmp_path / "video.mp4")
    assert [(file.name, file.read_text()) for file in tmp_path.iterdir()] == [("video.mp4", "before")]


@pytest.mark.slow
def test_a_disk_too_small_for_the_video_is_one_sentence(run: Run, tmp_path: Path):
    """By a limit of the size of files, which ffmpeg inherits."""
    (tmp_path / "video.mp4").write_text("before")
    pipeline: Any = run.pipeline
    path = camera_path(pipeline.datamanager.eval_dataset.cameras)
    path["camera_path"] = path["camera_path"][:3]
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    try:
        with pytest.raises(OutputError, match="make room"):
            render_video(pipeline, PLAIN, json.loads(json.dumps(path)), tmp_path / "video.mp4")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert [(file.name, file.read_text()) for file in tmp_path.iterdir()] == [("video.mp4", "before")]

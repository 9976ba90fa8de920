from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.recording.files import load_array, load_image
from enerf_ns.evaluation.scores import summary_scores
from enerf_ns.evaluation.views import aligned_views
from enerf_ns.events.batch import EventBatch
from enerf_ns.method.held_out_views import held_out_view, held_out_views
from enerf_ns.method.runs import Run
from enerf_ns.sensor.response import inverse_linlog, linlog

METRES = 2.5
HELD_OUT = [2, 6, 10]
"""Of 11 frames, every fourth."""


@pytest.fixture
def shown(run: Run, monkeypatch: pytest.MonkeyPatch) -> Any:
    """A pipeline whose field shows a wall parallel to every picture, darker to the right, brighter in each view."""
    scale = run.pipeline.datamanager.train_dataparser_outputs.dataparser_scale
    calls = []

    def outputs(rays: Any) -> dict[str, torch.Tensor]:
        height, width = rays.shape
        calls.append(rays)
        brightness = torch.linspace(0.5, 0.1, width).expand(height, width)[..., None] + 0.1 * len(calls)
        return {
            "rgb": brightness.expand(-1, -1, 3),
            "depth": scale * METRES * rays.metadata["directions_norm"],
            "accumulation": torch.ones(height, width, 1),
        }

    monkeypatch.setattr(run.pipeline.model, "get_outputs_for_camera_ray_bundle", outputs)
    return run.pipeline


def test_each_held_out_frame_is_seen_once_with_what_was_recorded_there(shown: Any, recording: Path):
    views, summary = held_out_views(shown)
    frames = read_recording(recording).frames
    assert frames is not None and frames.depth_filenames is not None
    assert [view.time for view in views] == frames.times[HELD_OUT].tolist()
    for view, number in zip(views, HELD_OUT, strict=True):
        assert view.recorded is not None and view.recorded_depth is not None
        expected = load_image(frames.filenames[number]) / 255.0
        np.testing.assert_allclose(view.recorded.numpy(), expected, atol=1e-6)
        np.testing.assert_array_equal(view.recorded_depth[..., 0].numpy(), load_array(frames.depth_filenames[number]))
    assert isinstance(summary["fps"], float) and summary["fps"] > 0
    assert summary["num_rays_per_sec"] == pytest.approx(summary["fps"] * 32 * 24)


def test_depth_is_along_the_optical_axis_and_in_metres(shown: Any):
    for view in held_out_views(shown)[0]:
        torch.testing.assert_close(view.depth, torch.full((24, 32, 1), METRES), rtol=1e-5, atol=0)


def test_a_view_is_reduced_to_means_over_squares_seen_from_their_middles(run: Run, recording: Path, tmp_path: Path):
    """Columns that are left over are cut off; depth is known only where all of a square's is."""
    whole, reduced = (held_out_view(run.pipeline.eval(), 1, by) for by in (1, 5))
    assert whole.recorded is not None and reduced.recorded is not None and reduced.recorded_depth is not None
    assert whole.recorded.shape == (24, 32, 3) and reduced.recorded.shape == reduced.rendered.shape == (4, 6, 3)
    blocks = whole.recorded.numpy()[:20, :30].reshape(4, 5, 6, 5, 3)
    np.testing.assert_allclose(reduced.recorded.numpy(), blocks.mean(axis=(1, 3)), atol=1e-6)
    np.testing.assert_allclose(reduced.rendered, whole.rendered[2:20:5, 2:30:5], atol=1e-4)
    assert reduced.depth is not None and whole.depth is not None
    np.testing.assert_allclose(reduced.depth, whole.depth[2:20:5, 2:30:5], rtol=1e-3)
    files = run.pipeline.datamanager.eval_dataset.frames.depth_filenames
    assert files is not None
    file = files[1]
    depth, kept = load_array(file), file.read_bytes()
    try:
        depth[7, 11] = 0.0
        np.save(file, depth)
        found = held_out_view(run.pipeline, 1, 5).recorded_depth
    finally:
        file.write_bytes(kept)
    assert found is not None and found[1, 2] == 0.0 and (found == 0.0).sum() == 1
    blocks = depth[:20, :30].reshape(4, 5, 6, 5).mean(axis=(1, 3))
    known = found[..., 0].numpy() > 0
    np.testing.assert_allclose(found[..., 0].numpy()[known], blocks[known], rtol=1e-5)


def test_renders_are_as_the_field_has_them(shown: Any):
    for number, view in enumerate(held_out_views(shown)[0]):
        expected = torch.linspace(0.5, 0.1, 32).expand(24, 32)[..., None].expand(-1, -1, 3) + 0.1 * (number + 1)
        torch.testing.assert_close(view.rendered, expected, rtol=0, atol=0)


@pytest.mark.parametrize("supervision", ["events", "frames"])
def test_every_run_is_aligned_alike_whatever_it_learnt_from(
    shown: Any, monkeypatch: pytest.MonkeyPatch, supervision: str
):
    monkeypatch.setattr(shown.datamanager.config, "supervision", supervision)
    table = summary_scores(*held_out_views(shown))
    assert table["protocol"] == "log-affine-set" and isinstance(table["brightness_scale"], float)


@pytest.mark.parametrize("response", ["linlog", "gamma:2.0:0.001"])
def test_the_scale_of_a_field_that_explains_all_events_is_the_expected_one(
    shown: Any, monkeypatch: pytest.MonkeyPatch, response: str
):
    """Log brightness that rose or fell from one level makes as many events as thresholds fit in between; the field has
    the change that these measure with the thresholds it learnt with, which are 1.2 times the true ones."""
    true = shown.datamanager.eval_dataset.recording.contrast_thresholds
    learnt_with = tuple(1.2 * threshold for threshold in true)
    config = replace(shown.model.config.sensor, contrast_thresholds=learnt_with, response=response)
    monkeypatch.setitem(shown.model._modules, "sensor", config.setup())
    exponent = 2.0 if response != "linlog" else 1.0
    views, summary = held_out_views(shown)
    for view in views:
        assert view.recorded is not None
        view.recorded = 0.2 + 0.8 * view.recorded.double()  # where linlog is a logarithm
        change = linlog(view.recorded) - 5.0
        on, off = change.clamp(min=0.0) / true[0], (-change).clamp(min=0.0) / true[1]
        nothing = torch.zeros(on.shape, dtype=torch.long)
        measured = shown.model.sensor.measured_change(EventBatch(nothing, nothing, nothing, on, off))
        view.rendered = inverse_linlog((5.0 + measured) / exponent + np.log(255) * (1 - 1 / exponent))
    table = summary_scores(views, summary)
    assert table["brightness_scale"] == pytest.approx(exponent / 1.2, rel=1e-6)
    assert table["brightness_scale_expected"] == pytest.approx(exponent / 1.2, rel=1e-6)


def test_a_scale_is_expected_of_what_was_learnt_from_events_with_known_thresholds_and_fitted_once(
    shown: Any, monkeypatch: pytest.MonkeyPatch
):
    name = "brightness_scale_expected"
    views, summary = held_out_views(shown)
    assert summary[name] == 1.0 and summary_scores(views, summary)[name] == 1.0
    for protocol in ("raw", "eventnerf", "log-affine-image", "log-offset"):
        assert name not in summary_scores(views, summary, protocol=protocol)
    negatives = [replace(view, rendered=1.2 - view.rendered) for view in views]
    assert name not in summary_scores(negatives, summary)
    monkeypatch.setattr(shown.datamanager.config, "supervision", "frames")
    assert name not in held_out_views(shown)[1]
    monkeypatch.setattr(shown.datamanager.config, "supervision", "events")
    dataset = shown.datamanager.eval_dataset
    monkeypatch.setattr(dataset, "recording", replace(dataset.recording, contrast_thresholds=None))
    assert name not in held_out_views(shown)[1]


def test_without_frames_there_are_views_with_nothing_recorded(run_without_frames: Run):
    views, summary = held_out_views(run_without_frames.pipeline)
    assert len(views) == 3 and aligned_views(views) == (views, {})
    assert all(view.recorded is None and view.recorded_depth is None for view in views)
    assert set(summary) == {"num_rays_per_sec", "fps", "event_correlation", "event_rmse", "event_sign"}
    assert isinstance(summary["event_correlation"], float) and -1 <= summary["event_correlation"] <= 1

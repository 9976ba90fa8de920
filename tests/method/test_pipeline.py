"""The pipeline's own part: batches to losses, and what Nerfstudio asks of it."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from small_runs import set_up, small_config

from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.sensor_estimates import estimates as sensor_estimates
from enerf_ns.dataparsers.sensor_estimates.estimates import noise_per_event, threshold_differences
from enerf_ns.method import pipeline as method_pipeline
from enerf_ns.method.pipeline import SLOPE_NS, SLOPE_PAIRS
from enerf_ns.sensor.response import Logarithm, luma


@pytest.fixture(scope="module")
def pipeline(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    config = small_config(
        recording,
        tmp_path_factory.mktemp("outputs"),
        data__supervision="events+frames",
        data__silent_pairs=16,
        data__held_out_events=0.2,
    )
    return set_up(config).pipeline


def test_losses_of_training_have_gradients_and_those_of_evaluation_have_none(pipeline: Any):
    _, losses, metrics = pipeline.get_train_loss_dict(0)
    assert set(metrics) == {"event_correlation", "frame_psnr"} and all(loss.requires_grad for loss in losses.values())
    _, losses, _ = pipeline.get_eval_loss_dict(0)
    assert set(losses) == {"event_loss", "no_event_loss", "frame_loss"}
    assert not any(loss.requires_grad for loss in losses.values()) and pipeline.training


def test_the_scores_of_events_are_those_of_what_is_rendered(pipeline: Any):
    """Over pairs that are held out, by a generator of its own, so that they are the same each time; a pixel sees the
    mean over its area."""
    torch.nn.init.normal_(pipeline.model.field.geometry.grid.table)  # at first nothing changes
    found = pipeline.event_scores(300)
    assert pipeline.event_scores(300) == found and pipeline.model.sensor.response == Logarithm(0.001)
    pairs = pipeline.datamanager.held_out_pair_sampler.sample(300, torch.Generator().manual_seed(0))
    levels = []
    for times in (pairs.start, pairs.end):
        seen = []
        for x, y in product((-0.375, -0.125, 0.125, 0.375), repeat=2):
            places = torch.tensor([[x, y]]).expand(300, 2)
            rays = pipeline.datamanager.event_camera.rays(pairs.pixels, times, places=places)
            pipeline.eval()
            with torch.no_grad():
                seen.append(luma(pipeline.model(rays)["rgb"].double()))
            pipeline.train()
        levels.append(torch.log(torch.stack(seen).mean(dim=0) + 0.001))
    c_on, c_off = pipeline.model.sensor.contrast_thresholds
    change, measured = (levels[1] - levels[0]).numpy(), (c_on * pairs.on - c_off * pairs.off).double().numpy()
    assert found["event_correlation"] == pytest.approx(np.corrcoef(change, measured)[0, 1], abs=1e-4)
    error = (change - measured) / (0.5 * (c_on + c_off))
    assert found["event_rmse"] == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-4)
    agrees = [a * b > 0 for a, b in zip(change, measured, strict=True) if b != 0]
    assert 0 < len(agrees) and found["event_sign"] == sum(agrees) / len(agrees)


def test_slopes_are_those_of_what_is_rendered(pipeline: Any):
    """Of the first pairs, from a moment before to a moment after each instant, as far as there are poses."""
    manager, sensor = pipeline.datamanager, pipeline.model.sensor
    torch.nn.init.normal_(pipeline.model.field.geometry.grid.table)
    trajectory = manager.event_camera.trajectory
    batch = manager.next_batch(sensor).events
    start = batch.start.clone()
    start[0] = trajectory.start
    batch = replace(batch, start=start)
    number = min(SLOPE_PAIRS, len(batch) - batch.num_silent)
    pipeline.eval()
    found = pipeline._slopes(batch, SLOPE_PAIRS)
    assert found.shape == (len(batch), 2) and not found.requires_grad and (found[number:] == 0.0).all()
    for instant, times in enumerate((batch.start, batch.end)):
        levels, moments = [], []
        for moment in (times - SLOPE_NS, times + SLOPE_NS):
            moments.append(moment[:number].clamp(trajectory.start, trajectory.end))
            with torch.no_grad():
                rgb = pipeline.model(manager.event_camera.rays(batch.pixels[:number], moments[-1]))["rgb"]
            levels.append(sensor.log_brightness(rgb, batch.pixels[:number]))
        expected = (levels[1] - levels[0]) / (1e-9 * (moments[1] - moments[0]))
        assert expected.abs().max() > 1.0
        torch.testing.assert_close(found[:number, instant], expected.float(), rtol=1e-3, atol=1e-2)
    pipeline.train()


def test_only_wide_cells_have_a_say_in_poses(pipeline: Any, monkeypatch):
    """Cells whose angle at the geometric mean of the range of depth is smaller than the stated one add nothing."""
    grid, manager = pipeline.model.field.geometry.grid, pipeline.datamanager
    box = pipeline.model.field.geometry.aabb
    distance = manager.event_camera.scale * np.sqrt(np.prod(manager.depth_range))
    angles = (float((box[1] - box[0]).max()) / grid.scalings / distance).tolist()
    monkeypatch.setattr(pipeline, "num_steps", 1000)
    monkeypatch.setattr(method_pipeline, "FINEST_SLOPES", np.sqrt(angles[1] * angles[2]))
    assert method_pipeline.FINEST_SLOPES < 0.9 * angles[1] and pipeline.poses.allowed
    batch = manager.next_batch(pipeline.model.sensor).events
    table = grid.table.view(len(angles), -1)
    said = []
    for kept in (slice(0, 2), slice(2, None)):
        with torch.no_grad():
            table.zero_()
            table[kept].normal_()
        pipeline.poses.normal.zero_()
        pipeline._refine_poses(pipeline.poses, batch, 100)
        said.append(pipeline.poses.normal.diagonal()[: pipeline.poses.number].abs().max())
    assert said[0] > 0.0 and said[1] == 0.0


def test_frames_alone_are_rendered_at_the_clock_that_is_stated(recording: Path, tmp_path: Path):
    config = small_config(recording, tmp_path, data__supervision="frames")
    config.pipeline.poses.clock_ms, config.pipeline.poses.frame_delay_ms = 5.0, 2.0
    manager = config.resolved().pipeline.setup(device="cpu").datamanager
    read, frames = read_recording(recording).trajectory, manager.train_dataset.frames
    late = torch.from_numpy(frames.times) + 5_000_000
    inside = (late >= read.start + 5_000_000) & (late <= read.end)
    found = manager.frame_camera.trajectory.poses(torch.from_numpy(frames.times)[inside])
    torch.testing.assert_close(found, read.poses(late[inside]), rtol=0, atol=1e-4)
    recorded = read_recording(recording).frames
    assert recorded is not None and set(frames.times + 2_000_000) < set(recorded.times)


def test_several_devices_keep_the_corrections_before_training(recording: Path, tmp_path: Path, capsys):
    """As a run of theirs that one device reads back does."""
    config = small_config(recording, tmp_path)
    config.pipeline.poses.clock_ms = 5.0
    resolved = config.resolved().pipeline
    one = resolved.setup(device="cpu")
    assert "several devices" not in capsys.readouterr().out
    torch.distributed.init_process_group("gloo", f"file://{tmp_path / 'meet'}", rank=0, world_size=1)
    try:
        several = resolved.setup(device="cpu", world_size=2)
        assert "several devices" in capsys.readouterr().out
        for made, looks in ((one, 1), (several, 0)):
            made.num_steps = 1000
            made.get_train_loss_dict(100)
            assert made.poses.looks == looks and made.datamanager.corrections.delay == 5.0
        stored = several.state_dict()
    finally:
        torch.distributed.destroy_process_group()
    one.load_pipeline(stored, 1)
    assert one.poses.looks == 0 and one.datamanager.corrections.delay == 5.0


@pytest.mark.parametrize(("mode", "blind", "starts"), [("val", 0, True), ("test", 0, False), ("val", 1000, False)])
def test_a_map_of_thresholds_starts_from_the_events(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mode: Any, blind: int, starts: bool
):
    """To train, where pixels are never blind; nothing of it is stored beside the map."""
    monkeypatch.setattr(sensor_estimates, "FEWEST_SLOPE", 2)  # a tenth of a second has no more
    config = small_config(recording, tmp_path, sensor__learn_threshold_map=True, sensor__refractory_period_ns=blind)
    made = config.resolved().pipeline.setup(device="cpu", test_mode=mode)
    found = made.model.sensor.threshold_map
    assert found is not None
    index = index_events(made.datamanager.recording)
    noise = noise_per_event(index, (0.25, 0.25)).value
    difference, variance = threshold_differences(index, (0.25, 0.25), noise)
    assert variance.isfinite().any() and found.deviations.any() == starts
    expected = torch.stack([1.0 / variance, difference / variance], dim=-1)
    torch.testing.assert_close(found.known, expected if starts else torch.zeros_like(expected))
    assert "known" not in found.state_dict()


def test_the_config_of_a_pipeline_has_nothing_open_and_the_users_is_as_it_was(recording: Path, tmp_path: Path):
    config = small_config(recording, tmp_path).resolved().pipeline
    made = config.setup(device="cpu", test_mode="test")
    assert config.model.num_channels is None and config.datamanager.dataparser.depth_range is None
    used = made.config
    assert used.model.num_channels == 1 and used.datamanager.dataparser.depth_range is not None
    assert used.model.sensor.contrast_thresholds is not None and used.datamanager.pair_mode == "partner"


@pytest.mark.parametrize(
    ("change", "scores"),
    [
        (lambda rgb: rgb, {"psnr", "ssim"}),
        (lambda rgb: 1.0 - rgb, set()),
        (lambda rgb: 0.0 * rgb, set()),
        (lambda rgb: torch.nan * rgb, set()),
    ],
    ids=["frame", "negative", "dark", "nan"],
)
@pytest.mark.parametrize("depth", [2.0, 0.0, torch.nan, torch.inf])
def test_a_picture_in_training_has_the_scores_that_it_can_have(pipeline: Any, change: Any, scores: set, depth: float):
    """As Nerfstudio logs them: numbers alone, and pictures that are finite."""
    batch = pipeline.datamanager.eval_dataset[0]
    outputs = {"rgb": change(batch["image"][..., :3]), "depth": torch.full((*batch["image"].shape[:2], 1), depth)}
    found, images = pipeline.model.get_image_metrics_and_images(outputs, batch)
    assert set(found) == scores and all(isinstance(score, float) and np.isfinite(score) for score in found.values())
    assert all(image.isfinite().all() for image in images.values())
    assert images["depth"].max() == (1.0 if depth == 2.0 else 0.0)

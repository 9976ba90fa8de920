"""A run that starts from edges: before its first step, rays are free up to points whose depth events show."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from recordings import write_event_recording
from small_runs import set_up, small_config

from enerf_ns.bench.numerics.points import CAMERA, TURNING, points_between, recording_of_points, shaking
from enerf_ns.dataparsers.recording.recording import EventRecording

POINTS = points_between(1.0, 3.0)


@pytest.fixture(scope="module")
def recording_of_known_points(tmp_path_factory: pytest.TempPathFactory) -> Path:
    events, trajectory, _ = recording_of_points(POINTS, shaking(0.2), TURNING)
    recording = EventRecording(Path("memory"), "test", CAMERA, trajectory, lambda: iter([events]), ())
    return write_event_recording(recording, tmp_path_factory.mktemp("points") / "recording")


@torch.no_grad()
def freedom(data: Path, output_dir: Path, **changes) -> float:
    """Share of the light from points that reaches the middle of the path, less the last tenth of the way, after step 0
    of a run that learns nearly nothing."""
    config = small_config(data, output_dir, **changes)
    config.pipeline.datamanager.dataparser = replace(config.pipeline.datamanager.dataparser, depth_range=(0.7, 4.0))
    for optimizer in config.optimizers.values():
        optimizer["optimizer"].lr = 1e-9
    trainer = set_up(config)
    with torch.enable_grad():
        trainer.train_iteration(0)
    manager, model = trainer.pipeline.datamanager, trainer.pipeline.model
    pose = manager.recording.trajectory.poses(torch.tensor(manager.recording.span[1] // 2))
    ahead = (torch.from_numpy(POINTS) - pose[:, 3]) @ pose[:, :3]
    x, y, z = ahead.T
    camera = manager.recording.camera
    seen = (z > 0) & (x.abs() * camera.fx < camera.cx * z) & (y.abs() * camera.fy < camera.cy * z)
    start, points = (
        manager.event_camera.in_scene(places).float() for places in (pose[None, :, 3], torch.from_numpy(POINTS)[seen])
    )
    shares = torch.linspace(0.3, 0.9, 400)[:, None, None]
    density = model.field.geometry.density_fn(start + shares * (points - start))[..., 0].mean(dim=0)
    return float(torch.exp(-0.6 * density * (points - start).norm(dim=1)).mean())


def test_a_field_that_starts_from_edges_lets_light_of_known_points_through(
    recording_of_known_points: Path, tmp_path: Path
):
    with_edges = freedom(recording_of_known_points, tmp_path, model__edge_start=True)
    without = freedom(recording_of_known_points, tmp_path, model__edge_start=False)
    assert 1.0 - with_edges < 0.7 * (1.0 - without), (with_edges, without)


def test_where_events_show_no_edge_a_line_says_so_and_training_goes_on(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    config = small_config(recording, tmp_path, model__edge_start=True)
    config.pipeline.datamanager.dataparser = replace(config.pipeline.datamanager.dataparser, depth_range=(90.0, 99.0))
    trainer = set_up(config)
    loss, _, _ = trainer.train_iteration(0)
    assert loss.isfinite() and "depth of no edge" in " ".join(capsys.readouterr().out.split())

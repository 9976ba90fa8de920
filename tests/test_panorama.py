"""A camera that only turns: what is trained, what is said, and what is left out, since nothing shows depth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from small_runs import small_config

from enerf_ns.choices.resolver import resolve
from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.inspection.page import Inspection
from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.evaluation.scores import summary_scores
from enerf_ns.export.surface import surface_views
from enerf_ns.method.held_out_views import held_out_views
from enerf_ns.method.runs import Run, method_config, train
from enerf_ns.report.writing import write_report
from enerf_ns.simulator.engine import simulate
from enerf_ns.simulator.settings import SimulationSettings
from enerf_ns.simulator.trajectories import look_at

PLACE = np.array([0.1, 0.0, 0.15])


@pytest.fixture(scope="module")
def turning(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A third of a second of a camera that turns by 20 degrees to and fro about two axes, in one place."""
    folder = tmp_path_factory.mktemp("turning")
    seconds = np.linspace(0.0, 0.35, 351)
    angles = np.radians([20.0, 10.0]) * np.sin(2 * np.pi * seconds[:, None] * [4.0, 7.0])
    rotations = look_at(PLACE, PLACE + np.array([0.0, 1.0, 0.0])) * Rotation.from_euler("yx", angles)
    lines = np.column_stack([seconds, np.tile(PLACE, (351, 1)), rotations.as_quat()])
    np.savetxt(folder / "poses.txt", lines, "%.9f")
    settings = SimulationSettings(
        "shapes", trajectory=folder / "poses.txt", width=48, height=36, num_frames=15, exposure_ms=0.0
    )
    simulate(settings, folder / "recording")
    return folder / "recording"


@pytest.fixture(scope="module")
def panorama(turning: Path) -> Run:
    """Of 150 steps on its events alone."""
    changes = {"max_num_iterations": 150, "timestamp": "run", "machine.device_type": "cpu"}
    pairs = {f"pipeline.datamanager.{name}": 1024 for name in ("event_pairs", "train_num_rays_per_batch")}
    return train(method_config("enerf", turning, turning.parent / "runs", changes | pairs))


def test_an_inspection_says_what_can_be_learned(turning: Path):
    found = Inspection.of(read_recording(turning))
    assert found.depth_range is None and "panorama" in found.numbers()["near and far"]
    (problem,) = [one for one in found.problems if "only turns" in one.what]
    assert "no depth, no mesh" in problem.advice and not [one for one in found.problems if "depth range" in one.what]


@pytest.mark.parametrize("states_depths", [True, False])
def test_a_panorama_is_chosen_unless_a_depth_range_is_given(turning: Path, tmp_path: Path, states_depths: bool):
    """The range that a recording states does not show how far surfaces are; that of a flag is followed."""
    config = small_config(turning, tmp_path)
    recording = read_recording(turning)
    assert recording.depth_range is not None
    recording = recording if states_depths else replace(recording, depth_range=None)
    resolution = resolve(config.pipeline, recording)
    assert resolution.values["model.panorama"] is True
    (row,) = [choice for choice in resolution.choices if choice.part == "panorama"]
    assert row.kept and "no depth" in row.value and "only turns" in row.why
    assert "panorama" in resolution.summary[0] and not any("depth" in flag for flag in resolution.flags_to_state)
    assert not {"proposal network", "contraction"} & {choice.part for choice in resolution.choices}
    config.pipeline.datamanager.dataparser.depth_range = (1.0, 4.0)
    assert resolve(config.pipeline, recording).values["model.panorama"] is False


def test_events_of_a_camera_that_turns_are_learned(panorama: Run):
    """A picture of one grey has a PSNR of 16 dB."""
    views, summary = held_out_views(panorama.pipeline)
    recorded = torch.stack([view.recorded for view in views if view.recorded is not None])
    grey = float(-10.0 * torch.log10((recorded - recorded.mean()).square().mean()))
    scores = summary_scores(views, summary)
    assert float(str(scores["psnr"])) > grey + 6.0, (scores, grey)
    assert not [name for name in scores if "depth" in name]
    assert all(view.depth is None and view.confidence is None for view in views)


@torch.no_grad()
def test_small_translations_change_nothing(panorama: Run):
    pipeline = panorama.pipeline.eval()
    camera = pipeline.datamanager.eval_dataset.cameras[:1]
    rays = camera.generate_rays(camera_indices=0, keep_shape=True)
    here = pipeline.model.get_outputs_for_camera_ray_bundle(rays)["rgb"]
    metres = pipeline.datamanager.train_dataparser_outputs.dataparser_scale
    rays.origins = rays.origins + 0.01 * metres
    there = pipeline.model.get_outputs_for_camera_ray_bundle(rays)["rgb"]
    assert (here - there).abs().max() < 0.02 and here.std() > 0.01


def test_its_report_has_no_depth_and_its_surface_is_refused(panorama: Run, tmp_path: Path):
    write_report([panorama], tmp_path, video=False)
    text = (tmp_path / "report.md").read_text()
    assert "panorama" in text and "depth RMSE" not in text and "depth_rmse" not in text
    page = (tmp_path / "report.html").read_text()
    assert "rendered depth" not in page and "held-out frame" in page
    with pytest.raises(RecordingError, match=r"panorama without depth"):
        surface_views(panorama.pipeline)


@torch.no_grad()
def test_pictures_of_ns_render_have_no_depth(panorama: Run):
    pipeline = panorama.pipeline.eval()
    shown = pipeline.model.get_outputs_for_camera(pipeline.datamanager.eval_dataset.cameras[:1])
    assert {"rgb", "display", "accumulation"} <= set(shown) and not {"depth", "normals", "confidence"} & set(shown)


def test_a_recording_that_is_simulated_from_it_has_no_depth(panorama: Run, tmp_path: Path):
    settings = SimulationSettings(from_run=panorama.config_file, duration=0.05, num_frames=2, exposure_ms=0.0)
    simulate(settings, tmp_path / "recording")
    frames = read_recording(tmp_path / "recording").frames
    assert frames is not None and len(frames.times) == 2 and frames.depth_filenames is None


def test_it_can_be_forced_for_any_recording(recording: Path, tmp_path: Path):
    config = small_config(recording, tmp_path, model__panorama=True)
    assert config.resolved().pipeline.model.panorama

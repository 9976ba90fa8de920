"""Gains and offsets of frames, against those that pictures were made with."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from enerf_ns.method.runs import method_config, train
from enerf_ns.simulator.engine import simulate
from enerf_ns.simulator.settings import SimulationSettings
from enerf_ns.supervision.frame_exposure import FrameExposure
from enerf_ns.supervision.losses import frame_loss


def test_gains_and_offsets_are_learned_up_to_their_means():
    random = torch.Generator().manual_seed(0)
    gain, offset = torch.tensor([0.7, 1.0, 1.3, 1.1]), torch.tensor([0.02, -0.01, 0.0, -0.01])
    shown = 0.6 * torch.rand(400, 3, generator=random)
    frames = torch.randint(4, (400,), generator=random)
    recorded = gain[frames, None] * shown + offset[frames, None]
    level = gain.log().mean().exp()
    exposure = FrameExposure(4)
    optimizer = torch.optim.Adam(exposure.parameters(), 0.02)
    for _ in range(400):
        loss = frame_loss(exposure(level * shown, frames), recorded, grey=False)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    exposure.times.copy_(torch.tensor([0, 10, 20, 30]))
    for number in range(4):
        found = exposure.at(10 * number)
        assert found == pytest.approx((float(gain[number] / level), float(offset[number])), abs=0.01)


def test_all_frames_together_are_exposed_as_the_field_shows():
    exposure = FrameExposure(5)
    with torch.no_grad():
        exposure.log_gain.copy_(torch.tensor([3.0, 1.0, 2.0, 2.5, 4.0]))
        exposure.offset.copy_(torch.tensor([0.1, 0.3, 0.1, 0.2, 0.0]))
    shown = torch.full((5, 1), 0.5)
    made = exposure(shown, torch.arange(5))[:, 0]
    ratio = (made - (exposure.offset - exposure.offset.mean())) / 0.5
    assert float(ratio.log().mean()) == pytest.approx(0.0, abs=1e-5)


def test_between_frames_exposure_is_interpolated_in_time():
    """The logarithm of the gain, and the offset; frames may be in any order."""
    exposure = FrameExposure(3)
    with torch.no_grad():
        exposure.log_gain.copy_(torch.tensor([math.log(1.21), 0.0, -math.log(1.21)]))
        exposure.offset.copy_(torch.tensor([0.1, 0.0, -0.1]))
    exposure.times.copy_(torch.tensor([200, 100, 0]))
    assert exposure.at(150) == pytest.approx((1.1, 0.05), rel=1e-5)
    assert exposure.at(-50) == pytest.approx(exposure.at(0)) and exposure.at(500) == pytest.approx(exposure.at(200))


WHOLE: tuple[dict[str, Any], dict[str, Any]] = {}, {"max_num_iterations": 400}
SMALL: tuple[dict[str, Any], dict[str, Any]] = (
    {"width": 64, "height": 48, "duration": 0.5, "num_frames": 11},
    {"max_num_iterations": 300, "pipeline.datamanager.event_pairs": 256},
)
"""What is simulated, and how it is trained: as the demo is, and smaller."""


@pytest.mark.slow
@pytest.mark.parametrize("size", [SMALL, pytest.param(WHOLE, marks=pytest.mark.exhaustive)], ids=["small", "whole"])
def test_a_training_beside_frames_finds_how_each_was_exposed(tmp_path: Path, size: tuple[dict, dict]):
    """Nobody says that exposure changes; the offsets stay small, since there are none."""
    folder, (simulated, trained) = tmp_path / "shapes", size
    simulate(SimulationSettings("shapes", layout="event_recording", **simulated), folder)
    files = sorted((folder / "frames").glob("*.png"))
    gains = np.random.default_rng(0).uniform(0.6, 1.0, len(files))
    for file, gain in zip(files, gains, strict=True):
        Image.fromarray((gain * np.asarray(Image.open(file)) + 0.5).astype(np.uint8)).save(file)
    changes = {
        **trained,
        "evaluation_share": 0.0,
        "pipeline.datamanager.supervision": "events+frames",
        "pipeline.datamanager.dataparser.train_frames": "sharp",
    }
    run = train(method_config("enerf", folder, tmp_path / "runs", changes))
    exposure = run.pipeline.model.exposure
    assert exposure is not None
    frames = run.pipeline.datamanager.train_dataset.frames
    wanted = np.log([gains[files.index(folder / "frames" / name.name)] for name in frames.filenames])
    found = np.array([exposure.at(int(time)) for time in frames.times])
    left = np.log(found[:, 0]) - (wanted - wanted.mean())
    assert np.sqrt(np.mean(left**2)) < 0.2 * wanted.std()
    assert np.abs(found[:, 1]).max() < 0.05

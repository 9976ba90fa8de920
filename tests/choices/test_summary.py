"""What training says of the choices for a scene before it begins."""

from __future__ import annotations

import shutil
import textwrap
from pathlib import Path
from typing import Any

import pytest
from small_runs import small_config

from enerf_ns.choices.resolution import Resolution
from enerf_ns.method.trainer import EnerfTrainerConfig

THRESHOLDS = "--pipeline.model.contrast-thresholds ON OFF"
FRAMES = "--pipeline.datamanager.supervision events+frames"
LEVEL = "--pipeline.model.mean-brightness MEAN"


@pytest.fixture(scope="module")
def bare(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The recording with its events, poses and depths alone: nobody states thresholds."""
    folder = tmp_path_factory.mktemp("bare") / "bare"
    left_out = shutil.ignore_patterns("images*", "depth", "simulation.json")
    shutil.copytree(recording, folder, ignore=left_out)
    return folder


def told(data: Path, folder: Path, **changes: Any) -> Resolution:
    config: EnerfTrainerConfig = small_config(data, folder, **changes)
    return config.resolved().pipeline.resolution


def test_a_recording_that_states_its_sensor_leaves_frames_to_learn_from(recording: Path, tmp_path: Path):
    found = told(recording, tmp_path)
    assert found.summary[0].startswith("The field learns from ") and "3 held-out frames" in found.summary[0]
    assert "assumed" not in " ".join(found.summary) and found.flags_to_state == (FRAMES,)
    both = told(recording, tmp_path, data__supervision="events+frames")
    assert " s and 8 frames" in both.summary[0] and both.flags_to_state == ()


def test_what_limits_the_result_stands_first(bare: Path, tmp_path: Path):
    """Without frames, and without thresholds; and each flag that states one of them ends its assumption."""
    found = told(bare, tmp_path)
    assert found.summary[0] == (
        "The recording holds no frames and the mean contrast threshold is assumed (0.25): brightness is known up to a "
        "power and a scale."
    )
    assert found.flags_to_state == (THRESHOLDS, LEVEL)
    stated = told(bare, tmp_path, sensor__contrast_thresholds=(0.2, 0.3))
    assert stated.summary[0] == "The recording holds no frames: brightness is known up to a scale."
    assert stated.flags_to_state == (LEVEL,)
    levelled = told(bare, tmp_path, sensor__contrast_thresholds=(0.2, 0.3), model__mean_brightness=0.2)
    assert levelled.summary[0] == "The recording holds no frames." and levelled.flags_to_state == ()


def test_what_is_learned_beside_the_field_is_named(bare: Path, tmp_path: Path):
    learned = told(bare, tmp_path, sensor__learn_leak_rate=True, sensor__learn_cutoff_frequency=True).summary[-1]
    assert learned.startswith("Training also learns the cutoff frequency and leak rate.")
    assert "Training corrects clock, mount, lens and drift of the poses if events show that they are wrong." in learned


@pytest.mark.parametrize("columns", [80, 120])
def test_it_fills_at_most_eight_lines(columns: int, bare: Path, tmp_path: Path):
    """With all that may be said of a sensor that nobody knows. No flag is longer than a line."""
    found = told(bare, tmp_path, sensor__learn_leak_rate=True, sensor__learn_cutoff_frequency=True)
    lines = textwrap.wrap(" ".join(found.summary), columns)
    assert len(lines) + len(found.flags_to_state) <= 8
    assert all(len(f"better with: {flag}") <= columns for flag in found.flags_to_state)

"""Rows of the poses."""

from __future__ import annotations

import copy
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from enerf_ns.choices.poses import noise, selection
from enerf_ns.choices.resolver import resolve
from enerf_ns.choices.scene import Scene
from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.recording.errors import FlagError
from enerf_ns.dataparsers.recording.trajectory import Trajectory
from enerf_ns.method.config import enerf
from enerf_ns.simulator.engine import simulate
from enerf_ns.simulator.event_sensor import SensorSettings
from enerf_ns.simulator.settings import SimulationSettings

NOISE = 0.03
"""Standard deviation of each coordinate of a position, metres."""


@pytest.mark.parametrize(
    ("by_flag", "stated", "distance"),
    [((0.5, 8.0), None, 2.0), (None, (0.5, 8.0), 2.0), ((1.0, 16.0), (0.5, 8.0), 4.0), (None, None, 5.0)],
)
def test_noise_of_poses_moves_the_picture_by_what_it_is_at_the_distance_of_the_scene(
    recording: Path, by_flag: tuple[float, float] | None, stated: tuple[float, float] | None, distance: float
):
    """The scene is in the geometric middle of its range of depth; where nobody states one, as far away as the camera
    goes, which is 3 m to the right and 4 m down here."""
    simulated = read_recording(recording)
    start, end = simulated.trajectory.times[[0, -1]]
    times = np.linspace(start, end, 401).astype(np.int64)
    way = np.linspace(0.0, 1.0, 401)[:, None] * [3.0, 4.0, 0.0]
    positions = way + NOISE * np.random.default_rng(0).normal(size=(401, 3))
    noisy = Trajectory(times, positions, np.tile([0.0, 0.0, 0.0, 1.0], (401, 1)))
    config: Any = copy.deepcopy(enerf.config.pipeline)
    config.datamanager.dataparser.depth_range = by_flag
    scene = Scene(config, replace(simulated, trajectory=noisy, depth_range=stated), None)
    selection(scene)
    noise(scene)
    (row,) = scene.choices
    (pixels,) = re.findall(r"^it moves the picture by ([\d.]+) pixels$", row.why)
    assert row.kept and float(pixels) == pytest.approx(simulated.camera.fx * NOISE / distance, rel=0.1)


def test_frames_alone_show_no_correction(recording: Path):
    config: Any = copy.deepcopy(enerf.config.pipeline)
    config.datamanager.supervision, config.poses.refine_mount = "frames", True
    with pytest.raises(FlagError, match=r"--pipeline\.refine-mount True .* frames alone; leave it out, or give"):
        resolve(config, read_recording(recording))


def test_a_focal_length_with_which_the_lens_has_no_inverse_is_refused(recording: Path):
    """The wider the view, the smaller the distortion with which the corners are seen in a direction."""
    simulated = read_recording(recording)
    camera = simulated.camera
    corner = np.hypot(camera.cx, camera.cy) / camera.fx
    most = (2.0 / 3.0 / corner) ** 2 / 3.0  # as large a distortion as a corner at this radius can have
    wide = replace(camera, model="radtan", distortion=(-0.8 * most, 0.0, 0.0, 0.0))
    config: Any = copy.deepcopy(enerf.config.pipeline)
    config.poses.focal_scale = 0.8
    with pytest.raises(FlagError, match=r"--pipeline\.focal-scale 0\.8 gives .* no inverse .*; calibrate again"):
        resolve(config, replace(simulated, camera=wide))


@pytest.mark.parametrize("cutoff", [None, 100.0])
def test_a_stated_lag_of_pixels_is_no_error_of_a_clock(cutoff: float | None, tmp_path: Path):
    """Events of a slow sensor are late by milliseconds. If nobody states its lag, poses and frames seem to be early."""
    sensor = SensorSettings(contrast_thresholds=(0.25, 0.25), cutoff_frequency=100.0)
    settings = SimulationSettings("shapes", layout="event_recording", width=80, height=60, sensor=sensor)
    simulate(settings, tmp_path / "slow")
    config: Any = copy.deepcopy(enerf.config.pipeline)
    config.model.sensor.learn_cutoff_frequency = False
    config.model.sensor.cutoff_frequency = cutoff
    resolution = resolve(config, read_recording(tmp_path / "slow"))
    (row,) = (choice for choice in resolution.choices if choice.part == "clock of the poses")
    assert (resolution.values["poses.clock_ms"] == 0.0) == (cutoff is not None)
    assert ("attributed to the lag of the pixels" in row.why) == (cutoff is not None)
    assert ("poses are stamped -" in row.why) == (cutoff is None)

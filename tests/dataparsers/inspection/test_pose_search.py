"""Poses of a new recording that contradict its events are mended, and no others."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import faults
import numpy as np
import pytest
from recordings import write_esim, write_event_recording
from scipy.spatial.transform import Rotation
from test_agreement import points_seen

from enerf_ns.bench.numerics.points import TURNING, shaking
from enerf_ns.dataparsers.formats import event_recording
from enerf_ns.dataparsers.formats.conversion import convert_recording
from enerf_ns.dataparsers.index import index_cache
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.inspection.pose_search import mend_poses
from enerf_ns.dataparsers.recording.recording import EventRecording
from enerf_ns.dataparsers.recording.trajectory import Trajectory


@pytest.fixture(scope="module")
def shaken() -> EventRecording:
    return replace(points_seen(shaking(0.1), TURNING), depth_range=None)


def ros(recording: EventRecording) -> EventRecording:
    """The file holds poses of a body with x forward, y left and z up."""
    read = recording.trajectory
    forward, left, up = [0, 0, 1], [-1, 0, 0], [0, -1, 0]
    turned = Rotation.from_quat(read.quaternions).as_matrix() @ np.array([forward, left, up]).T
    return faults.with_poses(recording, Trajectory(read.times, read.positions, Rotation.from_matrix(turned).as_quat()))


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        pytest.param(faults.inverse, "world to camera, the inverse", id="inverse"),
        pytest.param(faults.scalar_first, "quaternions in the order w x y z", id="w x y z", marks=pytest.mark.slow),
        pytest.param(faults.opengl, "OpenGL's camera axes", id="OpenGL", marks=pytest.mark.slow),
        pytest.param(ros, "ROS's axes of a body", id="ROS", marks=pytest.mark.slow),
    ],
)
def test_another_convention_and_another_clock_are_mended_together(
    shaken: EventRecording, tmp_path: Path, fault: Callable[[EventRecording], EventRecording], said: str
):
    folder = write_event_recording(faults.poses_late(fault(shaken), 14), tmp_path / "r")
    reading, clock = mend_poses(folder, folder)
    assert reading.startswith(f"The poses are read as {said}") and "times as sharp." in reading
    assert clock.startswith("The poses were stamped +1") and "taken off their times" in clock
    found, true = event_recording.read(folder).trajectory, shaken.trajectory
    assert np.abs(found.times - true.times).max() < 1_000_000
    np.testing.assert_allclose(found.positions, true.positions, atol=1e-9)
    turned = Rotation.from_quat(found.quaternions).inv() * Rotation.from_quat(true.quaternions)
    assert turned.magnitude().max() < 1e-7


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        (lambda read: read, "The poses fit the events: poses, clocks and calibration agree with the events"),
        (lambda read: faults.mirrored(read, 1), "The poses are as stated, but: The poses fit the events when they are"),
    ],
    ids=["none", "mirrored"],
)
def test_what_is_right_or_no_convention_is_left(shaken: EventRecording, tmp_path: Path, fault, said: str):
    folder = write_event_recording(fault(shaken), tmp_path / "r")
    before = (folder / "poses.txt").read_bytes()
    (sentence,) = mend_poses(folder, folder)
    assert (folder / "poses.txt").read_bytes() == before
    assert sentence.startswith(said)


def test_few_events_say_nothing(tmp_path: Path):
    _, searched = convert_recording(
        write_esim(tmp_path / "esim"), tmp_path / "new", finish=lambda folder: mend_poses(folder, tmp_path / "new")
    )
    assert searched == "The events are too few for a search of the convention and the clock of the poses."


def test_the_index_is_that_of_the_new_place(shaken: EventRecording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(index_cache, "CACHED_FROM", 1)
    monkeypatch.setenv("ENERF_CACHE", str(tmp_path / "cache"))
    source = write_event_recording(shaken, tmp_path / "r")
    convert_recording(source, tmp_path / "new", finish=lambda folder: mend_poses(folder, tmp_path / "new"))
    (entry,) = (tmp_path / "cache").iterdir()
    index_events(event_recording.read(tmp_path / "new"))
    assert [entry] == [*(tmp_path / "cache").iterdir()]

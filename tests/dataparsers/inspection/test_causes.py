"""A training names the cause why depth cannot be measured, or why it will not explain the events."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import faults
import numpy as np
import pytest

from enerf_ns.bench.experiments import FIVE, SEQUENCES
from enerf_ns.bench.numerics.points import CAMERA, TURNING, points_between, recording_of_points, shaking
from enerf_ns.bench.validation import CHOSEN_ON, ONLY_SCORED
from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.inspection.causes import depth_range_or_cause, why_not_explained
from enerf_ns.dataparsers.inspection.page import Inspection
from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.recording import EventRecording, Events
from enerf_ns.dataparsers.scene.depth_range import scene_depth_range
from enerf_ns.poses.corrections import Corrections
from enerf_ns.simulator.engine import simulate

STATED = 0.8, 4.0


def recording_of(positions: np.ndarray) -> EventRecording:
    """Points at 1 m to 3 m, seen by a camera that turns."""
    events, trajectory, _ = recording_of_points(points_between(1.0, 3.0), positions, TURNING)
    return EventRecording(Path("a memory"), "test", CAMERA, trajectory, lambda: iter([events]), ())


@pytest.fixture(scope="module")
def shaken() -> EventRecording:
    return recording_of(shaking(0.1))


def other_poses(recording: EventRecording) -> EventRecording:
    return faults.with_poses(recording, recording_of(shaking(0.1)[::-1] @ np.eye(3)[[1, 2, 0]]).trajectory)


FAULTS = pytest.mark.parametrize(
    ("fault", "cause", "mend"),
    [
        pytest.param(faults.inverse, "read as world to camera, the inverse", "invert each pose", id="inverse"),
        pytest.param(faults.scalar_first, "quaternions in the order w x y z", "move the first number", id="w x y z"),
        pytest.param(faults.opengl, "OpenGL's camera axes", "from the right by diag(1, -1, -1)", id="OpenGL"),
        pytest.param(lambda read: faults.mirrored(read, 1), "mirrored axes", "M = diag(1, -1, 1)", id="mirrored"),
        pytest.param(
            lambda read: faults.poses_late(read, 23), "the clocks disagree by 2", "ms off the times", id="late"
        ),
        pytest.param(
            lambda read: faults.longer_focal_length(read, 2.0), "focal length is wrong", "fx and fy", id="lens"
        ),
    ],
)


def cause_of(recording: EventRecording) -> str:
    """The cause that the error names where depth cannot be measured, and the warning where it can."""
    try:
        depth_range = depth_range_or_cause(recording)
    except RecordingError as error:
        return str(error)
    return why_not_explained(recording, depth_range, recording) or ""


@pytest.mark.sweep(2)
@pytest.mark.slow
@FAULTS
def test_each_fault_is_named_whether_a_depth_range_is_stated_or_not(
    shaken: EventRecording, fault: Callable[[EventRecording], EventRecording], cause: str, mend: str
):
    wrong = fault(shaken)
    for found in (cause_of(wrong), why_not_explained(wrong, STATED, wrong)):
        assert found is not None and cause in found and mend in found
        assert f"enerf inspect {shlex.quote('a memory')}" in found and "--depth-range" not in found


@pytest.mark.sweep(1)
@pytest.mark.slow
@pytest.mark.parametrize("fault", [faults.inverse, faults.opengl, other_poses])
def test_the_mend_of_wrong_poses_is_never_a_depth_range(
    shaken: EventRecording, fault: Callable[[EventRecording], EventRecording]
):
    """Wrong poses show no parallax; neither the error nor an inspection asks to state the range then."""
    wrong = fault(shaken)
    with pytest.raises(RecordingError, match=r"depth range of the scene cannot be measured, because") as error:
        depth_range_or_cause(wrong)
    assert "--depth-range" not in str(error.value) and "\n" not in str(error.value)
    (unknown,) = [one for one in Inspection.of(wrong).problems if "depth range of the scene" in one.what]
    assert "--depth-range" not in unknown.advice and "first problem" in unknown.advice


def test_right_poses_have_no_cause(shaken: EventRecording):
    assert why_not_explained(shaken, depth_range_or_cause(shaken), shaken) is None
    assert why_not_explained(shaken, STATED, shaken) is None


@pytest.mark.sweep(1)
@pytest.mark.slow
@pytest.mark.parametrize("name", [*FIVE, *CHOSEN_ON, *ONLY_SCORED])
def test_no_right_recording_of_the_benchmarks_has_a_cause(name: str, tmp_path: Path):
    sequence = SEQUENCES[name]
    size = {"width": sequence.simulation.get("width", 160), "height": sequence.simulation.get("height", 120)}
    if size["width"] > 346:
        size = {side: pixels // 2 for side, pixels in size.items()}
    simulate(sequence.simulation_settings(tmp_path, **size, num_frames=11), tmp_path / "recording")
    recording = read_recording(tmp_path / "recording")
    assert why_not_explained(recording, scene_depth_range(recording), recording) is None


def test_a_depth_range_without_the_scene_is_named(shaken: EventRecording):
    found = why_not_explained(shaken, (10.0, 40.0), shaken)
    assert found is not None and "depth range is 10 m to 40 m, but the parallax" in found
    assert "leave out --depth-range" in found


def test_a_depth_range_of_the_recording_is_not_to_be_left_out_of_the_command(shaken: EventRecording):
    wrong = 10.0, 40.0
    found = why_not_explained(replace(shaken, depth_range=wrong), wrong, shaken)
    assert found is not None and "give --depth-range" in found and "leave out" not in found


def test_a_camera_that_only_turns_has_no_cause():
    turning = recording_of(np.zeros((2000, 3)))
    for depth_range in (depth_range_or_cause(turning), STATED):
        assert why_not_explained(turning, depth_range, turning) is None


def test_without_a_cause_the_depth_range_is_asked_for():
    """Events in random places show neither parallax nor that the camera only turns."""
    events, trajectory, _ = recording_of_points(points_between(1.0, 3.0), shaking(0.1), TURNING)
    generator = np.random.default_rng(0)
    events = Events(generator.permutation(events.x), generator.permutation(events.y), events.t, events.p)
    random = EventRecording(Path("a memory"), "test", CAMERA, trajectory, lambda: iter([events]), ())
    with pytest.raises(RecordingError, match=r"neither .*; look at it with enerf inspect .* --depth-range NEAR FAR"):
        depth_range_or_cause(random)


def test_the_cause_is_searched_in_the_recording_as_read(shaken: EventRecording):
    """Corrections that were found with wrong poses are wrong, too."""
    read = faults.inverse(shaken)
    corrected = Corrections(delay=30.0).recording(read)
    with pytest.raises(RecordingError, match="read as world to camera, the inverse"):
        depth_range_or_cause(corrected, as_read=read)

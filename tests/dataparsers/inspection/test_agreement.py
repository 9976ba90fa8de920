"""Clocks, poses and focal lengths that contradict the events are reported, and no others."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import faults
import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from enerf_ns.bench.numerics.points import PHASE, TURNING, points_between, shaking
from enerf_ns.bench.validation import CHOSEN_ON, ONLY_SCORED
from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.inspection import agreement as agreement_module
from enerf_ns.dataparsers.inspection.agreement import Agreement, CornerFit, Estimate, is_in_focus, usual_depth
from enerf_ns.dataparsers.inspection.page import Inspection
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.recording import EventRecording, Events
from enerf_ns.dataparsers.recording.trajectory import Trajectory
from enerf_ns.dataparsers.scene.depth_range import scene_depth_range
from enerf_ns.simulator.engine import simulate
from enerf_ns.simulator.settings import SimulationSettings

CAMERA = Camera(160, 120, 150.0, 148.0, 81.0, 58.0, (-0.12, 0.05, 0.001, -0.0005), "radtan")
WIDE = Camera(160, 120, 110.0, 110.0, 81.0, 58.0, (-0.3, 0.1, 0.001, -0.0005), "radtan")
STILL = Rotation.from_rotvec(np.zeros((2000, 3)))


def points_seen(positions: np.ndarray, rotations: Rotation, camera: Camera = CAMERA) -> EventRecording:
    """Events wherever OpenCV's projection of a point enters another pixel; poses are known each millisecond."""
    events = []
    points = points_between(1.0, 3.0)
    coefficients = np.array(camera.distortion)
    before = None
    for step, (place, turn) in enumerate(zip(positions, rotations.inv(), strict=True)):
        seen = turn.apply(points - place)
        at = cv2.projectPoints(points, turn.as_rotvec(), -turn.apply(place), camera.matrix, coefficients)[0][:, 0]
        pixels = np.rint(at).astype(int)
        if before is not None:
            inside = (pixels >= 0).all(1) & (pixels < [160, 120]).all(1) & (seen[:, 2] > 0.1)
            moved = pixels[inside & (pixels != before).any(1)]
            events.append(np.column_stack([moved, np.full(len(moved), step * 1_000_000)]))
        before = pixels
    x, y, t = np.concatenate(events).T
    stream = Events(x.astype(np.uint16), y.astype(np.uint16), t, np.where(np.arange(len(t)) % 2, 1, -1).astype(np.int8))
    trajectory = Trajectory(np.arange(len(positions)) * 1_000_000, positions, rotations.as_quat())
    return EventRecording(
        Path("memory"), "test", camera, trajectory, lambda: iter([stream]), (), depth_range=(0.8, 4.0)
    )


@pytest.fixture(scope="module")
def shaken() -> EventRecording:
    return points_seen(shaking(0.1), TURNING)


def agreement(recording: EventRecording) -> Agreement:
    try:
        depth_range = scene_depth_range(recording)
    except RecordingError:
        depth_range = None
    found = Agreement.of(recording, depth_range)
    assert found is not None
    return found


def words(found: Agreement) -> str:
    return " ".join(problem.what + " " + problem.advice for problem in found.problems())


@pytest.mark.parametrize(
    "top, is_identifiable", [(0, True), (30, True), (-44, True), (-48, False), (49, False), (-200, False)]
)
def test_a_delay_at_the_end_of_the_search_is_not_identifiable(top: float, is_identifiable: bool):
    """As of a camera that slides evenly, whose events grow ever sharper towards one end, but for noise."""

    def curve(delays: np.ndarray) -> np.ndarray:
        noise = np.array([np.random.default_rng(abs(int(delay))).normal(size=100) for delay in delays])
        return 1.0 - 1e-5 * (1e-6 * delays[:, None] - top) ** 2 + 1e-6 * noise

    found = agreement_module._best_delay(curve, 50_000_000)
    assert found.is_identifiable == is_identifiable
    assert not is_identifiable or found.value == pytest.approx(top, abs=0.5)


@pytest.mark.parametrize("late", [0, 5, -23])
def test_the_best_delay_of_the_poses_is_the_true_one(shaken: EventRecording, late: int):
    found = agreement(faults.poses_late(shaken, late))
    assert found.pose_delay.is_identifiable and found.pose_delay.value == pytest.approx(late, abs=1.0)
    assert bool(found.problems()) == (found.pixels(late) > 1)
    assert found.frame_delay is None


@pytest.mark.parametrize("factor", [0.92, 1.1])
def test_the_best_focal_length_is_the_true_one(factor: float):
    """The camera turns, by 9 degrees, which makes it identifiable."""
    turning = Rotation.from_rotvec(2.5 * TURNING.as_rotvec())
    found = agreement(faults.longer_focal_length(points_seen(shaking(0.1), turning), factor))
    assert found.focal_scale.is_identifiable and found.focal_scale.value == pytest.approx(1 / factor, abs=0.02)
    assert "focal length is wrong" in words(found)


@pytest.mark.parametrize("by_frames", [1.0, 1 / 1.1])
def test_frames_of_the_same_camera_know_better_whether_the_focal_length_is_wrong(by_frames: float):
    """Where the parallax is weak, the sharpest focal length of events may be off by 5 % in spite of right poses."""
    found = agreement(faults.longer_focal_length(points_seen(shaking(0.1), TURNING), 1.1))
    corners = CornerFit(found.focus.recording.camera, Estimate(by_frames, 0.002, True), 0.5, 0.1)
    assert [problem.what[:16] for problem in found.problems()] == ["The focal length"]
    named = [problem.what[:16] for problem in replace(found, corners=corners).problems()]
    assert named == ["The focal length"] * (by_frames != 1.0)


@pytest.mark.parametrize("turn", [1.0, 2.5])
def test_the_stretch_of_a_wide_lens_is_no_sharpness(turn: float):
    """A longer focal length stretches the picture less, in which events lie denser, and fewer leave the view."""
    found = agreement(points_seen(shaking(0.1), Rotation.from_rotvec(turn * TURNING.as_rotvec()), WIDE))
    assert found.focal_scale.is_identifiable and found.focal_scale.value == pytest.approx(1.0, abs=0.008)


@pytest.mark.parametrize("lens", [CAMERA, WIDE])
def test_a_calibration_that_is_of_another_lens_is_named(lens: Camera):
    """That which a sample has, without distortion; and neither clocks nor poses are blamed for it."""
    recording = points_seen(shaking(0.1), TURNING, lens)
    found = agreement(replace(recording, camera=Camera(160, 120, 200.0, 200.0, 80.0, 60.0)))
    (problem,) = found.problems()
    assert re.search(r"focal length is wrong: 0\.\d{3} ± 0\.0\d{2} of the stated one fits", problem.what)
    assert 200 * found.focal_scale.value == pytest.approx(lens.fx, rel=0.12)  # some of it is distortion


SIMULATED_FAULTS = pytest.mark.sweep(2, "faults of a simulated recording")
SLIDER_FAULTS = pytest.mark.sweep(1, "faults of slider_depth")
"""Of all faults together, some are drawn: each takes seconds."""

READINGS = pytest.mark.parametrize(
    ("fault", "named"),
    [
        pytest.param(faults.inverse, "world to camera, the inverse", id="inverse"),
        pytest.param(faults.scalar_first, "quaternions in the order w x y z", id="scalar first"),
        pytest.param(faults.opengl, "OpenGL's camera axes with x right, y up, z backward", id="opengl"),
        pytest.param(lambda read: faults.mirrored(read, 0), "mirrored axes with x left, y down, z forward", id="x"),
        pytest.param(lambda read: faults.mirrored(read, 1), "mirrored axes with x right, y up, z forward", id="y"),
    ],
)


@READINGS
def test_poses_of_another_convention_are_named(
    shaken: EventRecording, fault: Callable[[EventRecording], EventRecording], named: str
):
    found = agreement(fault(shaken))
    assert [reading.words for reading in found.readings] == [named]
    assert f"read as {named}: events are then" in words(found)
    assert ("or let enerf convert --accept-found write" in words(found)) == ("mirrored" not in named)


@pytest.mark.parametrize(
    ("fault", "named", "mend"),
    [
        (lambda read: faults.exchanged(read, "size"), "x and y are exchanged", "exchange both columns"),
        (lambda read: faults.exchanged(read, "all"), "x and y are exchanged", "exchange both columns"),
        (
            lambda read: faults.turned_events(read, lambda events, camera: (camera.width - 1 - events.x, events.y)),
            "mirrored axes with x left, y down",
            "write width - 1 - x for x",
        ),
        (
            lambda read: faults.turned_events(read, lambda events, camera: (events.x, camera.height - 1 - events.y)),
            "mirrored axes with x right, y up",
            "write height - 1 - y for y",
        ),
        (
            lambda read: faults.turned_events(faults.exchanged(read, "all"), lambda e, c: (c.width - 1 - e.x, e.y)),
            "quarter of a turn (x up, y right)",
            "write y for x, and width - 1 - x for y",
        ),
        (
            lambda read: faults.turned_events(faults.exchanged(read, "all"), lambda e, c: (e.x, c.height - 1 - e.y)),
            "quarter of a turn (x down, y left)",
            "write height - 1 - y for x, and x for y",
        ),
    ],
    ids=["sizes too", "all", "x", "y", "quarter", "other quarter"],
)
def test_exchanged_and_mirrored_axes_of_the_sensor_are_named(shaken: EventRecording, fault, named: str, mend: str):
    found = agreement(fault(shaken))
    assert len(found.readings) == 1 and named in found.readings[0].words
    assert named in words(found) and f"f the poses are right, {found.readings[0].fault_of_events};" in words(found)
    assert mend in words(found)


def test_poses_of_a_body_are_reread_before_the_camera_is_mounted(shaken: EventRecording):
    mount = np.eye(4)
    mount[:3, :3], mount[:3, 3] = Rotation.from_euler("xyz", [0.7, -0.4, 1.9]).as_matrix(), [0.05, -0.02, 0.1]
    body = shaken.trajectory.of_mounted(np.linalg.inv(mount))
    x, y, z, w = body.quaternions.T
    wrong = Trajectory(body.times, body.positions, np.stack([w, x, y, z], axis=1)).of_mounted(mount)
    found = agreement(faults.with_poses(shaken, wrong))
    assert [reading.words for reading in found.readings] == ["quaternions in the order w x y z"]
    assert "--accept-found" not in words(found)  # enerf convert writes poses of the camera, whose order is right


def test_a_steady_slide_identifies_neither_clock_nor_focal_length():
    """At one speed a clock's delay moves the world alone, without turning a focal length trades with depth, and a half
    turn about the direction of motion changes nothing."""
    found = agreement(points_seen((PHASE / np.pi - 1) * [0.3, 0, 0], STILL))
    assert not found.pose_delay.is_identifiable and not found.problems()
    assert found.verdict().endswith(
        "the clock of the poses and the focal length are not identifiable from this recording"
    )
    assert found.rows()["equally sharp"].startswith("OpenGL's camera axes")


def test_a_slide_with_the_poses_of_structure_from_motion_agrees_with_its_events():
    """Their world has any direction, and they tremble. Another order of the quaternions then turns them by half a turn
    and a bit, which is nearly as sharp."""
    recording = points_seen((PHASE / np.pi - 1) * [0.3, 0, 0], STILL)
    read, world = recording.trajectory, Rotation.from_quat([0.0257, 0.0739, -0.0101, 0.9969])
    knots = np.random.default_rng(0).normal(size=(20, 3)) * 1e-3
    trembling = Rotation.from_rotvec(CubicSpline(np.linspace(0, 1, 20), knots)(np.linspace(0, 1, len(read.times))))
    turned = Trajectory(read.times, world.apply(read.positions), (world * trembling).as_quat())
    found = agreement(faults.with_poses(recording, turned))
    assert found.is_clear and found.problems() == []


def test_poses_of_another_recording_bring_nothing_into_focus(shaken: EventRecording):
    other = Trajectory(shaken.trajectory.times, shaking(0.1)[::-1] @ np.eye(3)[[1, 2, 0]], TURNING[::-1].as_quat())
    assert "No reading of the poses" in words(agreement(faults.with_poses(shaken, other)))


@pytest.mark.parametrize("seed", [2, 3, 4])
def test_poses_that_drift_far_agree_with_no_event(shaken: EventRecording, seed: int):
    """Other readings of them are clearly less sharp, and with one seed another lens is sharper."""
    generator, now, read = np.random.default_rng(seed), np.linspace(0, 1, 2000), shaken.trajectory
    knots = np.linspace(0, 1, 6), generator.normal(size=(6, 3)), generator.normal(size=(6, 3))
    shift, turn = (CubicSpline(knots[0], of_knots)(now) for of_knots in knots[1:])
    turned = Rotation.from_quat(read.quaternions) * Rotation.from_rotvec(np.radians(2.0) * turn)
    drifting = faults.with_poses(shaken, Trajectory(read.times, read.positions + 0.04 * shift, turned.as_quat()))
    found = agreement(drifting)
    assert found.is_clear and "No reading of the poses" in words(found)
    assert is_in_focus(shaken, 2.0) and not is_in_focus(drifting, 2.0)


@pytest.mark.parametrize("milliseconds", [15, 1])
def test_a_moment_identifies_no_delay(shaken: EventRecording, milliseconds: int):
    """A quarter of its length is shorter than the delays that are tried."""

    def early(times: np.ndarray) -> np.ndarray:
        return times * milliseconds // 2000

    (events,), path = shaken.stream_events(), shaken.trajectory
    events, poses = replace(events, t=early(events.t)), Trajectory(early(path.times), path.positions, path.quaternions)
    moment = replace(shaken, trajectory=poses, stream_events=lambda: iter([events]))
    assert is_in_focus(moment, 2.0)
    assert not agreement(moment).pose_delay.is_identifiable


def test_few_events_say_nothing(tmp_path: Path):
    from recordings import write_esim

    assert Agreement.of(read_recording(write_esim(tmp_path / "esim")), (1.0, 2.0)) is None


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> EventRecording:
    folder = tmp_path_factory.mktemp("shapes") / "recording"
    simulate(SimulationSettings("shapes", motion="shake", duration=0.6, num_frames=24, width=120, height=90), folder)
    return read_recording(folder)


@pytest.mark.slow
def test_a_simulated_recording_is_sound(simulated: EventRecording):
    found = agreement(simulated)
    assert found.problems() == [] and found.is_clear and len(found.readings) == 1
    assert found.pose_delay.is_identifiable and abs(found.pose_delay.value) < 0.5
    assert found.frame_delay is not None and found.frame_delay.is_identifiable and abs(found.frame_delay.value) < 1.0
    assert found.focal_scale.is_identifiable and found.focal_scale.value == pytest.approx(1.0, abs=0.01)
    assert found.corners is not None and found.corners.focal_scale.is_identifiable
    assert found.corners.focal_scale.value == pytest.approx(1.0, abs=0.01)


@SIMULATED_FAULTS
@pytest.mark.slow
@pytest.mark.parametrize("late", [10, -10])
def test_the_clock_of_the_poses_of_a_simulated_recording(simulated: EventRecording, late: int):
    found = agreement(faults.poses_late(simulated, late))
    assert found.pose_delay.value == pytest.approx(late, abs=0.5)
    assert f"the poses are stamped {abs(found.pose_delay.value):.1f} ms {'late' if late > 0 else 'early'}" in words(
        found
    )
    assert "to the times of the poses" in words(found) or "off the times of the poses" in words(found)


@SIMULATED_FAULTS
@pytest.mark.slow
@pytest.mark.parametrize("late", [10, -10])
def test_the_clock_of_the_frames_of_a_simulated_recording(simulated: EventRecording, late: int):
    found = agreement(faults.frames_late(simulated, late))
    assert found.frame_delay is not None and found.frame_delay.value == pytest.approx(late, abs=1.0)
    assert "the times of the frames" in words(found)


@SIMULATED_FAULTS
@pytest.mark.slow
@READINGS
def test_conventions_of_a_simulated_recording(
    simulated: EventRecording, fault: Callable[[EventRecording], EventRecording], named: str
):
    assert f"read as {named}: events are then" in words(agreement(fault(simulated)))


@SIMULATED_FAULTS
@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.9, 1.1, 0.3, 0.6, 0.8, 1.25, 1.7, 3.0])
def test_focal_length_of_a_simulated_recording(simulated: EventRecording, factor: float):
    found = agreement(faults.longer_focal_length(simulated, factor))
    assert found.focal_scale.value == pytest.approx(1 / factor, rel=0.025)
    assert found.problems()[0].what.startswith("The focal length is wrong: ")


@SIMULATED_FAULTS
@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.5, 0.9, 1.5])
def test_focal_length_of_the_frames_of_a_simulated_recording(simulated: EventRecording, factor: float):
    """Their camera alone is stated wrongly: what events say stays as it is."""
    wrong = faults.longer_focal_length(simulated, factor)
    found = agreement(replace(simulated, frames=wrong.frames, blurred_frames=wrong.blurred_frames))
    assert found.corners is not None and found.corners.focal_scale.is_identifiable
    assert found.corners.focal_scale.value == pytest.approx(1 / factor, rel=0.01)
    (problem,) = found.problems()
    assert problem.what.startswith("The focal length of the frames is wrong: ")
    assert "reprojection error of corners" in found.rows()["focal length by frames"]


@pytest.fixture
def slider(slider_depth: Inspection) -> EventRecording:
    return slider_depth.recording


@pytest.mark.slow
def test_slider_depth_is_sound(slider_depth: Inspection):
    """Its events are some milliseconds later than its frames and, by its turning point, than its poses."""
    found = slider_depth.agreement
    assert found is not None and found.problems() == []
    assert found.frame_delay is not None and found.pose_delay.is_identifiable and found.frame_delay.is_identifiable
    assert found.pose_delay.value == pytest.approx(found.frame_delay.value, abs=3.0)
    assert "focal length is not identifiable" in found.verdict()


@SLIDER_FAULTS
@pytest.mark.slow
@pytest.mark.parametrize("late", [10, -10])
@pytest.mark.parametrize("fault", [faults.poses_late, faults.frames_late])
def test_clocks_of_slider_depth(
    slider_depth: Inspection, fault: Callable[[EventRecording, int], EventRecording], late: int
):
    """The clock of its poses is identifiable because the slider turns back at its end."""
    sound, found = slider_depth.agreement, agreement(fault(slider_depth.recording, late))
    assert sound and sound.frame_delay and found.frame_delay
    moved = found.pose_delay.value - sound.pose_delay.value, found.frame_delay.value - sound.frame_delay.value
    expected = (late, 0) if fault is faults.poses_late else (0, late)
    assert moved == pytest.approx(expected, abs=2.0)
    assert words(found).startswith("The clocks disagree by ")


@SLIDER_FAULTS
@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "named"),
    [
        pytest.param(faults.inverse, "read as world to camera, the inverse, or", id="inverse"),
        pytest.param(lambda read: faults.mirrored(read, 0), "mirrored axes with x left, y down, z forward, or", id="x"),
        pytest.param(faults.scalar_first, "which in the order w x y z, or with OpenGL's axes", id="scalar first"),
        pytest.param(faults.opengl, "which in the order w x y z, or with OpenGL's axes", id="opengl"),
    ],
)
def test_conventions_of_slider_depth(
    slider: EventRecording, fault: Callable[[EventRecording], EventRecording], named: str
):
    """It slides without turning: several readings that point it the same way are equally sharp."""
    found = words(agreement(fault(slider)))
    assert named in found and "his motion does not show" in found


@SLIDER_FAULTS
@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.6, 0.9, 1.1, 1.7])
def test_focal_length_of_slider_depth_is_not_identifiable(slider: EventRecording, factor: float):
    found = agreement(faults.longer_focal_length(slider, factor))
    assert not found.focal_scale.is_identifiable and "focal length is not identifiable" in found.verdict()
    assert found.corners is not None and not found.corners.focal_scale.is_identifiable


@pytest.mark.slow
def test_dense_texture_leaves_several_readings_almost_as_sharp_but_the_clock_shows_that_the_poses_fit(tmp_path: Path):
    """On the paper's spiral, half a turn of the camera costs 8 % of the sharpness."""
    simulate(SimulationSettings("spiral1", width=96, height=72, num_frames=11), tmp_path / "spiral")
    recording = read_recording(tmp_path / "spiral")
    assert agreement(recording).verdict().startswith("poses, clocks and calibration agree")
    depth = usual_depth(recording, scene_depth_range(recording))
    assert is_in_focus(recording, depth)
    read = recording.trajectory
    backwards = Trajectory(read.times, read.positions[::-1].copy(), read.quaternions[::-1].copy())
    assert "do not belong together" in words(agreement(replace(recording, trajectory=backwards)))
    late = Trajectory(read.times + 25_000_000, read.positions, read.quaternions)
    for wrong in (backwards, late):
        assert not is_in_focus(replace(recording, trajectory=wrong), depth)


@pytest.mark.slow
def test_an_even_slide_is_not_called_wrong_although_a_mirror_image_is_almost_as_sharp(tmp_path: Path):
    """No motion makes events much sharper than the right poses of the validation set's slide."""
    settings = ONLY_SCORED["relief-large"].simulation_settings(
        tmp_path, width=320, height=240, layout="event_recording"
    )
    simulate(replace(settings, num_frames=2), tmp_path / "slide")
    recording = read_recording(tmp_path / "slide")
    found = agreement(recording)
    assert found.problems() == []
    assert found.is_clear or "no motion makes the events much sharper" in found.verdict()
    depth = usual_depth(recording, scene_depth_range(recording))
    assert is_in_focus(recording, depth)
    assert not is_in_focus(faults.inverse(recording), depth)
    other = Trajectory(
        recording.trajectory.times, recording.trajectory.positions[:, [1, 2, 0]], recording.trajectory.quaternions
    )
    assert agreement(replace(recording, trajectory=other)).problems() != []


@pytest.mark.slow
def test_strong_edges_before_black_leave_open_whether_poses_fit(tmp_path: Path):
    """Right poses of a camera around the statue of the validation set are as sharp as other readings by chance."""
    settings = CHOSEN_ON["statue"].simulation_settings(tmp_path, width=160, height=120, layout="event_recording")
    simulate(replace(settings, num_frames=2), tmp_path / "statue")
    recording = read_recording(tmp_path / "statue")
    found = agreement(recording)
    assert found.focus.has_strong_edges and not found.is_clear
    assert found.problems() == [] and "a few strong edges fire most events" in found.verdict()
    assert is_in_focus(recording, usual_depth(recording, scene_depth_range(recording)))

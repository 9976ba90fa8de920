"""Corners of frames against OpenCV's projections of points that are known."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.inspection.frame_tracks import FrameTracks, Pair
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.recording import Frames
from enerf_ns.dataparsers.recording.trajectory import Trajectory
from enerf_ns.simulator.engine import simulate
from enerf_ns.simulator.settings import SimulationSettings

CAMERA = Camera(160, 120, 150.0, 148.0, 81.0, 58.0)
TURNS = Rotation.from_rotvec([[0.0, 0.0, 0.0], [0.05, -0.12, 0.03]])


def seen(positions: np.ndarray, off: np.ndarray) -> FrameTracks:
    """Points of depths from 1 to 3 m, as they are seen from two places; in the second frame they are off by so much."""
    points = np.random.default_rng(0).uniform([-0.5, -0.4, 1.0], [0.5, 0.4, 3.0], (50, 3))
    pixels = []
    for place, turn in zip(positions, TURNS.inv(), strict=True):
        pixels.append(cv2.projectPoints(points, turn.as_rotvec(), -turn.apply(place), CAMERA.matrix, np.zeros(4))[0])
    pixels = np.stack(pixels)[:, :, 0] + np.stack([np.zeros_like(off), off])[:, None]
    directions = (pixels - [CAMERA.cx, CAMERA.cy]) / [CAMERA.fx, CAMERA.fy]
    trajectory = Trajectory(np.array([0, 10**9]), positions, TURNS.as_quat())
    frames = Frames((Path("0"), Path("1")), np.array([0, 10**9]), CAMERA, trajectory)
    return FrameTracks(frames, [Pair(0, 1, directions)])


STILL, MOVED = np.zeros((2, 3)), np.array([[0.0, 0.0, 0.0], [0.02, 0.12, -0.05]])


@pytest.mark.parametrize("positions", [STILL, MOVED], ids=["turned", "moved"])
def test_points_are_where_they_can_be(positions: np.ndarray):
    tracks = seen(positions, np.zeros(2))
    (errors,) = tracks.reprojection_errors(0.9)
    assert errors == pytest.approx(np.zeros(50), abs=1e-6)
    assert tracks.fit(0.9, 1.0, 0) == pytest.approx([1.0])
    assert tracks.reprojection_errors(0.9, 1.2)[0].mean() > 1.0  # pixels
    assert tracks.reprojection_errors(0.9, 1.0, 10**8)[0].mean() > 1.0


def test_a_reprojection_error_is_a_distance_in_pixels():
    off = np.array([3.0, -4.0])
    assert seen(STILL, off).reprojection_errors(0.9)[0] == pytest.approx(np.full(50, 5.0))


def test_a_point_on_its_epipolar_line_has_no_error_but_one_beyond_its_end_has():
    """The least depth ends the line: the error of a nearer point is the distance to a point at that depth."""
    tracks = seen(MOVED, np.zeros(2))
    points = np.random.default_rng(0).uniform([-0.5, -0.4, 1.0], [0.5, 0.4, 3.0], (50, 3))
    turn = TURNS[1].inv()
    ends = []
    for depths in (points[:, 2:], np.maximum(points[:, 2:], 2.0)):
        at = points / points[:, 2:] * depths
        ends.append(cv2.projectPoints(at, turn.as_rotvec(), -turn.apply(MOVED[1]), CAMERA.matrix, np.zeros(4))[0])
    further = np.linalg.norm(ends[1] - ends[0], axis=2)[:, 0]
    assert tracks.reprojection_errors(2.0)[0] == pytest.approx(further, abs=1e-6) and further.max() > 5.0


def test_corners_of_a_simulated_recording(tmp_path: Path):
    folder = tmp_path / "recording"
    simulate(SimulationSettings("shapes", motion="shake", duration=0.3, num_frames=12, width=120, height=90), folder)
    tracks = FrameTracks.of(read_recording(folder))
    assert tracks is not None and len(tracks.pairs) >= 5
    assert np.median(np.concatenate(tracks.reprojection_errors(0.5))) < 0.2
    assert np.median(np.concatenate(tracks.reprojection_errors(0.5, 1.1))) > 0.4


def test_frames_without_corners_say_nothing(tmp_path: Path):
    from recordings import write_davis

    assert FrameTracks.of(read_recording(write_davis(tmp_path / "davis"))) is None

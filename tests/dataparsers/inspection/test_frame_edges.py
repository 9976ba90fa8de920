"""Events on frames: when they fit, and where they are drawn."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation
from stripes import HEIGHT, WIDTH, recording_of_stripes

from enerf_ns.dataparsers.index.event_index import OFF_COLOUR, ON_COLOUR
from enerf_ns.dataparsers.inspection.agreement import _best_delay
from enerf_ns.dataparsers.inspection.frame_edges import FrameEdges
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.recording import EventRecording, Events, Frames
from enerf_ns.dataparsers.recording.trajectory import Trajectory

LENS = (-0.1, 0.02, 0.001, 0.0)


@pytest.mark.parametrize("late", [0, 12_000_000, -7_000_000])
def test_the_delay_of_frames_is_found_to_a_millisecond(tmp_path: Path, late: int):
    edges = FrameEdges.of(recording_of_stripes(tmp_path, late), (1.0, 2.0), 50_000_000)
    assert edges is not None and len(edges.planes) == 1
    found = _best_delay(lambda delays: edges.likeness(delays, 0), 50_000_000)
    assert found.is_identifiable and found.value == pytest.approx(-late * 1e-6, abs=1.0)


@pytest.mark.parametrize("plane", [0, 5, 11])
def test_events_are_drawn_where_another_camera_sees_them_at_a_depth(tmp_path: Path, plane: int):
    """As OpenCV undistorts, moves and projects them."""
    camera = Camera(WIDTH, HEIGHT, 100.0, 99.0, 60.0, 40.0, LENS, "radtan")
    seen = Camera(200, 150, 180.0, 180.0, 99.5, 74.5, LENS, "radtan")
    mount = np.eye(4)
    mount[:3, :3], mount[:3, 3] = Rotation.from_rotvec([0.02, -0.03, 0.05]).as_matrix(), [0.06, -0.02, 0.01]
    places = np.linspace(0, 1, 101)[:, None] * [0.1, 0.2, 0.3]
    trajectory = Trajectory(np.arange(101) * 10_000_000, places, Rotation.from_rotvec(places).as_quat())
    generator = np.random.default_rng(0)
    number = 40_000
    x, y = generator.integers(0, WIDTH, number), generator.integers(0, HEIGHT, number)
    t, p = np.sort(generator.integers(0, 10**9, number)), generator.integers(0, 2, number) * 2 - 1
    Image.fromarray(generator.integers(0, 256, (150, 200), dtype=np.uint8)).save(tmp_path / "0.png")
    frames = Frames((tmp_path / "0.png",), np.array([500_000_000]), seen, trajectory.of_mounted(mount))
    recording = EventRecording(
        tmp_path, "test", camera, trajectory, lambda: iter([Events(x, y, t, p)]), (), frames=frames
    )
    edges = FrameEdges.of(recording, (0.5, 3.0), 50_000_000)
    assert edges is not None and edges.planes[[0, -1]] == pytest.approx([3.0, 0.5])

    near = slice(np.searchsorted(t, 500_000_000) - 240, np.searchsorted(t, 500_000_000) + 240)
    pixels = np.column_stack([x, y])[near].astype(float)
    rays = cv2.undistortPoints(pixels[:, None], camera.matrix, np.array(LENS))[:, 0]
    points = np.append(rays, np.ones((len(rays), 1)), axis=1) * edges.planes[plane]
    back = np.linalg.inv(mount)
    target = seen.undistorted().matrix
    at = cv2.projectPoints(points, Rotation.from_matrix(back[:3, :3]).as_rotvec(), back[:3, 3], target, np.zeros(4))[0][
        :, 0
    ]
    picture, missed = edges.events_at(500_000_000, plane), 0
    assert picture.shape == (150, 200, 4)
    for (column, row), sign in zip(np.rint(at).astype(int), p[near], strict=True):
        if 0 <= column < 200 and 0 <= row < 150:
            colour = tuple(picture[row, column])
            missed += colour != (*(ON_COLOUR if sign > 0 else OFF_COLOUR), 255)
    assert missed < 20, "but for events that lie upon others, and places on the border of two pixels"
    assert 300 < (picture[..., 3] == 255).sum() <= 480


def test_without_frames_there_is_nothing_to_compare(tmp_path: Path):
    recording = recording_of_stripes(tmp_path, 0)
    object.__setattr__(recording, "frames", None)
    assert FrameEdges.of(recording, (1.0, 2.0), 50_000_000) is None


def test_frames_at_the_ends_of_the_events_are_left_out(tmp_path: Path):
    edges = FrameEdges.of(recording_of_stripes(tmp_path, 0), (1.0, 2.0), 250_000_000)
    assert edges is not None
    assert edges.frames.times.min() >= 250_000_000 and edges.frames.times.max() <= 750_000_000
    assert torch.from_numpy(edges.frames.times).numel() > 3

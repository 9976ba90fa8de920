"""Scores of surfaces, against distances that are known."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.files import load_array
from enerf_ns.export.scoring import distances, seen_points, simulated_scene, surface_scores
from enerf_ns.simulator.scene.scenes import Surface, build_scene

CAMERA = Camera(40, 30, 40.0, 40.0, 19.5, 14.5)


def square(z: float, half: float = 1.0) -> np.ndarray:
    corners = np.array([[-half, -half, z], [half, -half, z], [half, half, z], [-half, half, z]])
    return corners[[[0, 1, 2], [0, 2, 3]]]


def scene(*squares: np.ndarray):
    faces = np.concatenate(squares)
    return build_scene(
        [Surface(faces, faces[..., :2], np.ones((len(faces), 3, 1)), np.ones((1, 1, 1)))],
        camera=(0, 0, 0),
        target=(0, 0, 1),
    )


def mesh(*squares: np.ndarray) -> trimesh.Trimesh:
    corners = np.concatenate(squares).reshape(-1, 3)
    return trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3))


def test_a_wall_that_is_off_has_its_distance_and_what_is_hidden_does_not_count():
    """Before the camera at the origin, which looks along z; behind the wall stands another that it cannot see."""
    poses = [np.eye(3, 4)]
    found = surface_scores(mesh(square(2.1, 3.0)), scene(square(2.0, 3.0), square(4.0, 3.0)), CAMERA, poses)
    assert found.accuracy == pytest.approx(0.1, abs=1e-3)
    assert found.completeness == pytest.approx(0.1, abs=1e-3) and found.chamfer == pytest.approx(0.1, abs=1e-3)
    assert found.accurate_share == found.complete_share == 0.0


def test_half_a_wall_is_half_complete():
    half = square(2.0, 3.0)
    half[..., 0] = half[..., 0].clip(min=0.0)
    found = surface_scores(mesh(half), scene(square(2.0, 3.0)), CAMERA, [np.eye(3, 4)])
    assert found.accuracy < 1e-3 and found.accurate_share == 1.0
    assert found.complete_share == pytest.approx(0.525, abs=0.03)
    cloud = trimesh.PointCloud(trimesh.sample.sample_surface(mesh(half), 20_000, seed=0)[0])
    of_points = surface_scores(cloud, scene(square(2.0, 3.0)), CAMERA, [np.eye(3, 4)])
    assert of_points.complete_share == pytest.approx(found.complete_share, abs=0.03)


def test_distances_to_a_mesh_are_exact():
    points = np.array([[0.0, 0.0, 5.0], [2.0, 0.0, 2.0], [0.3, -0.2, 1.5]])
    np.testing.assert_allclose(distances(points, mesh(square(2.0))), [3.0, 1.0, 0.5], atol=1e-6)


def test_the_scene_of_a_simulated_recording_has_its_depth(recording: Path):
    """In the axes of the recording and in metres: what its cameras saw lies on it."""
    read, reference = read_recording(recording), simulated_scene(recording, [])
    assert reference is not None and read.frames is not None and read.frames.depth_filenames is not None
    pose = read.frames.trajectory.poses(torch.from_numpy(read.frames.times[3:4])).numpy()[0]
    depth = load_array(read.frames.depth_filenames[3])
    expected = (read.camera.pixel_directions() * depth[..., None]).reshape(-1, 3) @ pose[:, :3].T + pose[:, 3]
    found = seen_points(reference, read.camera, [pose])
    assert np.abs(found[:, None] - expected).sum(-1).min(1).max() < 1e-3


def test_a_scene_that_is_not_there_any_more_is_a_note(tmp_path: Path):
    (tmp_path / "simulation.json").write_text('{"scene": "gone/room.json"}')
    notes: list[str] = []
    assert simulated_scene(tmp_path, notes) is None
    assert re.match(
        r"Nothing is compared, since gone/room\.json is neither .*; give the scene by --reference\.$", notes[0]
    )


def test_what_was_not_simulated_has_no_scene(tmp_path: Path):
    assert simulated_scene(tmp_path, []) is None

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from small_runs import set_up, small_config

from enerf_ns.method.held_out_poses import CLOSE, held_out_numbers, nearest_poses, on_path


def poses(positions: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """Camera to world, [poses, 3, 4], from positions and rotation vectors."""
    return np.concatenate([Rotation.from_rotvec(turns).as_matrix(), positions[:, :, None]], axis=2)


def test_the_nearest_pose_is_that_of_a_loop():
    random = np.random.default_rng(0)
    held_out, training = (
        poses(random.standard_normal((number, 3)), random.standard_normal((number, 3))) for number in (5, 40)
    )
    depths = random.uniform(1, 3, 5)
    distances, angles = nearest_poses(held_out, training, depths)
    for view, depth, distance, angle in zip(held_out, depths, distances, angles, strict=True):
        found = []
        for other in training:
            turn = Rotation.from_matrix(view[:, :3].T @ other[:, :3]).magnitude()
            found.append((np.linalg.norm(view[:, 3] - other[:, 3]), turn))
        expected = min(found, key=lambda pair: pair[0] / depth + pair[1])
        assert (distance, angle) == pytest.approx(expected, abs=1e-9)


def test_small_angles_are_exact_and_half_turns_are_angles():
    turns = np.array([0.0, 1e-9, 1e-4, np.pi])[:, None] * [0.0, 1.0, 0.0]
    for turn in turns:
        _, angle = nearest_poses(
            poses(np.zeros((1, 3)), turn[None]), poses(np.zeros((1, 3)), 0 * turn[None]), np.ones(1)
        )
        assert angle[0] == pytest.approx(np.linalg.norm(turn), rel=1e-6, abs=1e-15)


def test_views_are_on_the_path_by_their_time_or_by_their_place():
    spans, times = np.array([[0, 10], [20, 30]]), np.array([0, 5, 15, 30, 31, 15])
    far = np.array([1.0, 1.0, 1.0, 1.0, 1.0, CLOSE])
    assert on_path(times, spans, far).tolist() == [True, True, False, True, False, True]
    assert on_path(None, spans, far).tolist() == [False] * 5 + [True]


@pytest.fixture(scope="module")
def manager(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    return set_up(small_config(recording, tmp_path_factory.mktemp("outputs"))).pipeline.datamanager


def test_frames_between_the_events_are_on_the_path_at_no_distance(manager: Any):
    numbers = held_out_numbers(manager, np.arange(3), np.full(3, 2.0))
    assert numbers["held_out_on_path"] == 3
    assert numbers["held_out_distance"] == numbers["held_out_distance_share"] == 0.0
    assert numbers["held_out_angle"] == pytest.approx(0.0, abs=1e-5)


def test_frames_between_frames_are_on_the_path_as_far_as_their_neighbours(manager: Any, monkeypatch):
    monkeypatch.setattr(manager.config, "supervision", "frames")
    numbers = held_out_numbers(manager, np.arange(3), np.full(3, 2.0))
    trajectory, train, held_out = manager.recording.trajectory, manager.train_dataset, manager.eval_dataset
    places = [trajectory.poses(torch.from_numpy(set_.frames.times))[:, :, 3] for set_ in (train, held_out)]
    least = torch.cdist(places[1], places[0]).min(dim=1).values.mean()
    assert numbers["held_out_on_path"] == 3 and numbers["held_out_angle"] > 0.0
    assert numbers["held_out_distance"] >= float(least) > 0.0
    assert numbers["held_out_distance_share"] == pytest.approx(numbers["held_out_distance"] / 2.0)


def test_views_of_a_trajectory_of_their_own_are_on_the_path_where_they_are_close(manager: Any, monkeypatch):
    frames = manager.eval_dataset.frames
    for shift, on in ((0.001, 3), (1.0, 0)):
        mounted = np.eye(4)
        mounted[0, 3] = shift
        own = replace(frames, trajectory=frames.trajectory.of_mounted(mounted))
        monkeypatch.setattr(manager.eval_dataset, "frames", own)
        monkeypatch.setattr(manager.train_dataset, "recording", replace(manager.recording, held_out_frames=own))
        numbers = held_out_numbers(manager, np.arange(3), np.full(3, 2.0))
        assert numbers["held_out_on_path"] == on
        assert numbers["held_out_distance"] <= shift + 1e-9

"""The simulated sequences of the paper: their frames, their blur, and that the presets of training fit them."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from enerf_ns.choices import presets as training
from enerf_ns.simulator.paper_sequences import PRESETS, SimulationPreset
from enerf_ns.simulator.scene.scenes import SCENES

PIXELS = 64
"""Step between the rows and columns that the tests render."""

SEEDS = range(40)

CAMERAS = {"roads": np.array([0, -0.75, 1.3]), "moon": np.array([0, -1.15, 1.5])}
"""Mean places before the scenes; their target is the origin."""


def rays_of(preset: SimulationPreset) -> tuple[np.ndarray, float]:
    """Directions through pixels all over the picture, z = 1, [N, 3], and the focal length."""
    focal_length = preset.width / 2 / math.tan(math.radians(preset.field_of_view / 2))
    columns, rows = np.meshgrid(
        np.arange(PIXELS / 2, preset.width, PIXELS) - preset.width / 2,
        np.arange(PIXELS / 2, preset.height, PIXELS) - preset.height / 2,
    )
    return np.stack([columns / focal_length, rows / focal_length, np.ones_like(rows)], -1).reshape(-1, 3), focal_length


def poses_of(preset: SimulationPreset, seed: int, times: np.ndarray) -> np.ndarray:
    assert preset.scene is not None
    trajectory = preset.trajectory(CAMERAS[preset.scene], np.zeros(3), np.random.default_rng(seed))
    return trajectory.poses(torch.from_numpy(times.astype(np.int64))).numpy()


def on_the_ground(preset: SimulationPreset, pose: np.ndarray) -> np.ndarray:
    """Points [N, 3] at which the rays of a camera meet the plane z = 0, near which all these scenes lie."""
    directions = rays_of(preset)[0] @ pose[:, :3].T
    return pose[:, 3] - directions * pose[2, 3] / directions[:, 2:]


@pytest.mark.parametrize("name", PRESETS)
def test_the_picture_moves_as_far_during_an_exposure_as_the_table_says(name: str):
    preset = PRESETS[name]
    _, focal_length = rays_of(preset)
    period, exposure = preset.duration * 1e9 / preset.num_frames, preset.exposure_ms * 1e6
    assert exposure <= period
    middles = (np.arange(preset.num_frames) + 0.5) * period
    times = middles[:, None] + np.linspace(-0.5, 0.5, 5) * exposure
    moved = []
    for seed in SEEDS:
        for poses in poses_of(preset, seed, times):
            points = on_the_ground(preset, poses[2])
            seen = np.einsum("pij,pni->pnj", poses[:, :, :3], points - poses[:, None, :, 3])
            pixels = focal_length * seen[..., :2] / seen[..., 2:]
            moved.append(np.linalg.norm(np.diff(pixels, axis=0), axis=-1).sum(0).mean())
    assert np.mean(moved) == pytest.approx(preset.blur, rel=0.05)


@pytest.mark.parametrize("name", PRESETS)
def test_the_presets_of_training_fit(name: str):
    """Their frames exist, and what is seen lies in their box and beyond their nearest depth."""
    simulated = PRESETS[name]
    preset = training.PRESETS[name]
    assert simulated.num_frames - 1 in {max(preset.train_frames), max(preset.train_frames) + 1}
    assert max(preset.held_out_frames) < simulated.num_frames
    assert simulated.contrast_thresholds == preset.contrast_thresholds
    x, y, z, half = preset.box
    for seed in SEEDS:
        for pose in poses_of(simulated, seed, np.linspace(0, simulated.duration * 1e9, 50)):
            points = on_the_ground(simulated, pose)
            assert np.abs(points - (x, y, z)).max() < half
            depth = (points - pose[:, 3]) @ pose[:, 2]
            assert preset.depth_range[0] < depth.min() and depth.max() < preset.depth_range[1]


@pytest.mark.parametrize("name", PRESETS)
def test_the_motion_is_one_of_the_seed(name: str):
    times = np.linspace(0, PRESETS[name].duration * 1e9, 7)
    first, again, other = (poses_of(PRESETS[name], seed, times) for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 0.05


def test_blur_is_mild_then_medium_then_strong():
    blurs = [PRESETS[name].blur for name in ("shake-moon1", "shake-moon2", "shake-carpet1")]
    assert blurs[1] > 2 * blurs[0] and blurs[2] > 2 * blurs[1]
    assert PRESETS["shake-carpet1"].scene == PRESETS["spiral1"].scene == PRESETS["spiral2"].scene
    assert {preset.width / preset.height for preset in PRESETS.values()} == {640 / 480}


@pytest.mark.slow
@pytest.mark.parametrize("name", CAMERAS)
def test_the_scenes_lie_about_the_ground_that_the_other_tests_take_them_for(name: str):
    scene = SCENES[name](np.random.default_rng(0))
    np.testing.assert_array_equal(scene.camera, CAMERAS[name])
    np.testing.assert_array_equal(scene.target, np.zeros(3))
    corners = scene.triangles.reshape(-1, 3)
    assert np.abs(corners[:, 2]).max() < 0.5 and np.abs(corners[:, :2]).max() > 10

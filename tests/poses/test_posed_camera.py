"""Rays against Nerfstudio's cameras, SciPy's poses, and finite differences."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from nerfstudio.cameras.cameras import Cameras
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.trajectory import Trajectory
from enerf_ns.poses.posed_camera import PosedCamera

CAMERA = Camera(24, 18, 20.0, 22.0, 11.0, 9.5)
DISTORTED = Camera(24, 18, 20.0, 22.0, 11.0, 9.5, (-0.1, 0.02, 0.001, -0.002), "radtan")
TIMES = np.arange(8) * 100_000_000
TURN = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
TRANSFORM = torch.from_numpy(np.column_stack([TURN, [0.5, -1.0, 2.0]]))
SCALE = 0.7


def trajectory() -> Trajectory:
    random = np.random.default_rng(0)
    turns = Rotation.from_rotvec(np.cumsum(random.normal(0, 0.2, (8, 3)), axis=0))
    return Trajectory(TIMES, np.cumsum(random.normal(0, 0.1, (8, 3)), axis=0), turns.as_quat())


def draw(number: int = 50) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    pixels = torch.randint(24 * 18, (number,), generator=generator)
    return pixels, torch.randint(int(TIMES[-1]), (number,), generator=generator)


def test_rays_are_those_of_nerfstudios_cameras_at_the_same_poses():
    pixels, times = draw()
    rays = PosedCamera(CAMERA, trajectory(), TRANSFORM, SCALE).rays(pixels, times)
    poses = trajectory().poses(times).numpy()
    poses = np.concatenate([TURN @ poses[:, :, :3], poses[:, :, 3:]], axis=2)
    poses[:, :, 3] = SCALE * (trajectory().poses(times).numpy()[:, :, 3] @ TURN.T + TRANSFORM[:, 3].numpy())
    cameras = Cameras(
        torch.from_numpy(poses * [1, -1, -1, 1]).float(), 20.0, 22.0, 11.5, 10.0, CAMERA.width, CAMERA.height
    )
    places = torch.stack([pixels // 24, pixels % 24], dim=-1) + 0.5
    expected = cameras.generate_rays(camera_indices=torch.arange(len(pixels))[:, None], coords=places)
    for name in ("origins", "directions"):
        torch.testing.assert_close(getattr(rays, name), getattr(expected, name), rtol=0, atol=1e-6)
    torch.testing.assert_close(rays.metadata["directions_norm"], expected.metadata["directions_norm"])
    assert rays.pixel_area.shape == (50, 1) and rays.pixel_area[0].item() == pytest.approx(1 / (20 * 22))
    assert rays.camera_indices is None


@pytest.mark.parametrize(("camera", "tolerance"), [(CAMERA, 1e-6), (DISTORTED, 1e-3)])
def test_rays_go_through_places_in_their_pixels(camera: Camera, tolerance: float):
    """As OpenCV undistorts them; with distortion, steps from pixel to pixel are differences."""
    pixels, times = draw()
    places = torch.rand(50, 2, generator=torch.Generator().manual_seed(2)) - 0.5
    posed = PosedCamera(camera, trajectory(), TRANSFORM, SCALE)
    rays = posed.rays(pixels, times, places=places)
    points = torch.stack([pixels % 24, pixels // 24], dim=-1).double() + places
    seen = cv2.undistortPoints(points.numpy()[:, None], camera.matrix, np.array(camera.distortion or (0.0,) * 4))[:, 0]
    towards = np.column_stack([seen, np.ones(50)])
    rotations = TURN @ trajectory().poses(times).numpy()[:, :, :3]
    expected = np.einsum("nij,nj->ni", rotations, towards)
    norms = np.linalg.norm(expected, axis=1, keepdims=True)
    np.testing.assert_allclose(rays.directions, expected / norms, atol=tolerance)
    np.testing.assert_allclose(rays.metadata["directions_norm"], norms, atol=tolerance)
    centres = posed.rays(pixels, times, places=torch.zeros(50, 2)).directions
    torch.testing.assert_close(centres, posed.rays(pixels, times).directions)


@pytest.mark.parametrize("camera", [CAMERA, DISTORTED])
def test_delays_shift_the_times(camera: Camera):
    pixels, times = draw()
    times = times.clamp(min=40_000_000, max=int(TIMES[-1]) - 40_000_000)
    posed = PosedCamera(camera, trajectory(), TRANSFORM, SCALE)
    for delay in (0, 1, 30_000_000, -30_000_000):
        rays = posed.rays(pixels, times, torch.full((50,), float(delay), dtype=torch.float64))
        expected = posed.rays(pixels, times + delay)
        for name in ("origins", "directions"):
            torch.testing.assert_close(getattr(rays, name), getattr(expected, name), rtol=0, atol=1e-6)


def test_a_delay_beyond_the_trajectory_is_refused():
    pixels, times = draw(1)
    posed = PosedCamera(CAMERA, trajectory(), TRANSFORM, SCALE)
    with pytest.raises(ValueError, match="the trajectory covers only"):
        posed.rays(pixels, times, torch.tensor([1e9], dtype=torch.float64))


def test_poses_are_differentiable_in_the_delay():
    """In float64, in units of a millisecond, at times inside the segments of the trajectory."""
    times = torch.tensor([51_000_000, 333_000_000, 602_000_000])

    def poses(milliseconds: torch.Tensor) -> torch.Tensor:
        return trajectory().poses(times, 1e6 * milliseconds)

    delays = torch.tensor([0.25, -3.4, 12.1], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(poses, delays, eps=1e-4, atol=1e-6)


def test_rays_follow_delays_and_corrections():
    """The derivatives that reach a parameter are those of finite differences of the rays."""
    pixels, times = draw(5)
    times = times.clamp(min=10_000_000, max=int(TIMES[-1]) - 10_000_000)
    posed = PosedCamera(DISTORTED, trajectory(), TRANSFORM, SCALE)
    weights = torch.randn(2, 5, 3, generator=torch.Generator().manual_seed(2))

    def total(delays: torch.Tensor, corrections: torch.Tensor) -> torch.Tensor:
        rays = posed.rays(pixels, times, delays, corrections)
        return (weights[0] * rays.origins + weights[1] * rays.directions).double().sum()

    delays = torch.zeros(5, dtype=torch.float64, requires_grad=True)
    corrections = torch.full((5, 6), 0.1, dtype=torch.float64, requires_grad=True)
    by_delay, by_correction = torch.autograd.grad(total(delays, corrections), (delays, corrections))
    for gradient, argument, step in ((by_delay, delays, 3e6), (by_correction, corrections, 1e-3)):
        for index in np.ndindex(*argument.shape):
            change = torch.zeros_like(argument)
            change[index] = step
            pairs = [(delays + s * change, corrections) if argument is delays else (delays, corrections + s * change)
                     for s in (1, -1)]  # fmt: skip
            expected = (total(*pairs[0]) - total(*pairs[1])).item() / (2 * step)
            assert gradient[index].item() == pytest.approx(expected, rel=0.02, abs=3e-4 if step < 1 else 2e-11)


def test_a_correction_moves_the_camera_in_its_own_axes():
    """By 2 cm to its right, and by a tenth of a radian about the axis along which it looks."""
    pixels, times = draw()
    posed = PosedCamera(CAMERA, trajectory(), TRANSFORM, SCALE)
    corrections = torch.tensor([0.02, 0.0, 0.0, 0.0, 0.0, 0.1], dtype=torch.float64).expand(50, 6)
    moved, still = posed.rays(pixels, times, corrections=corrections), posed.rays(pixels, times)
    right = TURN @ trajectory().poses(times).numpy()[:, :, 0:1]
    np.testing.assert_allclose(moved.origins - still.origins, SCALE * 0.02 * right[..., 0], atol=1e-6)
    roll = Rotation.from_rotvec([0.0, 0.0, 0.1]).as_matrix()
    rotations = TURN @ trajectory().poses(times).numpy()[:, :, :3]
    seen = np.einsum("nji,nj->ni", rotations, still.directions.numpy()) @ roll.T
    np.testing.assert_allclose(moved.directions, np.einsum("nij,nj->ni", rotations, seen), atol=1e-5)

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.interpolate import CubicSpline, interp1d
from scipy.spatial.transform import Rotation, Slerp

from enerf_ns.dataparsers.recording.trajectory import Trajectory, evenly_spaced


def random_trajectory(rng: np.random.Generator, num_poses: int, start: int = 0) -> Trajectory:
    gaps = rng.integers(1_000_000, 50_000_000, num_poses - 1)
    times = start + np.concatenate([[0], np.cumsum(gaps)])
    return Trajectory(times, rng.normal(size=(num_poses, 3)), rng.normal(size=(num_poses, 4)))


def turning(quaternions: list) -> Trajectory:
    times = 10_000_000 * np.arange(len(quaternions))
    return Trajectory(times, np.zeros((len(quaternions), 3)), np.asarray(quaternions, dtype=np.float64))


def queries(rng: np.random.Generator, trajectory: Trajectory) -> np.ndarray:
    between = rng.integers(trajectory.start, trajectory.end, 500, endpoint=True)
    return np.concatenate([between, trajectory.times, trajectory.times[:-1] + 1, trajectory.times[1:] - 1])


def seconds(trajectory: Trajectory, times: np.ndarray) -> np.ndarray:
    return (times - trajectory.start) / 1e9


def slerp(trajectory: Trajectory, times: np.ndarray) -> np.ndarray:
    rotations = Rotation.from_quat(trajectory.quaternions)
    return Slerp(seconds(trajectory, trajectory.times), rotations)(seconds(trajectory, times)).as_matrix()


@pytest.mark.parametrize("start", [0, 1_600_000_000_123_456_789])
@pytest.mark.parametrize("num_poses", [2, 3, 4, 5, 200])
def test_poses_equal_scipy(num_poses: int, start: int, device: str) -> None:
    rng = np.random.default_rng(num_poses)
    trajectory = random_trajectory(rng, num_poses, start)
    times = queries(rng, trajectory)
    poses = trajectory.poses(torch.tensor(times, device=device))
    assert poses.dtype == torch.float64 and poses.device.type == device
    poses = poses.cpu().numpy()

    knots = seconds(trajectory, trajectory.times)
    spline = CubicSpline(knots, trajectory.positions, bc_type="not-a-knot")
    np.testing.assert_allclose(poses[:, :, 3], spline(seconds(trajectory, times)), rtol=0, atol=1e-9)
    np.testing.assert_allclose(poses[:, :, :3], slerp(trajectory, times), rtol=0, atol=1e-9)
    if num_poses >= 4:
        inside = times <= trajectory.end - 1
        b_spline = interp1d(knots, trajectory.positions, kind="cubic", axis=0)(seconds(trajectory, times[inside]))
        np.testing.assert_allclose(poses[inside, :, 3], b_spline, rtol=0, atol=1e-9)


def test_two_positions_give_a_line_and_three_a_parabola() -> None:
    quaternions = np.tile([0.0, 0.0, 0.0, 1.0], (3, 1))
    times = np.array([0, 400_000_000, 1_000_000_000])
    query = torch.arange(0, 1_000_000_001, 50_000_000)
    s = query.numpy() / 1e9

    line = Trajectory(times[[0, 2]], np.array([[1.0, 2.0, 3.0], [3.0, 2.0, -3.0]]), quaternions[:2])
    expected = np.stack([1.0 + 2.0 * s, np.full_like(s, 2.0), 3.0 - 6.0 * s], -1)
    np.testing.assert_allclose(line.poses(query)[..., 3], expected, atol=1e-12)

    knots = times / 1e9
    parabola = Trajectory(times, np.stack([knots**2, 1.0 - knots, 3.0 * knots**2 + knots], -1), quaternions)
    expected = np.stack([s**2, 1.0 - s, 3.0 * s**2 + s], -1)
    np.testing.assert_allclose(parabola.poses(query)[..., 3], expected, atol=1e-12)


def test_nanoseconds_survive_at_absolute_times() -> None:
    start = 1_600_000_000_123_456_789
    times = start + 1_000_000_000 * np.arange(5)
    velocity = np.array([1.0, -2.0, 0.5])
    trajectory = Trajectory(times, np.arange(5.0)[:, None] * velocity, np.tile([0.0, 0.0, 0.0, 1.0], (5, 1)))
    steps = torch.tensor([0, 1, 2, 3, 100, 1_999_999_999, 2_000_000_001])
    expected = (steps.double() * 1e-9)[:, None] * torch.tensor(velocity)
    torch.testing.assert_close(trajectory.poses(start + steps)[..., 3], expected, rtol=0, atol=1e-15)


@pytest.mark.parametrize("angle", [0.0, 1e-300, 1e-160, 1e-17, 1e-12, 1e-8, 1e-4, 1.0, np.pi - 1e-8, np.pi])
def test_one_turn_passes_its_angle_evenly(angle: float) -> None:
    axis = np.array([2.0, -1.0, 2.0]) / 3.0
    first = Rotation.from_quat([0.5, 0.5, -0.5, 0.5])
    step = np.append(np.sin(angle / 2) * axis, np.cos(angle / 2))
    trajectory = turning([first.as_quat(), (first * Rotation.from_quat(step)).as_quat()])
    times = np.arange(0, 10_000_001, 500_000)
    expected = (first * Rotation.from_rotvec(np.linspace(0, 1, 21)[:, None] * angle * axis)).as_matrix()
    rotations = trajectory.poses(torch.tensor(times))[..., :3].numpy()
    if angle == np.pi:  # both ways round are as short: the halves of the turn are mirrored
        other = (first * Rotation.from_rotvec(np.linspace(0, -1, 21)[:, None] * angle * axis)).as_matrix()
        expected = expected if abs(rotations - expected).max() < abs(rotations - other).max() else other
        np.testing.assert_allclose(rotations, slerp(trajectory, times), atol=1e-9)
    np.testing.assert_allclose(rotations, expected, rtol=0, atol=1e-9)


def test_half_turns_between_exact_quaternions_equal_scipy() -> None:
    trajectory = turning([[0, 0, 0, 1], [0, 0, 1, 0], [0, 1, 0, 0], [1, 0, 0, 0], [0, 0, 0, -1]])
    times = queries(np.random.default_rng(0), trajectory)
    rotations = trajectory.poses(torch.tensor(times))[..., :3].numpy()
    np.testing.assert_allclose(rotations, slerp(trajectory, times), rtol=0, atol=1e-9)


def test_a_quaternion_and_its_negative_are_the_same_rotation() -> None:
    rng = np.random.default_rng(1)
    quaternions = rng.normal(size=(20, 4))
    signs = rng.choice([-1.0, 1.0], size=(20, 1))
    query = torch.arange(0, 190_000_000, 123_457)
    poses = turning(list(quaternions)).poses(query)
    torch.testing.assert_close(turning(list(quaternions * signs * 1.001)).poses(query), poses, rtol=0, atol=1e-12)

    still = turning([quaternions[0], -quaternions[0]]).poses(torch.arange(0, 10_000_001, 1_000_000))[..., :3].numpy()
    expected = np.broadcast_to(Rotation.from_quat(quaternions[0]).as_matrix(), still.shape)
    np.testing.assert_allclose(still, expected, rtol=0, atol=1e-12)


def test_rotations_are_orthonormal() -> None:
    rng = np.random.default_rng(2)
    trajectory = random_trajectory(rng, 300)
    rotations = trajectory.poses(torch.tensor(queries(rng, trajectory)))[..., :3]
    torch.testing.assert_close(
        rotations @ rotations.mT, torch.eye(3, dtype=torch.float64).expand_as(rotations), rtol=0, atol=1e-13
    )
    torch.testing.assert_close(torch.linalg.det(rotations), torch.ones(len(rotations), dtype=torch.float64))


@pytest.mark.parametrize(
    ("start", "end"),
    [(0, 10**9), (0, 7), (5, 5), (-(2**62), 2**62 - 1), (1_600_000_000_123_456_789, 1_600_003_600_123_456_790)],
)
@pytest.mark.parametrize("number", [2, 3, 50, 2000])
def test_instants_are_spaced_exactly(start: int, end: int, number: int) -> None:
    instants = evenly_spaced(start, end, number)
    expected = [start + (end - start) * i // (number - 1) for i in range(number)]  # of any size, in Python
    assert instants.dtype == np.int64 and instants.tolist() == expected and expected[-1] == end


@pytest.mark.parametrize("start", [0, 1_600_000_000_123_456_789])
def test_gaps_are_longer_than_the_rate_explains(start: int) -> None:
    """Over ten times the median step and over a tenth of a second, against a loop; two may follow each other."""
    for milliseconds in ([5] * 30 + [100, 101, 300, 5, 5, 400], [50] * 30 + [500, 501, 502, 50, 300], [1] * 9, [10**6]):
        times = start + np.cumsum([0, *milliseconds]) * 1_000_000
        still = np.zeros((len(times), 3)), np.tile([0.0, 0.0, 0.0, 1.0], (len(times), 1))
        trajectory = Trajectory(times, *still)
        limit = max(10 * sorted(milliseconds)[len(milliseconds) // 2], 100)
        assert trajectory.longest_step == limit * 1_000_000
        expected = [
            (int(a), int(b)) for a, b, step in zip(times[:-1], times[1:], milliseconds, strict=True) if step > limit
        ]
        assert trajectory.gaps.tolist() == [[*pair] for pair in expected]
        around = np.unique(np.concatenate([times - 1, times, times + 1, (times[:-1] + times[1:]) // 2]))
        inside = [any(a < time < b for a, b in expected) for time in around.tolist()]
        assert trajectory.in_gaps(around).tolist() == inside


def test_batch_shapes() -> None:
    trajectory = random_trajectory(np.random.default_rng(3), 5)
    times = torch.randint(trajectory.start, trajectory.end, (4, 3), generator=torch.Generator().manual_seed(0))
    poses = trajectory.poses(times)
    assert poses.shape == (4, 3, 3, 4)
    torch.testing.assert_close(trajectory.poses(times[2, 1]), poses[2, 1])
    assert trajectory.poses(times[:0]).shape == (0, 3, 3, 4)


def test_times_outside_are_told_and_refused() -> None:
    trajectory = random_trajectory(np.random.default_rng(4), 6, start=1_000_000_000)
    times = np.array([trajectory.start - 1, trajectory.start, trajectory.end, trajectory.end + 1])
    np.testing.assert_array_equal(trajectory.covers(times), [False, True, True, False])
    assert trajectory.covers(torch.tensor(times)).tolist() == [False, True, True, False]
    assert trajectory.poses(torch.tensor(times[1:3])).shape == (2, 3, 4)
    with pytest.raises(ValueError, match=r"from 0\.5\d* s to 1\.0\d* s, but .* covers only 1\.0\d* s"):
        trajectory.poses(torch.tensor([500_000_000, trajectory.start]))
    with pytest.raises(ValueError, match="covers only"):
        trajectory.poses(torch.tensor(times[3:]))


@pytest.mark.parametrize(
    ("times", "positions", "quaternions"),
    [
        ([0], [[0, 0, 0]], [[0, 0, 0, 1]]),
        ([0, 0], [[0, 0, 0]] * 2, [[0, 0, 0, 1]] * 2),
        ([0, 2, 1], [[0, 0, 0]] * 3, [[0, 0, 0, 1]] * 3),
        ([0, 1], [[0, 0, 0], [0, np.nan, 0]], [[0, 0, 0, 1]] * 2),
        ([0, 1], [[0, 0, 0]] * 2, [[0, 0, 0, 1], [0, 0, 0, 0]]),
        ([0, 1], [[0, 0, 0]] * 3, [[0, 0, 0, 1]] * 2),
        ([0, 1], [[0, 0, 0]] * 2, [[0, 0, 0, 1]] * 3),
    ],
)
def test_bad_poses_are_refused(times: list, positions: list, quaternions: list) -> None:
    with pytest.raises(ValueError):
        Trajectory(np.array(times), np.array(positions, dtype=float), np.array(quaternions, dtype=float))


def test_a_mounted_camera_moves_with_the_body() -> None:
    rng = np.random.default_rng(5)
    times, positions, quaternions = np.arange(6) * 10**8, rng.normal(size=(6, 3)), Rotation.random(6, rng).as_quat()
    mount = np.eye(4)
    mount[:3, :3], mount[:3, 3] = Rotation.from_rotvec([0.4, -0.1, 0.9]).as_matrix(), [0.1, -0.2, 0.05]
    bodies = np.tile(np.eye(4), (6, 1, 1))
    bodies[:, :3, :3], bodies[:, :3, 3] = Rotation.from_quat(quaternions).as_matrix(), positions
    mounted = Trajectory(times, positions, quaternions).of_mounted(mount)
    np.testing.assert_allclose(mounted.poses(torch.from_numpy(times)).numpy(), (bodies @ mount)[:, :3], atol=1e-12)
    assert mounted.body is not None and mounted.body[0].body is None
    np.testing.assert_array_equal(mounted.body[0].quaternions, quaternions)
    np.testing.assert_array_equal(mounted.body[1], mount)

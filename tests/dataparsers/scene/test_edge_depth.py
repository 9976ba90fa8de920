from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from edge_depth import errors
from scipy.ndimage import convolve1d, uniform_filter
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from enerf_ns.bench.numerics.points import CAMERA, TURNING, points_between, recording_of_points, shaking
from enerf_ns.dataparsers.compiled import compiled
from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.recording.recording import EventRecording
from enerf_ns.dataparsers.recording.trajectory import Trajectory
from enerf_ns.dataparsers.scene.edge_depth import RADIUS, SMOOTHING, EdgeView, _sweep, edge_depth

MOTION = shaking(0.2)


def recording_of(points: np.ndarray, positions: np.ndarray, rotations: Rotation = TURNING) -> EventRecording:
    events, trajectory, _ = recording_of_points(points, positions, rotations)
    return EventRecording(Path("memory"), "test", CAMERA, trajectory, lambda: iter([events]), ())


def relative_errors(view: EdgeView, points: np.ndarray) -> np.ndarray:
    """Differences between the depths of a view's edges and of the true points beside them in the view."""
    seen = (points - view.pose[:, 3]) @ view.pose[:, :3]
    seen = seen[seen[:, 2] > 0.05]
    places = view.focal_length * seen[:, :2] / seen[:, 2:] + np.array(view.principal_point)
    rows, columns = np.nonzero(view.depth)
    near = KDTree(places).query_ball_point(np.stack([columns, rows], axis=1), 2.0)
    found = view.depth[rows, columns]
    return np.array([min((abs(d / z - 1) for z in seen[i, 2]), default=1.0) for d, i in zip(found, near, strict=True)])


@pytest.mark.parametrize("unit", [1.0, 1000.0])
def test_edges_lie_where_the_points_are(unit: float):
    points = points_between(1.0, 3.0)
    views = edge_depth(recording_of(unit * points, unit * MOTION), (0.7 * unit, 4.0 * unit))
    found = np.concatenate([relative_errors(view, unit * points) for view in views])
    assert len(views) == 12 and len(found) > 12 * len(points)
    assert np.median(found) < 0.015 and np.mean(found > 0.05) < 0.05
    nearest = KDTree(np.concatenate([view.points for view in views])).query(unit * points)[0]
    assert np.mean(nearest < 0.02 * unit) > 0.35  # points beside each other in different depths are left out


def test_edges_of_a_recording_are_found_once_for_each_range():
    """The choice whether to start from them, and the start, ask for the same."""
    recording = recording_of(points_between(1.0, 3.0), MOTION)
    assert edge_depth(recording, (0.7, 4.0)) is edge_depth(recording, (0.7, 4.0))
    assert edge_depth(recording, (0.7, 4.0)) is not edge_depth(recording, (0.7, 5.0))


def test_points_and_depth_say_the_same():
    view = edge_depth(recording_of(points_between(1.0, 3.0), MOTION), (0.7, 4.0), num_views=3)[1]
    seen = (view.points - view.pose[:, 3]) @ view.pose[:, :3]
    rows, columns = np.nonzero(view.depth)
    np.testing.assert_allclose(seen[:, 2], view.depth[rows, columns], rtol=1e-6)
    place = view.focal_length * seen[:, :2] / seen[:, 2:] + np.array(view.principal_point)
    np.testing.assert_allclose(place, np.stack([columns, rows], axis=1), atol=1e-3)
    assert ((view.confidence > 0) == (view.depth > 0)).all()


def test_a_camera_that_only_turns_shows_no_depth():
    assert edge_depth(recording_of(points_between(1.0, 3.0), shaking(0.0)), (0.7, 4.0)) == []
    views = edge_depth(recording_of(points_between(1.0, 3.0), shaking(1e-4)), (0.7, 4.0))
    assert not any(view.depth.any() for view in views)


def test_wrong_poses_confirm_few_depths():
    recording = recording_of(points_between(1.0, 3.0), MOTION)
    read = recording.trajectory
    turned = Rotation.from_quat(read.quaternions).inv()
    inverse = Trajectory(read.times, -turned.apply(read.positions), turned.as_quat())
    wrong = EventRecording(Path("memory"), "test", CAMERA, inverse, recording.stream_events, ())
    right, found = (sum(np.count_nonzero(v.depth) for v in edge_depth(r, (0.7, 4.0))) for r in (recording, wrong))
    assert found < 0.1 * right


def test_the_sweep_finds_the_plane_of_largest_contrast():
    generator = np.random.default_rng(0)
    rows, columns, planes = 30, 40, np.arange(5.0, 15.0).astype(np.float32)
    lines = np.concatenate(
        [generator.uniform(-3, (columns + 3, rows + 3), (4000, 2)), generator.normal(0, 0.4, (4000, 2))], axis=1
    ).astype(np.float32)
    edge = generator.uniform(-1.5, 1.5, (900, 2))  # rays that meet on a vertical edge at the plane of 9
    at = np.stack([np.full(900, 20.5), generator.uniform(8, 22, 900)], axis=1)
    lines[:900] = np.concatenate([at - 9 * edge, edge], axis=1)
    plane, best, mean, ridge = compiled(_sweep, any_order=True)(
        lines, planes, rows, columns, RADIUS, np.array(SMOOTHING[1:], np.float32)
    )

    margin, contrasts, peaks = RADIUS + 1, [], []
    for disparity in planes:
        x, y = np.floor(lines[:, :2] + disparity * lines[:, 2:]).astype(int).T
        votes = np.zeros((rows + 2 * margin, columns + 2 * margin))
        seen = (x >= 0) & (y >= 0) & (x < columns) & (y < rows)
        np.add.at(votes, (y[seen] + margin, x[seen] + margin), 1)
        smooth = convolve1d(convolve1d(votes, SMOOTHING, 0, mode="constant"), SMOOTHING, 1, mode="constant")
        average, square = (uniform_filter(image, 2 * RADIUS + 1, mode="constant") for image in (smooth, smooth**2))
        inside = slice(margin, -margin), slice(margin, -margin)
        contrasts.append((square - average**2)[inside])
        peaks.append(((smooth - average) / np.sqrt(square - average**2 + 1e-3))[inside])
    contrasts, peaks = np.stack(contrasts), np.stack(peaks)
    largest = contrasts.argmax(0)
    chosen = np.rint(plane).astype(int)
    clear = np.sort(contrasts, 0)[-1] > 1.01 * np.sort(contrasts, 0)[-2]
    assert (np.abs(plane - largest)[clear] <= 0.5).all() and np.mean(clear) > 0.7
    np.testing.assert_allclose(best, contrasts.max(0), rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(mean, contrasts.mean(0), rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(ridge[clear], np.take_along_axis(peaks, largest[None], 0)[0][clear], rtol=1e-3)
    assert chosen[15, 20] == 4  # the edge


@pytest.mark.slow
def test_depths_of_a_simulated_recording_are_right_within_a_hundredth(tmp_path: Path):
    from enerf_ns.simulator.engine import simulate
    from enerf_ns.simulator.settings import SimulationSettings

    simulate(SimulationSettings("carpet", width=160, height=120, duration=0.4, num_frames=13), tmp_path / "carpet")
    recording = read_recording(tmp_path / "carpet")
    frames = recording.frames
    assert frames is not None
    views = edge_depth(recording, (0.7, 4.0))
    found = np.concatenate([errors(view, frames) for view in views])
    assert np.median(found) < 0.01 and np.mean(found > 0.05) < 0.05
    assert np.mean([np.mean(view.depth > 0) for view in views]) > 0.05

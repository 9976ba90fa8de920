"""When to render: displacements against OpenCV's projection, and pixels between pictures against what they see."""

from __future__ import annotations

import threading
import time
import weakref
from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
import torch
from known_points import points_seen, project, reference_poses
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.trajectory import Trajectory
from enerf_ns.sensor.response import Logarithm
from enerf_ns.simulator.sampling import MAX_CHANGE, MOST_HALVINGS, Render, adaptive_renders, render_times
from enerf_ns.simulator.scene.render import Renderer
from enerf_ns.simulator.scene.scenes import SCENES
from enerf_ns.simulator.trajectories import MOTIONS

EPS = 0.001
MS = 10**6
HEIGHT, WIDTH = 5, 8
MAX_ERROR = MAX_CHANGE**2 / 8
PARTS = 2**MOST_HALVINGS
"""That an interval is divided into at most."""
ESTIMATE = 1.25
"""Up to it, the error of a sine's straight line is above the estimate by second differences, if it turns by a radian
at most within an interval: with x = 1 / 2, 1 / (cos(x) (sin(x) / x)^2), since its bend is measured at the ends."""

Levels = Callable[[np.ndarray], np.ndarray]
"""Log brightness [times, pixels, *channels] at times (ns)."""


class Seen:
    """Pixels of known log brightness, and what was asked of them."""

    def __init__(self, levels: Levels, height: int = HEIGHT, delay: float = 0.0):
        self.levels, self.height, self.delay = levels, height, delay
        self.whole: list[int] = []
        self.calls = 0
        self.rng = np.random.default_rng(0)

    def __call__(self, time_ns: int, pixels: np.ndarray | None) -> np.ndarray:
        self.calls += 1
        if self.delay:
            time.sleep(self.rng.uniform(0, self.delay))
        brightness = np.exp(self.levels(np.array([time_ns]))[0]) - EPS
        if pixels is not None:
            return brightness[pixels]
        self.whole.append(time_ns)
        return brightness.reshape(self.height, -1, *brightness.shape[1:])


def sines(channels: tuple[int, ...] = (), fastest: float = 1.0, amplitude: float = 1.5, seed: int = 0) -> Levels:
    """Log brightness a sin(w t + phase) - 2 with another a, w and phase for every value; w is at most `fastest` radians
    a millisecond."""
    shape = (HEIGHT * WIDTH, *channels)
    rng = np.random.default_rng(seed)
    size, speed = rng.uniform(0.02, amplitude, shape), rng.uniform(0.05, fastest, shape) / MS
    phase = rng.uniform(0, 2 * np.pi, shape)
    return lambda times: size * np.sin(speed * times.reshape(-1, *np.ones(len(shape), int)) + phase) - 2


def ramps(times: np.ndarray) -> np.ndarray:
    """Brightness that rises or falls linearly with time, faster from pixel to pixel, and one that does not."""
    rise = np.arange(HEIGHT * WIDTH) - HEIGHT * WIDTH // 2
    return np.log(EPS + 0.9 + 0.003 * rise * (times[:, None] / MS - 14))


def rendered_at(renders: list[Render], pixel: int) -> np.ndarray:
    """Times at which a pixel is rendered."""
    between = [part.time for render in renders for part in render.before if pixel in part.pixels]
    return np.sort([*between, *(render.time for render in renders)])


def flat(renders: list[Render]) -> list[tuple]:
    """All that they hold, for comparison."""
    rows: list[tuple] = []
    for render in renders:
        rows += [(part.time, part.pixels.tolist(), part.brightness.tolist()) for part in render.before]
        rows.append((render.time, render.brightness.tolist()))
    return rows


def irregular(count: int, longest: int = MS, start: int = 7 * MS) -> np.ndarray:
    """Times from `start` on, up to `longest` apart."""
    return start + np.cumsum(np.random.default_rng(1).integers(longest // 2, longest, count))


@pytest.mark.parametrize("channels", [(), (3,)])
def test_whole_pictures_at_the_times_and_pixels_between_them(channels):
    source, times = Seen(sines(channels)), irregular(30)
    renders = list(adaptive_renders(source, times))
    assert [render.time for render in renders] == sorted(source.whole) == times.tolist()
    assert renders[0].before == [] and sum(len(render.before) for render in renders) > 30
    for last, render in pairwise(renders):
        between = [part.time for part in render.before]
        assert between == sorted(set(between)) and all(last.time < t < render.time for t in between)
        for part in render.before:
            assert 0 < len(part.pixels) < HEIGHT * WIDTH and (np.diff(part.pixels) > 0).all()
            np.testing.assert_array_equal(part.brightness, source(part.time, part.pixels))
        np.testing.assert_array_equal(render.brightness, source(render.time, None))


@pytest.mark.parametrize(
    ("levels", "spacing"),
    [
        (sines(), MS),
        (sines((3,), seed=1), MS),
        (sines(amplitude=6.0, seed=2), MS),
        (ramps, 2 * MS),
        (ramps, 4 * MS),
    ],
    ids=["grey", "colour", "strong", "ramps", "ramps far apart"],
)
def test_between_two_renders_of_a_pixel_it_changes_and_bends_no_more_than_the_bounds(levels, spacing):
    """But where the interval was halved most often. Of the first and the last interval there is no picture on one side,
    so that only the change is bounded."""
    times = irregular(36 * MS // spacing, spacing, start=0)
    renders = list(adaptive_renders(Seen(levels), times))
    checked = refined = 0
    for pixel in range(HEIGHT * WIDTH):
        at = rendered_at(renders, pixel)
        interval = np.searchsorted(times, at[1:]) - 1
        halved_most = np.diff(at) <= np.diff(times)[interval] // PARTS + 1
        change = np.abs(np.diff(levels(at)[:, pixel], axis=0)).reshape(len(at) - 1, -1).max(axis=1)
        assert (change[~halved_most] <= MAX_CHANGE + 1e-6).all()
        share = np.linspace(0, 1, 33)[:, None]
        dense = np.rint(at[:-1] + share * np.diff(at)).astype(np.int64)
        true = levels(dense.ravel())[:, pixel].reshape(*dense.shape, -1)
        line = true[0] + share[..., None] * (true[-1] - true[0])
        error = np.abs(true - line).max(axis=(0, 2))
        inner = ~halved_most & (interval > 0) & (interval < len(times) - 2)
        assert (error[inner] <= ESTIMATE * MAX_ERROR).all()
        checked += inner.sum()
        refined += len(at) - len(times)
    assert checked > 200 and refined > 10


def test_nothing_is_rendered_that_is_known_already():
    """Whatever is rendered between two pictures would have strayed, or changed, by more than the bounds, or is as bent
    where the intervals beside it begin or end."""
    levels, times = sines(seed=3), np.arange(40) * MS
    renders = list(adaptive_renders(Seen(levels), times))
    for pixel in range(HEIGHT * WIDTH):
        at = set(rendered_at(renders, pixel).tolist())
        for k, (start, end) in enumerate(pairwise(times.tolist())):
            if (start + end) // 2 in at:
                near = np.linspace(max(0, start - MS), min(end + MS, times[-1]), 200)
                level = levels(near)[:, pixel]
                bend = np.abs(np.gradient(np.gradient(level, near), near))[2:-2].max()
                change = abs(np.subtract(*levels(times[k : k + 2])[:, pixel]))
                assert change > MAX_CHANGE or bend * (end - start) ** 2 / 8 > MAX_ERROR


def test_halving_ends_after_the_most_halvings():
    def jump(times: np.ndarray) -> np.ndarray:
        """One pixel of all jumps in the third interval."""
        return np.where((times[:, None] > 2.4 * MS) & (np.arange(HEIGHT * WIDTH) == 13), 3.0, -3.0)

    renders = list(adaptive_renders(Seen(jump), np.arange(5) * MS))
    at, step = rendered_at(renders, 13), MS / PARTS
    gap = np.searchsorted(at, 2.4 * MS)
    assert at[gap - 1 : gap + 1].tolist() == [2.4 * MS // step * step, (2.4 * MS // step + 1) * step]
    assert np.diff(at).min() == step
    for pixel in (0, 12, 14):
        assert rendered_at(renders, pixel).tolist() == [0, MS, 2 * MS, 3 * MS, 4 * MS]


def test_a_pixel_that_does_not_change_is_not_rendered_between_pictures():
    levels = sines()
    still = np.arange(HEIGHT * WIDTH) % 3 == 0

    def some_still(times: np.ndarray) -> np.ndarray:
        return np.where(still, -1.0, levels(times))

    renders = list(adaptive_renders(Seen(some_still), np.arange(40) * MS))
    pixels = np.unique(np.concatenate([part.pixels for render in renders for part in render.before]))
    assert len(pixels) > 10 and not still[pixels].any()


@pytest.mark.parametrize("sign", [1, -1])
def test_a_turn_between_two_equal_pictures_is_found_by_its_neighbours(sign):
    """Two pixels turn halfway from one picture to the next; one strays by more than the bound, the other by less."""
    sizes = np.full(HEIGHT * WIDTH, 0.0)
    sizes[[3, 4]] = np.array([1.3, 0.7]) * MAX_ERROR * 8 / (np.cos(0.5) - np.cos(1.5))

    def turning(times: np.ndarray) -> np.ndarray:
        return sign * sizes * np.cos((times[:, None] - 3.5 * MS) / MS) - 1

    times = np.arange(2, 6) * MS
    levels = turning(times)[:, 3]
    assert abs(levels[1] - levels[2]) < 1e-9 and abs(levels[1] - levels[0]) < MAX_CHANGE
    renders = list(adaptive_renders(Seen(turning), times))
    assert 3.5 * MS in rendered_at(renders, 3)
    assert [len(rendered_at(renders, pixel)) for pixel in (4, 5)] == [4, 4]


def test_one_channel_is_enough_for_a_pixel_to_be_rendered():
    def red_alone(times: np.ndarray) -> np.ndarray:
        levels = np.full((len(times), HEIGHT * WIDTH, 3), -1.0)
        levels[:, 9, 0] += 0.4 * times / MS
        return levels

    renders = list(adaptive_renders(Seen(red_alone), np.arange(4) * MS))
    assert [[(part.time, part.pixels.tolist()) for part in render.before] for render in renders] == [
        [],
        *([(time_ns, [9])] for time_ns in (MS // 2, 3 * MS // 2, 5 * MS // 2)),
    ]


def test_an_infinite_change_renders_nothing_between_pictures():
    source, times = Seen(sines(amplitude=5.0)), np.arange(20) * MS
    renders = list(adaptive_renders(source, times, max_change=np.inf))
    assert all(render.before == [] for render in renders) and source.calls == 20
    assert [render.time for render in renders] == times.tolist()


@pytest.mark.parametrize("delay", [0.0, 0.003])
def test_any_number_of_threads_renders_the_same(delay):
    levels, times = sines(seed=4), irregular(25)
    alone = flat(list(adaptive_renders(Seen(levels), times, threads=1)))
    assert len(alone) > 50
    for threads in (1, 2, 5):
        assert flat(list(adaptive_renders(Seen(levels, delay=delay), times, threads=threads))) == alone


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_only_a_few_pictures_are_rendered_ahead_and_kept(threads):
    levels, times = sines(), np.arange(60) * MS
    pictures: list[weakref.ref] = []
    source = Seen(levels)

    def counted(time_ns: int, pixels: np.ndarray | None) -> np.ndarray:
        picture = source(time_ns, pixels)
        if pixels is None:
            pictures.append(weakref.ref(picture))
        return picture

    ahead, kept = [], []
    for index, _ in enumerate(adaptive_renders(counted, times, threads=threads)):
        if index in (10, 30, 50):
            time.sleep(0.1)  # in which the threads come as far as they may
            ahead.append(len(source.whole) - 1 - index)
            kept.append(sum(picture() is not None for picture in pictures))
    assert 0 < max(ahead) <= 2 * threads
    assert max(kept) <= 2 * threads + 3


@pytest.mark.parametrize("threads", [1, 2, 5])
@pytest.mark.parametrize(("max_change", "before"), [(np.inf, 12), (MAX_CHANGE, 11)])
def test_an_error_of_a_picture_is_raised_where_it_is_needed_first(threads, max_change, before):
    """For the bend of the interval that ends with the picture before it, if there is to be anything in between."""
    source = Seen(sines())

    def failing(time_ns: int, pixels: np.ndarray | None) -> np.ndarray:
        if time_ns == 12 * MS:
            raise OSError("the twelfth")
        return source(time_ns, pixels)

    renders = adaptive_renders(failing, np.arange(30) * MS, max_change, threads=threads)
    assert [next(renders).time for _ in range(before)] == [k * MS for k in range(before)]
    with pytest.raises(OSError, match="the twelfth"):
        next(renders)
    assert list(renders) == []


@pytest.mark.parametrize("threads", [1, 4])
def test_an_error_between_pictures_is_raised_with_the_picture_after_it(threads):
    source = Seen(sines(seed=4))

    def failing(time_ns: int, pixels: np.ndarray | None) -> np.ndarray:
        if pixels is not None and time_ns > 6 * MS:
            raise ValueError("in between")
        return source(time_ns, pixels)

    renders = adaptive_renders(failing, np.arange(30) * MS, threads=threads)
    assert [next(renders).time for _ in range(7)] == [k * MS for k in range(7)]
    with pytest.raises(ValueError, match="in between"):
        next(renders)


@pytest.mark.parametrize("threads", [1, 3])
def test_leaving_early_ends_all_threads(threads):
    existing = set(threading.enumerate())
    source = Seen(sines(), delay=0.005)
    renders = adaptive_renders(source, np.arange(200) * MS, threads=threads)
    for _ in range(3):
        next(renders)
    assert set(threading.enumerate()) - existing
    renders.close()  # pyright: ignore[reportAttributeAccessIssue]
    calls = source.calls
    assert not set(threading.enumerate()) - existing
    time.sleep(0.05)
    assert source.calls == calls < 200


@pytest.mark.parametrize(
    ("times", "between"),
    [
        ([5], []),
        ([5, 6], []),
        ([5, 6, 7, 8], []),
        ([5, 7], [6]),
        ([5, 8], [6, 7]),
        ([5, 5 + PARTS], [5 + k for k in range(1, PARTS)]),
        ([5, 5 + 2 * PARTS], [5 + 2 * k for k in range(1, PARTS)]),
    ],
)
def test_few_times_and_times_next_to_each_other(times, between):
    def steep(at: np.ndarray) -> np.ndarray:
        return np.repeat(7.0 * at[:, None] - 60, HEIGHT * WIDTH, axis=1)

    renders = list(adaptive_renders(Seen(steep), np.array(times)))
    assert [render.time for render in renders] == times
    assert [part.time for render in renders for part in render.before] == between


def test_black_that_becomes_less_black_is_rendered_between_as_any_other_change():
    """From 0 to the logarithm's offset within an interval; in its first half by ln 1.5, and in the second it still
    bends too much."""
    brightness = np.array([0.0, 0.001, 0.001, 0.001])

    def dark(times: np.ndarray) -> np.ndarray:
        return np.repeat(np.log(EPS + np.interp(times, np.arange(4) * MS, brightness))[:, None], HEIGHT * WIDTH, axis=1)

    first, *renders = adaptive_renders(Seen(dark), np.arange(4) * MS, response=Logarithm(EPS))
    assert (first.brightness < 1e-15).all()
    assert [part.time / MS for part in renders[0].before] == [0.25, 0.5, 0.75]


NORMAL, DISTANCE = np.array([0.15, -0.1, 1.0]), 1.8
"""Of the plane of points p with normal . p = distance."""

CAMERAS = {
    "pinhole": Camera(48, 36, 45.0, 43.0, 24.5, 17.0),
    "radtan": Camera(48, 36, 45.0, 43.0, 24.5, 17.0, (-0.25, 0.08, 0.002, -0.003), "radtan"),
    "fisheye": Camera(48, 36, 30.0, 31.0, 24.5, 17.0, (-0.05, 0.02, -0.01, 0.002), "fisheye"),
    "larger than the grid": Camera(72, 54, 66.0, 66.0, 36.0, 27.0, (-0.25, 0.08, 0.002, -0.003), "radtan"),
}


def places(camera: Camera) -> np.ndarray:
    """Of all pixels, [pixels, 2]."""
    return np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1).reshape(-1, 2)


def points_of_plane(camera: Camera, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """World points that the pixels see of the plane from a pose [4, 4], and their z-depths, by OpenCV."""
    seen = places(camera)
    here = np.tile(pose, (len(seen), 1, 1))
    on_rays = points_seen(seen, np.ones(len(seen)), here, camera.matrix, camera.distortion, camera.model)
    rays = on_rays - pose[:3, 3]
    depth = (DISTANCE - NORMAL @ pose[:3, 3]) / (rays @ NORMAL)
    assert (depth > 0.3).all()
    return pose[:3, 3] + depth[:, None] * rays, depth


def moving(translates: bool, rotates: bool, duration: int) -> Trajectory:
    """Back and forth at changing speed, with a pose every ten milliseconds."""
    times = np.arange(0, duration + 1, 10 * MS)
    phase = np.array([0.0, 1, 2]) + times[:, None] / MS * [0.031, 0.043, 0.027]
    positions = np.array([0.3, 0.25, 0.15]) * np.sin(phase) * translates
    rotations = Rotation.from_rotvec(np.array([0.2, 0.15, 0.4]) * np.cos(phase) * rotates)
    return Trajectory(times, positions, rotations.as_quat())


@pytest.mark.parametrize("model", CAMERAS)
@pytest.mark.parametrize(
    ("translates", "rotates"), [(True, False), (False, True), (True, True)], ids=["translates", "rotates", "both"]
)
def test_no_point_moves_further_than_asked_between_two_times(model, translates, rotates):
    """But by 3 percent, since displacements are measured from millisecond to millisecond of points seen up to 3 ms
    before or after. And there are hardly more times than that takes."""
    camera, furthest = CAMERAS[model], 0.7
    trajectory = moving(translates, rotates, 200 * MS)
    stops = np.array([0, 31_234_567, 31_234_568, 120 * MS, 200 * MS])

    def poses(times: np.ndarray) -> np.ndarray:
        return reference_poses(trajectory.times, trajectory.positions, trajectory.quaternions, times)

    def depth(time_ns: int) -> np.ndarray:
        pose = poses(np.array([time_ns]))[0]
        return points_of_plane(camera, pose)[1].reshape(camera.height, camera.width).astype(np.float32)

    times = render_times(camera, trajectory, depth, stops, furthest)
    assert times.dtype == np.int64 and (np.diff(times) > 0).all()
    assert times[0] == stops[0] and times[-1] == stops[-1] and np.isin(stops, times).all()
    moved = []
    for pose, following in pairwise(poses(times)):
        points, _ = points_of_plane(camera, pose)
        after = project(points, np.tile(following, (len(points), 1, 1)), camera.matrix, camera.distortion, camera.model)
        moved.append(np.linalg.norm(after - places(camera), axis=1).max())
    assert max(moved) <= 1.03 * furthest
    for start, end in pairwise(np.searchsorted(times, stops)):
        assert np.sum(moved[start:end]) > 0.9 * furthest * (end - start - 1)
    assert len(times) > 40


def test_half_the_displacement_takes_twice_the_times():
    camera, trajectory = CAMERAS["pinhole"], moving(True, True, 100 * MS)
    stops, depth = np.array([0, 100 * MS]), np.ones((36, 48), np.float32)
    counts = [len(render_times(camera, trajectory, lambda _: depth, stops, furthest)) for furthest in (0.8, 0.4, 0.2)]
    assert counts[0] > 20
    assert abs(counts[1] - 2 * counts[0]) <= 2 and abs(counts[2] - 2 * counts[1]) <= 2


def test_any_number_of_threads_finds_the_same_times():
    camera, trajectory = CAMERAS["fisheye"], moving(True, True, 100 * MS)
    stops = np.array([0, 100 * MS])

    def depth(time_ns: int) -> np.ndarray:
        return np.full((36, 48), 1 + time_ns * 1e-8)

    found = [render_times(camera, trajectory, depth, stops, 0.5, threads) for threads in (1, 2, 5)]
    np.testing.assert_array_equal(found[0], found[1])
    np.testing.assert_array_equal(found[0], found[2])


@pytest.mark.parametrize("stops", [[0, 100 * MS], [0, 3, 50 * MS, 100 * MS], [40 * MS], [40 * MS, 40 * MS + 1]])
@pytest.mark.parametrize("what", ["stands still", "sees nothing"])
def test_without_motion_or_anything_to_see_there_are_the_stops_alone(stops, what):
    camera, moves = CAMERAS["radtan"], what == "sees nothing"
    trajectory = moving(moves, moves, 100 * MS)
    depth = np.zeros((36, 48), np.float32) if moves else np.ones((36, 48), np.float32)
    assert render_times(camera, trajectory, lambda _: depth, np.array(stops)).tolist() == stops


def test_what_is_seen_in_one_pixel_alone_is_followed():
    camera, trajectory = CAMERAS["pinhole"], moving(True, False, 100 * MS)
    depth = np.zeros((36, 48), np.float32)
    depth[20, 7] = 0.5
    assert len(render_times(camera, trajectory, lambda _: depth, np.array([0, 100 * MS]))) > 50


def test_a_camera_that_stops_for_a_while_is_rendered_while_it_moves():
    times = np.arange(101) * MS
    steps = np.clip(np.arange(101) - 20, 0, 20) + np.clip(np.arange(101) - 70, 0, 20)
    positions = np.stack([0.01 * steps, 0 * steps, 0 * steps], axis=1)
    trajectory = Trajectory(times, positions, np.tile([0.0, 0, 0, 1], (101, 1)))
    camera = CAMERAS["pinhole"]
    found = render_times(camera, trajectory, lambda _: np.ones((36, 48), np.float32), times[[0, -1]], 0.5)
    assert len(found) == pytest.approx(2 * 20 * 0.01 * 45 / 0.5, rel=0.1)
    still = (found > 0) & (found < 18 * MS) | (found > 42 * MS) & (found < 68 * MS) | (found > 92 * MS)
    assert still[:-1].sum() <= 3


def test_no_point_of_a_scene_moves_further_than_asked_between_two_times():
    made = SCENES["shapes"](np.random.default_rng(0))
    camera = Camera(48, 36, 40.0, 40.0, 24.0, 18.0)
    renderer = Renderer(made, camera)
    trajectory = MOTIONS["shake"](2 * 10**8, made.camera, made.target, np.random.default_rng(1))
    stops = np.array([0, 12_345_678, 2 * 10**8])

    def depth(time_ns: int) -> np.ndarray:
        return renderer.depth(trajectory.poses(torch.tensor(time_ns)).numpy())

    times = render_times(camera, trajectory, depth, stops, 0.5)
    assert np.isin(stops, times).all() and (np.diff(times) > 0).all()
    poses = trajectory.poses(torch.from_numpy(times)).numpy()
    rays = camera.pixel_directions().reshape(-1, 3)
    furthest = []
    for pose, following in pairwise(poses):
        world = rays * renderer.depth(pose).reshape(-1, 1) @ pose[:, :3].T + pose[:, 3]
        seen = (world - following[:, 3]) @ following[:, :3]
        furthest.append(np.linalg.norm(40 * (seen / seen[:, 2:] - rays), axis=1).max())
    assert 0.4 < max(furthest) < 0.55


def test_a_thin_thing_close_by_moves_no_further_than_asked():
    """A pole, 2 pixels wide and 0.6 m away, before a wall at 20 m."""
    camera = Camera(400, 9, 300.0, 300.0, 200.0, 4.0)
    times = np.arange(41) * 5 * MS
    x = 0.2 * np.arange(41) / 40
    trajectory = Trajectory(times, np.stack([x, 0 * x, 0 * x], axis=1), np.tile([0.0, 0, 0, 1], (41, 1)))
    columns = camera.pixel_directions()[0, :, 0]

    def depth(time_ns: int) -> np.ndarray:
        pole = np.abs(0.6 * columns + np.interp(time_ns, times, x) - 0.123) < 0.002
        return np.tile(np.where(pole, 0.6, 20.0).astype(np.float32), (9, 1))

    found = render_times(camera, trajectory, depth, times[[0, -1]], 0.5)
    moved = 300 * np.diff(np.interp(found, times, x)) / 0.6
    assert 0.4 < moved.max() < 0.52

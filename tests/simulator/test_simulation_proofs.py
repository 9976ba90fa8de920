"""From a scene to its events: what they rebuild, their times against closed forms, blur against its integral."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from functools import cache
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from recordings import joined
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.recording import Events
from enerf_ns.dataparsers.recording.trajectory import Trajectory
from enerf_ns.sensor.response import Logarithm
from enerf_ns.simulator.engine import simulate
from enerf_ns.simulator.event_sensor import EventSensor, SensorSettings
from enerf_ns.simulator.frames import Exposures, Frame
from enerf_ns.simulator.sampling import MAX_CHANGE, MAX_DISPLACEMENT, adaptive_renders, render_times
from enerf_ns.simulator.scene.render import Renderer
from enerf_ns.simulator.scene.scenes import SCENES, Scene, Surface, build_scene
from enerf_ns.simulator.settings import SimulationSettings
from enerf_ns.simulator.sources import RenderedScene, Source
from enerf_ns.simulator.trajectories import MOTIONS

EPS = 0.001
MS, SECOND = 10**6, 10**9


def camera_of(width: int, height: int, focal_length: float) -> Camera:
    """Without distortion, looking along the middle of its picture."""
    return Camera(width, height, focal_length, focal_length, (width - 1) / 2, (height - 1) / 2)


@cache
def scene_of(name: str) -> Scene:
    return SCENES[name](np.random.default_rng(0)).grey()


@cache
def shaken(name: str, width: int = 40, height: int = 30, duration: int = 150 * MS) -> RenderedScene:
    """A scene that is seen by a camera that shakes."""
    scene = scene_of(name)
    trajectory = MOTIONS["shake"](duration, scene.camera, scene.target, np.random.default_rng(1))
    focal_length = width / 2 / math.tan(math.radians(30))
    return RenderedScene(Renderer(scene, camera_of(width, height, focal_length)), trajectory)


def moves(positions: np.ndarray, duration: int, roll: float = 0.0) -> Trajectory:
    """Through these positions in equal times, looking along z, rolled by an angle."""
    rotation = np.array([0, 0, math.sin(roll / 2), math.cos(roll / 2)])
    times = np.linspace(0, duration, len(positions)).astype(np.int64)
    return Trajectory(times, np.array(positions, float), np.tile(rotation, (len(positions), 1)))


def times_of(source: RenderedScene, stops: np.ndarray, max_displacement: float = MAX_DISPLACEMENT) -> np.ndarray:
    return render_times(source.renderer.camera, source.trajectory, source.depth, stops, max_displacement)


def events_of(source: Source, times: np.ndarray, settings: SensorSettings, threads: int = 2) -> Events:
    first, *renders = adaptive_renders(source.brightness, times, response=Logarithm(EPS), threads=threads)
    sensor = EventSensor(settings, first.brightness, first.time)
    pieces = [sensor.advance(picture, time, before) for time, picture, before in renders]
    return joined([*pieces, sensor.finish()])


def rebuilt_at(events: Events, times: np.ndarray, threshold: float, shape: tuple[int, int]) -> np.ndarray:
    """Sum of each pixel's events until each time, [times, height, width]."""
    order = np.searchsorted(events.t, times, side="right")
    sums, total, done = [], np.zeros(shape), 0
    for count in order.tolist():
        np.add.at(total, (events.y[done:count], events.x[done:count]), events.p[done:count])
        sums.append(threshold * total)
        done = count
    return np.stack(sums)


def slow(*values: object):
    return pytest.param(*values, marks=pytest.mark.slow)


@pytest.mark.sweep(2)
@pytest.mark.parametrize(
    ("name", "size"),
    [
        ("carpet", (80, 60)),
        ("shapes", (80, 60)),
        slow("roads", (80, 60)),
        slow("moon", (80, 60)),
        slow("shapes", (160, 120)),
        slow("board", (160, 120)),
    ],
)
def test_summed_events_stay_within_a_threshold_of_the_brightness_at_any_time(name, size):
    """But for few pixels and times. Between the times at which a pixel is rendered its log brightness strays from a
    line by a hundredth, which matters to as many as are that close to a threshold. And a pixel is the mean of 16
    samples: where an edge, or a letter, just reaches into one of them and turns back, that may show only between
    renders. The fewer pixels a picture has, the finer is what there is to see in each."""
    source, threshold = shaken(name, *size), 0.25
    times = times_of(source, np.array([source.start, source.end]))
    events = events_of(source, times, SensorSettings(contrast_thresholds=(threshold, threshold)))
    at = np.sort(np.random.default_rng(2).integers(source.start, source.end, 150))
    sums = rebuilt_at(events, at, threshold, (source.camera.height, source.camera.width))
    true = np.stack([np.log(EPS + source.brightness(time)) for time in at.tolist()])
    error = np.abs(true - np.log(EPS + source.brightness(source.start)) - sums)
    assert (error <= threshold).mean() >= 0.995
    assert (error <= threshold + 0.03).mean() >= 0.999
    assert np.ptp(true, axis=0).mean() > 2 * threshold and len(events) > 10 * sums[0].size


@pytest.mark.sweep(2)
@pytest.mark.parametrize(
    ("name", "size"),
    [
        ("carpet", (40, 30)),
        ("roads", (80, 60)),
        slow("moon", (80, 60)),
        slow("shapes", (160, 120)),
    ],
)
def test_twice_as_many_renders_create_and_lose_hardly_an_event(name, size):
    """Both rebuild the brightness at the end to a threshold, so that a pixel's sum differs by one event at most; others
    come and go in pairs, where a pixel turns between two renders."""
    source = shaken(name, *size)
    stops = np.array([source.start, source.end])
    counts, sums = [], []
    for max_displacement in (MAX_DISPLACEMENT, MAX_DISPLACEMENT / 2):
        times = times_of(source, stops, max_displacement)
        events = events_of(source, times, SensorSettings())
        counts.append(len(events))
        sums.append(np.zeros((source.camera.height, source.camera.width)))
        np.add.at(sums[-1], (events.y, events.x), events.p)
    assert counts[1] > 5000
    assert abs(counts[0] - counts[1]) <= 0.01 * counts[1]
    assert np.abs(sums[0] - sums[1]).max() <= 1


PERIOD, SWING, MIDDLE = 60.0, 0.9, -1.2
"""Wavelength (pixels), amplitude and mean (log brightness) of a texture whose log brightness is a sine."""


def waves(speed: float, duration: int) -> RenderedScene:
    """A plane in that texture a metre away from a camera that moves to its right by so many pixels a second."""
    focal_length, size = 60.0, 128
    columns = (np.arange(size) + 0.5) / size
    texture = np.exp(MIDDLE + SWING * np.sin(2 * np.pi * columns)) - EPS
    corners = np.array([[-20.0, -2, 1], [20, -2, 1], [20, 2, 1], [-20, 2, 1]])[[[0, 1, 2], [0, 2, 3]]]
    image = np.broadcast_to(texture[None, :, None], (size, size, 1))
    plane = Surface(corners, corners[..., :2] * (focal_length / PERIOD), np.ones((2, 3, 1)), image)
    scene = build_scene([plane], (0, 0, 0), (0, 0, 1))
    end = [speed / focal_length * duration / SECOND, 0, 0]
    return RenderedScene(Renderer(scene, camera_of(48, 4, focal_length)), moves(np.array([[0, 0, 0], end]), duration))


def crossings_of_sine(phase: float, speed: float, duration: float, threshold: float) -> list[tuple[float, float, int]]:
    """Times (s), levels (from the middle) and polarities at which SWING sin(phase + speed t) is a threshold away from
    where it was at the last one: from turn to turn, with the arc sine."""
    memorised = SWING * math.sin(phase)
    turns = np.pi / 2 + np.pi * np.arange(math.floor(phase / np.pi) - 1, (phase + speed * duration) / np.pi + 2)
    bounds = [phase, *turns[(turns > phase) & (turns < phase + speed * duration)], phase + speed * duration]
    found = []
    for begin, end in pairwise(bounds):
        rises = 1 if math.cos((begin + end) / 2) > 0 else -1
        centre = np.pi * round((begin + end) / 2 / np.pi)  # where the sine is 0 between these turns
        while rises * (SWING * math.sin(end) - memorised) >= threshold:
            memorised += rises * threshold
            angle = centre + rises * math.asin(memorised / SWING)
            found.append(((angle - phase) / speed, memorised, rises))
    return found


@pytest.mark.parametrize(
    ("max_displacement", "error"), [(MAX_DISPLACEMENT, 0.002), (8.0, 1.25 * MAX_CHANGE**2 / 8 + 0.002)]
)
def test_a_translating_texture_fires_when_its_wave_has_moved_by_a_threshold(max_displacement, error):
    """Log brightness at the time of an event is that of the closed form but for the error of the line it is found on,
    and that of rendering: bilinear interpolation between 128 texels a period, and the mean over a 60th of it.

    At 8 pixels a picture it is the pixels between pictures that keep to it."""
    speed, duration, threshold = 400.0, 400 * MS, 0.23
    source = waves(speed, duration)
    times = times_of(source, np.array([0, duration]), max_displacement)
    assert len(times) == pytest.approx(speed * duration / SECOND / max_displacement, abs=3)
    events = events_of(source, times, SensorSettings(contrast_thresholds=(threshold, threshold)))
    turn = 2 * np.pi / PERIOD
    delays = []
    for y, x in np.ndindex(4, 48):
        phase = turn * (x - 23.5)
        start = SWING * math.sin(phase)
        above, below = (SWING - start) / threshold, (SWING + start) / threshold
        if any(abs(SWING - abs(start + n * threshold)) < 2 * error for n in range(-8, 9)):
            continue  # whether the wave reaches this level before it turns is not known as exactly
        mine = (events.x == x) & (events.y == y)
        expected = crossings_of_sine(phase, turn * speed, duration / SECOND, threshold)
        assert events.p[mine].tolist() == [polarity for *_, polarity in expected]
        t, levels = np.array([row[:2] for row in expected]).T
        found = events.t[mine] / SECOND
        np.testing.assert_allclose(SWING * np.sin(phase + turn * speed * found), levels, rtol=0, atol=error)
        delays.append(np.abs(found - t))
        in_last_period = found > duration / SECOND - PERIOD / speed
        assert np.count_nonzero(in_last_period) == 2 * (math.floor(above) + math.floor(below))
    assert len(delays) > 4 * 20
    assert np.median(np.concatenate(delays)) < error / (SWING * turn * speed)


def test_the_rate_of_events_is_gradient_times_flow_over_the_threshold():
    """In every bin of 20 ms and pixel in which, and before which, log brightness does not turn: to one event."""
    speed, duration, threshold = 300.0, 300 * MS, 0.02
    source = waves(speed, duration)
    events = events_of(
        source, times_of(source, np.array([0, duration])), SensorSettings(contrast_thresholds=(threshold, threshold))
    )
    bins = np.arange(0, duration + 1, 20 * MS)
    found = np.histogramdd((events.t, events.y, events.x), (bins, np.arange(5) - 0.5, np.arange(49) - 0.5))[0]
    turn = 2 * np.pi / PERIOD
    at = np.linspace(0, duration, 15 * 200 + 1)[:-1].reshape(15, 200, 1) + duration / 6000
    gradient = SWING * turn * np.cos(turn * (np.arange(48) - 23.5 + speed * at / SECOND))  # per pixel, to the right
    expected = np.abs(gradient.sum(axis=1)) * speed * (20 * MS / SECOND / 200) / threshold
    one_way = np.abs(np.sign(gradient).sum(axis=1)) == 200
    began = np.concatenate([np.zeros((1, 48), bool), ~one_way[:-1]])  # what was left over must first be made up for
    steady = one_way & ~began
    assert steady.mean() > 0.4
    assert (np.abs(found - expected[:, None]).max(axis=1)[steady] <= 1.1).all()
    assert found.sum(axis=1)[steady].sum() == pytest.approx(4 * expected[steady].sum(), rel=0.01)


class Ramps:
    """Pixels whose log brightness is linear in time, each with another slope."""

    width, height = 6, 4
    start, end = 1_234_567, 1_234_567 + 100 * MS
    change = np.linspace(-2.9, 3.1, 24)

    def brightness(self, time: int, pixels: np.ndarray | None = None) -> np.ndarray:
        share = (time - self.start) / (self.end - self.start)
        picture = np.exp(-3.2 + self.change * (share - 0.5)) - EPS
        return picture.reshape(4, 6) if pixels is None else picture[pixels]


@pytest.mark.parametrize("pictures", [2, 8, 101])
def test_a_brightness_ramp_gives_exactly_the_times_of_its_events(pictures):
    """The n-th n thresholds into the ramp, to the nanosecond that it is rounded to, and floor(change / C) of them;
    however many pictures there are, and whichever pixels are rendered between them."""
    source, (on, off) = Ramps(), (0.25, 0.17)
    times = np.linspace(source.start, source.end, pictures).astype(np.int64)
    events = events_of(source, times, SensorSettings(contrast_thresholds=(on, off)))
    assert (np.diff(events.t) >= 0).all()
    for pixel, change in enumerate(source.change.tolist()):
        mine = events.y * 6 + events.x == pixel
        threshold = on if change > 0 else off
        n = np.arange(1, math.floor(abs(change) / threshold) + 1)
        exact = source.start + n * threshold / abs(change) * (source.end - source.start)
        np.testing.assert_allclose(events.t[mine], np.ceil(exact), rtol=0, atol=1)
        assert (events.p[mine] == np.sign(change)).all()


def test_a_ramp_from_image_to_image_of_a_folder_gives_the_times_of_its_events(tmp_path):
    """Images are held in single precision, which moves times by some ten nanoseconds."""
    (tmp_path / "images").mkdir()
    levels = np.random.default_rng(0).integers(300, 65536, (2, 5, 7)).astype(np.uint16)
    for k in range(2):
        cv2.imwrite(str(tmp_path / f"images/{k}.png"), levels[k])
    simulate(
        SimulationSettings(
            str(tmp_path / "images"),
            layout="event_recording",
            frames_per_second=10.0,
            gamma=False,
            num_frames=4,
            exposure_ms=10.0,
            sensor=SensorSettings(contrast_thresholds=(0.11, 0.13)),
        ),
        tmp_path / "recording",
    )
    x, y, t, p = (np.load(tmp_path / f"recording/events/{name}.npy") for name in "xytp")
    first, last = np.log(EPS + levels / 65535)
    total = 0
    for row, column in np.ndindex(5, 7):
        mine, change = (x == column) & (y == row), last[row, column] - first[row, column]
        threshold = 0.11 if change > 0 else 0.13
        n = np.arange(1, math.floor(abs(change) / threshold) + 1)
        np.testing.assert_allclose(t[mine], n * threshold / abs(change) * 100 * MS, rtol=0, atol=100)
        assert (np.where(p[mine] > 0, 1, -1) == np.sign(change)).all()
        total += len(n)
    assert len(t) == total > 100


BRIGHT, DARK = 0.9, 0.2


def edge(roll: float) -> RenderedScene:
    """A straight edge between bright and dark that 40 ms of motion bring from the left to the right of the picture, by
    0.3 pixels a millisecond; the camera is rolled by an angle."""
    halves = []
    for side, brightness in ((-1, BRIGHT), (1, DARK)):
        corners = np.array([[0.0, -9, 1], [9 * side, -9, 1], [9 * side, 9, 1], [0, 9, 1]])[[[0, 1, 2], [0, 2, 3]]]
        shade = np.full((2, 3, 1), brightness)
        halves.append(Surface(corners, np.zeros((2, 3, 2)), shade, np.ones((1, 1, 1))))
    scene = build_scene(halves, (0, 0, 0), (0, 0, 1))
    positions = np.array([[6.0 / 20, 0, 0], [-6.0 / 20, 0, 0]])
    return RenderedScene(Renderer(scene, camera_of(24, 10, 20.0)), moves(positions, 40 * MS, roll))


def blurred(source: RenderedScene, exposures: Exposures) -> Frame:
    """The one frame."""
    frames = [
        exposures.add(render.time, render.brightness)
        for render in adaptive_renders(source.brightness, times_of(source, exposures.stops))
    ]
    (frame,) = [frame for frame in frames if frame is not None]
    return frame


@pytest.mark.parametrize("roll", [0.0, 0.4, -1.1])
def test_blur_of_a_moving_edge_is_its_integral(roll):
    """Renders half a pixel apart are to the closed form within 2 percent of the step, since 16 samples show an edge in
    steps of a 16th, and the trapezoids cut the corners where it enters a pixel and leaves it."""
    source = edge(roll)
    start, end = 8 * MS, 32 * MS
    frame = blurred(source, Exposures(np.array([20 * MS]), end - start))
    assert frame.blurred is not None
    times = start + (np.arange(256) + 0.5) / 256 * (end - start)
    mean = np.mean([source.brightness(int(time)) for time in times], axis=0)
    step = BRIGHT - DARK
    np.testing.assert_allclose(frame.blurred, mean, rtol=0, atol=0.02 * step)

    # the camera turns by the angle, so that the normal of the edge turns back
    across, along = math.cos(roll), -math.sin(roll)
    rows, columns = np.mgrid[:10, :24]
    place = (columns - 11.5) * across + (rows - 4.5) * along

    def lit_until(passed: float) -> np.ndarray:
        """Integral over how far the edge has come of the share of a pixel that is lit: of the area behind it, whose
        shadow on the normal is a trapezoid."""
        wide, tall = abs(across) / 2, max(abs(along), 1e-6) / 2
        cubes = [np.clip(passed - place + i * wide + j * tall, 0, None) ** 3 * i * j for i in (1, -1) for j in (1, -1)]
        return np.sum(cubes, axis=0) / (24 * wide * tall)

    begin, reached = (-6 + 0.3 * time / MS for time in (start, end))
    share = (lit_until(reached) - lit_until(begin)) / (reached - begin)
    np.testing.assert_allclose(frame.blurred, DARK + step * share, rtol=0, atol=0.02 * step)
    assert np.ptp(frame.blurred) > 0.9 * step and np.abs(frame.blurred - frame.sharp).max() > 0.4 * step


def recorded(folder: Path, seed: int, scene: str = "carpet") -> Path:
    noisy = SensorSettings(
        contrast_thresholds=(0.2, 0.3), threshold_spread=0.05, shot_noise_rate=3.0, timestamp_jitter=1e5,
        refractory_period=50_000, seed=seed,
    )  # fmt: skip
    simulate(
        SimulationSettings(scene, duration=0.15, num_frames=12, exposure_ms=10.0, width=24, height=18, sensor=noisy),
        folder,
    )
    return folder


def test_a_recording_read_back_has_the_trajectory_that_was_rendered(tmp_path):
    read = read_recording(recorded(tmp_path / "recording", seed=3))
    scene_rng, motion_rng = np.random.default_rng(3).spawn(2)
    scene = SCENES["carpet"](scene_rng)
    rendered = MOTIONS["shake"](150 * MS, scene.camera, scene.target, motion_rng)
    times = torch.from_numpy(np.random.default_rng(0).integers(0, 150 * MS, 500))
    expected, found = rendered.poses(times).numpy(), read.trajectory.poses(times).numpy()
    np.testing.assert_allclose(found[..., 3], expected[..., 3], rtol=0, atol=1e-9)
    turned = Rotation.from_matrix(found[..., :3]).inv() * Rotation.from_matrix(expected[..., :3])
    assert turned.magnitude().max() < 1e-8
    assert np.linalg.norm(np.ptp(expected[..., 3], axis=0)) > 0.05  # metres
    assert read.frames is not None
    length = 150 * MS / 12
    np.testing.assert_allclose(read.frames.times, (np.arange(12) + 0.5) * length, rtol=0, atol=1000)
    assert read.contrast_thresholds == (0.2, 0.3)


@pytest.mark.parametrize("name", ["carpet", "shapes"])
def test_events_are_the_same_whatever_the_number_of_threads(name):
    source = shaken(name)
    times = times_of(source, np.array([source.start, source.end]))
    settings = SensorSettings(threshold_spread=0.05, shot_noise_rate=5.0, timestamp_jitter=1e5, cutoff_frequency=100.0)
    one, *others = (events_of(source, times, settings, threads) for threads in (1, 2, 4))
    assert len(one) > 3000
    for events in others:
        for column in "xytp":
            np.testing.assert_array_equal(getattr(events, column), getattr(one, column))


def events_written(folder: Path) -> np.ndarray:
    return np.concatenate([np.load(file) for file in sorted((folder / "events").glob("*.npy"))])


@pytest.mark.slow
def test_another_process_makes_the_same_events_of_the_same_seed_and_others_of_another(tmp_path):
    one = events_written(recorded(tmp_path / "one", seed=5))
    other = tmp_path / "other"
    code = f"from test_simulation_proofs import recorded, Path; recorded(Path({str(other)!r}), seed=5)"
    paths = os.pathsep.join(path for path in sys.path if path)
    subprocess.run([sys.executable, "-c", code], check=True, env={**os.environ, "PYTHONPATH": paths})
    np.testing.assert_array_equal(events_written(other), one)
    different = events_written(recorded(tmp_path / "different", seed=6))
    assert len(one) > 1000 and (len(different) != len(one) or (different != one).any())

"""Frames against closed forms: the integral over the exposure, grey levels, and the spread of the noise."""

from __future__ import annotations

import numpy as np
import pytest

from enerf_ns.dataparsers.recording.errors import FlagError
from enerf_ns.simulator.frames import Exposures, Frame, FrameSettings, develop

MS = 1_000_000
WIDTH, HEIGHT = 40, 3


def edge(position: float) -> np.ndarray:
    """A step at x = position, from 0.2 on its right to 0.9 on its left: the mean over each pixel's area."""
    lit = np.clip(position - np.arange(WIDTH) + 0.5, 0, 1)
    return np.broadcast_to(0.2 + 0.7 * lit, (HEIGHT, WIDTH))


def expose(exposures: Exposures, times: np.ndarray, picture) -> list[Frame]:
    frames = [exposures.add(time, picture(time)) for time in times.tolist()]
    return [frame for frame in frames if frame is not None]


def test_blur_of_a_moving_edge_is_its_integral():
    """The edge enters pixel x at x - 1/2 and leaves it at x + 1/2; its brightness is a ramp of time in between."""
    exposures = Exposures(np.array([20 * MS]), 30 * MS)
    start, speed = 3.3, 0.5 / MS  # 15 pixels within the exposure

    def position(time):
        return start + speed * (time - 5 * MS)

    crossings = 5 * MS + (np.arange(WIDTH + 1) - 0.5 - start) / speed
    times = np.concatenate([exposures.stops, np.rint(crossings[(crossings > 5 * MS) & (crossings < 35 * MS)])])
    (frame,) = expose(exposures, np.unique(times.astype(np.int64)), lambda time: edge(position(time)))

    def lit_since(p):  # integral over position of the share of the pixel that is lit
        into = np.clip(p - np.arange(WIDTH) + 0.5, 0, 1)
        return into**2 / 2 + np.clip(p - np.arange(WIDTH) - 0.5, 0, None)

    share = (lit_since(position(35 * MS)) - lit_since(position(5 * MS))) / 15
    assert frame.blurred is not None
    np.testing.assert_allclose(frame.blurred, np.broadcast_to(0.2 + 0.7 * share, (HEIGHT, WIDTH)), atol=1e-7)
    np.testing.assert_array_equal(frame.sharp, edge(position(20 * MS)))
    assert np.abs(frame.sharp - frame.blurred).max() > 0.3


def test_trapezoids_are_exact_for_linear_brightness_at_irregular_times():
    rng = np.random.default_rng(0)
    frame_times = np.array([10, 31, 55]) * MS
    exposures = Exposures(frame_times, 8 * MS)
    slope, level = rng.uniform(0, 0.01, (HEIGHT, WIDTH, 3)) / MS, rng.uniform(0, 0.3, (HEIGHT, WIDTH, 3))
    times = np.unique(np.concatenate([exposures.stops, rng.integers(0, 70 * MS, 200)]))
    frames = expose(exposures, times, lambda time: level + slope * time)
    assert [(frame.number, frame.time) for frame in frames] == list(enumerate(frame_times.tolist()))
    for frame in frames:
        assert frame.blurred is not None
        np.testing.assert_allclose(frame.blurred, level + slope * frame.time, rtol=1e-12)
        np.testing.assert_array_equal(frame.sharp, level + slope * frame.time)


def test_the_error_of_the_integral_falls_with_the_square_of_the_step():
    errors = []
    for count in (5, 9, 17):
        exposures = Exposures(np.array([20 * MS]), 40 * MS)
        (frame,) = expose(exposures, np.linspace(0, 40 * MS, count).astype(int), lambda t: np.sin([[t / (15 * MS)]]))
        exact = (1 - np.cos(40 / 15)) / (40 / 15)
        assert frame.blurred is not None
        errors.append(abs(frame.blurred[0, 0] - exact))
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.1) and errors[1] / errors[2] == pytest.approx(4, rel=0.1)


def test_exposures_that_touch_share_the_picture_between_them():
    exposures = Exposures(np.array([10, 30, 50]) * MS, 20 * MS)
    frames = expose(exposures, np.arange(0, 61, 5) * MS, lambda time: np.full((1, 1), time / MS))
    blurred = [frame.blurred.item() for frame in frames if frame.blurred is not None]
    assert blurred == pytest.approx([10, 30, 50])


def test_without_exposure_there_are_sharp_frames_alone():
    exposures = Exposures(np.array([0, 7, 9]), 0)
    frames = expose(exposures, np.arange(12), lambda time: np.full((1, 1), time))
    assert [(frame.time, frame.sharp.item(), frame.blurred) for frame in frames] == [
        (0, 0, None),
        (7, 7, None),
        (9, 9, None),
    ]


def test_pictures_are_not_changed():
    pictures = [np.full((2, 2), 0.25, np.float32) for _ in range(3)]
    exposures = Exposures(np.array([10]), 20)
    for time, picture in zip((0, 10, 20), pictures, strict=True):
        exposures.add(time, picture)
    assert all((picture == 0.25).all() for picture in pictures)


@pytest.mark.parametrize("left_out", [0, 1, 2])
def test_a_picture_that_is_left_out_is_noticed(left_out: int):
    exposures = Exposures(np.array([10]), 20)
    times = [time for number, time in enumerate((0, 10, 20)) if number != left_out]
    with pytest.raises(ValueError, match="Frame 0 needs pictures at 0, 10 and 20 ns"):
        for time in [-5, *times, 25]:
            exposures.add(time, np.zeros((1, 1)))


@pytest.mark.parametrize("exposure", [21 * MS, -1])
def test_exposures_longer_than_the_frame_interval_are_refused(exposure: int):
    with pytest.raises(FlagError, match=rf"exposure of {exposure * 1e-6:g} ms does not fit frames 20 ms apart"):
        Exposures(np.array([10, 30, 60]) * MS, exposure)
    Exposures(np.array([10, 30, 60]) * MS, 20 * MS)


@pytest.mark.parametrize(
    ("brightness", "level"),
    [(0, 0), (0.49 / 255, 0), (0.51 / 255, 1), (0.5, 128), (254.4 / 255, 254), (1, 255), (1.7, 255)],
)
def test_grey_levels_are_rounded_to_the_nearest(brightness: float, level: int):
    image = develop(np.full((2, 3), brightness), FrameSettings(), 0, False)
    assert image.dtype == np.uint8 and (image == level).all()


def test_pixels_saturate_at_the_saturation():
    brightness = np.array([[0.0, 1.0, 2.0, 4.0, 5.0]])
    np.testing.assert_array_equal(
        develop(brightness, FrameSettings(saturation=4.0), 0, False), [[0, 64, 128, 255, 255]]
    )


def test_read_noise_has_its_standard_deviation_at_any_brightness():
    for brightness in (0.3, 0.7):
        image = develop(np.full((300, 300), brightness), FrameSettings(read_noise=5.0), 0, False).astype(float)
        assert image.mean() == pytest.approx(255 * brightness, abs=0.1)
        assert image.std() == pytest.approx(np.hypot(5, np.sqrt(1 / 12)), rel=0.01)


def test_shot_noise_is_that_of_the_electrons():
    """The standard deviation of n electrons is the square root of n."""
    for brightness in (0.1, 0.5):
        settings = FrameSettings(saturation=1.25, shot_noise=1000.0)
        image = develop(np.full((300, 300), brightness), settings, 0, False).astype(float)
        electrons = 1000 * brightness / 1.25
        assert image.mean() == pytest.approx(255 * brightness / 1.25, abs=0.1)
        assert image.std() == pytest.approx(np.hypot(255 * np.sqrt(electrons) / 1000, np.sqrt(1 / 12)), rel=0.015)


def test_noise_is_of_the_seed_the_frame_and_whether_it_is_blurred():
    brightness = np.full((20, 20, 3), 0.5)

    def noisy(seed: int = 1, number: int = 4, blurred: bool = False) -> np.ndarray:
        return develop(brightness, FrameSettings(read_noise=3.0, shot_noise=500.0), number, blurred, seed)

    np.testing.assert_array_equal(noisy(), noisy())
    assert not any((other == noisy()).all() for other in (noisy(seed=2), noisy(number=5), noisy(blurred=True)))
    assert (noisy()[..., 0] != noisy()[..., 1]).any()


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (dict(saturation=0.0), "^--frame.saturation is 0, but must be a brightness from 1e-09 to 1e9.$"),
        (dict(saturation=float("nan")), "^--frame.saturation is nan"),
        (dict(read_noise=-1.0), "^--frame.read-noise is -1, but must be grey levels from 0 to 1e9.$"),
        (dict(shot_noise=float("inf")), "^--frame.shot-noise is inf, but must be electrons from 0 to 1e9.$"),
    ],
)
def test_settings_out_of_range_are_refused(wrong: dict, message: str):
    with pytest.raises(FlagError, match=message):
        FrameSettings(**wrong)

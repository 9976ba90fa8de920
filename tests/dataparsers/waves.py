"""Pixels whose log brightness is a sum of waves in closed form, the events of a sensor that sees them, and frames."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
from PIL import Image

from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.recording import EventRecording, Events, Frames
from enerf_ns.dataparsers.recording.trajectory import Trajectory

WIDTH, HEIGHT = 48, 36
STEP = 250_000  # ns
BLOCK = 4
"""Side of the squares of pixels that see the same waves, each pixel a little later than the one before."""
CAMERA = Camera(WIDTH, HEIGHT, 50.0, 50.0, 23.5, 17.5)


@cache
def waves() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Angular frequency, size and phase of the three waves of each pixel; float64 [waves, pixels]."""
    generator = np.random.default_rng(0)
    blocks = WIDTH // BLOCK * (HEIGHT // BLOCK)
    frequency, phase = generator.uniform(0.5, 4.0, (3, blocks)), generator.uniform(0, 2 * np.pi, (3, blocks))
    size = generator.dirichlet(np.ones(3), blocks).T
    y, x = np.divmod(np.arange(WIDTH * HEIGHT), WIDTH)
    block = y // BLOCK * (WIDTH // BLOCK) + x // BLOCK
    return 2 * np.pi * frequency[:, block], size[:, block], phase[:, block] + 0.1 * (x + y)


def log_brightness(time: float) -> np.ndarray:
    """Log brightness of each pixel at a time (s), between that of 30 and of 220 grey levels; float64 [pixels]."""
    frequency, size, phase = waves()
    low, high = np.log(30 / 255), np.log(220 / 255)
    return (low + high) / 2 + (high - low) / 2 * (size * np.sin(frequency * time + phase)).sum(0)


@cache
def events_of_waves(
    thresholds: tuple[float, float], duration: float, blind_for: int = 0, spread: float = 0.0
) -> Events:
    """Step by step: a pixel fires once for each threshold that its brightness has moved by; then it is blind (ns), if
    at all, and memorises anew what it sees."""
    generator = np.random.default_rng(1)
    on, off = np.array(thresholds)[:, None] * (1 + spread * generator.standard_normal((2, WIDTH * HEIGHT)))
    memory, before = log_brightness(0.0), log_brightness(0.0)
    awake, found = np.zeros(WIDTH * HEIGHT), []
    for step in range(1, int(duration * 1e9) // STEP + 1):
        now = log_brightness(step * STEP * 1e-9)
        seeing = awake <= step * STEP
        waking = seeing & (awake > (step - 1) * STEP)
        memory[waking] = now[waking]
        for sign, threshold in ((1, on), (-1, off)):
            while (
                fired := np.flatnonzero(seeing & (awake <= step * STEP) & (sign * (now - memory) >= threshold))
            ).size:
                memory[fired] += sign * threshold[fired]
                part = (memory[fired] - before[fired]) / (now - before)[fired]
                times = (step - 1 + part.clip(0, 1)) * STEP
                awake[fired] = times + blind_for if blind_for else 0.0
                found.append(np.stack([fired, times, np.full(len(fired), sign)]))
        before = now
    pixel, times, polarity = np.concatenate(found, axis=1).round().astype(np.int64)
    order = np.argsort(times, kind="stable")
    return Events(pixel[order] % WIDTH, pixel[order] // WIDTH, times[order], polarity[order])


def recording_of(events: Events, folder: Path, frame_times: np.ndarray | None = None) -> EventRecording:
    """The events within a second or more of poses, and frames of the waves at some times (ns)."""
    end = int(events.t[-1]) + 1
    trajectory = Trajectory(np.array([0, end]), np.array([[0.0, 0, 0], [1, 0, 0]]), np.tile([0.0, 0, 0, 1], (2, 1)))
    frames = None
    if frame_times is not None:
        files = tuple(folder / f"{number}.png" for number in range(len(frame_times)))
        for file, time in zip(files, frame_times.tolist(), strict=True):
            levels = 255 * np.exp(log_brightness(time * 1e-9)).reshape(HEIGHT, WIDTH)
            Image.fromarray(levels.round().astype(np.uint8)).save(file)
        frames = Frames(files, frame_times, CAMERA, trajectory)
    return EventRecording(folder, "test", CAMERA, trajectory, lambda: iter([events]), (), frames=frames)

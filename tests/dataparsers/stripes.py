"""Stripes that move past a camera, in closed form: frames of them and the events between."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.recording import EventRecording, Events, Frames
from enerf_ns.dataparsers.recording.trajectory import Trajectory

WIDTH, HEIGHT = 120, 80
SPEED = 200.0  # pixels a second


def stripes(time: float) -> np.ndarray:
    """Slanted bars of several widths that move to the right, uint8 [height, width]."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    place = x + 0.3 * y - SPEED * time
    return np.where((np.sin(place / 5) + np.sin(place / 3.1)) > 0, 200, 40).astype(np.uint8)


def recording_of_stripes(folder: Path, late: int) -> EventRecording:
    """Each pixel fires in the middle of each millisecond in which it changes; frames are stamped late (ns)."""
    events, before = [], stripes(0.0)
    for step in range(1, 1000):
        now = stripes(step * 1e-3)
        y, x = np.nonzero(now != before)
        events.append(
            np.stack([x, y, np.full(len(x), step * 1_000_000 - 500_000), np.where(now > before, 1, -1)[y, x]], axis=1)
        )
        before = now
    x, y, t, p = np.concatenate(events).T
    times = np.arange(200, 801, 50) * 1_000_000
    files = tuple(folder / f"{i}.png" for i in range(len(times)))
    for file, time in zip(files, times, strict=True):
        Image.fromarray(stripes(time * 1e-9)).save(file)
    camera = Camera(WIDTH, HEIGHT, 100.0, 100.0, 59.5, 39.5)
    turn = np.tile([0.0, 0.0, 0.0, 1.0], (2, 1))
    trajectory = Trajectory(np.array([0, 10**9]), np.array([[0.0, 0, 0], [1, 0, 0]]), turn)
    frames = Frames(files, times + late, camera, trajectory)
    return EventRecording(folder, "test", camera, trajectory, lambda: iter([Events(x, y, t, p)]), (), frames=frames)

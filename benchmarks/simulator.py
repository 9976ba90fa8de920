"""Time to make events compared with the time to render their pictures, each on one thread.

    python benchmarks/simulator.py

Prints a Markdown table: medians over pictures of the shake motion, 2500 of them a second.
"""

from __future__ import annotations

import statistics
import time
from typing import Literal

import numpy as np
import torch
import tyro

from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.simulator.event_sensor import EventSensor, SensorSettings
from enerf_ns.simulator.scene.render import Renderer
from enerf_ns.simulator.scene.scenes import SCENES
from enerf_ns.simulator.trajectories import MOTIONS

SENSORS = {
    "ideal": SensorSettings(),
    "noisy": SensorSettings(
        threshold_spread=0.03,
        refractory_period=100_000,
        leak_rate=0.1,
        shot_noise_rate=5.0,
        hot_pixels=1e-4,
        cutoff_frequency=200.0,
        timestamp_jitter=10_000.0,
        readout_rate=5e7,
    ),
}
"""Sensors by name: an ideal one, and one with all effects."""

PICTURES_PER_SECOND = 2500


def main(
    sizes: tuple[tuple[int, int], ...] = ((160, 120), (640, 480)),
    scene: Literal["shapes", "carpet"] = "shapes",
    pictures: int = 50,
) -> None:
    """Time pictures and their events.

    Args:
        sizes: Width and height of the picture.
        scene: What is seen.
        pictures: How many.
    """
    scene_rng, motion_rng = np.random.default_rng(0).spawn(2)
    made = SCENES[scene](scene_rng)
    trajectory = MOTIONS["shake"](10**9, made.camera, made.target, motion_rng)
    times = 10**8 + np.arange(pictures + 2) * (10**9 // PICTURES_PER_SECOND)
    poses = trajectory.poses(torch.from_numpy(times)).numpy()
    print("| size | sensor | events a picture | picture, ms | its events, ms | ratio |\n|---|---|---|---|---|---|")
    for width, height in sizes:
        focal_length = width / 2 / np.tan(np.radians(30))
        camera = Camera(width, height, focal_length, focal_length, width / 2, height / 2)
        renderer = Renderer(made, camera)
        rendering, seen = zip(*(timed(renderer.brightness, pose) for pose in poses), strict=True)
        for name, settings in SENSORS.items():
            sensor = EventSensor(settings, seen[0], int(times[0]))
            firing, events = zip(*map(timed, [sensor.advance] * len(seen[1:]), seen[1:], times[1:]), strict=True)
            count = sum(map(len, events[1:])) / pictures
            render_ms, events_ms = 1e3 * statistics.median(rendering[2:]), 1e3 * statistics.median(firing[1:])
            print(
                f"| {width} x {height} | {name} | {count:.0f} | {render_ms:.1f} | {events_ms:.1f} | "
                f"{events_ms / render_ms:.3f} |",
                flush=True,
            )


def timed(call, *arguments):
    """Duration of a call in seconds, and its result."""
    begin = time.perf_counter()
    result = call(*arguments)
    return time.perf_counter() - begin, result


if __name__ == "__main__":
    tyro.cli(main)

"""Cost and accuracy of simulated events against the rate of rendering.

    python benchmarks/simulator_accuracy.py

Prints a Markdown table for each scene. The reference are events of pictures 1/64 of a pixel of motion apart. Beyond C
is the share of pixels and times at which the brightness that the events add up to is further than a threshold from what
is rendered at that time.
"""

from __future__ import annotations

import time
from typing import Literal

import numpy as np
import tyro

from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.sensor.response import Logarithm
from enerf_ns.simulator.event_sensor import EventSensor, SensorSettings
from enerf_ns.simulator.sampling import adaptive_renders, render_times
from enerf_ns.simulator.scene.render import Renderer
from enerf_ns.simulator.scene.scenes import SCENES
from enerf_ns.simulator.sources import RenderedScene
from enerf_ns.simulator.trajectories import MOTIONS

WIDTH, HEIGHT = 160, 120
START, END = 300_000_000, 350_000_000
THRESHOLD = 0.25
LOOKS = 200
"""Times at which brightness is compared."""

RATES = ((0.5, np.inf), (0.5, 0.5), (0.5, 0.3), (0.5, 0.2), (0.25, 0.3), (0.125, 0.3))
"""Pixels of motion from picture to picture, and change of log brightness from one render of a pixel to the next."""


SceneName = Literal["shapes", "carpet", "roads", "moon", "board"]


def main(scenes: tuple[SceneName, ...] = ("shapes", "roads", "moon")) -> None:
    """Time renders and compare their events.

    Args:
        scenes: What is seen.
    """
    focal_length = WIDTH / 2 / np.tan(np.radians(30))
    camera = Camera(WIDTH, HEIGHT, focal_length, focal_length, WIDTH / 2, HEIGHT / 2)
    for name in scenes:
        scene_rng, motion_rng = np.random.default_rng(0).spawn(2)
        scene = SCENES[name](scene_rng).grey()
        trajectory = MOTIONS["shake"](10**9, scene.camera, scene.target, motion_rng)
        source = RenderedScene(Renderer(scene, camera), trajectory)
        looks = np.sort(np.random.default_rng(0).integers(START, END, LOOKS)).tolist()
        truth = [log_brightness(source.brightness(look)) for look in looks]
        expected = len(simulated(source, 1 / 64, np.inf)[1])
        print(f"\n{name}, {expected} events\n\n| displacement, px | change | seconds | pictures | more, in pictures | "
              "events missed | beyond C | beyond C + 0.03 |\n|---|---|---|---|---|---|---|---|")  # fmt: skip
        for max_displacement, max_change in RATES:
            begin = time.perf_counter()
            first, pixels, times, polarities, pictures, more = simulated(source, max_displacement, max_change)
            seconds = time.perf_counter() - begin
            rebuilt, done, errors = first.copy(), 0, []
            for look, true in zip(looks, truth, strict=True):
                until = np.searchsorted(times, look, side="right")
                np.add.at(rebuilt, pixels[done:until], THRESHOLD * polarities[done:until])
                done = until
                errors.append(np.abs(rebuilt - true))
            beyond = np.stack(errors) - THRESHOLD
            print(
                f"| {max_displacement} | {max_change} | {seconds:.2f} | {pictures} | {more:.1f} | "
                f"{1 - len(pixels) / expected:.2%} | {(beyond > 1e-6).mean():.3%} | {(beyond > 0.03).mean():.4%} |",
                flush=True,
            )


def log_brightness(picture: np.ndarray) -> np.ndarray:
    return Logarithm()(picture.ravel().astype(np.float64))


def simulated(source: RenderedScene, max_displacement: float, max_change: float) -> tuple:
    """Log brightness at the start, pixels, times and polarities of the events, and how much was rendered: pictures, and
    as how many more of them the pixels between pictures count."""
    times = render_times(
        source.renderer.camera, source.trajectory, source.depth, np.array([START, END]), max_displacement
    )
    renders = adaptive_renders(source.brightness, times, max_change)
    first = next(renders).brightness
    sensor = EventSensor(SensorSettings(contrast_thresholds=(THRESHOLD, THRESHOLD)), first, START)
    chunks, more = [], 0
    for render in renders:
        chunks.append(sensor.advance(render.brightness, render.time, render.before))
        more += sum(len(part.pixels) for part in render.before)
    x, y, t, p = (np.concatenate([getattr(chunk, column) for chunk in chunks]) for column in "xytp")
    return log_brightness(first), y.astype(int) * WIDTH + x, t, p, len(times), more / (WIDTH * HEIGHT)


if __name__ == "__main__":
    tyro.cli(main)

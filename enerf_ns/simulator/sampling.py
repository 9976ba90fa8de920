"""Times of rendering, dense enough that events can be interpolated between two pictures."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float32, Int64

from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.trajectory import Trajectory
from enerf_ns.sensor.response import Logarithm, Response
from enerf_ns.simulator.event_sensor import PartialPicture

MOTION_STEP = 1_000_000
"""Nanoseconds between the poses at which displacements are measured."""

STEPS_PER_DEPTH = 5
"""Number of steps of `MOTION_STEP` for each depth image, which is rendered in the middle of them."""

GRID = 64
"""Number of points along each axis of the picture whose displacement is measured; every pixel in a smaller picture.
Each point takes the smallest depth of the pixels from it to the next point."""

MAX_DISPLACEMENT = 0.5
"""Largest motion of a point from one picture to the next, pixels."""

MAX_CHANGE = 0.3
"""Largest change of log brightness of a pixel from one time of rendering to the next."""

MOST_HALVINGS = 3
"""Most halvings of an interval. A pixel is the mean of 16 samples, so that an edge passes it in 16 steps. Three
halvings of half a pixel of motion lead to one such step; more halvings would only resolve the steps."""


class Render(NamedTuple):
    """A picture of a sequence."""

    time: int
    """Time of the picture, ns."""
    brightness: Float[np.ndarray, "height width *channels"]
    """Linear brightness of all pixels."""
    before: list[PartialPicture]
    """Pixels rendered between the last picture and this one, in order of time."""


def render_times(
    camera: Camera,
    trajectory: Trajectory,
    depth: Callable[[int], Float32[np.ndarray, "height width"]],
    stops: Int64[np.ndarray, " stops"],
    max_displacement: float = MAX_DISPLACEMENT,
    threads: int | None = None,
) -> Int64[np.ndarray, " times"]:
    """Times of rendering between which no point of the scene moves further than `max_displacement`.

    The displacement of the fastest point of a grid over the picture is added up from millisecond to millisecond. The
    sum is divided evenly between two stops. Depth is rendered every 5 ms.

    Args:
        camera: Camera that moves.
        trajectory: Trajectory of the camera; covers the stops.
        depth: z-depth at a time (ns), 0 where no surface is seen. Called from several threads.
        stops: Times that must be among the times of rendering, ns, strictly increasing.
        max_displacement: Pixels.
        threads: Number of threads. Default: as many as PyTorch uses.

    Returns:
        Nanoseconds, strictly increasing, from the first stop to the last, all stops among them.
    """
    rows, columns = (np.unique(np.linspace(0, n, GRID, False).astype(int)) for n in (camera.height, camera.width))
    grid = np.ix_(rows, columns)
    rays = camera.pixel_directions()[grid].reshape(-1, 3)
    lengths = np.linalg.norm(rays, axis=1)[:, None, None]
    units = rays[:, :, None] / lengths
    steps = np.zeros((len(rays), 3, 2))
    for axis, step in enumerate(camera.pixel_steps()):
        steps[:, :2, axis] = step[grid].reshape(-1, 2)
    pixels_per_unit = np.linalg.pinv((steps - units * (units * steps).sum(1, keepdims=True)) / lengths)

    count = max(2, -(-int(stops[-1] - stops[0]) // MOTION_STEP) + 1)
    times = np.linspace(stops[0], stops[-1], count).round().astype(np.int64)
    poses = trajectory.poses(torch.from_numpy(times)).numpy()

    def displacements(first: int) -> np.ndarray:
        followed = poses[first : first + STEPS_PER_DEPTH + 1]
        middle = first + len(followed) // 2
        seen_depth = depth(int(times[middle]))
        nearest = np.minimum.reduceat(np.where(seen_depth > 0, seen_depth, np.inf), rows, axis=0)
        depths = np.minimum.reduceat(nearest, columns, axis=1).reshape(-1, 1)
        seen = depths[:, 0] < np.inf
        points = (rays[seen] * depths[seen]) @ poses[middle, :, :3].T + poses[middle, :, 3]
        directions = (points - followed[:, None, :, 3]) @ followed[:, :, :3]
        directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
        moved = np.einsum("nij,snj->sni", pixels_per_unit[seen], np.diff(directions, axis=0))
        return np.linalg.norm(moved, axis=-1).max(axis=1, initial=0)

    with ThreadPoolExecutor(threads or torch.get_num_threads()) as pool:
        parts = list(pool.map(displacements, range(0, count - 1, STEPS_PER_DEPTH)))
    travelled = np.cumsum(np.concatenate([[0], *parts]))
    rendered = [stops]
    for first, second in pairwise(np.interp(stops, times, travelled)):
        between = np.linspace(first, second, int(np.ceil((second - first) / max_displacement)) + 1)[1:-1]
        rendered.append(np.interp(between, travelled, times).astype(np.int64))
    return np.unique(np.concatenate(rendered))


def adaptive_renders(
    brightness: Callable[[int, Int64[np.ndarray, " pixels"] | None], Float[np.ndarray, "*pixels"]],
    times: Int64[np.ndarray, " times"],
    max_change: float = MAX_CHANGE,
    response: Response = Logarithm(),  # noqa: B008, since it cannot be changed
    threads: int | None = None,
) -> Iterator[Render]:
    """Pictures at the given times, and between them the pixels that change too much to be interpolated.

    Events are made from log brightness that is linear between two times of rendering. So log brightness of a pixel
    should change by at most `max_change` between them, and deviate from the line by at most `max_change**2 / 8`: 0.011
    for 0.3. That is the deviation of the logarithm of a brightness that changes linearly by `max_change`. The deviation
    is estimated from second differences, which also find pixels that become darker and brighter again. An interval in
    which a pixel exceeds either limit is halved for this pixel, at most `MOST_HALVINGS` times. The first and the last
    interval have only one second difference.

    The result depends on brightness only, not on threads. A few pictures are rendered ahead. An exception of a render
    is raised in place of its picture or of the picture before.

    Args:
        brightness: Function like `sources.Source.brightness`. Called from several threads.
        times: Times of the whole pictures, ns, strictly increasing.
        max_change: Change of log brightness. If it is infinite, nothing is rendered between pictures.
        response: Response that converts brightness to log brightness.
        threads: Number of threads that render. Default: as many as PyTorch uses.

    Yields:
        Pictures in order of time.
    """
    threads = threads or torch.get_num_threads()
    max_error = max_change**2 / 8
    pictures: dict[int, Future[np.ndarray]] = {}
    partial_pictures: dict[int, Future[list[PartialPicture]]] = {}
    pool = ThreadPoolExecutor(threads)

    def submit(index: int) -> None:
        if index < len(times):
            pictures[index] = pool.submit(brightness, int(times[index]), None)
        earlier = index - threads - 1  # by then a thread has begun every picture that `halve` waits for
        if 0 < earlier < len(times):
            partial_pictures[earlier] = pool.submit(halve, earlier)

    def halve(index: int) -> list[PartialPicture]:
        """The partial pictures in the interval that ends with this picture."""
        if max_change == np.inf:
            return []
        around = range(max(0, index - 2), min(len(times), index + 2))
        seen = [pictures[i].result() for i in around]
        levels = [response(picture.reshape(picture.shape[0] * picture.shape[1], -1)) for picture in seen]
        before, after = levels[index - 1 - around[0]], levels[index - around[0]]
        start, end = times[index - 1 : index + 1].tolist()
        error = np.zeros_like(levels[0])
        for i in range(len(around) - 2):
            bend = _bend(times[around[i : i + 3]] * 1.0, levels[i : i + 3])
            np.maximum(error, bend * np.float32((end - start) ** 2 / 8), out=error)
        return between(start, end, np.arange(len(error)), before, after, error)

    def between(
        start: int, end: int, pixels: np.ndarray, before: np.ndarray, after: np.ndarray, error: np.ndarray, halvings=0
    ) -> list[PartialPicture]:
        """The partial pictures of some pixels in an interval, from their log brightness before and after the interval,
        and the estimated deviation from a line."""
        wrong = ((np.abs(after - before) > max_change) | (error > max_error)).any(axis=1)
        middle = (start + end) // 2
        if halvings == MOST_HALVINGS or middle == start or not wrong.any():
            return []
        pixels, before, after = pixels[wrong], before[wrong], after[wrong]
        picture = PartialPicture(middle, pixels, brightness(middle, pixels))
        here = response(picture.brightness.reshape(before.shape))
        error = np.abs(before - 2 * here + after) / 8
        return [
            *between(start, middle, pixels, before, here, error, halvings + 1),
            picture,
            *between(middle, end, pixels, here, after, error, halvings + 1),
        ]

    try:
        for index in range(2 * threads):
            submit(index)
        for index, time in enumerate(times.tolist()):
            submit(index + 2 * threads)
            picture = pictures[index].result()
            before = partial_pictures.pop(index).result() if index > 0 else []
            yield Render(time, picture, before)
            pictures.pop(index - 2, None)
    finally:
        pool.shutdown(cancel_futures=True)


def _bend(times: np.ndarray, levels: list[np.ndarray]) -> np.ndarray:
    """Magnitude of the second derivative of a curve with three levels at three times."""
    first, second = times[1] - times[0], times[2] - times[1]
    slopes = (levels[2] - levels[1]) / second - (levels[1] - levels[0]) / first
    return np.abs(slopes) * (2 / (first + second))

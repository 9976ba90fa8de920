"""When to render, so that what lies between two pictures is known well enough to make events of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float32, Int64

from enerf_ns.dataparsers.calibration import Camera
from enerf_ns.dataparsers.trajectory import Trajectory
from enerf_ns.simulator.event_sensor import PartialPicture
from enerf_ns.simulator.render import pixel_steps

MOTION_STEP = 1_000_000
"""Nanoseconds from one pose to the next of those between which displacements are measured."""

STEPS_PER_DEPTH = 5
"""Of these steps, for which the points that the camera sees in their middle are followed."""

GRID = 64
"""Points that are followed, across and down the picture, or every pixel where it has fewer."""

MOST_HALVINGS = 3
"""Of an interval. A pixel is the mean of 16 samples, so that an edge passes it in as many steps: from half a pixel of
motion between pictures three halvings lead to that of one step, and more would show the steps alone."""


class Render(NamedTuple):
    """A picture of a sequence."""

    time: int
    """Nanoseconds."""
    brightness: Float[np.ndarray, "height width *channels"]
    """Linear."""
    before: list[PartialPicture]
    """Pixels whose brightness was needed between the last picture and this one, in the order of time."""
    done: float
    """Share of the pictures of the sequence that end with this one, from 0 to 1."""


def render_times(
    camera: Camera,
    trajectory: Trajectory,
    depth: Callable[[int], Float32[np.ndarray, "height width"]],
    stops: Int64[np.ndarray, " stops"],
    max_displacement: float,
    threads: int = 2,
) -> Int64[np.ndarray, " times"]:
    """Times of rendering, so close that no point of the scene moves further than `max_displacement` in between.

    Adds up, from millisecond to millisecond, the displacement of the point that moves most (of a grid over the
    picture), and divides the sum evenly between two stops.

    Args:
        camera: That moves.
        trajectory: Of the camera; covers the stops.
        depth: z-depth that the camera sees at a time (ns), 0 where it sees nothing. Called from several threads.
        stops: Nanoseconds, strictly increasing; times to render at in any case.
        max_displacement: Pixels.
        threads: How many measure displacements.

    Returns:
        Nanoseconds, strictly increasing, from the first stop to the last, all stops among them.
    """
    rows, columns = (np.unique(np.linspace(0, n - 1, GRID).round().astype(int)) for n in (camera.height, camera.width))
    grid = np.ix_(rows, columns)
    rays = camera.pixel_directions()[grid].reshape(-1, 3)
    lengths = np.linalg.norm(rays, axis=1)[:, None, None]
    units = rays[:, :, None] / lengths
    steps = np.zeros((len(rays), 3, 2))
    for axis, step in enumerate(pixel_steps(camera)):
        steps[:, :2, axis] = step[grid].reshape(-1, 2)
    pixels_per_unit = np.linalg.pinv((steps - units * (units * steps).sum(1, keepdims=True)) / lengths)

    count = max(2, -(-int(stops[-1] - stops[0]) // MOTION_STEP) + 1)
    times = np.linspace(stops[0], stops[-1], count).round().astype(np.int64)
    poses = trajectory.poses(torch.from_numpy(times)).numpy()

    def displacements(first: int) -> np.ndarray:
        followed = poses[first : first + STEPS_PER_DEPTH + 1]
        middle = first + len(followed) // 2
        depths = depth(int(times[middle]))[grid].reshape(-1, 1)
        seen = depths[:, 0] > 0
        points = (rays * depths)[seen] @ poses[middle, :, :3].T + poses[middle, :, 3]
        directions = (points - followed[:, None, :, 3]) @ followed[:, :, :3]
        directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
        moved = np.einsum("nij,snj->sni", pixels_per_unit[seen], np.diff(directions, axis=0))
        return np.linalg.norm(moved, axis=-1).max(axis=1, initial=0)

    with ThreadPoolExecutor(threads) as pool:
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
    max_change: float = 0.5,
    log_eps: float = 0.001,
    threads: int = 2,
) -> Iterator[Render]:
    """Pictures at the given times, and between them the pixels whose brightness changes fast.

    Of such a pixel an interval is halved until its log brightness differs by no more than `max_change` between the
    ends, or it was halved `MOST_HALVINGS` times. Where brightness changes linearly by that much, log brightness strays
    by at most an eighth of its square from the straight line that events are made from: 0.03, or an eighth of a
    threshold of 0.25, for 0.5.

    What is rendered depends on brightness alone. A few pictures are rendered ahead; an exception of a render is raised
    in its turn.

    Args:
        brightness: As of `sources.Source`. Called from several threads.
        times: Nanoseconds, strictly increasing; whole pictures are rendered at these and no others.
        max_change: Of the natural logarithm of log_eps + brightness; infinite: nothing is rendered between pictures.
        log_eps: Above 0.
        threads: How many render at once.

    Yields:
        In the order of time.
    """
    factor = np.exp(max_change)
    pictures: dict[int, Future[np.ndarray]] = {}
    partial_pictures: dict[int, Future[list[PartialPicture]]] = {}
    pool = ThreadPoolExecutor(threads)

    def submit(index: int) -> None:
        if index < len(times):
            pictures[index] = pool.submit(brightness, int(times[index]), None)
        earlier = index - threads  # so that no thread has to wait for its pictures
        if 0 < earlier < len(times):
            partial_pictures[earlier] = pool.submit(halve, earlier)

    def halve(index: int) -> list[PartialPicture]:
        """The interval that ends with this picture."""
        before, after = pictures[index - 1].result(), pictures[index].result()
        shape = (before.shape[0] * before.shape[1], -1)
        pixels = np.arange(shape[0])
        return between(int(times[index - 1]), int(times[index]), pixels, before.reshape(shape), after.reshape(shape))

    def between(
        start: int, end: int, pixels: np.ndarray, before: np.ndarray, after: np.ndarray, halvings: int = 0
    ) -> list[PartialPicture]:
        first, second = before + log_eps, after + log_eps
        changed = (np.maximum(first, second) > factor * np.minimum(first, second)).any(axis=1)
        middle = (start + end) // 2
        if halvings == MOST_HALVINGS or middle == start or not changed.any():
            return []
        pixels, before, after = pixels[changed], before[changed], after[changed]
        picture = PartialPicture(middle, pixels, brightness(middle, pixels))
        here = picture.brightness.reshape(before.shape)
        earlier = between(start, middle, pixels, before, here, halvings + 1)
        return [*earlier, picture, *between(middle, end, pixels, here, after, halvings + 1)]

    try:
        for index in range(2 * threads):
            submit(index)
        for index, time in enumerate(times.tolist()):
            submit(index + 2 * threads)
            picture = pictures[index].result()
            between_them = partial_pictures.pop(index).result() if index > 0 else []
            yield Render(time, picture, between_them, index / max(1, len(times) - 1))
            pictures.pop(index - 1, None)
    finally:
        pool.shutdown(cancel_futures=True)

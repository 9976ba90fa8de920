"""When to render, so that what lies between two pictures is known well enough to make events of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float32, Int64

from enerf_ns.dataparsers.calibration import Camera
from enerf_ns.dataparsers.trajectory import Trajectory
from enerf_ns.simulator.render import pixel_steps

MOTION_STEP = 1_000_000
"""Nanoseconds from one pose to the next of those between which displacements are measured."""

STEPS_PER_DEPTH = 5
"""Of these steps, for which the points that the camera sees in their middle are followed."""

GRID = 64
"""Points that are followed, across and down the picture, or every pixel where it has fewer."""

MOST_HALVINGS = 1
"""Of an interval. A pixel is the mean of a few samples, so that an edge passes it in steps, however small its motion:
more pictures between would show the same steps."""

AHEAD = 6
"""Pictures that are rendered before they are asked for; halved intervals may add as many."""


class Render(NamedTuple):
    """A picture of a sequence."""

    time: int
    """Nanoseconds."""
    brightness: Float[np.ndarray, "height width *channels"]
    """Linear."""
    done: float
    """Share of the whole sequence that ends with this picture, as far as it can be told, from 0 to 1."""


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
    brightness: Callable[[int], Float[np.ndarray, "height width *channels"]],
    times: Int64[np.ndarray, " times"],
    max_change: float = 0.5,
    log_eps: float = 0.001,
    threads: int = 2,
) -> Iterator[Render]:
    """Pictures at the given times and, where brightness changes fast, between them.

    An interval is halved `MOST_HALVINGS` times unless no pixel's log brightness differs by more than `max_change`
    between its ends. Where brightness changes linearly by that much, log brightness strays by at most an eighth of its
    square from the straight line that events are made from: 0.03, or an eighth of a threshold of 0.25, for 0.5.

    Which pictures there are depends on their brightness alone. A few are rendered ahead; an exception of a render is
    raised in its turn.

    Args:
        brightness: Linear brightness at a time (ns). Called from several threads.
        times: Nanoseconds, strictly increasing; all of them are rendered.
        max_change: Of the natural logarithm of log_eps + brightness.
        log_eps: Above 0.
        threads: How many pictures are rendered at once.

    Yields:
        In the order of time.
    """
    factor = np.exp(max_change)
    shares = np.linspace(0, 1, len(times)) if len(times) > 1 else np.ones(1)
    coming = iter(times.tolist())
    pool = ThreadPoolExecutor(threads)
    pending: list[_Pending] = []

    def submit(time: int, halvings: int = 0) -> _Pending:
        return _Pending(time, pool.submit(brightness, time), halvings)

    def is_rendered(index: int) -> bool:
        future = pending[index].future
        return future.done() and future.exception() is None

    def halve(index: int) -> bool:
        """Whether the interval that ends with this picture had to be halved."""
        before, after = pending[index - 1 : index + 1]
        if after.follows or after.halvings == MOST_HALVINGS or after.time - before.time < 2:
            return False
        first, second = before.future.result() + log_eps, after.future.result() + log_eps
        after.follows = not (np.maximum(first, second) > factor * np.minimum(first, second)).any()
        if not after.follows:
            after.halvings += 1
            pending.insert(index, submit((before.time + after.time) // 2, after.halvings))
        return not after.follows

    def rendered() -> Render:
        time = pending[0].time
        return Render(time, pending[0].future.result(), float(np.interp(time, times, shares)))

    try:
        pending.append(submit(next(coming)))
        yield rendered()
        while True:
            while len(pending) <= AHEAD and (time := next(coming, None)) is not None:
                pending.append(submit(time))
            if len(pending) == 1:
                return
            index = 2
            while index < len(pending) < 2 * AHEAD:
                index += 2 if is_rendered(index - 1) and is_rendered(index) and halve(index) else 1
            if not halve(1):
                del pending[0]
                yield rendered()
    finally:
        pool.shutdown(cancel_futures=True)


@dataclass
class _Pending:
    """A picture that is being rendered; the first of a list is the one that was yielded last."""

    time: int
    future: Future[np.ndarray]
    halvings: int
    """Of the interval that ends with it."""
    follows: bool = False
    """Whether it is known to be close enough to the one before."""

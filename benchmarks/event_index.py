"""Speed of the per-pixel event index beside a stable argsort: `python benchmarks/event_index.py`, one core."""

from __future__ import annotations

import time

import numpy as np
from rich.console import Console
from rich.table import Table

from enerf_ns.dataparsers.events import EventIndex
from enerf_ns.dataparsers.recording import Events

WIDTH, HEIGHT = 640, 480


def random_events(num_events: int) -> Events:
    rng = np.random.default_rng(0)
    return Events(
        x=rng.integers(0, WIDTH, num_events, dtype=np.uint16),
        y=rng.integers(0, HEIGHT, num_events, dtype=np.uint16),
        t=np.sort(rng.integers(0, 10**10, num_events)),
        p=rng.choice(np.array([-1, 1], np.int8), num_events),
    )


def argsort_index(events: Events) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The same index in NumPy alone."""
    pixels = events.y.astype(np.int32) * WIDTH + events.x
    order = np.argsort(pixels, kind="stable")
    positives = np.cumsum(events.p[order] > 0, dtype=np.int32)
    offsets = np.concatenate([[0], np.cumsum(np.bincount(pixels, minlength=WIDTH * HEIGHT))])
    return events.t[order], positives, offsets


def main() -> None:
    EventIndex.from_events(random_events(10), WIDTH, HEIGHT)  # compiles
    table = Table("events", "million events/s", "argsort, million events/s", "bytes/event", "with offsets")
    for num_events in (10**6, 10**7):
        events = random_events(num_events)
        begin = time.perf_counter()
        index = EventIndex.from_events(events, WIDTH, HEIGHT)
        middle = time.perf_counter()
        twin = argsort_index(events)
        end = time.perf_counter()
        columns = (index.times, index.positives, index.offsets)
        assert all(np.array_equal(ours, theirs) for ours, theirs in zip(columns, twin, strict=True))
        size = index.times.nbytes + index.positives.nbytes
        table.add_row(
            f"{num_events:,}",
            f"{num_events / (middle - begin) / 1e6:.1f}",
            f"{num_events / (end - middle) / 1e6:.1f}",
            f"{size / num_events:.1f}",
            f"{(size + index.offsets.nbytes) / num_events:.1f}",
        )
    Console().print(table)


if __name__ == "__main__":
    main()

"""Cases of sampling event pairs: bursts at one pixel, equal timestamps, offsets of the clock."""

from __future__ import annotations

from collections import Counter

import numpy as np
import torch

from enerf_ns.bench.numerics.case import case
from enerf_ns.dataparsers.index.event_index import EventIndex
from enerf_ns.dataparsers.recording.recording import Events
from enerf_ns.events.samplers import AccumulationSampler, EventPairSampler, SilentIntervalSampler, SilentPixelSampler

WIDTH, HEIGHT = 8, 4
DRAWN = 200_000


def _index(pixels: np.ndarray, times: np.ndarray) -> EventIndex:
    order = np.argsort(times, kind="stable")
    pixels, times = pixels[order], times[order]
    return EventIndex.from_events(
        Events(pixels % WIDTH, pixels // WIDTH, times, np.ones(len(times), np.int8)), WIDTH, HEIGHT
    )


def _burst() -> EventIndex:
    """10,000 events within a millisecond at one pixel, and eight pixels with two events a second apart."""
    pixels = np.concatenate([np.zeros(10_000, np.int64), np.repeat(np.arange(1, 9), 2)])
    times = np.concatenate([500_000_000 + 100 * np.arange(10_000), np.tile([0, 10**9], 8)])
    return _index(pixels, times)


@case(
    "10,000 events in a millisecond at one pixel beside pixels with two",
    "the number of pairs that a loop counts",
    0,
    "pairs",
)
def burst_pairs() -> float:
    counted = sum(min(10_000 - 1 - i, 10) for i in range(10_000)) + 8
    return abs(EventPairSampler(_burst(), "partner", max_distance=10).num_pairs - counted)


@case(
    "the same burst, pixels drawn with equal probability",
    "one pair of nine at each pixel, in standard deviations",
    5.0,
    "σ",
)
def burst_pixels() -> float:
    sampler = EventPairSampler(_burst(), "partner", max_distance=10, uniform_over="pixels")
    drawn = sampler.sample(DRAWN, torch.Generator().manual_seed(0)).pixels
    counts = np.array([Counter(drawn.tolist())[pixel] for pixel in range(9)])
    return np.abs((counts - DRAWN / 9) / np.sqrt(DRAWN * 8 / 81)).max()


@case("the same burst, silent pairs", "no event between the instants of a silent pair", 0, "events")
def burst_silence() -> float:
    index, generator = _burst(), torch.Generator().manual_seed(0)
    within = 0
    for sampler in (SilentPixelSampler(index, *index.span, 1000, 10**8), SilentIntervalSampler(index)):
        batch = sampler.sample(20_000, generator)
        within += int((index.count_until(batch.pixels, batch.end) - index.count_until(batch.pixels, batch.start)).sum())
    return float(within)


@case("all events of a pixel at three instants", "pairs of positive length that count all events", 0, "pairs")
def equal_stamps() -> float:
    times = np.repeat([5, 17, 40], [100, 1, 50])
    wrong = 0
    for mode in ("successor", "partner", "window"):
        sampler = EventPairSampler(_index(np.zeros(151, np.int64), times), mode, window_ns=100)
        batch = sampler.sample(1000, torch.Generator().manual_seed(0))
        until = {5: 100, 17: 101, 40: 151}
        counted = torch.tensor(
            [until[b] - until[a] for a, b in zip(batch.start.tolist(), batch.end.tolist(), strict=True)]
        )
        wrong += int((batch.end <= batch.start).sum() + (batch.on != counted).sum())
    return wrong


@case("clocks that show 0, an hour, 1.6e18 and 9e18 ns", "the same pairs, shifted", 0, "pairs")
def clocks() -> float:
    generator = np.random.default_rng(0)
    pixels, times = generator.integers(0, WIDTH * HEIGHT, 5000), np.sort(generator.integers(0, 10**9, 5000))

    def drawn(zero: int) -> torch.Tensor:
        index, seeded = _index(pixels, times + zero), torch.Generator().manual_seed(0)
        batches = [EventPairSampler(index, mode).sample(1000, seeded) for mode in ("successor", "partner", "window")]
        batches.append(SilentPixelSampler(index, *index.span, 10**6, 10**7).sample(1000, seeded))
        batches.append(AccumulationSampler(index, *index.span, 10**7).sample(1000, seeded))
        return torch.stack([torch.cat([batch.start, batch.end]) - zero for batch in batches])

    expected = drawn(0)
    return sum(int((drawn(zero) != expected).sum()) for zero in (3600 * 10**9, 16 * 10**17, 9 * 10**18))

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from math import sin

import numpy as np
import pytest
import torch
from scipy.optimize import root_scalar
from scipy.stats import chisquare

from enerf_ns.dataparsers.index.event_index import EventIndex
from enerf_ns.dataparsers.index.event_rates import missed_changes, rates_around, rates_between
from enerf_ns.dataparsers.recording.recording import Events
from enerf_ns.events import samplers as event_sampler
from enerf_ns.events.batch import EventBatch
from enerf_ns.events.missed_changes import MissedChanges
from enerf_ns.events.samplers import (
    AccumulationSampler,
    EventPairSampler,
    HeldOutPairSampler,
    InstantPairSampler,
    SilentIntervalSampler,
    SilentPixelSampler,
)
from enerf_ns.sensor.part import GREY
from enerf_ns.sensor.sensor_model import SensorModel, SensorModelConfig

WIDTH, HEIGHT = 5, 4
MODES = ["successor", "partner", "window"]
WINDOW = 100
START, END = 50, 1000
STRETCHES = [(0, 199), (330, 331), (450, 450), (500, 2000)]
"""First and last instant of the parts of time that poses cover, in the tests of gaps."""


def make_events(rows: list[tuple[int, int, int]]) -> Events:
    """Events from (pixel, time, polarity), in any order."""
    pixel, t, p = np.array(sorted(rows, key=lambda row: row[1])).T
    return Events(x=(pixel % WIDTH).astype(np.uint16), y=(pixel // WIDTH).astype(np.uint16), t=t, p=p.astype(np.int8))


def recording(equal_stamps: bool) -> dict[int, list[tuple[int, int]]]:
    """(time, polarity) of each pixel: 0 to 12 events, pixels 0, 7 and 19 silent, 5 with one event."""
    rng = np.random.default_rng(5)
    pixels = defaultdict(list)
    for pixel in range(WIDTH * HEIGHT):
        count = 0 if pixel in (0, 7, 19) else 1 if pixel == 5 else int(rng.integers(2, 13))
        times = np.sort(rng.choice(np.arange(START, END), count, replace=False))
        if equal_stamps:
            times = times // 60 * 60 + START
        pixels[pixel] = [(int(t), int(rng.choice([-1, 1]))) for t in times]
    return pixels


def index_of(pixels: dict[int, list[tuple[int, int]]], device: str = "cpu") -> EventIndex:
    events = make_events([(pixel, t, p) for pixel, events in pixels.items() for t, p in events])
    return EventIndex.from_events(events, WIDTH, HEIGHT).to(device)


def stretch_of(time: int) -> int | None:
    """Number of the stretch that a time lies in, by a loop; None in a gap."""
    return next((i for i, (first, last) in enumerate(STRETCHES) if first <= time <= last), None)


def all_pairs(pixels: dict, mode: str, max_distance: int, gaps: bool = False) -> list[tuple[int, int, int]]:
    """Every (pixel, start, end) that a mode may draw, by loops."""
    origin = min(t for events in pixels.values() for t, _ in events)
    pairs = []
    for pixel, events in pixels.items():
        instants = sorted({t for t, _ in events if not gaps or stretch_of(t) is not None})
        for i, start in enumerate(instants):
            if mode == "window":
                same_window = [t for t in instants if (t - origin) // WINDOW == (start - origin) // WINDOW]
                if gaps:
                    same_window = [t for t in same_window if stretch_of(t) == stretch_of(start)]
                ends = same_window[-1:] if start != same_window[-1] else []
            else:
                ends = instants[i + 1 : i + 1 + (1 if mode == "successor" else max_distance)]
            pairs += [(pixel, start, end) for end in ends]
    return pairs


def rows(pairs: EventBatch) -> list[tuple[int, int, int]]:
    return list(zip(pairs.pixels.tolist(), pairs.start.tolist(), pairs.end.tolist(), strict=True))


def sensor_with(refractory: int) -> SensorModel:
    return SensorModel(
        SensorModelConfig(
            contrast_thresholds=THRESHOLDS, response="linlog", refractory_period_ns=refractory, bayer_pattern=GREY
        )
    )


def seen_from(pairs: EventBatch, refractory: int) -> EventBatch:
    """The pairs from when their pixels can see again."""
    delays = sensor_with(refractory).blind_after(pairs.start, pairs.end)
    return pairs if delays is None else replace(pairs, start=pairs.start + delays.long())


def assert_counts_are_right(pairs: EventBatch, pixels: dict) -> None:
    for (pixel, start, end), on, off in zip(rows(pairs), pairs.on.tolist(), pairs.off.tolist(), strict=True):
        assert start < end
        fired = [p for t, p in pixels[pixel] if start < t <= end]
        assert (on, off) == (fired.count(1), fired.count(-1))


@pytest.mark.parametrize("equal_stamps", [False, True])
@pytest.mark.parametrize("max_distance", [1, 2, 3, 4, 7, 30])
def test_every_partner_is_decoded_once(max_distance: int, equal_stamps: bool) -> None:
    pixels = recording(equal_stamps)
    sampler = EventPairSampler(index_of(pixels), "partner", max_distance)
    expected = all_pairs(pixels, "partner", max_distance)
    assert sampler.num_pairs == len(expected)
    drawn = sampler.sample(60 * len(expected), torch.Generator().manual_seed(0))
    assert set(rows(drawn)) == set(expected)


def assert_as_likely(pairs: EventBatch, expected: list[tuple[int, int, int]], uniform_over: str) -> None:
    """All of the expected pairs are drawn and no other, each pair as often, or each pixel (chi-square test)."""
    drawn = Counter(rows(pairs))
    assert set(drawn) == set(expected)
    per_pixel = Counter(pixel for pixel, _, _ in expected)
    weights = np.array([1.0 if uniform_over == "pairs" else 1.0 / per_pixel[pixel] for pixel, _, _ in expected])
    assert chisquare([drawn[pair] for pair in expected], len(pairs) * weights / weights.sum()).pvalue > 1e-3


@pytest.mark.parametrize("equal_stamps", [False, True])
@pytest.mark.parametrize("uniform_over", ["pairs", "pixels"])
@pytest.mark.parametrize("mode", MODES)
def test_pairs_are_uniform_and_count_their_events(mode, uniform_over, equal_stamps: bool, device: str) -> None:
    pixels = recording(equal_stamps)
    expected = all_pairs(pixels, mode, 4)
    sampler = EventPairSampler(index_of(pixels, device), mode, 4, WINDOW, uniform_over)
    assert sampler.num_pairs == len(expected)

    pairs = sampler.sample(20_000, torch.Generator(device).manual_seed(1))
    assert pairs.pixels.device.type == device
    assert pairs.num_silent == 0 and {column.dtype for column in pairs.columns} == {torch.int64}
    assert_counts_are_right(pairs, pixels)
    assert_as_likely(pairs, expected, uniform_over)


@pytest.mark.parametrize("chunk", [1, 2, 7, 2**20])
@pytest.mark.parametrize("uniform_over", ["pairs", "pixels"])
@pytest.mark.parametrize("equal_stamps", [False, True])
@pytest.mark.parametrize("mode", MODES)
def test_no_pair_starts_or_ends_in_a_gap(mode, equal_stamps: bool, uniform_over, chunk: int, monkeypatch, device: str):
    """All pairs of the instants outside the gaps, as likely as ever, with all events between their instants."""
    monkeypatch.setattr(event_sampler, "CHUNK", chunk)
    pixels = recording(equal_stamps)
    expected = all_pairs(pixels, mode, 3, gaps=True)
    spanning = [pair for pair in expected if stretch_of(pair[1]) != stretch_of(pair[2])]
    assert bool(spanning) == (mode != "window")
    stretches = torch.tensor(STRETCHES, device=device)
    sampler = EventPairSampler(index_of(pixels, device), mode, 3, WINDOW, uniform_over, stretches)
    assert sampler.num_pairs == len(expected)
    pairs = sampler.sample(20_000, torch.Generator(device).manual_seed(1))
    assert_counts_are_right(pairs, pixels)
    assert_as_likely(pairs, expected, uniform_over)


@pytest.mark.parametrize("equal_stamps", [False, True])
@pytest.mark.parametrize("max_distance", [1, 3, 30])
def test_held_out_pairs_have_both_ends_in_the_spans(max_distance: int, equal_stamps: bool, device: str) -> None:
    """All of them that are so few events apart, each as likely as the others, by loops."""
    pixels = recording(equal_stamps)
    expected = []
    for pixel, events in pixels.items():
        times = [t for t, _ in events]
        instants = sorted({t for t in times if stretch_of(t) is not None})
        expected += [
            (pixel, start, end)
            for start in instants
            for end in instants
            if start < end and sum(start < t <= end for t in times) <= max_distance
        ]
    assert any(stretch_of(start) != stretch_of(end) for _, start, end in expected)
    sampler = HeldOutPairSampler(index_of(pixels, device), torch.tensor(STRETCHES, device=device), max_distance)
    pairs = sampler.sample(20_000, torch.Generator(device).manual_seed(1))
    assert_counts_are_right(pairs, pixels)
    assert_as_likely(pairs, expected, "pairs")


def test_events_that_are_held_out_one_a_pixel_make_no_pair() -> None:
    index = index_of({1: [(10, 1), (300, 1)], 2: [(20, 1)], 3: [(240, 1), (250, -1)]})
    for spans in (STRETCHES, []):
        with pytest.raises(ValueError, match="no pixel fired twice, 3 events apart or less"):
            HeldOutPairSampler(index, torch.tensor(spans, dtype=torch.int64).reshape(-1, 2), 3)


@pytest.mark.parametrize("mode", MODES)
def test_events_in_gaps_alone_make_no_pair(mode) -> None:
    index = index_of({1: [(t, 1) for t in range(200, 330)], 2: [(10, 1)]})
    with pytest.raises(ValueError, match="in the time that is used, so there is no pair"):
        EventPairSampler(index, mode, stretches=torch.tensor(STRETCHES))


@pytest.mark.parametrize("mode", MODES)
def test_a_pixel_that_fires_ten_thousand_times_in_a_millisecond_beside_pixels_with_two(mode) -> None:
    """All pairs are alike, or all pixels; in either case the sums are those of a loop over the stamps."""
    generator = np.random.default_rng(0)
    burst = np.sort(generator.integers(10**9, 10**9 + 10**6, 10_000))
    pixels = {7: [(int(t), int(p)) for t, p in zip(burst, generator.choice([-1, 1], 10_000), strict=True)]}
    pixels |= {pixel: [(10**9 + pixel, 1), (10**9 + 500 + pixel, -1)] for pixel in range(WIDTH * HEIGHT) if pixel != 7}
    index = index_of(pixels)
    times, polarities = np.array(pixels[7]).T
    instants = len(np.unique(times))
    most = {"successor": instants - 1, "partner": sum(instants - d for d in range(1, 31)), "window": instants - 1}
    for uniform_over in ("pairs", "pixels"):
        sampler = EventPairSampler(index, mode, 30, 10**6, uniform_over)
        assert sampler.num_pairs == most[mode] + 19
        pairs = sampler.sample(4000, torch.Generator().manual_seed(0))
        for (pixel, start, end), on, off in zip(rows(pairs), pairs.on.tolist(), pairs.off.tolist(), strict=True):
            assert start < end
            if pixel == 7:
                fired = polarities[np.searchsorted(times, start, "right") : np.searchsorted(times, end, "right")]
                assert (on, off) == ((fired == 1).sum(), (fired == -1).sum())
            else:
                assert (end - start, on, off) == (500, 0, 1)
        in_burst = int((pairs.pixels == 7).sum())
        if uniform_over == "pixels":
            assert chisquare(np.bincount(pairs.pixels.numpy(), minlength=20)).pvalue > 1e-3
        else:
            assert in_burst > 3980
    silent = SilentPixelSampler(index, *index.span, 100, 100).sample(2000, torch.Generator().manual_seed(1))
    assert len(silent) == 2000
    for pixel, start, end in rows(silent):
        assert not any(start < t <= end for t, _ in pixels[pixel]) or pixel == 7
        assert pixel != 7 or np.searchsorted(times, start, "right") == np.searchsorted(times, end, "right")


@pytest.mark.parametrize("chunk", [1, 2, 7])
@pytest.mark.parametrize("equal_stamps", [False, True])
@pytest.mark.parametrize("mode", MODES)
def test_events_in_small_chunks_make_the_same_pairs(mode, equal_stamps: bool, chunk: int, monkeypatch) -> None:
    monkeypatch.setattr(event_sampler, "CHUNK", chunk)
    pixels = recording(equal_stamps)
    expected = all_pairs(pixels, mode, 3)
    sampler = EventPairSampler(index_of(pixels), mode, 3, WINDOW)
    assert sampler.num_pairs == len(expected)
    drawn = sampler.sample(60 * len(expected), torch.Generator().manual_seed(0))
    assert set(rows(drawn)) == set(expected)


def chains(pairs: EventBatch) -> list[tuple[int, list[int]]]:
    """Pixel and instants of each chain, which its two pairs and its link agree on."""
    links = pairs.links
    assert links is not None and links.links is None
    found, number = [], len(links)
    for first, (pixel, start, end) in zip(rows(pairs), rows(links), strict=False):
        last = rows(pairs)[number + len(found)]
        assert first[0] == last[0] == pixel and (first[2], last[1]) == (start, end)
        found.append((pixel, [*first[1:], *last[1:]]))
    return found


@pytest.mark.parametrize("gaps", [False, True])
@pytest.mark.parametrize("equal_stamps", [False, True])
@pytest.mark.parametrize(("mode", "max_distance"), [("successor", 1), ("partner", 2), ("partner", 9)])
def test_chains_are_events_of_one_pixel_in_order(mode, max_distance: int, equal_stamps: bool, gaps: bool, device: str):
    pixels = recording(equal_stamps)
    stretches = torch.tensor(STRETCHES, device=device) if gaps else None
    sampler = EventPairSampler(index_of(pixels, device), mode, max_distance, stretches=stretches)
    pairs = sampler.sample_chains(3001, torch.Generator(device).manual_seed(0))
    assert len(pairs) == 3001 and pairs.links is not None and len(pairs.links) == 1500
    expected = set(all_pairs(pixels, mode, max_distance, gaps))
    assert rows(pairs)[-1] in expected, "the pair that is in no chain is one of those of sample"
    began = Counter()
    for pixel, instants in chains(pairs):
        allowed = sorted({t for t, _ in pixels[pixel] if not gaps or stretch_of(t) is not None})
        numbers = [allowed.index(t) for t in instants]
        steps = [after - before for before, after in pairwise(numbers)]
        assert 1 <= steps[0] <= max_distance and all(0 <= step <= max_distance for step in steps)
        assert all(steps) or (numbers[-1] == len(allowed) - 1 and (numbers[0] == 0 or not any(steps[1:])))
        began[pixel] += 1
    assert len(began) == len({pixel for pixel, _, _ in expected})
    for batch in (pairs, pairs.links):
        for (pixel, start, end), on, off in zip(rows(batch), batch.on.tolist(), batch.off.tolist(), strict=True):
            fired = [p for t, p in pixels[pixel] if start < t <= end]
            assert (on, off) == (fired.count(1), fired.count(-1))


def test_a_long_pixel_repeats_no_event_in_a_chain():
    pixels = {3: [(START + i, 1) for i in range(40)], 4: [(START, 1), (START + 1, 1)]}
    pairs = EventPairSampler(index_of(pixels), "partner", 10).sample_chains(4000, torch.Generator().manual_seed(0))
    found = chains(pairs)
    assert all(len(set(instants)) == 4 for pixel, instants in found if pixel == 3)
    ends = [START, START + 1]
    assert {tuple(instants) for pixel, instants in found if pixel == 4} == {(ends[0], *3 * ends[1:])}
    assert {instants[0] for pixel, instants in found if pixel == 3} >= set(range(START, START + 30))


def test_windows_of_time_are_in_no_chain():
    sampler = EventPairSampler(index_of(recording(False)), "window", window_ns=WINDOW)
    with pytest.raises(ValueError, match="chains"):
        sampler.sample_chains(4, torch.Generator().manual_seed(0))


@pytest.mark.parametrize("refractory", [1, 30, 5000])
@pytest.mark.parametrize("mode", MODES)
def test_a_pair_begins_when_the_pixel_sees_again_and_never_at_its_end(mode, refractory: int) -> None:
    pixels = recording(True)
    expected = [(pixel, min(a + refractory, b - 1), b) for pixel, a, b in all_pairs(pixels, mode, 3)]
    sampler = EventPairSampler(index_of(pixels), mode, 3, WINDOW)
    pairs = sampler.sample(60 * len(expected), torch.Generator().manual_seed(0))
    assert pairs.num_silent == 0
    assert set(rows(seen_from(pairs, refractory))) == set(expected)


def fire(signal: Callable[[float], float], end: float, on: float, off: float, refractory: int) -> list[tuple[int, int]]:
    """(time, polarity) of an ideal pixel that is blind after each event and then remembers what it sees first.

    It walks along log brightness in steps of 0.1 ms, and finds the crossing within a step by root finding.
    """
    events: list[tuple[int, int]] = []
    time, reference = 0.0, signal(0.0)
    while time < end:
        following = time + 1e5
        change = signal(following) - reference
        if -off < change < on:
            time = following
            continue
        level = reference + (on if change > 0 else -off)
        time = root_scalar(lambda t, level=level: signal(t) - level, bracket=(time, following)).root
        events.append((round(time), 1 if change > 0 else -1))
        time += refractory
        reference = signal(time)
    return events


THRESHOLDS = (0.2, 0.25)


def signal_of(pixel: int) -> Callable[[float], float]:
    """Log brightness over a second, as a function of time in ns."""
    return lambda t: sin((9 + pixel) * t * 1e-9) + 0.4 * sin((23 - pixel) * t * 1e-9 + pixel)


@pytest.mark.parametrize("refractory", [0, 1_000_000, 8_000_000])
def test_successors_measure_the_threshold_and_other_pairs_miss_what_changes_while_the_pixel_is_blind(refractory: int):
    pixels = {pixel: fire(signal_of(pixel), 1e9, *THRESHOLDS, refractory) for pixel in range(6)}
    generator = torch.Generator().manual_seed(0)
    blind = {
        (pixel, time): signal_of(pixel)(time + refractory) - signal_of(pixel)(time)
        for pixel, events in pixels.items()
        for time, _ in events
    }

    def errors(sampler: EventPairSampler, refractory: int) -> tuple[list[float], list[float]]:
        """Of every drawn pair, the change that it measures too little, and what changed in between unseen."""
        pairs = seen_from(sampler.sample(2000, generator), refractory)
        measured = (
            sensor_with(refractory)
            .measured_change(replace(pairs, on=pairs.on.double(), off=pairs.off.double()))
            .tolist()
        )
        changes = [signal_of(pixel)(end) - signal_of(pixel)(start) for pixel, start, end in rows(pairs)]
        unseen = [sum(blind[pixel, t] for t, _ in pixels[pixel] if a < t < b) for pixel, a, b in rows(pairs)]
        return [change - m for change, m in zip(changes, measured, strict=True)], unseen

    index = index_of(pixels)
    error, unseen = errors(EventPairSampler(index, "successor"), refractory)
    assert not any(unseen)
    np.testing.assert_allclose(error, 0.0, atol=1e-7)
    error, unseen = errors(EventPairSampler(index, "partner", 4), refractory)
    np.testing.assert_allclose(error, unseen, atol=1e-7)
    error, _ = errors(EventPairSampler(index, "successor"), 0)
    assert (max(map(abs, error)) > 0.01) == (refractory > 0)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("refractory", [0, 1_000_000, 8_000_000])
def test_rates_are_exact_where_log_brightness_has_a_constant_second_derivative(refractory: int, sign: int):
    """At each event, and when its pixel sees again. The first and the last have the rate of their one interval."""

    def slope(time: float) -> float:
        return 8.0 + 20.0 * time * 1e-9

    fired = fire(lambda t: sign * (8e-9 * t + 10.0 * (1e-9 * t) ** 2), 1e9, *THRESHOLDS, refractory)
    index, number, threshold = index_of({0: fired}), len(fired), THRESHOLDS[sign < 0]
    assert number > 20 and {polarity for _, polarity in fired} == {sign}
    events = torch.arange(number)
    for delay in (0, refractory):
        found = rates_around(index, events, torch.zeros_like(events), delay, refractory)
        own, other = (found[:, 0], found[:, 1]) if sign > 0 else (found[:, 1], found[:, 0])
        expected = [slope(time + delay) / threshold for time, _ in fired]
        expected[0] = 1e9 / (fired[1][0] - fired[0][0] - refractory)
        expected[-1] = 1e9 / (fired[-1][0] - fired[-2][0] - refractory)
        np.testing.assert_allclose(own, expected, rtol=1e-5)
        assert not other.any()


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("refractory", [0, 8_000_000])
def test_rates_at_any_instants_are_exact_where_log_brightness_has_a_constant_second_derivative(
    refractory: int, sign: int
):
    """Before the middle of the first interval, and after that of the last one, they are those of the interval."""
    fired = fire(lambda t: sign * (8e-9 * t + 10.0 * (1e-9 * t) ** 2), 1e9, *THRESHOLDS, refractory)
    index, threshold = index_of({2: fired, 3: [(5, 1), (9, -1)]}), THRESHOLDS[sign < 0]
    stamps = np.array([time for time, _ in fired])
    times = np.random.default_rng(0).integers(0, 10**9, 500)
    pixels = torch.full((500,), 2)
    until = index.offsets[2] + torch.from_numpy(np.searchsorted(stamps, times, side="right"))
    found = rates_between(index, until, pixels, torch.from_numpy(times), refractory).numpy()
    middles = stamps[[1, -1]] - 0.5 * (stamps[[1, -1]] - stamps[[0, -2]] - refractory)
    expected = (8.0 + 20.0 * 1e-9 * times.clip(*middles)) / threshold
    expected[(times < stamps[0]) | (times >= stamps[-1])] = 0.0
    np.testing.assert_allclose(found[:, int(sign < 0)], expected, rtol=1e-4)
    assert not found[:, int(sign > 0)].any() and 0 < np.count_nonzero(expected == 0.0) < 100


def test_pairs_of_any_instants_have_the_rates_at_both():
    index = index_of(recording(False))
    sampler = InstantPairSampler(index, START, END, 10**6)
    batch = sampler.sample_chains(301, torch.Generator().manual_seed(0), 0)
    assert batch.links is not None and batch.links.rates is not None and batch.links.rates.shape == (150, 2, 2)
    for one in (batch, batch.links):
        assert one.rates is not None
        for instant, times in enumerate((one.start, one.end)):
            until = index.offsets[one.pixels] + index.count_until(one.pixels, times)
            expected = rates_between(index, until, one.pixels, times, 0)
            torch.testing.assert_close(one.rates[:, instant], expected, rtol=0, atol=0)
    events = EventPairSampler(index, "partner").sample(50, torch.Generator().manual_seed(0), 0)
    joined = events.followed_by(batch).rates
    assert joined is not None and batch.rates is not None and torch.equal(joined[50:], batch.rates)
    assert sampler.sample(3, torch.Generator().manual_seed(0)).rates is None


@pytest.mark.parametrize("step", [1_000, 1_000_000])
def test_rates_of_equal_stamps_are_those_of_a_step_of_the_clock(step: int):
    """The true rate of 3000 on events a second, whose stamps are whole steps, is never told ten times too large."""
    stamps = np.arange(0.0, 1e9, 1e9 / 3000).astype(np.int64) // step * step
    index = index_of({0: [(int(stamp), 1) for stamp in stamps]})
    assert index.resolution == step
    events = torch.arange(len(stamps))
    rates = rates_around(index, events, torch.zeros_like(events), 0, 0)[:, 0]
    assert rates.min() > 300 and rates.max() < 30_000


def test_the_same_seed_draws_the_same_pairs() -> None:
    sampler = EventPairSampler(index_of(recording(False)), "partner")
    one, same, other = (rows(sampler.sample(100, torch.Generator().manual_seed(seed))) for seed in (3, 3, 4))
    assert one == same != other


def test_absolute_times_keep_their_nanoseconds() -> None:
    late = 1_600_000_000_123_456_789
    pixels = {3: [(late, 1), (late + 1, 1), (late + 3, -1)]}
    pairs = EventPairSampler(index_of(pixels), "partner").sample(100, torch.Generator().manual_seed(0))
    assert set(rows(pairs)) == {(3, late, late + 1), (3, late, late + 3), (3, late + 1, late + 3)}
    assert_counts_are_right(pairs, pixels)


def test_more_pairs_than_int32_holds() -> None:
    count, distance = 70_000, 65_000
    zero = np.zeros(count, np.uint16)
    events = Events(x=zero, y=zero, t=np.arange(count), p=np.where(np.arange(count) % 3, 1, -1).astype(np.int8))
    sampler = EventPairSampler(EventIndex.from_events(events, 1, 1), "partner", distance)
    assert sampler.num_pairs == sum(count - d for d in range(1, distance + 1)) > 2**31
    pairs = sampler.sample(50_000, torch.Generator().manual_seed(0))
    gap = pairs.end - pairs.start
    assert gap.min() >= 1 and gap.max() <= distance and pairs.end.max() < count
    off = pairs.end // 3 - pairs.start // 3
    assert torch.equal(pairs.off, off) and torch.equal(pairs.on, gap - off)
    decile = np.array(
        [sum(count - d for d in range(k * distance // 10 + 1, (k + 1) * distance // 10 + 1)) for k in range(10)]
    )
    drawn = np.bincount((gap.numpy() - 1) * 10 // distance, minlength=10)
    assert chisquare(drawn, 50_000 * decile / decile.sum()).pvalue > 1e-3


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("pixels", [{1: [(5, 1)], 2: [(6, -1)]}, {1: [(5, 1), (5, 1)]}])
def test_no_pair_is_an_error(pixels: dict, mode) -> None:
    with pytest.raises(ValueError, match="no pair"):
        EventPairSampler(index_of(pixels), mode)


def test_no_pair_in_any_window_is_an_error() -> None:
    index = index_of({1: [(5, 1), (104, 1), (105, 1)], 2: [(204, -1), (205, -1)]})
    assert EventPairSampler(index, "window", window_ns=100).num_pairs == 1
    with pytest.raises(ValueError, match=r"within a window of 1e-06 ms"):
        EventPairSampler(index, "window", window_ns=1)


def test_no_event_at_all_is_an_error() -> None:
    empty = EventIndex(
        torch.zeros(0, dtype=torch.int64), torch.zeros(0, dtype=torch.int32), torch.zeros(21, dtype=torch.int64), WIDTH
    )
    for mode in ("successor", "window"):
        with pytest.raises(ValueError, match="no pair"):
            EventPairSampler(empty, mode)


def silent_stretches(
    pixels: dict, start: int, end: int, refractory: int = 0, gaps: bool = False
) -> dict[int, list[tuple[int, int]]]:
    """First and last instant of every stretch of each pixel without an event, by a loop over instants."""
    stretches = defaultdict(list)
    for pixel in range(WIDTH * HEIGHT):
        times = {t + blind for t, _ in pixels.get(pixel, []) for blind in range(max(refractory, 1))}
        begin = None
        for instant in range(start, end + 2):
            silent = instant <= end and instant not in times and not (gaps and stretch_of(instant) is None)
            if silent and begin is None:
                begin = instant
            elif not silent and begin is not None:
                stretches[pixel].append((begin, instant - 1))
                begin = None
    return stretches


@pytest.mark.parametrize(("start", "end"), [(START, END), (0, 1200), (300, 700)])
@pytest.mark.parametrize("equal_stamps", [False, True])
@pytest.mark.parametrize(("min_duration", "max_duration"), [(1, 2), (20, 60), (200, 10_000)])
@pytest.mark.parametrize("refractory", [0, 25])
def test_silent_pixels_are_silent(start, end, equal_stamps, min_duration, max_duration, refractory, device) -> None:
    pixels = recording(equal_stamps)
    pixels[1] = [(start, 1), (end, -1)]
    stretches = silent_stretches(pixels, start, end, refractory)
    long_enough = {pixel: [(a, b) for a, b in found if b - a >= min_duration] for pixel, found in stretches.items()}
    sampler = SilentPixelSampler(index_of(pixels, device), start, end, min_duration, max_duration)
    pairs = sampler.sample(3000, torch.Generator(device).manual_seed(2), refractory)
    assert len(pairs) == 3000 and pairs.pixels.device.type == device
    assert not pairs.on.any() and not pairs.off.any() and pairs.num_silent == len(pairs)
    assert_counts_are_right(pairs, pixels)
    for pixel, a, b in rows(pairs):
        assert a < b <= a + max_duration
        assert any(first <= a and b <= last for first, last in long_enough[pixel])
    assert set(pairs.pixels.tolist()) == {pixel for pixel, found in long_enough.items() if found}


def test_hot_pixels_only_look_silent(device: str) -> None:
    """Their events were left out, so that those of pixels 0, 7 and 19 might be."""
    pixels = recording(False)
    hot = torch.tensor([0, 19], device=device)
    sampler = SilentPixelSampler(replace(index_of(pixels, device), hot_pixels=hot), START, END, 1, 100)
    pairs = sampler.sample(5000, torch.Generator(device).manual_seed(0))
    assert set(pairs.pixels.tolist()) == set(range(WIDTH * HEIGHT)) - {0, 19}
    assert_counts_are_right(pairs, pixels)


@pytest.mark.parametrize("refractory", [0, 60])
def test_silent_pixels_are_drawn_in_proportion_to_their_silence(refractory: int) -> None:
    pixels = recording(False)
    sampler = SilentPixelSampler(index_of(pixels), START, END, 100, 400)
    pairs = sampler.sample(20_000, torch.Generator().manual_seed(3), refractory)
    stretches = silent_stretches(pixels, START, END, refractory)
    silence = np.array([sum(b - a + 1 for a, b in stretches[pixel] if b - a >= 100) for pixel in range(WIDTH * HEIGHT)])
    drawn = np.bincount(pairs.pixels.numpy(), minlength=WIDTH * HEIGHT)
    assert not drawn[silence == 0].any()
    expected = silence[silence > 0] * (20_000 / silence.sum())
    assert chisquare(drawn[silence > 0], expected).pvalue > 1e-3


@pytest.mark.parametrize("refractory", [0, 25])
def test_silent_pairs_start_and_end_outside_of_what_is_held_out(refractory: int, device: str) -> None:
    """At all other instants of a silence alike, also where it spans what is held out; none where it lies within."""
    pixels = {pixel: [] for pixel in range(WIDTH * HEIGHT)} | {0: [(199, 1), (240, 1), (330, -1)]}
    spans = [(200, 329), (400, 449), (600, 600)]
    held_out = {t for first, last in spans for t in range(first, last + 1)}
    sampler = SilentPixelSampler(
        index_of(pixels, device), START, END, 20, 5000, held_out=torch.tensor(spans, device=device)
    )
    pairs = sampler.sample(20_000, torch.Generator(device).manual_seed(0), refractory)
    assert len(pairs) == 20_000
    ends = Counter()
    for pixel, start, end in rows(pairs):
        assert start < end and not held_out & {start, end}
        assert pixel or not any(start - max(refractory, 1) < t <= end for t, _ in pixels[0])
        ends.update((start, end) if pixel else ())
    assert set(ends) == set(range(START, END + 1)) - held_out
    assert chisquare([*ends.values()]).pvalue > 1e-3


@pytest.mark.parametrize(("start", "end"), [(START, END), (0, 2500), (250, 480)])
@pytest.mark.parametrize("refractory", [0, 60])
def test_silent_pixels_keep_out_of_gaps(start: int, end: int, refractory: int, device: str) -> None:
    """Every instant outside the gaps is as likely as the others to be looked around."""
    pixels = recording(False)
    stretches = silent_stretches(pixels, start, end, refractory, gaps=True)
    shortest = 50 if end > 500 else 1
    long_enough = {pixel: [(a, b) for a, b in found if b - a >= shortest] for pixel, found in stretches.items()}
    parts = torch.tensor(STRETCHES, device=device)
    sampler = SilentPixelSampler(index_of(pixels, device), start, end, shortest, 200, parts)
    pairs = sampler.sample(20_000, torch.Generator(device).manual_seed(3), refractory)
    assert len(pairs) == 20_000
    assert_counts_are_right(pairs, pixels)
    drawn = Counter()
    for pixel, a, b in rows(pairs):
        assert a < b <= a + 200
        (around,) = [(first, last) for first, last in long_enough[pixel] if first <= a and b <= last]
        drawn[pixel, around] += 1
    silence = {(pixel, (a, b)): b - a + 1 for pixel, found in long_enough.items() for a, b in found}
    assert set(drawn) <= set(silence)
    expected = np.array([*silence.values()]) * (20_000 / sum(silence.values()))
    assert chisquare([drawn[key] for key in silence], expected).pvalue > 1e-3


def test_a_recording_in_one_gap_shows_no_silence() -> None:
    with pytest.raises(ValueError, match="All events lie in one gap"):
        SilentPixelSampler(index_of(recording(False)), 210, 320, 1, 100, torch.tensor(STRETCHES))


def test_two_instants_of_a_silent_pixel_are_uniform() -> None:
    pixels = {pixel: [(t, 1) for t in range(0, 100, 5)] for pixel in range(WIDTH * HEIGHT)}
    sampler = SilentPixelSampler(index_of(pixels), 0, 99, 3, 1000)
    pairs = sampler.sample(20_000, torch.Generator().manual_seed(4))
    drawn = Counter((start % 5, end % 5) for _, start, end in rows(pairs))
    expected = [(a, b) for a in range(1, 5) for b in range(a + 1, 5)]
    assert set(drawn) == set(expected)
    assert chisquare([drawn[pair] for pair in expected]).pvalue > 1e-3


def test_rare_silence_still_fills_the_batch() -> None:
    pixels = {pixel: [(t, 1) for t in range(0, 2000, 2)] for pixel in range(WIDTH * HEIGHT)}
    pixels[4] = [(t, p) for t, p in pixels[4] if not 1000 < t < 1040]
    pairs = SilentPixelSampler(index_of(pixels), 0, 1999, 20, 100).sample(5000, torch.Generator().manual_seed(0))
    assert len(pairs) == 5000 and set(pairs.pixels.tolist()) == {4}
    assert pairs.start.min() == 1001 and pairs.end.max() == 1039
    assert_counts_are_right(pairs, pixels)


def test_where_there_is_no_silence_pairs_are_of_one_instant() -> None:
    """Between which nothing changes, so that they cost nothing."""
    pixels = {pixel: [(t, 1) for t in range(0, 100, 5)] for pixel in range(WIDTH * HEIGHT)}
    never = SilentPixelSampler(index_of(pixels), 0, 99, 4, 1000), SilentIntervalSampler(index_of({3: [(5, 1), (7, 1)]}))
    for sampler in never:
        pairs = sampler.sample(64, torch.Generator().manual_seed(0))
        assert pairs.num_silent == len(pairs) == 64 and torch.equal(pairs.start, pairs.end)
        assert not (pairs.on + pairs.off).any()


@pytest.mark.parametrize("arguments", [{"max_distance": 0}, {"window_ns": 0}])
def test_impossible_pairs_are_refused(arguments: dict) -> None:
    with pytest.raises(ValueError, match="at least 1"):
        EventPairSampler(index_of(recording(False)), "partner", **arguments)


@pytest.mark.parametrize(("min_duration", "max_duration"), [(0, 10), (10, 1)])
def test_impossible_durations_are_refused(min_duration: int, max_duration: int) -> None:
    with pytest.raises(ValueError, match="at least"):
        SilentPixelSampler(index_of(recording(False)), START, END, min_duration, max_duration)


LONGEST = 90
"""Length of the longest window, in the tests of accumulation."""


def window_weights(pixels: dict, start: int, end: int, gaps: bool) -> dict[bool, Counter]:
    """How likely windows of (pixel, tenth of the time, ninth of the longest length) are, by a loop over all windows:
    of those with events (True), and of any (False)."""
    weights = {True: Counter(), False: Counter()}
    for last in range(start, end + 1):
        stretch = stretch_of(last)
        if gaps and stretch is None:
            continue
        earliest = max(start, STRETCHES[stretch][0]) if gaps and stretch is not None else start
        for duration in range(1, LONGEST + 1):
            first = max(last - duration, earliest)
            if first == last:
                continue
            for pixel in range(WIDTH * HEIGHT):
                key = pixel, (last - start) * 10 // (end - start + 1), (last - first - 1) * 9 // LONGEST
                weights[False][key] += 1
                if any(first < t <= last for t, _ in pixels[pixel]):
                    weights[True][key] += 1
    return weights


def assert_windows_as_likely(pairs: list[tuple[int, int, int]], weights: Counter, start: int, end: int) -> None:
    """By pixel and time, and by time and length (chi-square tests); what is expected less than five times is one."""
    keys = [(pixel, (b - start) * 10 // (end - start + 1), (b - a - 1) * 9 // LONGEST) for pixel, a, b in pairs]
    for chosen in (slice(2), slice(1, 3)):
        drawn, expected = Counter(key[chosen] for key in keys), defaultdict(float)
        for key, weight in weights.items():
            expected[key[chosen]] += weight * len(pairs) / weights.total()
        assert set(drawn) <= set(expected)
        rare = [key for key, number in expected.items() if number < 5]
        cells = [[key] for key in expected if key not in rare] + [rare] * bool(rare)
        counts, likely = ([sum(of[key] for key in cell) for cell in cells] for of in (drawn, expected))
        assert chisquare(counts, likely).pvalue > 1e-3


@pytest.mark.parametrize("gaps", [False, True])
@pytest.mark.parametrize("equal_stamps", [False, True])
def test_accumulated_windows_are_as_likely_as_a_loop_says(equal_stamps: bool, gaps: bool, device: str) -> None:
    """Of nine tenths, all windows in which the pixel fired; of the others, all windows."""
    pixels = recording(equal_stamps)
    start, end = 300, 700
    stretches = torch.tensor(STRETCHES, device=device) if gaps else None
    sampler = AccumulationSampler(index_of(pixels, device), start, end, LONGEST, stretches)
    pairs = sampler.sample(20_000, torch.Generator(device).manual_seed(0))
    assert len(pairs) == 20_000 and pairs.num_silent == 0 and pairs.pixels.device.type == device
    assert {column.dtype for column in pairs.columns} == {torch.int64}
    assert_counts_are_right(pairs, pixels)
    drawn = rows(pairs)
    assert all(start <= a < b <= min(a + LONGEST, end) for _, a, b in drawn)
    assert not gaps or all(stretch_of(a) == stretch_of(b) is not None for _, a, b in drawn)
    counts = pairs.on + pairs.off
    assert counts[:18_000].all() and not counts[18_000:].all()
    weights = window_weights(pixels, start, end, gaps)
    assert_windows_as_likely(drawn[:18_000], weights[True], start, end)
    assert_windows_as_likely(drawn[18_000:], weights[False], start, end)


def test_accumulated_windows_leave_hot_pixels_out_and_repeat_with_their_seed() -> None:
    hot = torch.tensor([0, 8])
    sampler = AccumulationSampler(replace(index_of(recording(False)), hot_pixels=hot), START, END, LONGEST)
    one, same, other = (rows(sampler.sample(5000, torch.Generator().manual_seed(seed))) for seed in (3, 3, 4))
    assert one == same != other
    assert {pixel for pixel, _, _ in one} == set(range(WIDTH * HEIGHT)) - {0, 8}


def test_rare_events_still_fill_a_batch_of_windows_and_none_leave_negatives() -> None:
    pixels: dict = defaultdict(list, {3: [(500, 1), (501, -1)]})
    pairs = AccumulationSampler(index_of(pixels), 0, 20_000, 40).sample(1000, torch.Generator().manual_seed(0))
    assert len(pairs) == 1000 and set(pairs.pixels[:900].tolist()) == {3}
    assert_counts_are_right(pairs, pixels)
    pairs = AccumulationSampler(index_of(pixels), 0, 10**12, 40).sample(1000, torch.Generator().manual_seed(0))
    assert len(pairs) == 1000 and not (pairs.on + pairs.off).any()
    assert torch.equal(pairs.start[:900], pairs.end[:900]) and (pairs.start[900:] < pairs.end[900:]).all()


def test_windows_that_cannot_be_drawn_are_refused() -> None:
    index = index_of({1: [(t, 1) for t in range(200, 330)], 2: [(250, 1)]})
    with pytest.raises(ValueError, match="outside the gaps of the poses, so there is nothing"):
        AccumulationSampler(index, *index.span, 10, torch.tensor(STRETCHES))
    with pytest.raises(ValueError, match="at least 1"):
        AccumulationSampler(index, *index.span, 0)
    with pytest.raises(ValueError, match="at two different times"):
        AccumulationSampler(index_of({1: [(5, 1)]}), 5, 5, 10)


@pytest.mark.parametrize("gaps", [False, True])
@pytest.mark.parametrize("refractory", [0, 12])
@pytest.mark.parametrize("equal_stamps", [False, True])
def test_silent_intervals_lie_between_successive_events(equal_stamps, refractory: int, gaps: bool, device: str) -> None:
    """Each interval is as likely as the others that hold two instants, and in it each pair of instants."""
    pixels = recording(equal_stamps)
    expected = {}
    for pixel, a, b in all_pairs(pixels, "successor", 1, gaps):
        first = a + max(refractory, 1)
        if first < b - 1 and not (gaps and stretch_of(a) != stretch_of(b)):
            expected[pixel, first, b - 1] = 0
    stretches = torch.tensor(STRETCHES, device=device) if gaps else None
    sampler = SilentIntervalSampler(index_of(pixels, device), stretches)
    pairs = sampler.sample(20_000, torch.Generator(device).manual_seed(0), refractory)
    assert pairs.num_silent == len(pairs) == 20_000 and not pairs.on.any() and not pairs.off.any()
    assert_counts_are_right(pairs, pixels)
    shares = []
    for pixel, a, b in rows(pairs):
        ((_, first, last),) = [key for key in expected if key[0] == pixel and key[1] <= a < b <= key[2]]
        expected[pixel, first, last] += 1
        instants = last - first + 1
        shares.append((b - a, instants))
    assert chisquare([*expected.values()]).pvalue > 1e-3
    # of n instants, n - d pairs have the distance d: the mean distance is (n + 1) / 3, its variance (n + 1)(n - 2) / 18
    deviations = [(d - (n + 1) / 3) / ((n + 1) * (n - 2) / 18) ** 0.5 for d, n in shares if n > 2]
    assert abs(np.sum(deviations)) < 4 * len(deviations) ** 0.5


def test_two_instants_of_a_silent_interval_are_uniform() -> None:
    sampler = SilentIntervalSampler(index_of({pixel: [(t, 1) for t in range(0, 100, 5)] for pixel in range(20)}))
    pairs = sampler.sample(20_000, torch.Generator().manual_seed(4))
    drawn = Counter((start % 5, end % 5) for _, start, end in rows(pairs))
    expected = [(a, b) for a in range(1, 5) for b in range(a + 1, 5)]
    assert set(drawn) == set(expected)
    assert chisquare([drawn[pair] for pair in expected]).pvalue > 1e-3


def level_after(events: list[tuple[int, int]], time: int) -> float:
    """What a pixel's events up to a time add up to, and what is left of the last of them, in thresholds; by a loop."""
    before = [polarity for t, polarity in events if t <= time]
    return sum(before) + (event_sampler.AHEAD * before[-1] if before else 0.0)


@pytest.mark.parametrize("gaps", [False, True])
@pytest.mark.parametrize("longest", [1, 90, 10**6])
@pytest.mark.parametrize("equal_stamps", [False, True])
def test_pairs_of_any_instants_tell_what_the_events_between_add_up_to(equal_stamps, longest: int, gaps: bool, device):
    pixels = recording(equal_stamps)
    stretches = torch.tensor(STRETCHES, device=device) if gaps else None
    sampler = InstantPairSampler(index_of(pixels, device), START, END, longest, stretches)
    batch = sampler.sample_chains(4001, torch.Generator(device).manual_seed(0))
    assert batch.links is not None and (len(batch), len(batch.links)) == (4001, 2000)
    assert all(instants == sorted(instants) for _, instants in chains(batch))
    pairs_and_links = []
    for one in (batch, batch.links):
        assert one.num_silent == one.num_of_events == 0 and one.num_any == len(one)
        assert not one.starts_at_events and one.ahead is not None
        pairs_and_links += zip(*(column.tolist() for column in (*one.columns, one.ahead)), strict=True)
    for pixel, start, end, on, off, ahead in pairs_and_links:
        assert START <= start <= end <= END
        assert not gaps or (stretch_of(start) is not None and stretch_of(end) is not None)
        gap = max(b[0] - a[1] for a, b in pairwise(STRETCHES)) if gaps else 0
        assert end - start <= longest + gap
        between = [polarity for t, polarity in pixels[pixel] if start < t <= end]
        assert (on, off) == (between.count(1), between.count(-1))
        told = level_after(pixels[pixel], end) - level_after(pixels[pixel], start) if between else 0.0
        assert on - off + ahead == pytest.approx(told, abs=1e-6)


def test_any_instants_are_drawn_alike_over_pixels_and_time():
    sampler = InstantPairSampler(index_of(recording(False)), START, END, 10**6)
    batch = sampler.sample(60_000, torch.Generator().manual_seed(0))
    assert batch.links is None
    assert chisquare(torch.bincount(batch.pixels, minlength=WIDTH * HEIGHT)).pvalue > 1e-3
    times = torch.cat([batch.start, batch.end])
    assert chisquare(torch.histc(times.double(), 19, START, END + 1)).pvalue > 1e-3
    fired = (batch.on + batch.off > 0).double().mean()
    assert 0.1 < fired < 0.9, "pairs are kept whether the pixel fired between them or not"


def test_any_instants_repeat_with_their_seed_and_leave_hot_pixels_out():
    index = replace(index_of(recording(False)), hot_pixels=torch.tensor([3, 4]))
    sampler = InstantPairSampler(index, START, END, 90)
    one, other = (sampler.sample(2000, torch.Generator().manual_seed(7)) for _ in range(2))
    assert all(torch.equal(a, b) for a, b in zip(one.columns, other.columns, strict=True))
    assert not {3, 4} & set(one.pixels.tolist())


def test_instants_that_are_no_time_apart_are_refused():
    with pytest.raises(ValueError, match="max_duration_ns"):
        InstantPairSampler(index_of(recording(False)), START, END, 0)


@pytest.mark.parametrize("sign", [1, -1])
def test_missed_changes_are_exact_where_log_brightness_has_a_constant_second_derivative(sign: int):
    """The first and the last event have one interval beside them alone."""
    refractory, threshold = 8_000_000, THRESHOLDS[sign < 0]

    def signal(time: float) -> float:
        return sign * (8e-9 * time + 10.0 * (1e-9 * time) ** 2)

    fired = fire(signal, 1e9, *THRESHOLDS, refractory)
    index = index_of({0: fired})
    missed = missed_changes(index, torch.arange(len(fired)), torch.zeros(len(fired), dtype=torch.long), refractory)
    expected = [sign * (signal(time + refractory) - signal(time)) / threshold for time, _ in fired]
    assert len(fired) > 15 and min(expected) > 0.25
    own, other = missed[1:-1, int(sign < 0)], missed[1:-1, int(sign > 0)]
    np.testing.assert_allclose(own, expected[1:-1], rtol=1e-5)
    assert not other.any()


def test_no_more_than_two_thresholds_count_as_missed_at_once():
    fired = [(0, 1), (1_000_101, 1), (2_000_203, -1), (3_000_307, -1)]
    events = torch.arange(4)
    missed = missed_changes(index_of({3: fired}), events, torch.full_like(events, 3), 1_000_000)
    assert missed.sum(dim=1).tolist() == pytest.approx([2, 2, 2, 2])
    assert (missed > 0.0).tolist() == [[True, False], [True, True], [False, True], [False, True]]


@pytest.mark.parametrize("pixels_at_once", [1, 3, 2**12])
def test_missed_changes_add_up_over_the_events_of_a_pixel(pixels_at_once: int, monkeypatch, device):
    monkeypatch.setattr("enerf_ns.events.missed_changes.PIXELS_AT_ONCE", pixels_at_once)
    pixels, blind = recording(False), 15
    index = index_of(pixels, device)
    missed = MissedChanges(index, blind)
    pixel_of = torch.repeat_interleave(torch.arange(WIDTH * HEIGHT, device=device), index.offsets.diff())
    single = missed_changes(index, torch.arange(len(index), device=device), pixel_of, blind).cpu().double().numpy()
    for sampler in (
        EventPairSampler(index, "partner", 4, missed=missed),
        EventPairSampler(index, "window", window_ns=WINDOW, missed=missed),
        HeldOutPairSampler(index, torch.tensor(STRETCHES, device=device), 4, missed),
        InstantPairSampler(index, START, END, 300, missed=missed),
    ):
        batch = sampler.sample(500, torch.Generator(device).manual_seed(0))
        for pixel, start, end, on, off in zip(*(column.tolist() for column in batch.columns), strict=True):
            own, of_own = pixels[pixel], single[int(index.offsets[pixel]) :]
            seen_from = min(start + blind, end - 1) if batch.starts_at_events else start
            expected = np.zeros(2)
            for (t, polarity), missed_then in zip(own, of_own, strict=False):
                expected[int(polarity < 0)] += start < t <= end
                for sign, until, time in ((-1, start, seen_from), (1, end, end)):
                    is_last = not any(t < later <= until for later, _ in own)
                    share = min((time - t) / blind, 1.0) if is_last else 1.0
                    expected += sign * (t <= until) * share * missed_then
            assert (on, off) == pytest.approx(tuple(expected), abs=1e-4)


@pytest.mark.parametrize("refractory", [1_000_000, 8_000_000])
def test_sums_with_what_was_missed_are_the_change_of_brightness(refractory: int):
    """Of pairs of events, and of any instants as exactly as for a pixel that is never blind."""

    def errors(blind: int, completed: bool) -> tuple[float, float]:
        """Root mean square errors of both kinds of pairs, in mean thresholds."""
        index = index_of({pixel: fire(signal_of(pixel), 1e9, *THRESHOLDS, blind) for pixel in range(6)})
        missed = MissedChanges(index, blind) if completed else None
        found = []
        for sampler in (
            EventPairSampler(index, "partner", 10, missed=missed),
            InstantPairSampler(index, 0, 10**9 - 1, 10**9, missed=missed),
        ):
            batch = sampler.sample(4000, torch.Generator().manual_seed(0))
            batch = batch.subset(batch.pixels < 6)
            seen = seen_from(batch, blind) if batch.starts_at_events else batch
            changes = [signal_of(pixel)(end) - signal_of(pixel)(start) for pixel, start, end in rows(seen)]
            off = sensor_with(blind).measured_change(seen).double().numpy() - changes
            found.append(float(np.sqrt((off**2).mean()) / np.mean(THRESHOLDS)))
        return found[0], found[1]

    (of_events, of_any), (_, of_ideal) = errors(refractory, True), errors(0, False)
    events_without, any_without = errors(refractory, False)
    assert of_events < 0.12 and of_events < 0.15 * events_without
    assert of_any < 1.15 * of_ideal < 0.8 and of_any < 0.95 * any_without


@pytest.mark.parametrize("refractory", [1_000_000, 8_000_000])
def test_links_of_chains_of_blind_pixels_reach_to_when_they_see_again(refractory: int):
    """All changes between the four instants of a chain, in one order, are that from its first to its last."""
    index = index_of({pixel: fire(signal_of(pixel), 1e9, *THRESHOLDS, refractory) for pixel in range(6)})
    sensor = sensor_with(refractory)
    sampler = EventPairSampler(index, "partner", 4, missed=MissedChanges(index, refractory))
    batch = sampler.sample_chains(2000, torch.Generator().manual_seed(0), refractory)
    links, number = batch.links, 1000
    assert links is not None and len(links) == number and not links.starts_at_events
    seen = seen_from(batch, refractory)
    assert torch.equal(links.start, seen.end[:number]) and torch.equal(links.end, seen.start[number:])
    assert (links.start < links.end).all()
    for part in (seen, links):
        changes = [signal_of(pixel)(end) - signal_of(pixel)(start) for pixel, start, end in rows(part)]
        off = sensor.measured_change(part).double().numpy() - changes
        assert np.sqrt((off**2).mean()) < 0.15 * np.mean(THRESHOLDS)
    assert batch.rates is not None and links.rates is not None
    torch.testing.assert_close(links.rates[:, 0], batch.rates[:number, 1])
    torch.testing.assert_close(links.rates[:, 1], batch.rates[number:, 0])

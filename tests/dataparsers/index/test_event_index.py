from __future__ import annotations

from collections import defaultdict

import numpy as np
import pytest
import torch

from enerf_ns.dataparsers.index.event_index import EventIndex, event_picture, sorted_bands, survey_events
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.recording import Events


def random_events(num_events: int, width: int, height: int, span: int) -> Events:
    rng = np.random.default_rng(num_events)
    return Events(
        x=rng.integers(0, width, num_events).astype(np.uint16),
        y=rng.integers(0, height, num_events).astype(np.uint16),
        t=np.sort(rng.integers(0, span, num_events)),
        p=rng.choice(np.array([-1, 1], np.int8), num_events),
    )


@pytest.mark.parametrize(
    ("num_events", "width", "height", "span"),
    [(0, 4, 3, 1), (1, 4, 3, 1), (500, 7, 5, 10**9), (500, 7, 5, 40), (300, 1, 1, 10**9), (50, 90, 70, 10**18)],
)
def test_index_equals_a_list_per_pixel(num_events: int, width: int, height: int, span: int) -> None:
    events = random_events(num_events, width, height, span)
    lists = defaultdict(list)
    for x, y, t, p in zip(events.x, events.y, events.t, events.p, strict=True):
        lists[int(y) * width + int(x)].append((int(t), int(p)))

    index = EventIndex.from_events(events, width, height)
    assert len(index.offsets) == width * height + 1
    assert len(index.times) == len(index.positives) == num_events
    for pixel in range(width * height):
        first, stop = index.offsets[pixel : pixel + 2].tolist()
        assert index.times[first:stop].tolist() == [t for t, _ in lists[pixel]]
        for i in range(first, stop):
            for j in range(i, stop):
                polarities = [p for _, p in lists[pixel][i - first + 1 : j - first + 1]]
                on = int(index.positives[j] - index.positives[i])
                assert on == polarities.count(1)
                assert j - i - on == polarities.count(-1)


def test_events_within_spans_are_those_of_a_mask() -> None:
    events = random_events(2000, 7, 5, 1000)
    index = EventIndex.from_events(events, 7, 5)
    spans = np.array([[500, 620], [10, 20], [15, 40], [900, 900], [990, 5000], [-9, -3]])
    inside = ((events.t[:, None] >= spans[:, 0]) & (events.t[:, None] <= spans[:, 1])).any(1)
    found = index.events_within(spans)
    order = np.lexsort((events.y[inside].astype(int) * 7 + events.x[inside], events.t[inside]))
    for name in "xyt":
        np.testing.assert_array_equal(getattr(found, name), getattr(events, name)[inside][order])
    assert sorted(zip(found.t, found.x, found.y, found.p, strict=True)) == sorted(
        zip(*(getattr(events, name)[inside] for name in "txyp"), strict=True)
    )
    assert len(index.events_within(np.zeros((0, 2), np.int64))) == 0


def test_events_of_one_time_keep_their_order() -> None:
    polarity = np.array([1, -1, -1, 1, 1, -1, 1], np.int8)
    zero = np.zeros(7, np.uint16)
    index = EventIndex.from_events(Events(x=zero, y=zero, t=np.full(7, 5), p=polarity), 2, 2)
    assert index.positives.diff().tolist() == [0, 0, 1, 1, 0, 1]


def test_strided_columns() -> None:
    columns = np.array([[1, 0, 3, 1], [0, 1, 7, -1], [1, 0, 9, 1]])
    events = Events(
        x=columns[:, 0].astype(np.uint16), y=columns[:, 1].astype(np.uint16), t=columns[:, 2], p=columns[:, 3]
    )
    index = EventIndex.from_events(events, 2, 2)
    assert index.times.tolist() == [3, 9, 7]
    assert index.positives.tolist() == [1, 2, 2]
    assert index.offsets.tolist() == [0, 0, 2, 3, 3]


def test_twelve_bytes_an_event(device: str) -> None:
    index = EventIndex.from_events(random_events(1000, 8, 6, 10**9), 8, 6).to(device)
    assert index.offsets.device.type == device
    assert index.times.dtype == torch.int64 and index.times.untyped_storage().nbytes() == 8 * 1000
    assert index.positives.dtype == torch.int32 and index.positives.untyped_storage().nbytes() == 4 * 1000


@pytest.mark.parametrize(("x", "y"), [(4, 0), (0, 3), (65535, 65535)])
def test_events_outside_the_sensor_are_refused(x: int, y: int) -> None:
    events = Events(
        x=np.array([0, x], np.uint16), y=np.array([0, y], np.uint16), t=np.array([0, 1]), p=np.ones(2, np.int8)
    )
    with pytest.raises(ValueError, match="outside the 4 x 3 sensor"):
        EventIndex.from_events(events, 4, 3)


def test_against_a_slow_dictionary_of_lists() -> None:
    rng = np.random.default_rng(3)
    events = random_events(5000, 16, 12, 10**6)
    start, end = 200_000, 800_000
    by_pixel: dict[int, list[tuple[int, int]]] = {}
    for x, y, t, p in zip(events.x.tolist(), events.y.tolist(), events.t.tolist(), events.p.tolist(), strict=True):
        if start <= t <= end:
            by_pixel.setdefault(y * 16 + x, []).append((t, p))
    pieces = np.split(np.arange(5000), np.sort(rng.integers(0, 5000, 9)))

    def stream():
        return iter([Events(*(getattr(events, name)[piece] for name in "xytp")) for piece in pieces])

    survey = survey_events(stream, 16, 12, start, end)
    for max_events in (1, 300, 5000):
        bands = list(sorted_bands(stream, survey, max_events))
        times, positives = (np.concatenate(parts) for parts in zip(*bands, strict=True))
        assert len(bands) > 1 or max_events == 5000
        index = EventIndex(torch.from_numpy(times), torch.from_numpy(positives), survey.offsets, 16)
        polarity = np.diff(positives, prepend=0) * 2 - 1
        for pixel in range(16 * 12):
            mine = slice(int(index.offsets[pixel]), int(index.offsets[pixel + 1]))
            assert list(zip(times[mine], polarity[mine], strict=True)) == by_pixel.get(pixel, [])

    pixels, instants = torch.from_numpy(rng.integers(0, 16 * 12, 500)), torch.from_numpy(rng.integers(0, 10**6, 500))
    counted = [
        sum(t <= time for t, _ in by_pixel.get(pixel, []))
        for pixel, time in zip(pixels.tolist(), instants.tolist(), strict=True)
    ]
    assert index.count_until(pixels, instants).tolist() == counted
    in_order = sorted((t, pixel, p) for pixel, fired in by_pixel.items() for t, p in fired)
    back = index.events()
    assert list(zip(back.t, back.y.astype(int) * 16 + back.x, back.p, strict=True)) == in_order
    assert index.span == (in_order[0][0], in_order[-1][0])
    assert index.num_positive == sum(p > 0 for _, _, p in in_order)
    assert len(index.events(at_most=100)) <= 100
    assert set(zip(*(column.tolist() for column in vars(index.events(at_most=100)).values()), strict=True)) <= set(
        zip(*(column.tolist() for column in vars(back).values()), strict=True)
    )


def test_a_picture_shows_the_latest_event_of_each_pixel() -> None:
    camera = Camera(10, 5, 10.0, 10.0, 5.0, 2.5)
    t = np.arange(20)
    x, y = np.array([t % 10, t // 10 % 5])
    x[15], y[15] = 3, 0  # again
    p = np.where(t % 3, 1, -1)
    index = EventIndex.from_events(Events(x, y, t, p), 10, 5)
    picture = event_picture(index, camera, 17)  # a fifth of 50 pixels: the latest ten
    drawn = {}
    for event in range(17, -1, -1):
        if len(drawn) < 10:
            drawn.setdefault((y[event], x[event]), p[event])
    for row in range(5):
        for column in range(10):
            red, _, blue = picture[row, column].tolist()
            expected = drawn.get((row, column))
            assert (red > blue, blue > red) == (expected == 1, expected == -1)


def test_a_picture_before_the_first_event_is_white() -> None:
    index = EventIndex.from_events(random_events(100, 8, 6, 10**6), 8, 6)
    assert (event_picture(index, Camera(8, 6, 10.0, 10.0, 4.0, 3.0), -1) == 255).all()

from __future__ import annotations

from collections import defaultdict

import numpy as np
import pytest
import torch

from enerf_ns.dataparsers.events import EventIndex
from enerf_ns.dataparsers.recording import Events


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

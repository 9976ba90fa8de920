from __future__ import annotations

import numpy as np
import pytest

from enerf_ns.dataparsers.index.event_index import EventIndex
from enerf_ns.dataparsers.recording.recording import Events
from enerf_ns.sensor.thresholds import balanced_thresholds


@pytest.mark.parametrize(("num_on", "num_off"), [(9, 3), (3, 9), (6, 6)])
def test_events_cancel_at_balanced_thresholds(num_on: int, num_off: int):
    polarities = np.repeat(np.array([1, -1], np.int8), (num_on, num_off))
    number = np.arange(num_on + num_off)
    index = EventIndex.from_events(
        Events((number % 4).astype(np.uint16), np.zeros_like(number, np.uint16), 1000 * number, polarities), 4, 1
    )
    on, off = balanced_thresholds(index)
    assert num_on * on == pytest.approx(num_off * off) and (on + off) / 2 == pytest.approx(1.0)

from __future__ import annotations

import numpy as np
import pytest
import torch

from enerf_ns.dataparsers.event_index import EventIndex
from enerf_ns.dataparsers.recording import Events
from enerf_ns.events.brightness_range import log_brightness_range
from enerf_ns.sensor.response import Linlog

WIDTH, HEIGHT = 100, 70  # more pixels than are looked at
THRESHOLDS = (0.2, 0.3)


def random_events() -> Events:
    generator = np.random.default_rng(0)
    number = 60_000
    x = generator.integers(0, WIDTH, number).astype(np.uint16)
    y = generator.integers(0, HEIGHT - 10, number).astype(np.uint16)  # the last rows are silent
    polarity = (2 * (generator.random(number) < 0.6) - 1).astype(np.int8)
    return Events(x, y, np.sort(generator.integers(0, 10**9, number)), polarity)


def ranges_by_a_loop(events: Events) -> list[float]:
    """Of each pixel with events, in the order of the pixels."""
    sums: dict[int, list[float]] = {}
    for x, y, p in zip(events.x.tolist(), events.y.tolist(), events.p.tolist(), strict=True):
        running = sums.setdefault(y * WIDTH + x, [0.0])
        running.append(running[-1] + (THRESHOLDS[0] if p > 0 else -THRESHOLDS[1]))
    return [max(running) - min(running) for _, running in sorted(sums.items())]


@pytest.mark.parametrize("share", [0.0, 0.5, 0.99, 1.0])
def test_it_is_the_quantile_over_pixels_of_how_far_their_sums_go(share: float):
    events = random_events()
    found = log_brightness_range(EventIndex.from_events(events, WIDTH, HEIGHT), THRESHOLDS, share)
    assert found == pytest.approx(np.quantile(ranges_by_a_loop(events)[::2], share))


def test_a_pixel_that_only_brightens_spans_its_events():
    events = Events(np.zeros(7, np.uint16), np.zeros(7, np.uint16), np.arange(7), np.ones(7, np.int8))
    assert log_brightness_range(EventIndex.from_events(events, 3, 2), (0.25, 0.1)) == pytest.approx(7 * 0.25)


def test_of_a_simulated_recording_it_is_what_its_frames_span(recording):
    """But for what is left over of a threshold at both ends."""
    from enerf_ns.dataparsers.files import load_image
    from enerf_ns.dataparsers.formats.registry import read_recording
    from enerf_ns.dataparsers.indexing import index_events

    read = read_recording(recording)
    assert read.frames is not None
    pictures = np.stack([load_image(file)[..., 0] for file in read.frames.filenames]) / 255.0
    levels = Linlog()(torch.from_numpy(pictures))
    spanned = float((levels.amax(0) - levels.amin(0)).quantile(0.99))
    found = log_brightness_range(index_events(read), (0.25, 0.25))
    assert spanned - 0.5 <= found <= spanned + 0.5

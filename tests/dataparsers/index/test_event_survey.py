"""One pass over the events, against loops."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import median_filter

from enerf_ns.dataparsers.index.event_survey import EventStream, sorted_bands, survey_events
from enerf_ns.dataparsers.recording.recording import Events


def test_hot_pixels_are_found_by_their_neighbourhood() -> None:
    rng = np.random.default_rng(0)
    width, height = 24, 18
    counts = rng.poisson(20, (height, width))
    counts[:, 12:] = rng.poisson(150, (height, 12))  # texture beside a plain region
    counts[3, 4] = 2000
    counts[0, 0] = 1500  # at the border
    counts[9, 20] = 1000  # six times its neighbours: an edge
    counts[17, 2] = 0
    pixels = np.repeat(np.arange(width * height), counts.ravel())
    rng.shuffle(pixels)
    stream = [Events(pixels % width, pixels // width, np.arange(len(pixels)), np.ones(len(pixels), np.int8))]
    survey = survey_events(lambda: iter(stream), width, height, 0, len(pixels))
    np.testing.assert_array_equal(survey.counts, counts.ravel())
    usual = median_filter(counts, size=5, mode="nearest")
    survey.leave_out_hot_pixels(height)
    np.testing.assert_array_equal(survey.hot_pixels, np.flatnonzero(counts > 10 * np.maximum(usual, 5)))
    assert survey.hot_pixels.tolist() == [0, 3 * width + 4]
    assert survey.num_hot_events == 3500
    ((times, positives),) = sorted_bands(lambda: iter(stream), survey, 2**31)
    kept = np.flatnonzero(~np.isin(pixels, survey.hot_pixels))
    np.testing.assert_array_equal(times, kept[np.argsort(pixels[kept], kind="stable")])
    np.testing.assert_array_equal(positives, np.arange(1, len(kept) + 1))


def stream_of(rows: np.ndarray, pieces: int) -> EventStream:
    return lambda: (Events(*piece.T) for piece in np.array_split(rows, pieces))


@pytest.mark.parametrize("pieces", [1, 3, 10])
def test_a_survey_counts_what_a_loop_counts(pieces: int):
    random = np.random.default_rng(0)
    t = np.sort(random.integers(0, 1000, 500))
    rows = np.column_stack([random.integers(0, 5, 500), random.integers(0, 4, 500), t, random.integers(0, 2, 500)])
    survey = survey_events(stream_of(rows, pieces), 5, 4, 100, 800)
    counts = np.zeros(20, int)
    for x, y, time, _ in rows.tolist():
        counts[5 * y + x] += 100 <= time <= 800
    np.testing.assert_array_equal(survey.counts, counts)
    assert (survey.num_events, survey.first, survey.last) == (500, t[0], t[-1])
    assert survey.outside is survey.backwards is survey.odd_polarity is None
    np.testing.assert_array_equal(survey.offsets, np.concatenate([[0], np.cumsum(counts)]))


@pytest.mark.parametrize("max_events", [1, 37, 10**6])
def test_bands_are_the_events_sorted_by_pixel_and_time(max_events: int):
    random = np.random.default_rng(1)
    t = np.sort(random.integers(0, 300, 200))
    rows = np.column_stack([random.integers(0, 3, 200), random.integers(0, 3, 200), t, random.integers(0, 2, 200)])
    survey = survey_events(stream_of(rows, 4), 3, 3, 0, 300)
    bands = list(sorted_bands(stream_of(rows, 4), survey, max_events))
    times, positives = (np.concatenate(columns) for columns in zip(*bands, strict=True))
    order = sorted(range(200), key=lambda i: 3 * rows[i, 1] + rows[i, 0])
    np.testing.assert_array_equal(times, rows[order, 2])
    np.testing.assert_array_equal(positives, np.cumsum(rows[order, 3]))


@pytest.mark.parametrize(
    ("row", "fault"), [([5, 0, 50, 1], "outside"), ([0, 0, 9, 1], "backwards"), ([0, 0, 50, -1], "odd_polarity")]
)
def test_a_survey_ends_at_the_first_fault(row: list[int], fault: str):
    rows = np.array([[0, 0, 10, 0], [1, 1, 20, 1], row, [9, 9, 5, 9]])
    survey = survey_events(stream_of(rows, 2), 5, 4, 0, 100)
    found = {name: getattr(survey, name) for name in ("outside", "backwards", "odd_polarity")}
    assert found == {**dict.fromkeys(found), fault: 2}
    assert survey.odd_event == tuple(row)

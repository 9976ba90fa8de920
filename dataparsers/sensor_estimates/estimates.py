"""Estimates of sensor parameters from a recording, before training, each with its standard error."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int64
from scipy.optimize import nnls
from torch import Tensor

from enerf_ns.dataparsers.index.event_index import EventIndex
from enerf_ns.dataparsers.index.event_rates import missed_changes
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.recording.recording import CONTRAST_THRESHOLD_LIMITS, EventRecording
from enerf_ns.dataparsers.sensor_estimates.frame_contrast import thresholds_from_frames

ASSUMED_THRESHOLD = 0.25
"""Mean threshold that is assumed if no frames determine it. Events determine log brightness only up to this factor."""

SAMPLED_EVENTS = 2**21
"""Largest number of events that are used: the events of evenly spaced pixels."""

FEWEST_INTERVALS = 10_000
"""Smallest number of intervals between events of one pixel that show whether there is a refractory period."""

SHARP_EDGE = 1.25
"""Largest ratio between quantiles of the intervals in which brightness goes on that a refractory period explains; see
`refractory_period`. It is 1.1 to 6 in simulated recordings without a period, and at most 1.18 in simulated recordings
with a period that causes many misses."""

LARGEST_TURN = 1.6
"""Largest ratio between the shortest intervals in which brightness turns back and those in which it goes on that a
refractory period explains. It is 2.2 to 17 in simulated recordings without a period. With a period it is 1 for fast
brightness, and up to 1.3 for brightness so slow that pixels take half of the period again until their next event."""

PERIOD_ERROR = 0.01
"""Smallest relative error of the refractory period; see `refractory_period`."""

WINDOWS = tuple(round(8 * 2 ** (i / 2)) for i in range(24))
"""Numbers of successive events of a pixel that are summed. Over fewer events, the scene alone makes the sum grow."""

FEWEST_PIXELS, LEAST_SHARE = 200, 0.1
"""Smallest number of pixels with as many events as are summed, and smallest share of the pixels with any. The few
pixels with the most events are unusual."""

BALANCE_ERROR = 0.01
"""Smallest relative error of thresholds from counts: a leak adds on events, and a scene may brighten as a whole."""

SPREAD_ERROR = 0.08
"""Smallest relative error of the spread of thresholds, from the growth that the scene itself causes."""

GROUPS = 16
"""Parts of the sensor, each left out once for standard errors (jackknife)."""

SIGNIFICANT = 3.0
"""Standard errors from 0 beyond which a parameter differs from 0 significantly."""

LEAST_GROWTH = 0.5
"""Smallest share of the variance of the longest sums that a spread of thresholds must cause to be identifiable. A scene
causes some tenths of it."""


FEWEST_SLOPE = 16
"""Smallest number of events of a pixel for which the slope of their sum is used."""

FIRST_DIFFERENCE = 0.05
"""Prior standard deviation of the relative difference of a pixel's thresholds."""

MEDIAN_OF_SQUARES = 0.4549
"""Median of the square of a normal deviate of variance 1."""

PIXELS_AT_ONCE = 2**12
"""Pixels whose events are processed together."""


@dataclass(frozen=True)
class Estimate:
    """An estimate of a parameter of the sensor."""

    value: float
    error: float
    """Standard error in the same unit; infinite for a value that is assumed."""
    why: str
    """Half a sentence that can follow "because", with the numbers that the estimate rests on."""


def refractory_period(index: EventIndex) -> Estimate | None:
    """Time (ns) for which a pixel is blind after an event, if the events show it.

    With a refractory period, the intervals between events of one pixel have a sharp lower edge: low quantiles lie close
    together. The edge is nearly the same for intervals in which brightness goes on and in which it turns back. Without
    a period, intervals in which brightness turns back are several times as long. Quantiles are used, since jitter and
    read-out set the shortest interval. The edge is the straight line through the quantiles of 0.1 and 0.3 % of the
    intervals in which brightness goes on, at 0 %. Even the fastest brightness takes some time from the end of the
    period to the next threshold. The difference between turning back and going on measures this time; a quarter of it
    is subtracted. The error combines half of that difference, half of the distance from the edge to the quantile of
    1 %, and 1 %. In simulations with a period of 8 ms, the estimate is 8.0 to 8.1 ms for fast brightness and 7.6 to
    10.6 ms for slow brightness.

    Args:
        index: On the CPU.

    Returns:
        None if the events show no period: there is no edge, or too few intervals are shorter than the motion makes
        them.
    """
    times, is_on, follows = _sampled(index)
    intervals, turns = np.diff(times)[follows], (is_on[1:] != is_on[:-1])[follows]
    if len(intervals) < FEWEST_INTERVALS or min(turns.sum(), (~turns).sum()) < FEWEST_INTERVALS / 10:
        return None
    lowest, low, high = np.quantile(intervals[~turns], [0.001, 0.003, 0.01]).tolist()
    back = float(np.quantile(intervals[turns], 0.01))
    if lowest <= 0 or high > SHARP_EDGE * lowest or not 1 / LARGEST_TURN < back / high < LARGEST_TURN:
        return None
    edge, slow = lowest - 0.5 * (low - lowest), max(back - high, 0.0)
    period = max(edge - 0.25 * slow, 0.0)
    return Estimate(
        float(period),
        math.hypot(0.5 * slow, 0.5 * (high - edge), PERIOD_ERROR * edge),
        f"of {len(intervals):,} intervals between events of a pixel, 99 % are longer than {_ms(high)} where brightness "
        f"goes on, of which 99.9 % are longer than {_ms(lowest)}, and than {_ms(back)} where it turns back",
    )


def share_closer(index: EventIndex, time: int) -> float:
    """Share of the intervals between successive events of one pixel that are shorter than a time (ns)."""
    times, _, follows = _sampled(index)
    return float((np.diff(times)[follows] < time).mean()) if follows.any() else 0.0


def contrast_thresholds(recording: EventRecording, blind_for: int) -> tuple[Estimate, Estimate, bool]:
    """C_on and C_off, and whether their mean was measured.

    Frames of the same camera determine both (`thresholds_from_frames`). Without them, the mean is `ASSUMED_THRESHOLD`,
    and the errors are those of the ratio. Over a long recording the changes of every pixel nearly cancel, so that
    (on events) C_on = (off events) C_off. A sensor with a refractory period misses more of the faster changes, which
    are not equally often of either polarity: the ratio of counts is wrong by a factor of 1.2 to 1.65 in simulated
    recordings. The thresholds of such a sensor are assumed to be equal, with infinite error.

    Args:
        recording: The recording; its index is made if it does not exist.
        blind_for: The refractory period, ns; 0 for none.

    Raises:
        RecordingError: The events or a frame cannot be used.
    """
    index = index_events(recording)
    measured = thresholds_from_frames(recording, blind_for)
    if measured is not None:
        values, errors, why = measured
        on, off = (Estimate(float(value), float(error), why) for value, error in zip(values, errors, strict=True))
        return on, off, True
    num_on, num_off = index.num_positive, len(index) - index.num_positive
    if blind_for or not num_on or not num_off:
        why = "the sensor misses changes while it is blind" if blind_for else "the events are of one polarity"
        assumed = Estimate(ASSUMED_THRESHOLD, math.inf, f"{why}, so that both thresholds are assumed to be equal")
        return assumed, assumed, False
    counts = index.offsets.diff().numpy()
    rises = torch.where(index.offsets > 0, index.positives[(index.offsets - 1).clamp(min=0)], 0)
    on_of_pixels = rises.diff().numpy()
    edges = np.linspace(0, len(counts), GROUPS + 1).astype(int)[:-1]
    of_groups = np.stack([np.add.reduceat(column, edges) for column in (on_of_pixels, counts - on_of_pixels)])
    without = of_groups.sum(1, keepdims=True) - of_groups
    values = _balanced(np.array([num_on]), np.array([num_off]))[:, 0]
    errors = np.hypot(_jackknife(_balanced(*without)), BALANCE_ERROR * values)
    why = f"{num_on:,} on and {num_off:,} off events darken as much as they brighten; the mean is assumed"
    on, off = (Estimate(float(value), float(error), why) for value, error in zip(values, errors, strict=True))
    return on, off, False


def threshold_spread(index: EventIndex, contrast_thresholds: tuple[float, float]) -> Estimate | None:
    """Relative standard deviation of thresholds from pixel to pixel.

    A spread makes the variance of a pixel's sum of events grow with the square of their number. The brightness of a
    scene is bounded, and noise makes the variance grow with the number.

    Args:
        index: On the CPU.
        contrast_thresholds: C_on and C_off; only their ratio matters.

    Returns:
        None if it does not differ from 0 significantly, or if the sensor has a refractory period, whose misses look
        alike.
    """
    if refractory_period(index) is not None:
        return None
    growth = _growth(index, contrast_thresholds, with_spread=True)
    if growth is None:
        return None
    square, error = growth.values[2], growth.errors[2]
    if not square > SIGNIFICANT * error or square * growth.squares < LEAST_GROWTH * growth.variance:
        return None
    spread, share = math.sqrt(square), square * growth.squares / growth.variance
    why = (
        f"the sums of {growth.longest} successive events of a pixel vary by {growth.variance:.3g} squared thresholds, "
        f"{100 * share:.0f} % of it in step with the square of their number"
    )
    return Estimate(spread, math.hypot(error / (2 * spread), SPREAD_ERROR * spread), why)


def noise_per_event(index: EventIndex, contrast_thresholds: tuple[float, float], completed_ns: int = 0) -> Estimate:
    """Variance that noise adds to a pixel's sum of events with each event, in squared mean thresholds: the part of the
    variance that grows with the number of events, as in a random walk.

    Args:
        index: On the CPU.
        contrast_thresholds: C_on and C_off; only their ratio matters.
        completed_ns: Sums are completed by what pixels missed that were blind for this time after each event
            (`missed_changes`). Default: they are not.

    Returns:
        0 with infinite error if pixels have too few events.
    """
    with_spread = not completed_ns and refractory_period(index) is None
    growth = _growth(index, contrast_thresholds, with_spread, completed_ns)
    if growth is None:
        return Estimate(0.0, math.inf, f"hardly any pixels have {WINDOWS[2]} events")
    why = (
        f"the sums of {WINDOWS[0]} to {growth.longest} successive events of a pixel vary by {growth.first:.3g} to "
        f"{growth.variance:.3g} squared thresholds"
    )
    return Estimate(float(growth.values[1]), float(growth.errors[1]), why)


def scene_variance(
    index: EventIndex, contrast_thresholds: tuple[float, float], noise: float, completed_ns: int = 0
) -> float:
    """Variance of the log brightness of a scene that a pixel sees, in squared mean thresholds.

    It is the largest variance of a pixel's sum of events over any number of them, less the variance that noise adds.

    Args:
        index: On the CPU.
        contrast_thresholds: C_on and C_off; only their ratio matters.
        noise: Variance that noise adds with each event (`noise_per_event`).
        completed_ns: As in `noise_per_event`.

    Returns:
        0 if pixels have too few events.
    """
    growth = _growth(index, contrast_thresholds, False, completed_ns)
    return 0.0 if growth is None else max(float((growth.variances - noise * growth.lengths).max()), 0.0)


def threshold_differences(
    index: EventIndex, contrast_thresholds: tuple[float, float], noise: float
) -> tuple[Float32[Tensor, " pixels"], Float32[Tensor, " pixels"]]:
    """Relative deviation of the on threshold of each pixel less that of its off threshold, from its events.

    A pixel with a relatively high on threshold fires too few on events, so that the running sum of its events falls,
    while brightness comes and goes. The difference is therefore the slope of that sum over the events (least squares),
    in thresholds. A leak adds a slope in proportion to time, and a wrong ratio of the sensor's thresholds adds the same
    slope everywhere: both are fitted to the slopes of all pixels, and subtracted. Brightness itself makes slopes differ
    by an amount that falls with the cube of the number of events. The slopes of the first and the second half of the
    events of each pixel give this amount.

    Args:
        index: On the CPU, of a sensor without a refractory period, during which changes are missed.
        contrast_thresholds: C_on and C_off; only their ratio matters.
        noise: Variance that noise adds with each event (`noise_per_event`).

    Returns:
        The relative difference, and its variance; 0 and infinity for pixels with fewer than `FEWEST_SLOPE` events.
    """
    on, off = (threshold / (0.5 * sum(contrast_thresholds)) for threshold in contrast_thresholds)
    parts = [_sums_for_slopes(index, on, off, first) for first in range(0, len(index.offsets) - 1, PIXELS_AT_ONCE)]
    halves = np.concatenate(parts, axis=1)  # sums, pixels, halves
    number = halves[0].sum(1)
    enough = number >= FEWEST_SLOPE
    difference, variance = np.zeros(len(number)), np.full(len(number), np.inf)
    if enough.any():
        slopes, (first, second) = _slopes(halves.sum(2)[:, enough]), _slopes(halves[:, enough]).T
        n = number[enough]
        # a random walk's slope over n steps has a variance of 1.2 of a step's over n; m grows by a half with each
        scatter = float(np.median((second - first) ** 2 * n**3)) / MEDIAN_OF_SQUARES
        scene = max(scatter / 16 - 1.2 * noise * float(np.median(n**2)), 0.0)
        spread = scene / n**3 + 4.8 * noise / n
        common = np.stack([np.ones(len(n)), 1 / n], axis=1)
        weight = 1 / np.sqrt(spread + FIRST_DIFFERENCE**2)
        fitted = np.linalg.lstsq(common * weight[:, None], slopes * weight, rcond=None)[0]
        difference[enough], variance[enough] = common @ fitted - slopes, np.maximum(spread, 1e-8)
    return torch.from_numpy(difference).float(), torch.from_numpy(variance).float()


def _sums_for_slopes(index: EventIndex, on: float, off: float, first: int) -> Float64[np.ndarray, "5 pixels 2"]:
    """Number, and sums of m, y, m * m and m * y, over each half of the events of some pixels. y is the sum of the
    events of the pixel so far, in mean thresholds; m is half of their sum without signs."""
    offsets = index.offsets[first : first + PIXELS_AT_ONCE + 1]
    begin, end = int(offsets[0]), int(offsets[-1])
    counts = offsets.diff()
    pixel = torch.repeat_interleave(torch.arange(len(counts)), counts)
    number = torch.arange(begin, end) - offsets[pixel] + 1
    before = torch.where(offsets > 0, index.positives[(offsets - 1).clamp(min=0)], 0)
    rises = on * (index.positives[begin:end] - before[pixel]).double()
    falls = off * number.double() - rises * (off / on)
    level, passed = rises - falls, 0.5 * (rises + falls)
    part = (2 * pixel + (2 * number > counts[pixel])).numpy()
    weights = (None, passed, level, passed * passed, passed * level)
    columns = [np.bincount(part, None if w is None else w.numpy(), 2 * len(counts)) for w in weights]
    return np.stack(columns).astype(np.float64).reshape(5, -1, 2)


def _slopes(sums: Float64[np.ndarray, "5 *sets"]) -> Float64[np.ndarray, "*sets"]:
    """Slopes of y over m by least squares, from their number and their sums."""
    number, m, y, mm, my = sums
    return (number * my - m * y) / np.maximum(number * mm - m * m, 1e-12)


def median_interval(index: EventIndex) -> float:
    """Median time (ms) from an event to the next of its pixel, in which brightness changes by a threshold.

    Args:
        index: On the CPU.

    Returns:
        Infinity if no pixel has two events.
    """
    times, _, follows = _sampled(index)
    return 1e-6 * float(np.median(np.diff(times)[follows])) if follows.any() else math.inf


@dataclass(frozen=True)
class _Growth:
    """How the variance of sums of events grows with their number, in squared mean thresholds."""

    values: Float64[np.ndarray, "3"]
    """Constant variance, variance that each event adds, and squared spread."""
    errors: Float64[np.ndarray, "3"]
    longest: int
    """Number of events of the longest sums."""
    first: float
    """Variance of the shortest sums."""
    variance: float
    """Variance of the longest sums."""
    squares: float
    """Variance that a squared spread of 1 would add to the longest sums."""
    lengths: Int64[np.ndarray, " windows"]
    """Numbers of events that are summed."""
    variances: Float64[np.ndarray, " windows"]
    """Variance of the sums of each number."""


def _growth(
    index: EventIndex, contrast_thresholds: tuple[float, float], with_spread: bool, completed_ns: int = 0
) -> _Growth | None:
    """The growth of the sums of `WINDOWS` events, by a fit to their variance with coefficients of at least 0."""
    on, off = np.array(contrast_thresholds) / np.mean(contrast_thresholds)
    chosen, pixels = _sampled_events(index)
    times, is_on, follows = _sampled(index)
    pixel = np.concatenate([[0], np.cumsum(~follows)])
    ups = np.concatenate([[0.0], np.cumsum(is_on)])
    numbers = np.arange(len(times) + 1)
    total = on * ups - off * (numbers - ups)
    if completed_ns:
        missed = missed_changes(index, chosen, pixels, completed_ns).double().numpy()
        total[1:] += np.cumsum(on * missed[:, 0] - off * missed[:, 1])
    drift = total[-1] / len(times)
    per_pixel = np.bincount(pixel)
    group = pixel * GROUPS // len(per_pixel)
    fewest = max(FEWEST_PIXELS, LEAST_SHARE * len(per_pixel))
    rows = []
    for length in WINDOWS:
        if np.count_nonzero(per_pixel >= length) < fewest:
            break
        within = pixel[length - 1 :] == pixel[: len(pixel) - length + 1]
        begin = np.flatnonzero(within)
        sums = total[begin + length] - total[begin] - drift * length
        rises = ups[begin + length] - ups[begin]
        squares = (on * rises) ** 2 + (off * (length - rises)) ** 2
        of = group[begin]
        rows.append([np.bincount(of, weights, GROUPS) for weights in (None, sums**2, squares)])
    if len(rows) < 3:
        return None
    table = np.array(rows)  # windows, (number, squared sums, squares), groups

    def fit(table: np.ndarray) -> np.ndarray:
        number, variance, squares = table.sum(2).T
        variance, squares = variance / number, squares / number
        columns = np.stack([np.ones(len(number)), WINDOWS[: len(number)], squares * with_spread], axis=1)
        weights = 1 / (1 + variance)  # events are whole thresholds
        return nnls(columns * weights[:, None], variance * weights)[0]

    number, variance, squares = table.sum(2).T
    without = np.stack([fit(np.delete(table, i, axis=2)) for i in range(GROUPS)], axis=1)
    return _Growth(
        values=fit(table),
        errors=_jackknife(without),
        longest=WINDOWS[len(rows) - 1],
        first=float(variance[0] / number[0]),
        variance=float(variance[-1] / number[-1]),
        squares=float(squares[-1] / number[-1]),
        lengths=np.array(WINDOWS[: len(rows)]),
        variances=variance / number,
    )


def _sampled(
    index: EventIndex,
) -> tuple[Int64[np.ndarray, " events"], Bool[np.ndarray, " events"], Bool[np.ndarray, " events-1"]]:
    """Times of the events of some pixels, whether each is an on event, and whether it follows one of its pixel."""
    chosen, pixels = _sampled_events(index)
    before = torch.where(chosen > 0, index.positives[(chosen - 1).clamp(min=0)], 0)
    is_on = (index.positives[chosen] > before).numpy()
    return index.times[chosen].numpy(), is_on, (pixels[1:] == pixels[:-1]).numpy()


def _sampled_events(index: EventIndex) -> tuple[Int64[Tensor, " events"], Int64[Tensor, " events"]]:
    """Numbers of the events of some pixels in the index, and the pixel of each."""
    step = -(-len(index) // SAMPLED_EVENTS) | 1
    pixels = torch.arange(0, len(index.offsets) - 1, step)
    first, counts = index.offsets[pixels], index.offsets[pixels + 1] - index.offsets[pixels]
    ends = counts.cumsum(0)
    chosen = torch.repeat_interleave(first - ends + counts, counts) + torch.arange(int(ends[-1]))
    return chosen, torch.repeat_interleave(pixels, counts)


def _balanced(num_on: Int64[np.ndarray, " sets"], num_off: Int64[np.ndarray, " sets"]) -> Float64[np.ndarray, "2 sets"]:
    """C_on and C_off under which events of both polarities cancel, both at least the smallest threshold."""
    both, least = 2 * ASSUMED_THRESHOLD, CONTRAST_THRESHOLD_LIMITS[0]
    on = np.clip(both * num_off / np.maximum(num_on + num_off, 1), least, both - least)
    return np.stack([on, both - on])


def _jackknife(without: Float64[np.ndarray, "values groups"]) -> Float64[np.ndarray, " values"]:
    """Standard errors of values, from the values without each group (jackknife)."""
    groups = without.shape[1]
    return np.sqrt((groups - 1) / groups * ((without - without.mean(1, keepdims=True)) ** 2).sum(1))


def _ms(time: float) -> str:
    return f"{time * 1e-6:.4g} ms"

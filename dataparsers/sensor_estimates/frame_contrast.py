"""Estimates from frames of the same camera of what events leave open: contrast thresholds and the level of
brightness."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from scipy import ndimage

from enerf_ns.dataparsers.index.event_index import EventIndex
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.recording.picture_depth import LUMA, brightness
from enerf_ns.dataparsers.recording.recording import CONTRAST_THRESHOLD_LIMITS, EventRecording, Frames

DARKEST, BRIGHTEST = 20, 245
"""Darkest and brightest grey level of the pixels of frames that are used. Darker levels are rounded by more than 2.5 %,
and not all responses are logarithms there; brighter ones may be saturated."""

NUM_STARTS = 24
"""Largest number of frames that others are compared to."""

SAMPLED_PIXELS = 2**15
"""Largest number of pixels of a frame that are compared, evenly spaced."""

EVENTS_BETWEEN = 0.25
"""Smallest mean number of events of a pixel between the frames that are compared; fewer carry little information."""

FEWEST_NEIGHBOURS = 4
"""Smallest number of the eight pixels around one whose changes must be known."""

GONE_ON = 0.35
"""Thresholds by which log brightness has gone on since the last event, in its direction. With this value, the estimated
thresholds of simulated recordings of ideal sensors are right within 3 %."""

FAINTEST = 0.01
"""Brightness up to which pixels are left out of a mean of log brightness, since the logarithm of black is unknown."""

FEWEST_ROWS = 1000
"""Smallest number of changes of a pixel between frames that thresholds are fitted to."""

FEWEST_QUIET, EXPOSURE_CHANGES = 200, 0.02
"""Smallest number of pixels without events between two frames that determine the change of exposure, and smallest
change of log brightness from frame to frame at which an exposure counts as changing. The change was at most 0.011 in 12
simulated recordings with a constant exposure and in slider_depth. It is 0.04 for an exposure that wanders by 40 %
within a second, with 41 frames."""

TAKEN_OFF = 0.04
"""Smallest such change that is subtracted before thresholds are measured; a smaller one harms them less than the
subtraction."""

INSTANTS = 5
"""Instants of an exposure at which events are counted."""

MODEL_ERROR, BLURRED_ERROR = 0.03, 0.08
"""Smallest relative error for sharp and for blurred frames; see `thresholds_from_frames`."""

MOST_FRAMES = 200
"""Largest number of successive frames that are searched for those that enclose an interval."""

NEAREST_ROWS = 400
"""Intervals of each polarity from which the thresholds of a blind sensor come: those that frames enclose most
closely."""

FEWEST_NEAREST = 50
"""Smallest number of such intervals."""

LARGEST_ERROR = 0.5
"""Largest relative error of thresholds that count as measured."""


def thresholds_from_frames(
    recording: EventRecording, blind_for: int
) -> tuple[Float64[np.ndarray, "2"], Float64[np.ndarray, "2"], str] | None:
    """C_on and C_off with which the events explain the changes of log brightness from frame to frame.

    Frames are linear, with the response that the recording states. A change is
    C_on * (on events) - C_off * (off events). The last event before each frame counts `GONE_ON` more, since a pixel
    after an on event is probably above its memorised value. With least squares, the noise of the events would lower the
    thresholds (attenuation in a regression: to less than two thirds on slider_depth). The mean change of the
    neighbouring pixels is independent of that noise. It therefore takes the place of the events in the normal equations
    (instrumental variables, one for changes up and one for changes down). The difference between the results of frames
    at one and at two steps is part of the error. On simulated recordings with known thresholds the mean is right within
    4 % (validation set, `floor`, `relief`, `clutter`, `near`). For a sensor with all faults but blindness
    (`clutter-faults`) it is 14 % high.

    A sensor with a refractory period misses changes. From the end of the period to the next event, brightness still
    changes by one threshold. The intervals that two frames enclose most closely are used, and extrapolated in a
    straight line to intervals that frames enclose exactly. Half of the scatter is part of the error.

    Args:
        recording: The recording; its index is made if it does not exist. Its sharp frames are used, else the blurred
            ones, whose events are counted at several instants of the exposure.
        blind_for: The refractory period, ns; 0 for none.

    Returns:
        Values, standard errors, and half a sentence on what they rest on. None if there are no frames, another camera
        took them, they are too blurred for a blind sensor, or they do not determine both thresholds.

    Raises:
        RecordingError: The file of a frame is missing or cannot be decoded.
    """
    frames = recording.camera_frames
    if frames is None or frames.camera != recording.camera or frames.trajectory is not recording.trajectory:
        return None
    comparison = _Comparison(recording, index_events(recording), frames)
    found = comparison.of_blind_sensor(blind_for) if blind_for else comparison.of_counts()
    if found is None:
        return None
    values, errors, why = found
    errors = np.hypot(errors, (MODEL_ERROR if comparison.is_sharp else BLURRED_ERROR) * values)
    least, largest = CONTRAST_THRESHOLD_LIMITS
    if not (np.all((values > least) & (values < largest)) and np.all(errors < LARGEST_ERROR * values)):
        return None
    return values, errors, why


def exposure_change(recording: EventRecording, frames: Frames) -> float | None:
    """Change of the exposure from frame to frame, as root mean square of log brightness.

    It comes from the pixels without an event between two frames. Their brightness changed by less than a threshold, up
    as often as down, so that the median of their change is the change of the exposure.

    Args:
        recording: The recording; its index is made if it does not exist.
        frames: Frames of the recording that may be used.

    Returns:
        None if another camera took the frames, or too few pixels are without events.

    Raises:
        RecordingError: The file of a frame is missing or cannot be decoded.
    """
    if frames.camera != recording.camera or frames.trajectory is not recording.trajectory:
        return None
    return _Comparison(recording, index_events(recording), frames).exposure_change


def mean_brightness(recording: EventRecording, frames: Frames, event_share: float) -> float | None:
    """Geometric mean of the brightness of frames, over the pixels that a field renders which learns from events.

    Pixels that are not brighter than `FAINTEST` do not count.

    Args:
        recording: The recording; its index is made if it does not exist.
        frames: Frames of the recording that may be used; `NUM_STARTS` of them are used, evenly spaced.
        event_share: Share of the rays that belong to events. For this share, pixels count in proportion to their
            events; for the rest, all pixels count alike.

    Returns:
        None if another camera took the frames, or they are black.

    Raises:
        RecordingError: The file of a frame is missing or cannot be decoded.
    """
    if frames.camera != recording.camera or frames.trajectory is not recording.trajectory:
        return None
    chosen = np.unique(np.linspace(0, len(frames.times) - 1, NUM_STARTS).round().astype(int))
    counts = index_events(recording).offsets.diff().numpy()
    weights = event_share * counts / counts.sum() + (1.0 - event_share) / len(counts)
    total, weight = 0.0, 0.0
    for number in chosen.tolist():
        image = brightness(frames.image(number)).reshape(len(counts), -1)
        level = image @ LUMA if image.shape[1] == 3 else image[:, 0].astype(float)
        is_seen = level > FAINTEST
        total += np.log(level[is_seen]) @ weights[is_seen]
        weight += weights[is_seen].sum()
    return math.exp(total / weight) if weight else None


@dataclass(frozen=True)
class _Between:
    """Place of an instant between the events of some pixels."""

    is_known: Bool[np.ndarray, " pixels"]
    """Whether there are events before and after."""
    number: Int64[np.ndarray, " pixels"]
    """Events up to the instant."""
    rises: Int64[np.ndarray, " pixels"]
    """On events up to the instant."""
    since: Int64[np.ndarray, " pixels"]
    """Time since the last event, ns."""
    until: Int64[np.ndarray, " pixels"]
    """Time to the next event, ns."""
    after_on: Bool[np.ndarray, " pixels"]
    """Whether the last event is an on event."""
    before_on: Bool[np.ndarray, " pixels"]
    """Whether the next event is an on event."""


@dataclass(frozen=True)
class _Seen:
    """A frame beside the events."""

    brightness: Float64[np.ndarray, " sensor"]
    """Log brightness of all pixels of the sensor; see `_Comparison._log_brightness`."""
    is_known: Bool[np.ndarray, " pixels"]
    """Whether the pixels that are compared have events before and after."""
    rises: Float64[np.ndarray, " pixels"]
    """On events of the compared pixels up to the frame, as a mean over its exposure, and what brightness has gone on
    since."""
    falls: Float64[np.ndarray, " pixels"]
    """The same for off events."""


class _Comparison:
    """Some pixels of frames beside their events."""

    def __init__(self, recording: EventRecording, index: EventIndex, frames: Frames):
        first, last = index.span
        during = np.flatnonzero((frames.exposed[:, 0] >= first) & (frames.exposed[:, 1] <= last))
        self.recording, self.index, self.frames = recording, index, frames.subset(during)
        num_pixels = len(index.offsets) - 1
        self.pixels = torch.arange(0, num_pixels, -(-num_pixels // SAMPLED_PIXELS) | 1)
        steps = np.diff(self.frames.times)
        self.step = float(np.median(steps)) if len(steps) else 0.0
        self.rate = len(index) / num_pixels / max(last - first, 1)
        kind, _, offset = (recording.response or "").partition(":")
        self.offset = float(offset) if kind == "logarithm" else 0.0

    @property
    def is_sharp(self) -> bool:
        """Whether no frame has a known exposure time."""
        return not np.ptp(self.frames.exposed, axis=1).any()

    @cached_property
    def exposure_change(self) -> float | None:
        """Change of the exposure from frame to frame; see the function `exposure_change`."""
        number = len(self.frames.times)
        if number < 2:
            return None
        firsts = np.unique(np.linspace(0, number - 2, NUM_STARTS).round().astype(int))
        found = [self._exposure_step(*map(self._seen, (first, first + 1))) for first in firsts.tolist()]
        known = [step for step in found if step is not None]
        return float(np.sqrt(np.mean(np.square(known)))) if 2 * len(known) > len(found) else None

    def _exposure_step(self, one: _Seen, other: _Seen) -> float | None:
        """Change of log exposure between two frames; None if too few pixels saw no event."""
        table, _, change = self._difference(one, other)
        quiet = change[~table.any(axis=1)]
        return float(np.median(quiet)) if len(quiet) >= FEWEST_QUIET else None

    def of_counts(self) -> tuple[np.ndarray, np.ndarray, str] | None:
        """Thresholds of a sensor that sees all changes."""
        number = len(self.frames.times)
        if not self.step or not self.rate:
            return None
        lag = max(int(np.ceil(EVENTS_BETWEEN / (self.rate * self.step))), 1)
        if number <= 2 * lag:
            return None
        starts = np.unique(np.linspace(0, number - 1 - 2 * lag, NUM_STARTS).round().astype(int))
        squares, products = np.zeros((len(starts), 2, 2, 2)), np.zeros((len(starts), 2, 2))
        rows = 0
        for i, start in enumerate(starts.tolist()):
            one, other, third = (self._seen(start + step * lag) for step in range(3))
            for j, after in enumerate((other, third)):
                if self.exposure_change is not None and self.exposure_change > TAKEN_OFF:
                    step = self._exposure_step(one, after) or 0.0
                    after = replace(after, brightness=after.brightness - step)
                table, instruments, change = self._difference(one, after)
                squares[i, j], products[i, j] = instruments.T @ table, instruments.T @ change
                rows += np.count_nonzero(table.any(axis=1)) if j == 0 else 0
        if rows < FEWEST_ROWS:
            return None

        def fit(chosen: np.ndarray, lags: slice) -> np.ndarray:
            square, product = squares[chosen][:, lags].sum((0, 1)), products[chosen][:, lags].sum((0, 1))
            return np.linalg.lstsq(square, product, rcond=1e-10)[0]

        each, both = np.arange(len(starts)), slice(0, 2)
        values = fit(each, both)
        without = np.stack([fit(np.delete(each, i), both) for i in each])
        jackknife = np.sqrt((len(each) - 1) / len(each) * ((without - without.mean(0)) ** 2).sum(0))
        trend = np.abs(fit(each, slice(0, 1)) - fit(each, slice(1, 2)))
        why = f"{rows:,} changes of log brightness from frame to frame are explained best by events of these thresholds"
        return values, np.hypot(jackknife, trend), why

    def of_blind_sensor(self, blind_for: int) -> tuple[np.ndarray, np.ndarray, str] | None:
        """Thresholds of a sensor with a refractory period (ns)."""
        first = max(len(self.frames.times) - MOST_FRAMES, 0) // 2
        times = self.frames.times[first : first + MOST_FRAMES]
        if not self.is_sharp or len(times) < 2:
            return None
        sampled = self.pixels.numpy()
        brightness = np.stack([self._log_brightness(first + number)[sampled] for number in range(len(times))])
        rows = []
        for number, time in enumerate(times[:-1].tolist()):
            seen = _between(self.index, self.pixels, time)
            ends = time + seen.until
            following = np.searchsorted(times, ends, side="right") - 1
            chosen = np.flatnonzero(seen.is_known & (seen.since >= blind_for) & (following > number))
            last = following[chosen]
            change = brightness[last, chosen] - brightness[number, chosen]
            known = np.isfinite(change)
            chosen, last, change = chosen[known], last[known], change[known]
            sign = np.where(seen.before_on[chosen], 1.0, -1.0)
            late, early = seen.since[chosen] - blind_for, ends[chosen] - times[last]
            rows.append(np.stack([sign, sign * change, late * 1e-6, early * 1e-6]))
        sign, change, late, early = np.concatenate(rows, axis=1)
        rises, falls = (_enclosed(change[sign == s], late[sign == s], early[sign == s]) for s in (1, -1))
        if rises is None or falls is None:
            return None
        (on, on_error, num_on), (off, off_error, num_off) = rises, falls
        why = (
            f"frames enclose {num_on:,} intervals before an on event and {num_off:,} before an off event closely, and "
            "log brightness changes by so much in them"
        )
        return np.array([on, off]), np.array([on_error, off_error]), why

    def _seen(self, number: int) -> _Seen:
        opens, closes = self.frames.exposed[number].tolist()
        places = (np.arange(INSTANTS) + 0.5) / INSTANTS if closes > opens else np.array([0.5])
        instants = (opens + (closes - opens) * places).astype(np.int64)
        between = [_between(self.index, self.pixels, int(instant)) for instant in instants]
        known = np.logical_and.reduce([seen.is_known for seen in between])
        rises = np.mean([seen.rises + GONE_ON * seen.after_on for seen in between], axis=0)
        falls = np.mean([seen.number - seen.rises + GONE_ON * ~seen.after_on for seen in between], axis=0)
        return _Seen(self._log_brightness(number), known, rises, falls)

    def _difference(self, one: _Seen, other: _Seen) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """On events and minus off events between two frames as rows of a matrix; changes of the neighbouring pixels, up
        and down, as rows of another; and the changes of log brightness that they explain."""
        change = other.brightness - one.brightness
        around, chosen = self._of_neighbours(change), self.pixels.numpy()
        change, around = change[chosen], around[chosen]
        known = np.isfinite(change) & np.isfinite(around) & one.is_known & other.is_known
        table = np.stack([other.rises - one.rises, one.falls - other.falls], axis=1)
        instruments = np.stack([np.maximum(around, 0.0), np.minimum(around, 0.0)], axis=1)
        return table[known], instruments[known], change[known]

    def _of_neighbours(self, change: Float64[np.ndarray, " sensor"]) -> Float64[np.ndarray, " sensor"]:
        """Mean change of the eight pixels around each; not a number if fewer than `FEWEST_NEIGHBOURS` are known."""
        known = np.isfinite(change).reshape(-1, self.index.width)
        filled = np.where(known, change.reshape(known.shape), 0.0)
        ring = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]])
        total, number = (ndimage.convolve(part.astype(float), ring, mode="constant") for part in (filled, known))
        return np.where(number >= FEWEST_NEIGHBOURS, total / np.maximum(number, 1), np.nan).ravel()

    def _log_brightness(self, number: int) -> Float64[np.ndarray, " sensor"]:
        """Log brightness of a frame at all pixels of the sensor; not a number where it is too dark or too bright."""
        image = self.frames.image(number)
        image = (image if image.dtype == np.uint8 else 255 * image).astype(float)
        image = image.reshape(len(self.index.offsets) - 1, -1)
        pattern = self.recording.bayer_pattern
        if image.shape[1] == 1:
            level = image[:, 0]
        elif pattern is None:
            level = image @ LUMA
        else:
            y, x = np.divmod(np.arange(len(image)), self.index.width)
            channel = np.array(["RGB".index(letter) for letter in pattern])[2 * (y % 2) + x % 2]
            level = np.take_along_axis(image, channel[:, None], axis=1)[:, 0]
        usable = (level >= DARKEST) & (level <= BRIGHTEST)
        return np.where(usable, np.log(np.where(usable, level, 1) / 255 + self.offset), np.nan)


def _between(index: EventIndex, pixels: torch.Tensor, time: int) -> _Between:
    number = index.count_until(pixels, torch.full_like(pixels, time))
    first, stop = index.offsets[pixels], index.offsets[pixels + 1]
    last, following = (first + number - 1).clamp(min=0), (first + number).clamp(max=len(index) - 1)

    def rises_until(event: torch.Tensor) -> torch.Tensor:
        return torch.where(event >= 0, index.positives[event.clamp(min=0)], 0).long()

    known = (number > 0) & (first + number < stop)
    rises = torch.where(number > 0, rises_until(last) - rises_until(first - 1), 0)
    columns = (
        number,
        rises,
        time - index.times[last],
        index.times[following] - time,
        rises_until(last) > rises_until(last - 1),
        rises_until(following) > rises_until(following - 1),
    )
    return _Between(known.numpy(), *(column.numpy() for column in columns))


def _enclosed(change: np.ndarray, late: np.ndarray, early: np.ndarray) -> tuple[float, float, int] | None:
    """A threshold, its error, and the number of intervals that it rests on.

    Args:
        change: Change of log brightness between two frames within an interval, in the direction of its event.
        late: Time from the start of the interval to the first frame, ms.
        early: Time from the second frame to the event, ms.
    """
    if len(change) < FEWEST_NEAREST:
        return None
    nearest = np.argsort(late + early)[:NEAREST_ROWS]
    change, table = change[nearest], np.stack([np.ones(len(nearest)), late[nearest], early[nearest]], axis=1)

    def fit(chosen: np.ndarray) -> float:
        """Least absolute deviations, by reweighting: some brightness changes fast beside a frame."""
        rows, wanted, weights = table[chosen], change[chosen], np.ones(len(chosen))
        for _ in range(30):
            found = np.linalg.lstsq(rows * weights[:, None], wanted * weights, rcond=None)[0]
            weights = 1 / np.sqrt(np.maximum(np.abs(wanted - rows @ found), 1e-3))
        return float(found[0])

    generator = np.random.default_rng(0)
    value = fit(np.arange(len(change)))
    bootstrap = np.std([fit(generator.integers(0, len(change), len(change))) for _ in range(30)])
    slopes = np.linalg.lstsq(table, change, rcond=None)[0]
    scatter = float(np.std(change - table @ slopes))
    return value, float(np.hypot(bootstrap, 0.5 * scatter)), len(change)

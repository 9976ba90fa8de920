"""Simulates the pixels of an event sensor: makes events from pictures of brightness.

The signal of a pixel is its log brightness, computed by the response of the sensor, and linear in time between two
pictures. A pixel memorises a level of its signal. When the signal rises above this level by the on threshold, or falls
below it by the off threshold, the pixel fires an event and memorises the current signal. This is ESIM (Rebecq, Gehrig,
Scaramuzza, CoRL 2018, section 3.1). Every crossing is timed to the nanosecond. All else is off by default:

* Refractory period: for this time after an event, a pixel neither fires nor memorises. Then it memorises its signal
  (Low, Lee: Robust e-NeRF, ICCV 2023).
* Finite bandwidth: the signal is log brightness behind a first-order low pass, solved in closed form between two
  pictures. The cut-off frequency grows with brightness (in the middle between two pictures).
* Leak: the memorised level falls steadily, so that a pixel under constant brightness fires on events.
* Shot noise and hot pixels: events of a Poisson process, on and off equally often. After such an event, too, a pixel
  memorises its signal and waits for the refractory period.
* Read-out: jitter of the times, and a bus with a limited rate of events.

The effect of brightness on bandwidth and noise, the leak, and shot noise that resets a pixel follow v2e (Hu, Liu,
Delbruck: v2e: From Video Frames to Realistic DVS Events, CVPRW 2021).

Random numbers depend on the seed, the pixel, and a running number of its noise or its events, but not on threads.
Events of a static scene do not depend on the number of pictures.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
import tyro
from jaxtyping import Float, Int64

from enerf_ns.dataparsers.compiled import compiled
from enerf_ns.dataparsers.recording.errors import FlagError, RecordingError
from enerf_ns.dataparsers.recording.recording import CONTRAST_THRESHOLD_LIMITS, Events
from enerf_ns.sensor.response import LINEAR_UNTIL, Gamma, Logarithm, response_named

READOUT_QUEUE = 1000
"""Most events that wait for the bus. Events that come while so many wait are lost."""

SENSOR = 1
"""Number that, with the seed, draws the sensor. Scene and motion are drawn from the seed alone."""

CUT_JITTER = 6
"""Largest jitter of a time, in standard deviations."""

TOLERANCE = 1e-9
"""Tolerance of log brightness in reaching a threshold: far above rounding, far below any noise."""

KNEE = math.log(LINEAR_UNTIL)
"""Log brightness up to which linlog is linear."""

NEVER = 2**62
"""Time (ns) of events that never happen."""


@dataclass(frozen=True)
class SensorSettings:
    """The event sensor; ideal by default.

    Raises:
        FlagError: A setting is out of its range.
    """

    contrast_thresholds: tyro.conf.Suppress[tuple[float, float]] = (0.25, 0.25)
    """Contrast thresholds of on events and of off events: the change of log brightness that causes one event."""
    threshold_spread: float = 0.0
    """Standard deviation of the thresholds between pixels, as a fraction of the threshold. The thresholds are constant
    in time."""
    refractory_period: int = 0
    """Refractory period: nanoseconds after an event in which a pixel fires no event. Then it memorises its log
    brightness."""
    leak_rate: float = 0.0
    """On events per second of a pixel under constant brightness. Its memorised level falls by this rate times its on
    threshold."""
    shot_noise_rate: float = 0.0
    """Noise events per second and pixel. At brightness b the rate is multiplied by 1 - 0.75 (255 b + 20) / 275: 0.95 in
    the dark, 0.25 at brightness 1 and above."""
    hot_pixels: float = 0.0
    """Fraction of pixels that are hot. A hot pixel has noise events at the hot pixel rate instead of shot noise."""
    hot_pixel_rate: float = 1000.0
    """Noise events per second of a hot pixel, at any brightness."""
    cutoff_frequency: float = 0.0
    """Cut-off frequency of the photoreceptor at brightness 1, in Hz. At brightness b it is multiplied by
    (255 b + 20) / 275. 0 means no low pass."""
    timestamp_jitter: float = 0.0
    """Standard deviation of the times of events, in nanoseconds. Events are sorted afterwards."""
    readout_rate: float = 0.0
    """Events per second that the bus carries. Events wait in a queue and are lost if it is full. 0 means no limit."""
    response: str = Logarithm().name
    """Response that converts brightness to log brightness: logarithm:OFFSET is the logarithm of brightness plus the
    offset; linlog is the response of E-NeRF."""
    seed: int = 0
    """Seed of all random numbers: scene, motion, and noise."""

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name == "contrast_thresholds":
                least, largest = CONTRAST_THRESHOLD_LIMITS
                fine = len(value) == 2 and all(least <= threshold <= largest for threshold in value)
                expected = f"two numbers from {least:g} to {largest:g}"
            elif field.name == "response":
                try:
                    response = response_named(value)
                except ValueError as error:
                    raise FlagError(f"--response names {error}") from error
                if isinstance(response, Gamma):
                    raise FlagError(
                        f"--response is {value}, but a sensor sees linear brightness, which is not gamma-encoded; "
                        f"give logarithm:{response.offset!r}, which is the same for linear brightness."
                    )
                continue
            elif field.name == "hot_pixels":
                fine, expected = 0 <= value <= 1, "between 0 and 1"
            else:
                fine, expected = 0 <= value <= 1e15, "at least 0 and at most 1e15"
            if not fine:
                raise FlagError(f"--{field.name.replace('_', '-')} is {value}, but must be {expected}.")


class PartialPicture(NamedTuple):
    """Brightness of some pixels at a time between two pictures."""

    time: int
    """Time of the picture, ns."""
    pixels: Int64[np.ndarray, " pixels"]
    """Numbers of the pixels, y * width + x."""
    brightness: Float[np.ndarray, "pixels *channels"]
    """Linear brightness of the pixels."""


class _Pixels(NamedTuple):
    """Constants and state of every pixel.

    Levels are signal plus leak: in place of a memorised level that falls, the signal rises.
    """

    on: np.ndarray
    off: np.ndarray
    leak: np.ndarray
    """Rise of each pixel's level by leak, per nanosecond."""
    noise_rate: np.ndarray
    """Noise events of each pixel per nanosecond, before brightness thins them out."""
    hot: np.ndarray
    signal: np.ndarray
    """Signal of each pixel at the time of the last picture, without leak."""
    memorised: np.ndarray
    rises: np.ndarray
    falls: np.ndarray
    """Number of off thresholds passed since `memorised`; `rises` counts on thresholds. The memorised level is now
    `memorised + rises * on - falls * off`, so that rounding errors do not add up."""
    upper: np.ndarray
    lower: np.ndarray
    """Level of each pixel's next off event; `upper` is the level of its next on event."""
    awake: np.ndarray
    """End (ns) of each pixel's refractory period, at which it memorises its signal."""
    noise: np.ndarray
    """Time (ns) of each pixel's next possible noise event."""
    num_noise: np.ndarray
    num_events: np.ndarray


class EventSensor:
    """The pixels of an event sensor with their memorised levels.

    Args:
        settings: Settings of the sensor.
        brightness: Picture [H, W] that all pixels memorise at the start: linear, at least 0, without an upper limit; 1
            is white in frames. For a sensor with colour filters, the channel of each pixel.
        time: Time of this picture, nanoseconds.

    Attributes:
        contrast_thresholds: On and off threshold of each pixel, float64 [2, H, W].
        hot_pixels: Numbers (y * width + x) of the hot pixels, int64 [N], in increasing order.

    Raises:
        FlagError: `threshold_spread` leaves pixels without a valid threshold.
        RecordingError: The picture has a value that is negative or not finite.
    """

    def __init__(self, settings: SensorSettings, brightness: Float[np.ndarray, "height width"], time: int):
        self.settings, self.start, self.time = settings, int(time), int(time)
        self._response = response_named(settings.response)
        self.height, self.width = brightness.shape
        size = brightness.size
        drawn = np.random.SeedSequence([settings.seed, SENSOR])
        threshold_rng, hot_rng = np.random.default_rng(drawn).spawn(2)
        spread = 1 + settings.threshold_spread * threshold_rng.standard_normal((2, *brightness.shape))
        self.contrast_thresholds = spread * np.array(settings.contrast_thresholds)[:, None, None]
        without = np.count_nonzero((self.contrast_thresholds < CONTRAST_THRESHOLD_LIMITS[0]).any(0))
        if without:
            raise FlagError(
                f"--threshold-spread is {settings.threshold_spread}, which leaves {without} of {size} pixels without a "
                f"threshold of {CONTRAST_THRESHOLD_LIMITS[0]} or more; give a smaller one."
            )
        self.hot_pixels = np.sort(hot_rng.choice(size, round(settings.hot_pixels * size), replace=False))
        self._keys = drawn.generate_state(4, np.uint64)
        self._all = np.arange(size)
        self._log_brightness = self._respond(brightness, self._all, self.time)

        on, off = self.contrast_thresholds.reshape(2, size)
        hot = np.zeros(size, bool)
        hot[self.hot_pixels] = True
        signal = self._log_brightness.copy()
        self._pixels = _Pixels(
            on=on,
            off=off,
            leak=settings.leak_rate * 1e-9 * on,
            noise_rate=1e-9 * np.where(hot, settings.hot_pixel_rate, settings.shot_noise_rate),
            hot=hot,
            signal=signal,
            memorised=signal.copy(),
            rises=np.zeros(size, np.int64),
            falls=np.zeros(size, np.int64),
            upper=signal + on,
            lower=signal - off,
            awake=np.full(size, self.start),
            noise=np.full(size, self.start),
            num_noise=np.zeros(size, np.int64),
            num_events=np.zeros(size, np.int64),
        )
        _first_noise(self._pixels, self._keys)
        self._held = np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0, np.int8)
        self._bus_free = 0.0
        """Time at which the bus has carried all earlier events, nanoseconds since the start."""

    def advance(
        self, brightness: Float[np.ndarray, "height width"], time: int, before: Sequence[PartialPicture] = ()
    ) -> Events:
        """Events from the last picture to this one.

        Jitter and a slow bus hold events back. A later call or `finish` returns them.

        Args:
            brightness: Picture [H, W], as for `EventSensor`.
            time: Time of the picture in nanoseconds, later than the last picture.
            before: Brightness of some pixels between the last picture and this one, in order of time.

        Returns:
            Events in order of time, later than the events of the last call. Their times, rounded up to the nanosecond,
            are after the last picture and not after this one. Events of the same time are in order of pixels.

        Raises:
            RecordingError: The picture has another size, is not later than the last one, or has a value that is
                negative or not finite.
        """
        time = int(time)
        if brightness.shape != (self.height, self.width):
            raise RecordingError(
                f"The picture at {time} ns has the shape {brightness.shape}, but the first one had "
                f"{(self.height, self.width)}."
            )
        if time <= self.time:
            raise RecordingError(f"The picture at {time} ns must be later than the last one, at {self.time} ns.")
        since = np.full(brightness.size, self.time)
        parts = [self._held]
        last = self.time
        for picture in before:
            if not last < picture.time < time:
                raise RecordingError(f"Pixels at {picture.time} ns are not between {last} ns and {time} ns.")
            last = picture.time
            parts.append(self._see(picture.pixels, since, picture.brightness, picture.time))
        parts.append(self._see(self._all, since, brightness, time))
        self.time = time
        pixel, times, polarity = map(np.concatenate, zip(*parts, strict=True))
        return self._read_out(pixel, times, polarity, time - math.ceil(CUT_JITTER * self.settings.timestamp_jitter))

    def _see(
        self, pixels: np.ndarray, since: np.ndarray, brightness: np.ndarray, time: int
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Pixels, times and polarities of the events of some pixels since they were seen last."""
        settings = self.settings
        now = self._respond(brightness, pixels, time)
        offset = self._response.offset if isinstance(self._response, Logarithm) else math.nan
        cutoff = 2e-9 * math.pi * settings.cutoff_frequency
        return _fire(
            self._pixels, self._keys, pixels, self._log_brightness, now, self.start, since, time,
            offset, cutoff, int(settings.refractory_period), settings.timestamp_jitter,
        )  # fmt: skip

    def finish(self) -> Events:
        """The events that were held back.

        Times after the last picture are set to its time. Events that still wait for the bus then are lost.
        """
        pixel, times, polarity = self._held
        return self._read_out(pixel, np.minimum(times, self.time), polarity, self.time)

    def _read_out(self, pixel: np.ndarray, times: np.ndarray, polarity: np.ndarray, settled: int) -> Events:
        """Events up to the time `settled`, which no later event can precede, in order of time; holds the others
        back."""
        order = np.lexsort((pixel, times))
        pixel, times, polarity = pixel[order], times[order], polarity[order]
        count = int(np.searchsorted(times, settled, "right"))
        sent = slice(count)
        if self.settings.readout_rate:
            departures, self._bus_free = _transmit(
                times[:count], self.start, self.time, self._bus_free, self.settings.readout_rate * 1e-9
            )
            count = len(departures)
            sent = np.flatnonzero(departures >= self.start)
            times = np.concatenate([departures, times[count:]])
        self._held = pixel[count:], times[count:], polarity[count:]
        y, x = np.divmod(pixel[sent].astype(np.int32), np.int32(self.width))
        return Events(x, y, times[sent], polarity[sent])

    def _respond(self, brightness: np.ndarray, pixels: np.ndarray, time: int) -> np.ndarray:
        """Log brightness, float64 [pixels]."""
        flat = brightness.ravel()
        if not (flat.min(initial=0) >= 0 and flat.max(initial=0) < math.inf):
            wrong = int(np.argmin((flat >= 0) & (flat < math.inf)))
            y, x = divmod(int(pixels[wrong]), self.width)
            raise RecordingError(
                f"The picture at {time} ns is {flat[wrong]} at x = {x}, y = {y}, but brightness must be finite and at "
                "least 0."
            )
        return self._response(flat.astype(np.float64))


@compiled
def _fire(  # pragma: no cover
    pixels, keys, which, seen, now, first, since, end, offset, cutoff, refractory_period, jitter
):
    """Pixels, times and polarities of the events of the pixels `which`, in their order, up to the time `end`.

    Each pixel had the log brightness `seen` at the time `since` and has `now` at `end`; its state is advanced to `end`.
    In the loop, times are nanoseconds since `since`: `s` is the last change of the memorised level, `awake` and `noise`
    are those of `_Pixels`. For `offset` see `_brightness`.
    """
    count = 0
    pixel, times, polarity = np.empty(4096, np.int64), np.empty(4096, np.int64), np.empty(4096, np.int8)
    for k in range(len(which)):
        i = which[k]
        start, x0, x1, y0 = since[i], seen[i], now[k], seen[i]
        duration = float(end - start)
        since[i], seen[i] = end, x1
        decay = 0.0
        if cutoff > 0:
            y0 = pixels.signal[i]
            decay = cutoff * (255 * _brightness((x0 + x1) / 2, offset) + 20) / 275
        leak, leaked = pixels.leak[i], pixels.leak[i] * (start - first)
        curve = y0 + leaked, x0 - y0, (x1 - x0) / duration, leak, decay
        if cutoff > 0:
            pixels.signal[i] = _level(curve, duration) - leaked - leak * duration
        awake, noise = pixels.awake[i] - start, pixels.noise[i] - start
        if noise > duration and (
            awake > duration
            or (
                awake <= 0
                and max(x0, x1, y0) + leaked + leak * duration < pixels.upper[i] - TOLERANCE
                and min(x0, x1, y0) + leaked > pixels.lower[i] + TOLERANCE
            )
        ):
            continue

        turn = _turn(curve)
        s = 0.0
        while True:
            fired = 0
            stamp = noise
            stop = min(float(noise), duration)
            if awake <= stop:
                if awake > s:
                    s = float(awake)
                    pixels.memorised[i] = _level(curve, s)
                    pixels.rises[i] = pixels.falls[i] = 0
                    pixels.upper[i] = pixels.memorised[i] + pixels.on[i]
                    pixels.lower[i] = pixels.memorised[i] - pixels.off[i]
                fired, s = _next_crossing(curve, turn, s, stop, pixels.lower[i], pixels.upper[i])
                if fired != 0:
                    pixels.rises[i] += fired > 0
                    pixels.falls[i] += fired < 0
                    level = pixels.memorised[i] + pixels.rises[i] * pixels.on[i] - pixels.falls[i] * pixels.off[i]
                    pixels.upper[i], pixels.lower[i] = level + pixels.on[i], level - pixels.off[i]
                    stamp = int(min(max(np.ceil(s - 1e-3), 1.0), duration))
                    if refractory_period > 0:
                        awake = stamp + refractory_period
            if fired == 0:
                if noise > duration:
                    break
                here = _brightness(x0 + (x1 - x0) * (noise / duration), offset)
                chance = 1.0 if pixels.hot[i] else 1 - 0.75 * (255 * min(here, 1.0) + 20) / 275
                draw = _random(keys[1], i, pixels.num_noise[i])
                if awake <= noise and _uniform(draw) <= chance:
                    fired = 1 if draw & np.uint64(1) else -1
                    awake = noise + refractory_period
                pixels.num_noise[i] += 1
                noise += _gap(keys[0], i, pixels.num_noise[i], pixels.noise_rate[i])
                if fired == 0:
                    continue
            if count == len(pixel):
                pixel, times, polarity = _longer(pixel), _longer(times), _longer(polarity)
            if jitter > 0:
                stamp += int(np.rint(jitter * _normal(keys, i, pixels.num_events[i])))
            pixels.num_events[i] += 1
            pixel[count], times[count], polarity[count] = i, max(start + stamp, first), fired
            count += 1
        pixels.awake[i], pixels.noise[i] = start + awake, start + noise
    return pixel[:count], times[:count], polarity[:count]


@compiled
def _brightness(level, offset):  # pragma: no cover
    """Compiled twin of `Logarithm.inverse` for one number, or of `Linlog.inverse` if the offset is nan."""
    if not np.isnan(offset):
        return np.exp(level) - offset
    return (level * (LINEAR_UNTIL / KNEE) if level < KNEE else np.exp(level)) / 255


@compiled
def _level(curve, s):  # pragma: no cover
    """Level of a curve at time s: a line behind a low pass, plus leak.

    A curve has five numbers: the level at its start, the input minus the output at its start, the slope of the input,
    the slope of the leak, and the angular frequency of the low pass (0 for no low pass).
    """
    level, pull, slope, leak, decay = curve
    if decay == 0:
        return level + (slope + leak) * s
    done = -np.expm1(-decay * s)
    return level + leak * s + pull * done + slope * (s - done / decay)


@compiled
def _turn(curve):  # pragma: no cover
    """Time at which the level of a curve is highest or lowest; infinity if it only rises or only falls."""
    _, pull, slope, leak, decay = curve
    remaining = (slope + leak) / (slope - pull * decay)
    return -np.log(remaining) / decay if decay > 0 and 0 < remaining < 1 else np.inf


@compiled
def _next_crossing(curve, turn, s, stop, lower, upper):  # pragma: no cover
    """+1 or -1 and the first time from s to stop at which the level reaches upper or lower; else 0 and s."""
    since = s
    for until in (turn, stop):
        if not since <= until <= stop:
            continue
        level = _level(curve, until)
        if level >= upper - TOLERANCE:
            return 1, _reached(curve, upper, since, until)
        if level <= lower + TOLERANCE:
            return -1, _reached(curve, lower, since, until)
        since = until
    return 0, s


@compiled
def _reached(curve, wanted, low, high):  # pragma: no cover
    """Time between low and high at which a level that only rises, or only falls, reaches the wanted level.

    With a low pass it is found by Newton's method, with a bisection where Newton's method leaves the bracket.
    """
    level, pull, slope, leak, decay = curve
    if decay == 0:
        return min(max((wanted - level) / (slope + leak), low), high)
    rises = _level(curve, low) < wanted
    s = (low + high) / 2
    for _ in range(200):
        excess = _level(curve, s) - wanted
        if (excess < 0) == rises:
            low = s
        else:
            high = s
        following = s - excess / (leak + slope + (pull * decay - slope) * np.exp(-decay * s))
        if not low <= following <= high:
            following = (low + high) / 2
        if abs(following - s) < 1e-4:
            return following
        s = following
    return s


@compiled
def _longer(values):  # pragma: no cover
    longer = np.empty(2 * len(values), values.dtype)
    longer[: len(values)] = values
    return longer


@compiled
def _random(key, pixel, number):  # pragma: no cover
    """64 random bits: number `pixel * 2^32 + number` of the sequence SplitMix64 (Steele, Lea, Flood, OOPSLA 2014)."""
    place = (np.uint64(pixel) << np.uint64(32)) + np.uint64(number)
    bits = key + (place + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
    bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return bits ^ (bits >> np.uint64(31))


@compiled
def _uniform(bits):  # pragma: no cover
    """Uniform random number in (0, 1], from the upper 53 of 64 bits."""
    return (np.float64(bits >> np.uint64(11)) + 1) * 2.0**-53


@compiled
def _normal(keys, pixel, number):  # pragma: no cover
    """Normal random number by Box and Muller's method, clipped to `CUT_JITTER`."""
    radius = np.sqrt(-2 * np.log(_uniform(_random(keys[2], pixel, number))))
    return min(max(radius * np.cos(2 * np.pi * _uniform(_random(keys[3], pixel, number))), -CUT_JITTER), CUT_JITTER)


@compiled
def _gap(key, pixel, number, rate):  # pragma: no cover
    """Nanoseconds, at least 1, from one event of a Poisson process to the next."""
    return int(max(np.ceil(min(-np.log(_uniform(_random(key, pixel, number))) / rate, 1e18)), 1.0))


@compiled
def _first_noise(pixels, keys):  # pragma: no cover
    for i in range(len(pixels.on)):
        if pixels.noise_rate[i] > 0:
            pixels.noise[i] += _gap(keys[0], i, 0, pixels.noise_rate[i])
        else:
            pixels.noise[i] = NEVER


@compiled
def _transmit(times, first, end, free, rate):  # pragma: no cover
    """Times (ns) at which the bus has carried events, up to the last event that it carries before `end`.

    Args:
        times: Times at which the events come, int64 [N], in order.
        first: Start of the recording, ns.
        free: Time at which the bus has carried all earlier events, ns since `first`.
        rate: Rate of the bus, events per nanosecond.

    Returns:
        The times, int64 [M] with M <= N, `first - 1` for lost events; and the new value of `free`.
    """
    departures = np.empty(len(times), np.int64)
    for i in range(len(times)):
        came = float(times[i] - first)
        if (free - came) * rate >= READOUT_QUEUE:
            departures[i] = first - 1
            continue
        leaves = max(free, came)
        if leaves > end - first:
            return departures[:i], free
        departures[i] = first + int(np.ceil(leaves))
        free = leaves + 1 / rate
    return departures, free

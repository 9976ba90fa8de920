"""Names the unit in which times seem to be written, from how often events, poses and frames come.

Units of time differ by 1000, and the usual rates of a kind of sensor lie closer together than that.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, product
from pathlib import Path

import numpy as np
from jaxtyping import Int64

from enerf_ns.dataparsers.recording.errors import RecordingError

NANOSECONDS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}
"""Length of each unit of time, nanoseconds."""

NAMES = {"s": "seconds", "ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}

USUAL_RATES = {"events": (0.03, 2000.0), "poses": (1.0, 5000.0), "frames": (0.5, 2000.0)}
"""Least and largest usual rate: events per second and pixel, poses per second, frames per second."""

MIDDLE_RATES = {kind: math.sqrt(least * largest) for kind, (least, largest) in USUAL_RATES.items()}
"""Rate in the middle of the usual ones."""

LARGEST_SPAN_RATIO = 300
"""Largest ratio between the time spans of events or frames and of poses. Units of time differ by 1000."""

LARGEST_RATE, LARGEST_RATE_OF_PIXEL = 2e9, 5e4
"""Events per second of a sensor, and of a pixel on average, that no sensor can send."""

FEWEST_EVENTS = 1000
"""Fewest events whose rate means anything."""

SHORTEST_CLIP = 500_000_000
"""Shortest time of events at a usual rate, nanoseconds, that is believed to be a small part of a long log of poses."""

SHORTEST_FRAME_STEP = 1_000_000
"""Shortest time between frames, nanoseconds. Closer frames are in another unit if they also span a small part of the
poses."""


@dataclass(frozen=True)
class Times:
    """The times of events, poses or frames, as a reader reads them."""

    kind: str
    """A key of `USUAL_RATES`."""
    file: Path
    unit: str
    """Unit in which they were read, a key of `NANOSECONDS`."""
    number: int
    span: int
    """Time from the first to the last, ns."""
    step: float
    """Usual time from one to the next, ns; of events, of one pixel."""
    flag: str = ""
    """Flag that states the unit, if there is one."""
    is_certain: bool = False
    """Whether the unit is known for certain, as in the files of camera makers."""

    @classmethod
    def of_events(cls, file: Path, unit: str, number: int, span: int, pixels: int, is_certain: bool = False) -> Times:
        """Returns the times of a number of events on so many pixels."""
        return cls("events", file, unit, number, span, max(span, 1) * pixels / max(number, 1), "", is_certain)

    @classmethod
    def of_rows(cls, kind: str, file: Path, unit: str, times: Int64[np.ndarray, " rows"], flag: str = "") -> Times:
        """Returns the times (ns) of poses or frames."""
        step = float(np.median(np.diff(times))) if len(times) > 1 else 1e9 / MIDDLE_RATES[kind]
        return cls(kind, file, unit, len(times), int(times[-1] - times[0]), step, flag)

    @property
    def rate(self) -> float:
        """Events per second and pixel, poses per second or frames per second."""
        return 1e9 / max(self.step, 1e-9)

    @property
    def unusualness(self) -> float:
        """Distance of the rate from the middle of the usual ones, above 1 if it is unusual."""
        middle, largest = MIDDLE_RATES[self.kind], USUAL_RATES[self.kind][1]
        return abs(math.log(self.rate / middle) / math.log(largest / middle))

    @property
    def words(self) -> str:
        """The number, the time span and the rate, in words."""
        if self.number < 2:
            return f"{self.number:,} {self.kind}"
        rate = self.number / max(self.span, 1) * 1e9 if self.kind == "events" else self.rate
        return f"{self.number:,} {self.kind} within {self.span * 1e-9:.6g} s ({rate:.3g} a second)"

    def if_in(self, unit: str) -> Times:
        """Returns the times if the numbers in the file are in another unit."""
        factor = NANOSECONDS[unit] / NANOSECONDS[self.unit]
        span = max(round(max(self.span, 1) * factor), 1)
        return Times(self.kind, self.file, unit, self.number, span, self.step * factor, self.flag)


def likely_units(columns: Sequence[Times]) -> list[str]:
    """Returns the units in which the times of a recording are likeliest written, one for each of the columns.

    They are those at which rates are closest to `MIDDLE_RATES`, in units of the usual distance, spans are closest to
    each other, in decades, and the fewest columns are in another unit.
    """

    def unlikeliness(units: Sequence[str]) -> float:
        read = [column.if_in(unit) for column, unit in zip(columns, units, strict=True)]
        rates = sum(column.unusualness**2 for column in read)
        spans = [column.span for column in read if column.number > 1]
        apart = sum(math.log10(one / other) ** 2 for one, other in combinations(spans, 2))
        return rates + apart + sum(column.unit != unit for column, unit in zip(columns, units, strict=True))

    choices = ([column.unit] if column.is_certain else [*NANOSECONDS] for column in columns)
    return list(min(product(*choices), key=unlikeliness))


def check_units(path: Path, columns: Sequence[Times]) -> None:
    """Checks that events, poses and frames can be in the units in which they were read.

    Args:
        path: Folder of the recording.
        columns: Its times. Events are passed over if they are fewer than `FEWEST_EVENTS`.

    Raises:
        RecordingError: The spans do not fit together, or no sensor sends so many events a second.
    """
    columns = [column for column in columns if column.kind != "events" or column.number >= FEWEST_EVENTS]
    poses = next(column for column in columns if column.kind == "poses")
    if any(_is_impossible(column, poses) for column in columns):
        raise RecordingError(f"{path} holds {wrong_units(columns)}")


def _is_impossible(column: Times, poses: Times) -> bool:
    too_long = column.span > LARGEST_SPAN_RATIO * poses.span
    too_short = LARGEST_SPAN_RATIO * column.span < poses.span
    if column.kind == "frames":
        return too_long or (too_short and column.number > 1 and column.step < SHORTEST_FRAME_STEP)
    is_clip = column.span >= SHORTEST_CLIP and column.unusualness <= 1 and poses.unusualness <= 1
    too_many = column.number > LARGEST_RATE * column.span * 1e-9 or column.rate > LARGEST_RATE_OF_PIXEL
    return column.kind == "events" and (too_long or (too_short and not is_clip) or too_many)


def wrong_units(columns: Sequence[Times]) -> str:
    """Returns the end of a sentence, after "holds", that states which times are in another unit, and what to do."""
    spans = [column.span for column in columns if column.number > 1]
    fit = max(spans, default=1) <= LARGEST_SPAN_RATIO * min(spans, default=1)
    what = ", ".join(column.words for column in columns)
    what += ", which is too fast or too slow for a camera" if fit else ", which does not fit together"
    wrong: dict[tuple[str, str, str], list[Times]] = {}
    for column, unit in zip(columns, likely_units(columns), strict=True):
        if unit != column.unit:
            wrong.setdefault((unit, column.unit, column.flag), []).append(column)
    if not wrong:
        return f"{what}; state the times of all in the units that the format asks for."
    sentences = []
    for (unit, expected, flag), kinds in wrong.items():
        *others, last = (f"{column.kind} ({column.file.name})" for column in kinds)
        whose = f"{', '.join(others)} and {last}" if others else last
        mend = f"give {flag} {unit}" if flag else conversion(unit, expected)
        sentences.append(
            f"the times of {whose} look like {NAMES[unit]}, but {NAMES[expected]} were expected, so {mend}"
        )
    return f"{what}: {'; '.join(sentences)}."


def unusual_units(columns: Sequence[Times]) -> str | None:
    """Returns what `wrong_units` returns if two rates are unusual, and all would be usual in other units; else None."""
    columns = [column for column in columns if column.kind != "events" or column.number >= FEWEST_EVENTS]
    if sum(column.unusualness > 1 for column in columns) < 2:
        return None
    likely = [column.if_in(unit) for column, unit in zip(columns, likely_units(columns), strict=True)]
    return wrong_units(columns) if all(column.unusualness <= 1 for column in likely) else None


def check_usual_units(path: Path, columns: Sequence[Times]) -> None:
    """Raises RecordingError with what `unusual_units` says, for times that are found to be wrong."""
    if wrong := unusual_units(columns):
        raise RecordingError(f"{path} holds {wrong}")


def unit_by_step(step: float, unit: str, kind: str) -> str | None:
    """Returns words on the unit in which times seem to be written, if it is another one than the stated one.

    Args:
        step: Usual time from row to row, in the unit of the file.
        unit: The stated unit.
        kind: "poses" or "frames".
    """
    likely = likely_unit(step, kind)
    if not step > 0 or likely == unit:
        return None
    return (
        f"the times of the file are usually {step:g} apart, which look like {NAMES[likely]} where {NAMES[unit]} were "
        f"expected, so {conversion(likely, unit)}"
    )


def likely_unit(step: float, kind: str) -> str:
    """Returns the unit in which numbers are likeliest written that grow by `step` from row to row.

    Args:
        step: In the unit that is looked for; of events, of the whole sensor.
        kind: A key of `USUAL_RATES`.
    """
    rate = MIDDLE_RATES[kind] * (100_000 if kind == "events" else 1)  # pixels of a small sensor
    return min(NANOSECONDS, key=lambda unit: abs(math.log10(max(step, 1e-15) * NANOSECONDS[unit] * 1e-9 * rate)))


def unit_of_date(time: float) -> str | None:
    """Returns the unit in which a number of the time since 1970 lies in this century; None if there is none."""
    dates = (unit for unit, length in NANOSECONDS.items() if 1e18 < abs(time) * length < 4e18)
    return next(dates, None)


def conversion(unit: str, expected: str) -> str:
    """Returns words that state how times in one unit become times in the expected one."""
    one, other = NANOSECONDS[unit], NANOSECONDS[expected]
    return f"multiply them by {one // other:,}" if one > other else f"divide them by {other // one:,}"

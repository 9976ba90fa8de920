"""Ranges of the numbers with which a recording is read, for whatever method."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from enerf_ns.dataparsers.recording.camera import LARGEST_SIDE
from enerf_ns.dataparsers.recording.errors import FlagError
from enerf_ns.dataparsers.recording.recording import DEPTH_LIMITS

COUNT = (0, 10**9)

RANGES: dict[str, tuple[float, float]] = {
    "held_out_every": (1, 10**9),
    "exposure_ms": (0.0, 1e6),
    "downscale_factor": (1.0, LARGEST_SIDE),
    "depth_range": DEPTH_LIMITS,
    "box": (-DEPTH_LIMITS[1], DEPTH_LIMITS[1]),
    "contraction_depth": DEPTH_LIMITS,
    "time_range": (-4e9, 4e9),  # in ns, differences of int64 hold them
    "train_frame_indices": COUNT,
    "held_out_frame_indices": COUNT,
}
"""Lowest and highest value of each number, or of each of several numbers, by the name of the field of
`EventDataParserConfig`."""


def check_range(flag: str, values: Sequence[Any], limits: tuple[float, float] | None) -> None:
    """Checks that the numbers of a flag are finite, and within the lowest and the highest one, if there are limits.

    Raises:
        FlagError: One is not.
    """
    lowest, highest = limits or (-math.inf, math.inf)
    if not all(math.isfinite(value) and lowest <= value <= highest for value in values):
        expected = f"from {lowest:.10g} to {highest:.10g}" if limits else "finite"
        raise FlagError(f"{flag} is {shown(values)}, but must be {expected}.")


def check_reading(config: Any, of: str = "") -> None:
    """Checks the numbers with which a recording is read.

    Args:
        config: Any object with some of the fields of `EventDataParserConfig`.
        of: Words before the flags in errors, such as "event-data ".

    Raises:
        FlagError: A number is not finite or outside its range, or numbers contradict each other.
    """
    given = {name: getattr(config, name, None) for name in RANGES}
    for name, value in given.items():
        if value is not None:
            flag = f"{of}--{name.replace('_', '-')}"
            values = value if isinstance(value, list | tuple) else [value]
            check_range(flag, values, RANGES[name])
            if name in ("depth_range", "time_range") and not values[0] < values[1]:
                raise FlagError(f"{flag} is {shown(values)}, but the second number must be above the first.")
            if name == "box" and values[3] < DEPTH_LIMITS[0]:
                raise FlagError(f"{flag} is {shown(values)}, but half its side must be at least {DEPTH_LIMITS[0]:g} m.")
    if given["contraction_depth"] is not None and given["box"] is not None:
        raise FlagError(f"{of}--contraction-depth contradicts {of}--box; leave one of both out.")


def shown(values: Sequence[Any]) -> str:
    """Returns numbers in words."""
    return " ".join(f"{value:.10g}" if isinstance(value, float) else str(value) for value in values)

"""Checks of events and poses that are the same in every kind of file."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float64, Int

from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.time_units import (
    FEWEST_EVENTS,
    NAMES,
    NANOSECONDS,
    conversion,
    likely_unit,
    unit_of_date,
)

if TYPE_CHECKING:
    import h5py

STORED_TYPES = {"x": np.uint16, "y": np.uint16, "t": np.int64, "p": np.int8}
"""Types of the columns of events in a recording of this project's layout."""

LATEST = 2**62
"""Limit of times, ns (146 years). The difference of two times below it fits into 64 bits."""

FARTHEST = 1e9
"""Largest distance of a camera from the origin, metres. Beyond it, splines overflow."""

QUATERNION_TOLERANCE = 1e-3
"""Largest error of the norm of a quaternion that is renormalised."""


def check_columns(
    path: Path, columns: Mapping[str, np.ndarray | h5py.Dataset], unit: str, floats: bool = False
) -> None:
    """Checks the types, shapes and lengths of the columns of events.

    Args:
        path: The file or folder of the columns.
        columns: The columns x, y, t and p by name, such as t or t.npy; p may be Boolean.
        unit: The unit of the times, us or ns, for the error message.
        floats: Whether all columns but p may hold floats.

    Raises:
        RecordingError: A column does not hold one whole number for each event, or there are no events.
    """
    for name, column in columns.items():
        if floats and column.ndim == 1 and column.dtype.kind == "f" and not name.startswith("p"):
            continue
        if name.startswith("t") and column.ndim == 1 and column.dtype.kind == "f" and len(column) >= FEWEST_EVENTS:
            step = float(column[-1] - column[0]) / len(column)
            likely = unit_of_date(float(column[-1])) or likely_unit(step, "events")
            factor = NANOSECONDS[likely] / NANOSECONDS[unit]
            raise RecordingError(
                f"{path} holds {name} as {column.dtype}, up to {column[-1]:g}, which look like {NAMES[likely]}, but "
                f"whole {NAMES[unit]} were expected; save np.rint({name[0]} * {factor:g}).astype(np.int64)."
            )
        if column.ndim != 1 or column.dtype.kind not in ("iub" if name.startswith("p") else "iu"):
            raise RecordingError(
                f"{path} holds {name} as {column.dtype} of shape {column.shape}, but one whole number for each event "
                f"(t in {NAMES[unit]}) was expected; save it with .astype(np.{STORED_TYPES[name[0]].__name__})."
            )
    check_lengths(path, {name: len(column) for name, column in columns.items()})
    if not all(len(column) for column in columns.values()):
        raise RecordingError(f"{path} holds no events; give a recording with some.")


def check_lengths(path: Path, lengths: Mapping[str, int]) -> None:
    """Raises RecordingError unless all columns of a file have the same number of rows."""
    if len(set(lengths.values())) > 1:
        found = ", ".join(f"{length:,} {name}" for name, length in lengths.items())
        raise RecordingError(f"{path} holds {found}, but as many of each were expected; copy it again.")


def check_times(path: Path, times: Int[np.ndarray, " times"], unit: str = "ns", offset: int = 0) -> None:
    """Raises RecordingError if a time reaches `LATEST`.

    Args:
        path: The file.
        times: In the unit, before the offset is added.
        unit: us or ns.
        offset: In the unit.
    """
    extremes = (int(times.min()) + offset, int(times.max()) + offset) if len(times) else (0,)
    furthest = max(extremes, key=abs)
    if abs(furthest) >= LATEST // NANOSECONDS[unit]:
        likely = unit_of_date(furthest)
        raise RecordingError(
            f"{path} holds the time {furthest} {unit}, which is beyond 146 years; {NAMES[unit]} were expected"
            + (f", and these look like {NAMES[likely]}, so {conversion(likely, unit)}." if likely else ".")
        )


def unit_quaternions(
    path: Path,
    positions: Float64[np.ndarray, "poses 3"],
    quaternions: Float64[np.ndarray, "poses 4"],
    notes: list[str],
    place: Callable[[int], str],
) -> Float64[np.ndarray, "poses 4"]:
    """Returns the quaternions of poses (xyzw) with norm 1.

    Args:
        path: The file.
        positions: Metres.
        quaternions: xyzw.
        notes: Gets a sentence if a norm is off by more than 1e-6.
        place: Words for row number i of the file.

    Raises:
        RecordingError: A number is not finite, a position lies beyond `FARTHEST`, or the norm of a quaternion is off by
            more than `QUATERNION_TOLERANCE`.
    """
    norms = np.linalg.norm(quaternions, axis=1)
    errors = np.abs(norms - 1.0)
    far = ~(np.abs(positions) <= FARTHEST).all(axis=1)
    if far.any():
        row = int(np.argmax(far))
        raise RecordingError(
            f"{path}, {place(row)}, holds the position {positions[row].tolist()}, but numbers within {FARTHEST:g} m of "
            "the origin were expected."
        )
    bad = ~(errors <= QUATERNION_TOLERANCE)
    if bad.any():
        row = int(np.argmax(bad))
        raise RecordingError(
            f"{path}, {place(row)}, holds a quaternion of norm {norms[row]:.6g}, but rotations are unit quaternions "
            "(qx qy qz qw)."
        )
    if errors.max() > 1e-6:
        notes.append(
            f"{(errors > 1e-6).sum():,} of {len(norms):,} quaternions in {path.name} were off norm 1 by up to "
            f"{errors.max():.2g} and are renormalised."
        )
    return quaternions / norms[:, None]

"""Tables of numbers in text files: poses and time stamps, with errors that name the line."""

from __future__ import annotations

from decimal import Decimal
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64

from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.files import read_text

NANOSECONDS = {"s": Decimal(10) ** 9, "us": Decimal(1000), "ns": Decimal(1)}

QUATERNION_TOLERANCE = 1e-3
"""Largest error of the norm of a quaternion that is renormalised."""

FARTHEST = 1e9
"""Most metres that a camera may be away from the origin; beyond, splines overflow."""


def read_rows(path: Path, columns: str) -> tuple[list[list[str]], list[int]]:
    """The cells of a table whose columns are separated by white space.

    Empty lines, lines that start with "#" and a first line without any number are passed over.

    Args:
        path: The file.
        columns: Their names, separated by spaces; a row may have no fewer and no more.

    Returns:
        rows, and the number of each one's line in the file, from 1.

    Raises:
        RecordingError: The file is missing, not text, empty, or has a row with another number of columns.
    """
    lines = read_text(path, f"a text file with the columns {columns}").splitlines()
    rows, numbers = [], []
    for number, line in enumerate(lines, start=1):
        cells = line.split()
        if not cells or line.startswith("#") or (number == 1 and not any(map(_is_number, cells))):
            continue
        if len(cells) != len(columns.split()):
            raise RecordingError(
                f"{path}, line {number} has {len(cells)} columns, but {len(columns.split())} were expected: {columns}."
            )
        rows.append(cells)
        numbers.append(number)
    if not rows:
        raise RecordingError(f"{path} is empty; rows of the columns {columns} were expected.")
    return rows, numbers


def parse_times(path: Path, cells: list[str], numbers: list[int], unit: str) -> Int64[np.ndarray, " rows"]:
    """Nanoseconds from decimal text in seconds ("s"), microseconds ("us") or nanoseconds ("ns"), exact at any length.

    Raises:
        RecordingError: A cell is no number, or a time does not lie after the one before it.
    """
    times: list[int] = []
    for cell, number in zip(cells, numbers, strict=True):
        if not _is_number(cell) or not np.isfinite(float(cell)):
            raise _not_a_number(path, number, cell)
        try:
            time = int((Decimal(cell) * NANOSECONDS[unit]).to_integral_value())
        except (ArithmeticError, ValueError) as error:
            raise _not_a_number(path, number, cell) from error
        if abs(time) >= 2**62:
            raise RecordingError(f"{path}, line {number} holds the time {cell} {unit}, which is beyond 146 years.")
        if times and time <= times[-1]:
            raise RecordingError(
                f"{path}, line {number} has the time {cell} {unit}, which is not after that of the row before; times "
                "must increase from row to row."
            )
        times.append(time)
    return np.array(times, dtype=np.int64)


def parse_numbers(path: Path, rows: list[list[str]], numbers: list[int]) -> Float64[np.ndarray, "rows columns"]:
    """The cells as finite float64.

    Raises:
        RecordingError: A cell is no finite number.
    """
    values = np.empty((len(rows), len(rows[0])))
    for i, (row, number) in enumerate(zip(rows, numbers, strict=True)):
        for j, cell in enumerate(row):
            if not _is_number(cell) or not np.isfinite(float(cell)):
                raise _not_a_number(path, number, cell)
            values[i, j] = float(cell)
    return values


def read_times(path: Path, unit: str) -> Int64[np.ndarray, " rows"]:
    """One time a line, in nanoseconds; errors as of `parse_times`."""
    rows, numbers = read_rows(path, f"t_{unit}")
    return parse_times(path, [row[0] for row in rows], numbers, unit)


def read_poses(
    path: Path, unit: str, notes: list[str]
) -> tuple[Int64[np.ndarray, " poses"], Float64[np.ndarray, "poses 3"], Float64[np.ndarray, "poses 4"]]:
    """Poses, one a line: `t px py pz qx qy qz qw`, camera to world, OpenCV axes, metres.

    Args:
        path: The file.
        unit: Of the times, "s", "us" or "ns".
        notes: Gets a sentence if quaternions had to be renormalised.

    Returns:
        times in nanoseconds, positions, and unit quaternions xyzw.

    Raises:
        RecordingError: The file is missing or empty, has fewer than two rows, a column too few or too many, something
            that is no finite number, times that do not increase, a position beyond 1e9 m, or a quaternion whose norm
            is off by more than 1e-3.
    """
    rows, numbers = read_rows(path, f"t_{unit} px py pz qx qy qz qw")
    if len(rows) < 2:
        raise RecordingError(f"{path} holds {len(rows)} pose, but at least 2 were expected.")
    times = parse_times(path, [row[0] for row in rows], numbers, unit)
    values = parse_numbers(path, [row[1:] for row in rows], numbers)
    if (np.abs(values) > FARTHEST).any():
        row, column = np.argwhere(np.abs(values) > FARTHEST)[0]
        raise RecordingError(
            f"{path}, line {numbers[row]} holds {rows[row][column + 1]}, but positions within {FARTHEST:g} m and unit "
            "quaternions were expected."
        )
    positions, quaternions = values[:, :3], values[:, 3:]
    norms = np.linalg.norm(quaternions, axis=1)
    errors = np.abs(norms - 1.0)
    if (errors > QUATERNION_TOLERANCE).any():
        bad = int(np.argmax(errors > QUATERNION_TOLERANCE))
        raise RecordingError(
            f"{path}, line {numbers[bad]} holds a quaternion of norm {norms[bad]:.6g}, but rotations are unit "
            "quaternions (qx qy qz qw)."
        )
    if (errors > 1e-6).any():
        notes.append(
            f"{(errors > 1e-6).sum():,} of {len(norms):,} quaternions in {path.name} were off norm 1 by up to "
            f"{errors.max():.2g} and are renormalised."
        )
    return times, positions, quaternions / norms[:, None]


def _is_number(cell: str) -> bool:
    """Whether a text is a number as all programs write them; Python's may have underscores and digits of any script."""
    try:
        float(cell)
    except ValueError:
        return False
    return cell.isascii() and "_" not in cell


def _not_a_number(path: Path, number: int, cell: str) -> RecordingError:
    return RecordingError(f"{path}, line {number} holds {cell!r} where a finite number was expected.")

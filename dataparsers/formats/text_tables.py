"""Tables of numbers in text files: poses and time stamps, with errors that name the line."""

from __future__ import annotations

import math
from decimal import Decimal
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64

from enerf_ns.dataparsers.formats.columns import LATEST, unit_quaternions
from enerf_ns.dataparsers.recording.errors import RecordingError, shortened
from enerf_ns.dataparsers.recording.files import LARGEST_TABLE, LONGEST_LINE, reading
from enerf_ns.dataparsers.recording.time_units import NANOSECONDS, unit_by_step

MOST_ROWS = 2_000_000
"""Most rows of a table: those of half an hour at a thousand poses per second."""


def read_rows(path: Path, columns: str, separator: str = " ") -> tuple[list[list[str]], list[int]]:
    """Returns the cells of a table whose columns are separated by white space, or also by another separator.

    Empty lines, lines that start with "#" and a first line without any number are ignored.

    Args:
        path: The file.
        columns: The names of the columns, separated by spaces.
        separator: What counts as a space, such as a comma.

    Returns:
        The cells of each row, and the number of its line in the file, from 1.

    Raises:
        RecordingError: The file is missing, not text, empty or too large, or has a row with another number of columns.
    """
    count = len(columns.split())
    rows, numbers, number = [], [], 0
    expected = f"a text file with the columns {columns}"
    with reading(path, expected, LARGEST_TABLE), open(path, encoding="utf-8-sig") as file:
        while line := file.readline(LONGEST_LINE + 1):
            number += 1
            if len(line) > LONGEST_LINE:
                raise RecordingError(
                    f"{path}, line {number} has more than {LONGEST_LINE:,} letters, but {count} columns were expected: "
                    f"{columns}."
                )
            cells = line.replace(separator, " ").split()
            if not cells or line.startswith("#") or (number == 1 and all(_number(cell) is None for cell in cells)):
                continue
            if len(cells) != count:
                raise RecordingError(
                    f"{path}, line {number} has {len(cells)} columns, but {count} were expected: {columns}."
                )
            if len(rows) == MOST_ROWS:
                raise RecordingError(
                    f"{path} has more than {MOST_ROWS:,} rows, but a recording of at most so many poses or frames was "
                    "expected; give a part of it."
                )
            rows.append(cells)
            numbers.append(number)
    if not rows:
        raise RecordingError(f"{path} is empty; rows of the columns {columns} were expected.")
    return rows, numbers


def parse_times(
    path: Path, cells: list[str], numbers: list[int], unit: str, kind: str = "poses"
) -> Int64[np.ndarray, " rows"]:
    """Returns nanoseconds from decimal text in the unit "s", "us" or "ns", exact at any number of digits.

    Args:
        path: The file, for error messages.
        cells: The text of each row.
        numbers: The number of its line.
        unit: The unit.
        kind: "poses" or "frames", whose usual rate tells another unit.

    Raises:
        RecordingError: A cell is not a finite number, or the times do not increase.
    """
    times: list[int] = []
    for cell, number in zip(cells, numbers, strict=True):
        value = _number(cell)
        if value is None or not math.isfinite(value):
            raise _not_a_number(path, number, cell)
        try:
            time = int((Decimal(cell) * NANOSECONDS[unit]).to_integral_value())
        except (ArithmeticError, ValueError) as error:
            raise _not_a_number(path, number, cell) from error
        if abs(time) >= LATEST:
            wrong = _wrong_unit(cells, unit, kind) or "give times in this unit"
            raise RecordingError(
                f"{path}, line {number} holds the time {shortened(cell)} {unit}, which is beyond 146 years; {wrong}."
            )
        if times and time <= times[-1]:
            is_rounded = Decimal(cell) > Decimal(cells[len(times) - 1])
            wrong = is_rounded and _wrong_unit(cells, unit, kind)
            raise RecordingError(
                f"{path}, line {number} has the time {shortened(cell)} {unit}, which is not after that of the row "
                f"before; {wrong or 'times must increase from row to row'}."
            )
        times.append(time)
    return np.array(times, dtype=np.int64)


def _wrong_unit(cells: list[str], unit: str, kind: str) -> str | None:
    """Returns words on the unit in which times that increase seem to be written, if it is another one than stated."""
    try:
        step = float(np.median(np.diff(np.array(cells, np.longdouble)))) if len(cells) > 1 else 0.0
    except ValueError:
        return None
    return unit_by_step(step, unit, kind)


def parse_numbers(path: Path, rows: list[list[str]], numbers: list[int]) -> Float64[np.ndarray, "rows columns"]:
    """Returns the cells as float64.

    Raises:
        RecordingError: A cell is not a finite number.
    """
    values = np.empty((len(rows), len(rows[0])))
    for i, (row, number) in enumerate(zip(rows, numbers, strict=True)):
        for j, cell in enumerate(row):
            value = _number(cell)
            if value is None or not math.isfinite(value):
                raise _not_a_number(path, number, cell)
            values[i, j] = value
    return values


def read_times(path: Path, unit: str) -> Int64[np.ndarray, " rows"]:
    """Returns the times (ns) of a file with one time in each line; raises what `parse_times` raises."""
    rows, numbers = read_rows(path, f"t_{unit}")
    return parse_times(path, [row[0] for row in rows], numbers, unit, "frames")


def read_poses(
    path: Path, unit: str, notes: list[str]
) -> tuple[Int64[np.ndarray, " poses"], Float64[np.ndarray, "poses 3"], Float64[np.ndarray, "poses 4"]]:
    """Returns the poses of a file with lines `t px py pz qx qy qz qw`: camera to world, OpenCV axes, metres.

    Args:
        path: The file.
        unit: The unit of the times, "s", "us" or "ns".
        notes: Gets a sentence if quaternions were renormalised.

    Returns:
        Times in nanoseconds, positions, and unit quaternions xyzw.

    Raises:
        RecordingError: The file is missing or empty, has fewer than two rows, a row with too few or too many columns,
            a cell that is not a finite number, times that do not increase, a position beyond 1e9 m, or a quaternion
            whose norm is off by more than 1e-3.
    """
    rows, numbers = read_rows(path, f"t_{unit} px py pz qx qy qz qw")
    if len(rows) < 2:
        raise RecordingError(f"{path} holds {len(rows)} pose, but at least 2 were expected.")
    times = parse_times(path, [row[0] for row in rows], numbers, unit)
    values = parse_numbers(path, [row[1:] for row in rows], numbers)
    positions = values[:, :3]
    quaternions = unit_quaternions(path, positions, values[:, 3:], notes, lambda row: f"line {numbers[row]}")
    return times, positions, quaternions


def _number(cell: str) -> float | None:
    """Returns the number that a text states, or None if it is none in ASCII without underscores, as Python allows."""
    try:
        value = float(cell)
    except ValueError:
        return None
    return value if cell.isascii() and "_" not in cell else None


def _not_a_number(path: Path, number: int, cell: str) -> RecordingError:
    return RecordingError(f"{path}, line {number} holds {shortened(cell)!r} where a finite number was expected.")

"""Values of JSON files, which may be of any type, with errors that name the file and the key."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from enerf_ns.dataparsers.recording.errors import RecordingError

LONGEST = 60
"""Most letters of a value that an error shows."""


def parse_numbers(
    path: Path, name: str, value: object, shape: tuple[int, ...], expected: str
) -> Float64[np.ndarray, "..."]:
    """Finite numbers of this shape from nested lists.

    Args:
        path: The file.
        name: Of the value in the file.
        value: What was found.
        shape: () for one number.
        expected: In words, such as "two numbers".

    Raises:
        RecordingError: The value is something else.
    """
    try:
        return parse_array(value, shape)
    except ValueError as error:
        raise RecordingError(f"{path} holds {name} = {shown(value)}, but {expected} were expected.") from error


def parse_nanoseconds(path: Path, about: dict, name: str) -> int | None:
    """The whole number of nanoseconds that a JSON file holds under a name; None where it holds none.

    Raises:
        RecordingError: The value is something else.
    """
    value = about.get(name)
    if name in about and type(value) is not int:
        raise RecordingError(f"{path} holds {name} = {shown(value)}, but a whole number of nanoseconds was expected.")
    return value


def parse_array(value: object, shape: tuple[int, ...]) -> Float64[np.ndarray, "..."]:
    """Finite numbers of this shape from nested lists.

    Raises:
        ValueError: The value is something else.
    """
    array = np.array(value, dtype=object)
    if array.shape != shape or not all(type(number) in (int, float) for number in array.flat):
        raise ValueError(f"{shape} numbers were expected")
    try:
        numbers = array.astype(np.float64)
    except OverflowError as error:
        raise ValueError("a number is too large") from error
    if not np.isfinite(numbers).all():
        raise ValueError("finite numbers were expected")
    return numbers


def shown(value: object) -> str:
    """A value as JSON writes it, on one line and no longer than an error should be."""
    text = json.dumps(value)
    return text if len(text) <= LONGEST else text[: LONGEST - 3] + "..."

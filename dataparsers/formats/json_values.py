"""Values of JSON and YAML files, which may be of any type, with errors that name the file and the place in it."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
from jaxtyping import Float64

from enerf_ns.dataparsers.recording.camera import Camera, CameraModel, check_rotation
from enerf_ns.dataparsers.recording.errors import RecordingError, shortened
from enerf_ns.dataparsers.recording.files import of_file, read_json


@dataclass(frozen=True)
class Value:
    """A value in a file of nested objects and lists.

    Indexing by a key or a number gives an inner value. Every error is a RecordingError that names the file, the place
    of the value in it, what was found and what was expected.
    """

    path: Path
    """The file."""
    found: Any
    """The value, as the parser of JSON or YAML returns it."""
    name: str = ""
    """Place in the file, such as frame_camera.fx; empty for the whole file."""

    def __getitem__(self, key: str | int) -> Value:
        container: Any = self.found if isinstance(self.found, list if isinstance(key, int) else dict) else None
        try:
            found = None if container is None else container[key]
        except LookupError:
            found = None
        inner = self._inner(key, found)
        if found is None:
            raise RecordingError(f"{self.path} lacks {inner.name}, which was expected; add it, or give another file.")
        return inner

    def get(self, key: str) -> Value | None:
        """Returns the inner value, or None where this object lacks it or holds null.

        Raises:
            RecordingError: This is no object.
        """
        if not isinstance(self.found, dict):
            raise self.wrong("an object was")
        found = self.found.get(key)
        return None if found is None else self._inner(key, found)

    def values(self, count: int | None = None) -> list[Value]:
        """Returns the items of a list, which must be `count` if that is given."""
        if not isinstance(self.found, list) or count not in (None, len(self.found)):
            raise self.wrong("a list was" if count is None else f"a list of {count} was")
        return [self._inner(i, item) for i, item in enumerate(self.found)]

    def check_keys(self, required: tuple[str, ...], optional: tuple[str, ...] = ()) -> None:
        """Raises RecordingError unless this is an object with all required keys and no unknown ones."""
        if not isinstance(self.found, dict):
            raise self.wrong(f"an object with {in_words(required)} was")
        where = f" in {self.name}" if self.name else ""
        if missing := [key for key in required if key not in self.found]:
            raise RecordingError(
                f"{self.path} lacks {in_words(missing)}{where}; add it, as the layout event_recording asks for."
            )
        if unknown := [key for key in self.found if key not in required + optional]:
            raise RecordingError(
                f"{self.path} holds the unknown key {unknown[0]!r}{where}; known are {in_words(required + optional)}."
            )

    def numbers(self, shape: tuple[int, ...], expected: str = "") -> Float64[np.ndarray, "..."]:
        """Returns finite numbers from nested lists of this shape.

        Args:
            shape: () for one number.
            expected: What was expected, with its verb, such as "two numbers were". Default: the shape.
        """
        array = np.array(self.found, dtype=object)
        if array.shape == shape and all(type(number) in (int, float) for number in array.flat):
            with suppress(OverflowError):
                numbers = array.astype(np.float64)
                if np.isfinite(numbers).all():
                    return numbers
        raise self.wrong(expected or (f"{' x '.join(map(str, shape))} numbers were" if shape else "a number was"))

    def each(self, *keys: str) -> list[float]:
        """Returns the numbers of an object that stand under these keys."""
        return [float(self[key].numbers(())) for key in keys]

    def pair(self, key: str, expected: str = "") -> tuple[float, float] | None:
        """Returns the two numbers under a key, or None where this object lacks it or holds null."""
        value = self.get(key)
        if value is None:
            return None
        first, second = value.numbers((2,), expected).tolist()
        return first, second

    def nanoseconds(self, key: str) -> int | None:
        """Returns the whole number of nanoseconds under a key, or None where this object lacks it or holds null."""
        value = self.get(key)
        if value is not None and type(value.found) is not int:
            raise value.wrong("a whole number of nanoseconds was")
        return None if value is None else value.found

    def nested(self, side: int) -> Value:
        """Returns a matrix whose numbers stand in one list, row by row, as a list of rows; other values as they are."""
        if not isinstance(self.found, list) or len(self.found) != side * side:
            return self
        rows = [self.found[start : start + side] for start in range(0, side * side, side)]
        return Value(self.path, rows, self.name)

    def intrinsics(self) -> list[float]:
        """Returns fx, fy, cx and cy of a camera matrix of 3 x 3 numbers, nested or in one list."""
        (fx, skew, cx), (left, fy, cy), last = self.nested(3).numbers((3, 3), "fx 0 cx 0 fy cy 0 0 1 was").tolist()
        if [skew, left, *last] != [0, 0, 0, 0, 1]:
            raise self.wrong("fx 0 cx 0 fy cy 0 0 1 was")
        return [fx, fy, cx, cy]

    def pose(self) -> Float64[np.ndarray, "4 4"]:
        """Returns a matrix [R | t] with the last row 0 0 0 1."""
        matrix = self.numbers((4, 4), "a matrix of 4 x 4 numbers was")
        try:
            check_rotation(matrix[:3, :3])
        except ValueError as error:
            raise RecordingError(f"{self.path} holds a {self.name} whose upper left 3 x 3 part {error}.") from error
        if (matrix[3] != [0, 0, 0, 1]).any():
            raise RecordingError(
                f"{self.path} holds a {self.name} whose last row is {matrix[3].tolist()}, but 0 0 0 1 was expected."
            )
        return matrix

    def camera(
        self,
        size: Sequence[Any],
        intrinsics: Sequence[float],
        distortion: Sequence[float] = (),
        model: str = "pinhole",
    ) -> Camera:
        """Returns the camera that this object states.

        Args:
            size: Width and height, pixels.
            intrinsics: fx, fy, cx, cy, pixels.
            distortion: Coefficients of the model.
            model: A `CameraModel`.
        """
        (width, height), (fx, fy, cx, cy) = size, intrinsics
        with of_file(self.place):
            return Camera(width, height, fx, fy, cx, cy, tuple(distortion), cast(CameraModel, model))

    def choice(self, names: Iterable[str]) -> str:
        """Returns the text, which must be one of some names."""
        names = [*names]
        if self.found not in names:
            raise self.wrong(f"one of {in_words(names)} was")
        return self.found

    def wrong(self, expected: str) -> RecordingError:
        """Returns the error for a value that is not as expected.

        Args:
            expected: With its verb, such as "two numbers were".
        """
        return RecordingError(f"{self.path} holds {self.name} = {shown(self.found)}, but {expected} expected.")

    @property
    def place(self) -> str:
        """The file and the place in it, as the subject of a sentence."""
        return f"{self.path}, {self.name}," if self.name else str(self.path)

    def _inner(self, key: str | int, found: object) -> Value:
        name = f"{self.name}[{key}]" if isinstance(key, int) else f"{self.name}.{key}".removeprefix(".")
        return Value(self.path, found, name)


def open_json(path: Path) -> Value:
    """Returns the object of a JSON file.

    Raises:
        RecordingError: The file is missing or holds no JSON object.
    """
    return Value(path, read_json(path))


def shown(value: object) -> str:
    """Returns the start of a value as JSON writes it, on one line."""
    try:
        text = json.dumps(value, default=str)
    except (TypeError, ValueError, RecursionError):  # keys that JSON has not, and circles, which YAML may hold
        text = type(value).__name__
    return shortened(text)


def in_words(names: tuple[str, ...] | list[str]) -> str:
    """Returns names as a list in words: "x, y and t"."""
    return " and ".join(filter(None, [", ".join(names[:-1]), names[-1]]))

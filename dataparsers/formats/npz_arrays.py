"""Arrays in .npz files of any size, which are read piece by piece and never unpickled."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from zipfile import ZipFile

import numpy as np

from enerf_ns.dataparsers.formats.robust_enerf import listed
from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.files import LARGEST_ARRAY, check_npy_header, reading

EXPECTED = "an .npz file of NumPy"

KINDS = {
    "integers": "iu",
    "whole numbers or booleans": "iub",
    "numbers": "iuf",
    "numbers or booleans": "iufb",
    "text": "US",
}
"""Kinds of NumPy's types by the words of an error."""

Form = tuple[str, tuple[int | None, ...]]
"""A key of `KINDS`, and the shape, of which None is any length."""


class StoredArray:
    """An array in an .npz file, which is read from its first to its last row and never unpickled."""

    def __init__(self, path: Path, archive: ZipFile, name: str, kind: str, shape: tuple[int | None, ...]):
        if f"{name}.npy" not in archive.namelist():
            found = listed(entry.removesuffix(".npy") for entry in archive.namelist())
            raise RecordingError(f"{path} lacks the array {name}, and holds {found}; save it with {name}.")
        self._stream = archive.open(f"{name}.npy")
        version = np.lib.format.read_magic(self._stream)
        if version not in ((1, 0), (2, 0)):
            raise ValueError(f"the array {name} is of version {version} of the format")
        self._stream.seek(0)
        check_npy_header(self._stream)
        np.lib.format.read_magic(self._stream)
        header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        self.shape, self.by_column, self.dtype = header(self._stream)
        if self.dtype.hasobject:
            raise RecordingError(
                f"{path} holds {name} as pickled Python objects, which are never loaded, since they can run code; save "
                f"it as an array of {kind}."
            )
        fits = len(self.shape) == len(shape) and all(
            size in (None, found) for size, found in zip(shape, self.shape, strict=True)
        )
        if self.dtype.kind not in KINDS[kind] or not fits:
            expected = "(" + ", ".join("n" if size is None else str(size) for size in shape) + ")"
            raise RecordingError(
                f"{path} holds {name} as {self.dtype} of shape {self.shape}, but {kind} of shape {expected} were "
                "expected."
            )
        stored = archive.getinfo(f"{name}.npy").file_size - self._stream.tell()
        if stored != math.prod(self.shape) * self.dtype.itemsize:
            raise EOFError(f"the array {name} of shape {self.shape} does not fill its {stored:,} bytes")

    def __len__(self) -> int:
        return self.shape[0]

    def rows(self, count: int) -> np.ndarray:
        """Returns the next rows."""
        return self._numbers((count, *self.shape[1:]))

    def whole(self) -> np.ndarray:
        """Returns the whole array.

        Raises:
            ValueError: It has more than `LARGEST_ARRAY` bytes.
        """
        if (size := math.prod(self.shape) * self.dtype.itemsize) > LARGEST_ARRAY:
            raise ValueError(f"an array has {size:,} bytes, but at most {LARGEST_ARRAY:,} were expected")
        return self._numbers(self.shape)

    def close(self) -> None:
        self._stream.close()

    def _numbers(self, shape: tuple[int, ...]) -> np.ndarray:
        data = self._stream.read(math.prod(shape) * self.dtype.itemsize)
        return np.frombuffer(data, self.dtype).reshape(shape, order="F" if self.by_column else "C")


def open_arrays(path: Path, forms: Mapping[str, Form], stack: ExitStack) -> list[StoredArray]:
    """Returns the arrays of a file by name, which stay open until the stack closes.

    Raises:
        RecordingError: The file is missing or damaged, or lacks an array of this form.
    """
    arrays = []
    with reading(path, EXPECTED):
        archive = stack.enter_context(ZipFile(path))
        for name, form in forms.items():
            arrays.append(StoredArray(path, archive, name, *form))
            stack.callback(arrays[-1].close)
    return arrays


def load_arrays(path: Path, forms: Mapping[str, Form]) -> list[np.ndarray]:
    """Returns arrays of a file by name, as a whole.

    Raises:
        RecordingError: The file is missing or damaged, lacks an array of this form, or one is too large.
    """
    with reading(path, EXPECTED), ZipFile(path) as archive:
        return [StoredArray(path, archive, name, *form).whole() for name, form in forms.items()]

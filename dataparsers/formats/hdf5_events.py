"""Reads and writes events in HDF5 files as DSEC, TUM-VIE and EDS have them: one dataset for each column.

    x, y        integers, pixels; a reader may allow floats
    t           integers, µs, or another unit that a reader states
    p           integers or booleans, polarity
    t_offset    one integer, µs, which is added to every time (optional, at the root)

The columns lie in the group events/ or at the root. This module also reads the rectify maps that come with such files.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from enerf_ns.dataparsers.formats.columns import check_columns, check_times
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.files import of_file, reading, write_all
from enerf_ns.dataparsers.recording.hdf5_files import check_filters, member, member_at, open_hdf5
from enerf_ns.dataparsers.recording.recording import EVENTS_AT_A_TIME, Events
from enerf_ns.dataparsers.recording.time_units import NANOSECONDS, Times

if TYPE_CHECKING:
    import h5py

COLUMNS = ("x", "y", "t", "p")

METADATA_BYTES = 2**17
"""Bytes that one addition to a file may need beside its events."""

SMALLEST_CACHE = 2**20
"""Least bytes of cache for decompressed chunks that are not used up."""


class Hdf5Events:
    """The events of a file. The constructor checks them; `stream` reads them in pieces.

    Args:
        path: The file.
        unit: Unit of the times, us or ns.
        floats: Whether x, y and t may be floats.
        group: Group of the datasets x, y, t, p, with / between its parts. Where there is none, they are at the root.

    Raises:
        RecordingError: The file is missing, truncated, not HDF5 or empty, lacks a column, has columns of another type
            or of different lengths, or is compressed by a filter that is not available.
    """

    path: Path
    num_events: int
    """Number of events when the file was opened first; events that are appended later do not count."""
    first_time: int
    """Time of the first event, ns on the clock of the file."""
    last_time: int
    """Time of the last event, ns on the clock of the file."""

    def __init__(self, path: Path, unit: str = "us", floats: bool = False, group: str = "events"):
        self.path, self.unit, self._group = path, unit, group
        self._cache = SMALLEST_CACHE
        with reading(path, "an HDF5 file with events"), self._open() as file:
            columns = self._columns(file)
            for column in columns.values():
                check_filters(self.path, column)
            check_columns(self.path, columns, unit, floats)
            self._offset = self._read_offset(file)
            self._cache = max(SMALLEST_CACHE, *(_chunk_bytes(column) for column in columns.values()))
            self.num_events = len(columns["t"])
            self.first_time = int(self._times(columns["t"], 0, 1, 0)[0])
            self.last_time = int(self._times(columns["t"], self.num_events - 1, self.num_events, 0)[0])

    def times(self, pixels: int) -> Times:
        """Returns the times of the events of a sensor with so many pixels."""
        return Times.of_events(self.path, self.unit, self.num_events, self.last_time - self.first_time, pixels)

    def stream(self, zero: int) -> Iterator[Events]:
        """Yields the `num_events` events in file order, `EVENTS_AT_A_TIME` at once.

        Args:
            zero: Time (ns, on the clock of the file) that becomes 0.

        Raises:
            RecordingError: The file cannot be read any more, or has fewer events than at first.
        """
        with reading(self.path, "an HDF5 file with events"):
            file = self._open()
        with file:
            with reading(self.path, "an HDF5 file with events"):
                columns = self._columns(file)
            for start in range(0, self.num_events, EVENTS_AT_A_TIME):
                stop = min(start + EVENTS_AT_A_TIME, self.num_events)
                with reading(self.path, f"an HDF5 file with events {start + 1:,} to {stop:,}"):
                    x, y, p = (columns[name][start:stop] for name in ("x", "y", "p"))
                    t = self._times(columns["t"], start, stop, zero)
                if not len(x) == len(y) == len(t) == len(p) == stop - start:
                    raise RecordingError(
                        f"{self.path} held {self.num_events:,} events and holds fewer now; wait until it is written, "
                        "and read it again."
                    )
                yield Events(x, y, t, p)

    def _open(self) -> h5py.File:
        return open_hdf5(self.path, rdcc_nbytes=self._cache, rdcc_w0=1.0)

    def _columns(self, file: h5py.File) -> dict[str, h5py.Dataset]:
        import h5py

        group = member_at(self.path, file, self._group)
        group = file if group is None else group
        if not isinstance(group, h5py.Group):
            raise RecordingError(
                f"{self.path} holds a dataset {self._group}, but a group of the datasets x, y, t, p was expected."
            )
        columns = {name: member(self.path, group, name) for name in COLUMNS}
        missing = [name for name, column in columns.items() if not isinstance(column, h5py.Dataset)]
        if missing:
            where = "its root" if group.name == "/" else f"its group {self._group}/"
            raise RecordingError(
                f"{self.path} lacks the dataset{'s' * (len(missing) > 1)} {', '.join(missing)} in {where}; events are "
                f"the datasets x, y, t, p in a group {self._group}/ or at the root."
            )
        return columns  # type: ignore[return-value]

    def _read_offset(self, file: h5py.File) -> int:
        offset = member(self.path, file, "t_offset")
        if offset is None:
            return 0
        import h5py

        if not isinstance(offset, h5py.Dataset) or offset.dtype.kind not in "iu" or offset.size != 1:
            found = f"{offset.dtype} of shape {offset.shape}" if isinstance(offset, h5py.Dataset) else "no dataset"
            raise RecordingError(f"{self.path} holds t_offset as {found}, but one integer (µs) was expected.")
        check_filters(self.path, offset)
        return int(np.asarray(offset).reshape(()))

    def _times(self, column: h5py.Dataset, start: int, stop: int, zero: int) -> np.ndarray:
        """Returns the times of some events, nanoseconds from `zero`."""
        times = column[start:stop]
        nanoseconds = NANOSECONDS[self.unit]
        if times.dtype.kind == "f":
            if not np.isfinite(times).all():
                raise RecordingError(f"{self.path} holds a time that is not finite; copy it again from its source.")
            check_times(self.path, times, self.unit, self._offset)
            whole = np.rint(times)
            times = whole.astype(np.int64) * nanoseconds + np.rint((times - whole) * nanoseconds).astype(np.int64)
        else:
            check_times(self.path, times, self.unit, self._offset)
            times = times.astype(np.int64)
            times *= nanoseconds
        times += self._offset * nanoseconds - zero
        return times


def read_rectified_camera(path: Path, undistorted: Camera) -> Camera:
    """Returns a camera of the model lookup from its rectify map.

    The map holds, for each pixel of the sensor, its place (x, y in pixels) in the undistorted image.

    Args:
        path: HDF5 file with the dataset rectify_map, floats [height, width, 2].
        undistorted: The pinhole camera of the undistorted image.

    Raises:
        RecordingError: The file is missing, truncated or not HDF5, or holds no such map of the size of the camera.
    """
    import h5py

    height, width = undistorted.height, undistorted.width
    with reading(path, "an HDF5 file with a rectify map"), open_hdf5(path) as file:
        dataset = member(path, file, "rectify_map")
        if not isinstance(dataset, h5py.Dataset):
            raise RecordingError(f"{path} lacks the dataset rectify_map, which was expected.")
        if dataset.dtype.kind != "f" or dataset.shape != (height, width, 2):
            raise RecordingError(
                f"{path} holds rectify_map as {dataset.dtype} of shape {dataset.shape}, but floats of shape "
                f"{(height, width, 2)} were expected: x, y of each pixel of the sensor."
            )
        check_filters(path, dataset)
        rectify_map = dataset[...].astype(np.float32)
    if not np.isfinite(rectify_map).all():
        raise RecordingError(f"{path} holds a rectify_map with numbers that are not finite; make it again.")
    if not (np.diff(rectify_map[..., 0], axis=1).min() > 0 and np.diff(rectify_map[..., 1], axis=0).min() > 0):
        raise RecordingError(
            f"{path} holds a rectify_map whose x does not increase along rows or whose y does not increase along "
            "columns, as in the map of a camera; make it again."
        )
    matrix = undistorted.matrix
    directions = (rectify_map.astype(np.float64) - matrix[:2, 2]) / matrix[[0, 1], [0, 1]]
    with of_file(path):
        return replace(undistorted, model="lookup", directions=directions)


def _chunk_bytes(dataset: h5py.Dataset) -> int:
    return dataset.chunks[0] * dataset.dtype.itemsize if dataset.chunks else 0


class Hdf5EventsFile:
    """An HDF5 file of events that grows: x, y, t (whole microseconds) and p (0 or 1).

    With a group, the file also holds ms_to_idx: the index of the first event of each millisecond.

    Until the file is closed, only whole chunks are added. A chunk that is rewritten as it grows may replace another one
    that the file on the disk still refers to. Before an addition, its space is reserved on the disk, since a file whose
    addition fails halfway cannot be read any more. The oldest version of the file format is used, in which an open file
    is not marked as open.

    Args:
        path: The new file.
        group: "events/", or "" for the root.
        filters: Arguments for h5py's `create_dataset`.
        to_us: Function from times (ns) to the microseconds in the file.
        chunk: Number of events that are compressed and written together.
    """

    def __init__(self, path: Path, group: str, filters: dict, to_us: Callable[[np.ndarray], np.ndarray], chunk: int):
        import h5py

        self._path, self._to_us, self._chunk = path, to_us, chunk
        self._file = h5py.File(path, "w", libver=("earliest", "v108"), rdcc_nbytes=0)
        self._reserve(0)
        make = partial(self._file.create_dataset, shape=(0,), maxshape=(None,))
        types = {"x": np.uint16, "y": np.uint16, "t": np.int64, "p": np.uint8}
        options = {"chunks": (chunk,), **filters}
        self._columns = {name: make(group + name, dtype=dtype, **options) for name, dtype in types.items()}
        self._milliseconds = make("ms_to_idx", dtype=np.uint64, chunks=(1024,)) if group else None
        self._file.flush()
        self._num_events, self._next_millisecond = 0, 0
        self._rest = {name: np.zeros(0, dtype) for name, dtype in types.items()}

    def append(self, events: Events) -> None:
        new = {"x": events.x, "y": events.y, "t": self._to_us(events.t), "p": events.p > 0}
        for name, column in new.items():
            self._rest[name] = np.concatenate([self._rest[name], column.astype(self._rest[name].dtype)])
        self._add(len(self._rest["t"]) // self._chunk * self._chunk)

    def close(self) -> None:
        try:
            for column in self._columns.values():  # an interruption may have left some longer than others
                column.resize((self._num_events,))
            if self._milliseconds is not None:
                self._milliseconds.resize((self._next_millisecond,))
            self._add(len(self._rest["t"]))
        finally:
            length = self._file.id.get_filesize()
            self._file.close()
            os.truncate(self._path, length)

    def _add(self, count: int) -> None:
        """Adds the first `count` events that are held back."""
        if not count:
            return
        times, indices = self._rest["t"][:count], np.zeros(0, np.int64)
        if self._milliseconds is not None:
            milliseconds = np.arange(self._next_millisecond, times[-1] // 1000 + 1)
            indices = self._num_events + np.searchsorted(times, 1000 * milliseconds)
        self._reserve(sum(column[:count].nbytes for column in self._rest.values()) + indices.nbytes)
        for name, column in self._columns.items():
            column.resize((self._num_events + count,))
            column[self._num_events :] = self._rest[name][:count]
        if self._milliseconds is not None:
            self._milliseconds.resize((self._next_millisecond + len(indices),))
            self._milliseconds[self._next_millisecond :] = indices
        self._file.flush()
        self._num_events += count
        self._next_millisecond += len(indices)
        self._rest = {name: column[count:] for name, column in self._rest.items()}

    def _reserve(self, num_bytes: int) -> None:
        """Lengthens the file beyond the end that the HDF5 library knows; the library fills this space later."""
        end = self._file.id.get_filesize() + num_bytes + METADATA_BYTES
        with open(self._path, "r+b", buffering=0) as file:
            length = file.seek(0, os.SEEK_END)
            try:
                write_all(file, bytes(max(end - length, 0)))
            except OSError:
                file.truncate(length)
                raise

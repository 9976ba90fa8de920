"""Events in HDF5 files of the layout of DSEC, TUM-VIE and EDS: whole microseconds, and one dataset a column.

    x, y        integers, pixels
    t           integers, µs
    p           integers or booleans, polarity
    t_offset    one integer, µs, to be added to every time (optional, at the root)

The columns lie in the group events/ or at the root. Rectify maps, which come beside such files, are read here as well.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float32

from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.files import reading, write_all
from enerf_ns.dataparsers.recording.recording import EVENTS_AT_A_TIME, Events

if TYPE_CHECKING:
    import h5py

COLUMNS = ("x", "y", "t", "p")

LATEST = 2**62 // 1000
"""Time in µs; what lies beyond (146 years) does not fit into 64 bits of nanoseconds, or is no µs."""

BLOSC_FILTERS, BLOSC_PARAMETERS = (32001, 32026), 4
"""Filters Blosc and Blosc2, and how many parameters they have at least; they end the process where they find fewer in a
damaged file."""

METADATA_BYTES = 2**17
"""Bytes by which a file that is written may grow beside its events at a time."""

SMALLEST_CACHE = 2**20
"""Least bytes of cache for chunks that were decompressed and are not yet used up."""


class Hdf5Events:
    """The events of a file, looked at once, and read in pieces later.

    Args:
        path: The file.

    Raises:
        RecordingError: The file is missing, truncated or no HDF5, lacks a column, is empty, has columns of another type
            or of different lengths, or is compressed by a filter that is not available.
    """

    path: Path
    num_events: int
    """Number of events when the file was looked at; what is appended later does not count."""
    first_time: int
    """Time of the first event, ns on the clock of the file."""
    last_time: int
    """Time of the last event, ns on the clock of the file."""

    def __init__(self, path: Path):
        self.path = path
        self._cache = SMALLEST_CACHE
        with reading(path, "an HDF5 file with events"), self._open() as file:
            columns = self._columns(file)
            self._check(columns)
            self._offset = self._read_offset(file)
            self._cache = max(SMALLEST_CACHE, *(_chunk_bytes(column) for column in columns.values()))
            self.num_events = len(columns["t"])
            self.first_time = int(self._times(columns["t"], 0, 1, 0)[0])
            self.last_time = int(self._times(columns["t"], self.num_events - 1, self.num_events, 0)[0])

    def stream(self, zero: int) -> Iterator[Events]:
        """The events that were there when the file was looked at, in file order, `EVENTS_AT_A_TIME` at once.

        Args:
            zero: Time (ns, on the clock of the file) that becomes 0.

        Raises:
            RecordingError: The file cannot be read any more, or has fewer events than before.
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
                        "then read it again."
                    )
                yield Events(x, y, t, p)

    def _open(self) -> h5py.File:
        import h5py
        import hdf5plugin  # noqa: F401  makes the filters known

        return h5py.File(self.path, "r", locking=False, rdcc_nbytes=self._cache, rdcc_w0=1.0)

    def _columns(self, file: h5py.File) -> dict[str, h5py.Dataset]:
        import h5py

        group = _member(self.path, file, "events")
        group = file if group is None else group
        if not isinstance(group, h5py.Group):
            raise RecordingError(
                f"{self.path} holds a dataset events, but a group of the datasets x, y, t, p was expected."
            )
        columns = {name: _member(self.path, group, name) for name in COLUMNS}
        missing = [name for name, column in columns.items() if not isinstance(column, h5py.Dataset)]
        if missing:
            where = "its group events/" if group.name == "/events" else "its root"
            raise RecordingError(
                f"{self.path} lacks the dataset{'s' * (len(missing) > 1)} {', '.join(missing)} in {where}; events are "
                "the datasets x, y, t, p in a group events/ or at the root."
            )
        return columns  # type: ignore[return-value]

    def _check(self, columns: dict[str, h5py.Dataset]) -> None:
        for name, column in columns.items():
            if column.dtype.kind not in ("iub" if name == "p" else "iu"):
                expected = "whole microseconds (integers)" if name == "t" else "integers"
                raise RecordingError(f"{self.path} holds {name} as {column.dtype}, but {expected} were expected.")
            if column.ndim != 1:
                raise RecordingError(
                    f"{self.path} holds {name} as an array of shape {column.shape}, but one number an event was "
                    "expected."
                )
            _check_filters(self.path, column)
        lengths = {name: len(column) for name, column in columns.items()}
        if len(set(lengths.values())) > 1:
            found = ", ".join(f"{length:,} {name}" for name, length in lengths.items())
            raise RecordingError(f"{self.path} holds {found}, but as many of each were expected; copy it again.")
        if lengths["t"] == 0:
            raise RecordingError(f"{self.path} holds no events; give a recording with some.")

    def _read_offset(self, file: h5py.File) -> int:
        member = _member(self.path, file, "t_offset")
        if member is None:
            return 0
        offset = np.asarray(member)
        if offset.dtype.kind not in "iu" or offset.size != 1:
            raise RecordingError(
                f"{self.path} holds t_offset as {offset.dtype} of shape {offset.shape}, but one integer (µs) was "
                "expected."
            )
        return int(offset.reshape(()))

    def _times(self, column: h5py.Dataset, start: int, stop: int, zero: int) -> np.ndarray:
        """Times of some events, nanoseconds from `zero`."""
        times = column[start:stop]
        extremes = (int(times.min()) + self._offset, int(times.max()) + self._offset) if len(times) else ()
        if any(abs(time) >= LATEST for time in extremes):
            raise RecordingError(
                f"{self.path} holds the time {max(extremes, key=abs)} µs, which is beyond 146 years; times were "
                "expected in microseconds."
            )
        times = times.astype(np.int64)
        times *= 1000
        times += self._offset * 1000 - zero
        return times


def read_rectify_map(path: Path, width: int, height: int) -> Float32[np.ndarray, "height width 2"]:
    """Where each pixel of a camera lies in its undistorted image: x and y in pixels.

    Args:
        path: HDF5 file with the dataset rectify_map.
        width, height: Of the sensor, pixels.

    Raises:
        RecordingError: The file is missing, truncated or no HDF5, or holds no such map of this size.
    """
    import h5py
    import hdf5plugin  # noqa: F401  makes the filters known

    with reading(path, "an HDF5 file with a rectify map"), h5py.File(path, "r", locking=False) as file:
        dataset = _member(path, file, "rectify_map")
        if not isinstance(dataset, h5py.Dataset):
            raise RecordingError(f"{path} lacks the dataset rectify_map, which was expected.")
        if dataset.dtype.kind != "f" or dataset.shape != (height, width, 2):
            raise RecordingError(
                f"{path} holds rectify_map as {dataset.dtype} of shape {dataset.shape}, but floats of shape "
                f"{(height, width, 2)} were expected: x, y of each pixel of the sensor."
            )
        _check_filters(path, dataset)
        rectify_map = dataset[...].astype(np.float32)
    if not np.isfinite(rectify_map).all():
        raise RecordingError(f"{path} holds a rectify_map with numbers that are not finite; make it again.")
    if not (np.diff(rectify_map[..., 0], axis=1).min() > 0 and np.diff(rectify_map[..., 1], axis=0).min() > 0):
        raise RecordingError(
            f"{path} holds a rectify_map whose x does not increase along rows or whose y does not down columns, as "
            "those of a camera do; make it again."
        )
    return rectify_map


def _member(path: Path, group: h5py.Group, name: str) -> h5py.Group | h5py.Dataset | h5py.Datatype | None:
    """What has a name in a group; None where nothing has.

    Raises:
        RecordingError: It is kept elsewhere, by a link, as external storage or as a virtual dataset: what lies in
            another file of the disk is not for the sender of this one to name.
    """
    import h5py

    link = group.get(name, getlink=True)
    if link is None:
        return None
    member = group[name] if isinstance(link, h5py.HardLink) else None
    if member is None or (isinstance(member, h5py.Dataset) and (member.external or member.is_virtual)):
        raise RecordingError(
            f"{path} refers for {name} to another place, such as another file, and that is not followed; repack the "
            "file with the data in it."
        )
    return member


def _check_filters(path: Path, dataset: h5py.Dataset) -> None:
    import h5py

    properties = dataset.id.get_create_plist()
    for i in range(properties.get_nfilters()):
        number, _, parameters, name = properties.get_filter(i)
        if not h5py.h5z.filter_avail(number):
            called = f" ({name.decode(errors='replace')!r})" if name else ""
            raise RecordingError(
                f"{path} is compressed by the HDF5 filter {number}{called}, which is neither in h5py nor in "
                "hdf5plugin; install its plugin and set HDF5_PLUGIN_PATH, or repack the file without it."
            )
        if number in BLOSC_FILTERS and len(parameters) < BLOSC_PARAMETERS:
            raise RecordingError(
                f"{path} is compressed by the HDF5 filter {number} (Blosc) and lacks its parameters; copy it again "
                "from its source."
            )


def _chunk_bytes(dataset: h5py.Dataset) -> int:
    return dataset.chunks[0] * dataset.dtype.itemsize if dataset.chunks else 0


class Hdf5EventsFile:
    """An HDF5 file of events that grows: x, y, t (whole microseconds) and p (0 or 1).

    If they are in a group, there is also ms_to_idx: each millisecond's first event.

    Only whole chunks are added until the file is closed, since one that is rewritten as it grows may end up in place
    of another that the file on the disk still refers to. The room that an addition needs is taken from the disk before
    it is made, since a file whose addition fails halfway cannot be read any more. The oldest version of the file format
    is used, in which a file is not marked as open.

    Args:
        path: The file, which is made anew.
        group: "events/", or "" for the root.
        filters: Of h5py's `create_dataset`.
        to_us: From times (ns) to the microseconds that the file shall hold.
        chunk: Events that are compressed, and written, together.
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
            for column in self._columns.values():  # of which some may have grown before an interruption
                column.resize((self._num_events,))
            if self._milliseconds is not None:
                self._milliseconds.resize((self._next_millisecond,))
            self._add(len(self._rest["t"]))
        finally:
            length = self._file.id.get_filesize()
            self._file.close()
            os.truncate(self._path, length)

    def _add(self, count: int) -> None:
        """Adds the first events of those held back."""
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
        """Makes the file so much longer than the library knows; what lies behind its end it uses as it needs it."""
        end = self._file.id.get_filesize() + num_bytes + METADATA_BYTES
        with open(self._path, "r+b", buffering=0) as file:
            length = file.seek(0, os.SEEK_END)
            try:
                write_all(file, bytes(max(end - length, 0)))
            except OSError:
                file.truncate(length)
                raise

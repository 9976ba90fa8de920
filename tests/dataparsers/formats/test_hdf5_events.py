from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
import hdf5plugin
import numpy as np
import pytest

from enerf_ns.dataparsers.formats import hdf5_events
from enerf_ns.dataparsers.formats.hdf5_events import Hdf5Events, read_rectified_camera
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.errors import RecordingError

NUM_EVENTS = 5000
EPOCH = 1_636_000_000_123_456
"""An absolute time in µs."""


def columns(num_events: int = NUM_EVENTS, zero: int = EPOCH) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    return {
        "x": rng.integers(0, 640, num_events).astype(np.uint16),
        "y": rng.integers(0, 480, num_events).astype(np.uint16),
        "t": zero + np.sort(rng.integers(0, 10**7, num_events)),
        "p": rng.integers(0, 2, num_events).astype(np.uint8),
    }


def write(path: Path, where: str = "/", offset: int | None = None, data: dict | None = None, **storage) -> Path:
    with h5py.File(path, "w") as file:
        for name, column in (columns() if data is None else data).items():
            file.require_group(where).create_dataset(name, data=column, **storage)
        if offset is not None:
            file["t_offset"] = offset
    return path


def read(events: Hdf5Events, zero: int = 0) -> dict[str, np.ndarray]:
    pieces = list(events.stream(zero))
    return {name: np.concatenate([getattr(piece, name) for piece in pieces]) for name in "xytp"}


def check(found: dict[str, np.ndarray], zero: int = 0, offset: int = 0) -> None:
    """Against what was written, with Python's unlimited integers for the times."""
    written = columns()
    for name in ("x", "y", "p"):
        np.testing.assert_array_equal(found[name], written[name])
    assert found["t"].tolist() == [(t + offset) * 1000 - zero for t in written["t"].tolist()]
    assert found["t"].dtype == np.int64


def test_events_in_nanoseconds_between_pixels(tmp_path: Path):
    """Where a reader allows them; times with a fraction keep it."""
    x, t = np.array([0.25, 3.5], np.float32), np.array([5.25, 7.0])
    data = {"x": x, "y": np.array([1, 2], np.uint16), "t": t, "p": np.array([0, 1], np.uint8)}
    path = write(tmp_path / "events.h5", data=data)
    found = read(Hdf5Events(path, "us", floats=True))
    np.testing.assert_array_equal(found["x"], x)
    assert found["t"].tolist() == [5250, 7000] and found["t"].dtype == np.int64
    assert read(Hdf5Events(path, "ns", floats=True))["t"].tolist() == [5, 7]
    with pytest.raises(RecordingError, match="holds x as float32"):
        Hdf5Events(path)
    path = write(tmp_path / "nan.h5", data=data | {"t": np.array([1.0, np.nan])})
    with pytest.raises(RecordingError, match="holds a time that is not finite"):
        Hdf5Events(path, "us", floats=True)


@pytest.mark.parametrize("where", ["/", "events"])
@pytest.mark.parametrize("offset", [None, 1_000_000_000, -1000])
@pytest.mark.parametrize("zero", [0, EPOCH * 1000 + 789])
def test_events_at_the_root_or_in_their_group_with_or_without_an_offset(
    tmp_path: Path, where: str, offset: int | None, zero: int
):
    events = Hdf5Events(write(tmp_path / "events.h5", where, offset))
    times = columns()["t"].tolist()
    assert events.num_events == NUM_EVENTS
    assert events.first_time == (times[0] + (offset or 0)) * 1000
    assert events.last_time == (times[-1] + (offset or 0)) * 1000
    check(read(events, zero), zero, offset or 0)


@pytest.mark.parametrize(
    "storage",
    [
        {},
        {"chunks": (999,)},
        {"chunks": (NUM_EVENTS,), "compression": "gzip", "shuffle": True},
        {"compression": "lzf"},
        {**hdf5plugin.Blosc(cname="zstd", shuffle=hdf5plugin.Blosc.SHUFFLE)},
        {**hdf5plugin.Blosc2()},
        {**hdf5plugin.Zstd(), "fletcher32": True},
    ],
    ids=["contiguous", "chunks", "gzip", "lzf", "blosc", "blosc2", "zstd"],
)
@pytest.mark.parametrize("at_a_time", [1000, 4999, NUM_EVENTS, 2**21])
def test_pieces_are_the_whole_however_it_is_stored(
    tmp_path: Path, storage: dict, at_a_time: int, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(hdf5_events, "EVENTS_AT_A_TIME", at_a_time)
    events = Hdf5Events(write(tmp_path / "events.h5", **storage))
    assert [len(piece) for piece in events.stream(0)] == [
        min(at_a_time, NUM_EVENTS - start) for start in range(0, NUM_EVENTS, at_a_time)
    ]
    for _ in range(2):
        check(read(events))


@pytest.mark.parametrize(
    "dtypes",
    [
        {"x": "<i2", "y": ">u2", "t": ">i8", "p": "?"},
        {"x": "u1", "y": "u1", "t": "u8", "p": "i1"},
        {"x": "i8", "y": "u8", "t": "i8", "p": "i8"},
    ],
)
def test_any_integer_types(tmp_path: Path, dtypes: dict[str, str]):
    data = {name: column % 200 if name in "xy" else column for name, column in columns().items()}
    data = {name: column.astype(dtypes[name]) for name, column in data.items()}
    found = read(Hdf5Events(write(tmp_path / "events.h5", data=data)))
    for name in ("x", "y", "p"):
        np.testing.assert_array_equal(found[name], data[name])
    np.testing.assert_array_equal(found["t"], data["t"].astype(np.int64) * 1000)


def test_short_times_do_not_overflow(tmp_path: Path):
    data = {name: column[:3] for name, column in columns().items()} | {"t": np.array([0, 2**31, 2**32 - 1], np.uint32)}
    found = read(Hdf5Events(write(tmp_path / "events.h5", offset=-5, data=data)))
    assert found["t"].tolist() == [-5000, (2**31 - 5) * 1000, (2**32 - 6) * 1000]


def test_events_appended_later_do_not_count(tmp_path: Path):
    path = write(tmp_path / "events.h5", maxshape=(None,), chunks=(700,))
    events = Hdf5Events(path)
    stream = events.stream(0)
    with h5py.File(path, "a") as file:
        for dataset in file.values():
            dataset.resize((2 * NUM_EVENTS,))
            dataset[NUM_EVENTS:] = 1
    assert sum(len(piece) for piece in stream) == NUM_EVENTS
    check(read(events))
    assert events.num_events == NUM_EVENTS


def test_a_file_that_shrank_is_noticed(tmp_path: Path):
    events = Hdf5Events(write(tmp_path / "events.h5", maxshape=(None,)))
    with h5py.File(events.path, "a") as file:
        for dataset in file.values():
            dataset.resize((NUM_EVENTS - 1,))
    with pytest.raises(RecordingError, match=r"held 5,000 events and holds fewer now"):
        read(events)


def test_reading_leaves_the_file_as_it_was(tmp_path: Path):
    path = write(tmp_path / "events.h5")
    before = path.read_bytes(), path.stat().st_mtime_ns
    path.chmod(0o444)
    check(read(Hdf5Events(path)))
    assert (path.read_bytes(), path.stat().st_mtime_ns) == before


def without(name: str) -> dict[str, np.ndarray]:
    return {other: column for other, column in columns().items() if other != name}


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (without("t"), "lacks the dataset t in its root"),
        ({"t": columns()["t"]}, "lacks the datasets x, y, p in its root"),
        ({}, "lacks the datasets x, y, t, p in its root"),
        (
            columns() | {"t": columns()["t"] * 1e-6},
            "which look like seconds, but whole microseconds were expected; save np.rint(t * 1e+06).astype(np.int64)",
        ),
        (columns() | {"x": columns()["x"].astype(np.float32)}, "holds x as float32"),
        (columns() | {"x": columns()["x"] > 3}, "holds x as bool"),
        (columns() | {"p": columns()["p"].astype(complex)}, "holds p as complex128"),
        (columns() | {"p": np.full(NUM_EVENTS, b"on")}, "holds p as |S2"),
        (columns() | {"y": columns()["y"][:-7]}, "holds 5,000 x, 4,993 y, 5,000 t, 5,000 p, but as many of each"),
        (columns() | {"y": columns()["y"][:, None]}, "holds y as uint16 of shape (5000, 1), but one whole number"),
        (columns() | {"y": np.uint16(3)}, "holds y as uint16 of shape (), but one whole number"),
        (columns(0), "holds no events"),
        (columns() | {"t": columns()["t"] * 1000}, "these look like nanoseconds, so divide them by 1,000"),
        (columns() | {"t": np.full(NUM_EVENTS, 2**64 - 1, np.uint64)}, "us, which is beyond 146 years"),
    ],
)
def test_columns_of_another_kind(tmp_path: Path, data: dict, message: str):
    path = write(tmp_path / "events.h5", data=data)
    with pytest.raises(RecordingError) as caught:
        Hdf5Events(path)
    assert str(caught.value).startswith(f"{path} ") and message in str(caught.value)


def test_a_time_beyond_all_measure_in_the_middle(tmp_path: Path):
    data = columns()
    data["t"][2500] = 2**62
    events = Hdf5Events(write(tmp_path / "events.h5", data=data))
    with pytest.raises(RecordingError, match=f"holds the time {2**62} us, which is beyond 146 years"):
        read(events)


@pytest.mark.parametrize("offset", [1.5, np.array([1, 2]), "late"])
def test_an_offset_that_is_no_integer(tmp_path: Path, offset):
    path = write(tmp_path / "events.h5", offset=offset)
    with pytest.raises(RecordingError, match=r"holds t_offset as .*, but one integer \(µs\) was expected"):
        Hdf5Events(path)


def make_missing(path: Path) -> None:
    path.unlink()


def make_folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def make_dataset(path: Path) -> None:
    write(path, data={"events": np.zeros(3)})


def make_groups(path: Path) -> None:
    with h5py.File(path, "w") as file:
        for name in "xytp":
            file.create_group(f"events/{name}")


def make_broken_links(path: Path) -> None:
    with h5py.File(path, "w") as file:
        for name in "xytp":
            file[name] = h5py.ExternalLink("elsewhere.h5", f"/{name}")


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (make_missing, "is missing; an HDF5 file with events was expected there."),
        (make_folder, "is a folder; an HDF5 file with events was expected there."),
        (make_dataset, "holds a dataset events, but a group"),
        (make_groups, "lacks the datasets x, y, t, p in its group events/"),
        (make_broken_links, "refers for x to another place"),
        (lambda path: path.write_bytes(b""), "is empty; an HDF5 file with events was expected."),
        (lambda path: path.write_bytes(b"x y t p\n1 2 3 1\n"), "file signature not found"),
    ],
)
def test_no_file_of_events(tmp_path: Path, damage: Callable[[Path], object], message: str):
    path = write(tmp_path / "events.h5")
    damage(path)
    with pytest.raises(RecordingError) as caught:
        Hdf5Events(path)
    text = str(caught.value)
    assert text.startswith(f"{path} ") and message in text and "\n" not in text


@pytest.mark.parametrize("storage", [{}, {"chunks": (500,), **hdf5plugin.Blosc(cname="zstd")}])
def test_a_truncated_file(tmp_path: Path, storage: dict):
    whole = write(tmp_path / "whole.h5", **storage).read_bytes()
    path = tmp_path / "events.h5"
    for kept in [*range(0, 200, 13), *np.linspace(200, len(whole) - 1, 40).astype(int)]:
        path.write_bytes(whole[:kept])
        with pytest.raises(RecordingError) as caught:
            read(Hdf5Events(path))
        assert str(caught.value).startswith(f"{path} ") and "\n" not in str(caught.value)


def test_a_file_truncated_after_it_was_looked_at(tmp_path: Path):
    events = Hdf5Events(write(tmp_path / "events.h5"))
    events.path.write_bytes(events.path.read_bytes()[:-5000])
    with pytest.raises(RecordingError, match="truncated file"):
        read(events)


def test_a_damaged_chunk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(hdf5_events, "EVENTS_AT_A_TIME", 1000)
    path = write(tmp_path / "events.h5", chunks=(500,), compression="gzip")
    with h5py.File(path) as file:
        place = file["x"].id.get_chunk_info(5).byte_offset
    content = bytearray(path.read_bytes())
    content[place : place + 50] = bytes(50)
    path.write_bytes(content)
    stream = Hdf5Events(path).stream(0)
    assert len(next(stream)) == len(next(stream)) == 1000
    with pytest.raises(RecordingError, match=r"cannot be read as an HDF5 file with events 2,001 to 3,000 \("):
        next(stream)


def test_a_filter_that_is_not_there(tmp_path: Path):
    path = write(tmp_path / "events.h5", data={})
    space = h5py.h5s.create_simple((NUM_EVENTS,))
    properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    properties.set_chunk((NUM_EVENTS,))
    properties.set_filter(0x8ECF, h5py.h5z.FLAG_OPTIONAL)
    with h5py.File(path, "a") as file:
        for name, column in columns().items():
            h5py.h5d.create(file.id, name.encode(), h5py.h5t.py_create(column.dtype), space, properties)
    with pytest.raises(RecordingError, match=r"compressed by the HDF5 filter 36559.*, which is neither in h5py nor"):
        Hdf5Events(path)


def test_a_filter_without_its_parameters(tmp_path: Path):
    """In the file, their number stands before the name of the filter."""
    path = write(tmp_path / "events.h5", **hdf5plugin.Blosc())
    path.write_bytes(path.read_bytes().replace(b"\x07\0blosc", b"\0\0blosc"))
    with pytest.raises(RecordingError, match=r"compressed by the HDF5 filter 32001 \(Blosc\) and lacks its parameters"):
        Hdf5Events(path)


@pytest.mark.parametrize("storage", [{}, {"chunks": (500,), "compression": "gzip"}])
def test_flipped_bytes_give_a_sentence_or_events(tmp_path: Path, storage: dict):
    """The library underneath checks little, but what it raises must not come through."""
    whole = write(tmp_path / "whole.h5", data=columns(1000), **storage).read_bytes()
    rng, path, failures = np.random.default_rng(1), tmp_path / "events.h5", 0
    for _ in range(100):
        content = bytearray(whole)
        places = rng.integers(0, min(len(content), 6000), 4)
        for place in places:
            content[place] = rng.integers(256)
        path.write_bytes(content)
        try:
            found = read(Hdf5Events(path))
        except RecordingError as error:
            failures += 1
            assert str(error).startswith(f"{path} ") and "\n" not in str(error)
        else:
            assert len({len(column) for column in found.values()}) == 1
    assert failures > 0


UNDISTORTED = Camera(24, 18, 20.0, 21.0, 11.5, 8.5)


def write_map(path: Path, rectify_map: np.ndarray, name: str = "rectify_map", **storage) -> Path:
    with h5py.File(path, "w") as file:
        file.create_dataset(name, data=rectify_map, **storage)
    return path


def plain_map(width: int = 24, height: int = 18) -> np.ndarray:
    rows, columns = np.mgrid[:height, :width].astype(np.float32)
    return np.dstack([1.1 * columns - 3, 0.9 * rows + 2])


@pytest.mark.parametrize("storage", [{}, {**hdf5plugin.Blosc()}])
def test_a_rectify_map(tmp_path: Path, storage: dict):
    path = write_map(tmp_path / "map.h5", plain_map(), **storage)
    camera = read_rectified_camera(path, UNDISTORTED)
    directions = (plain_map().astype(float) - [UNDISTORTED.cx, UNDISTORTED.cy]) / [UNDISTORTED.fx, UNDISTORTED.fy]
    np.testing.assert_array_equal(camera.pixel_directions()[..., :2], directions)
    assert camera.undistorted() == UNDISTORTED


@pytest.mark.parametrize(
    ("rectify_map", "name", "message"),
    [
        (plain_map(), "map", "lacks the dataset rectify_map"),
        (plain_map(18, 24), "rectify_map", "of shape (24, 18, 2), but floats of shape (18, 24, 2) were expected"),
        (plain_map().astype(int), "rectify_map", "holds rectify_map as int64"),
        (np.where(plain_map() > 20, np.nan, plain_map()), "rectify_map", "numbers that are not finite"),
        (plain_map()[..., ::-1], "rectify_map", "x does not increase along rows"),
        (-plain_map(), "rectify_map", "x does not increase along rows"),
    ],
)
def test_what_is_no_rectify_map(tmp_path: Path, rectify_map: np.ndarray, name: str, message: str):
    path = write_map(tmp_path / "map.h5", rectify_map, name)
    with pytest.raises(RecordingError) as caught:
        read_rectified_camera(path, UNDISTORTED)
    assert str(caught.value).startswith(f"{path} ") and message in str(caught.value)


def test_a_truncated_or_missing_rectify_map(tmp_path: Path):
    path = write_map(tmp_path / "map.h5", plain_map())
    shutil.copy(path, tmp_path / "cut.h5")
    (tmp_path / "cut.h5").write_bytes(path.read_bytes()[:-100])
    with pytest.raises(RecordingError, match="truncated file"):
        read_rectified_camera(tmp_path / "cut.h5", UNDISTORTED)
    with pytest.raises(RecordingError, match="is missing; an HDF5 file with a rectify map was expected there"):
        read_rectified_camera(tmp_path / "none.h5", UNDISTORTED)

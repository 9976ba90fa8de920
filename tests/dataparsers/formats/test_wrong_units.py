"""Each layout with times in each wrong unit, and with x and y exchanged: the unit, or the exchange, is named."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, field
from decimal import Decimal
from functools import cache
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import test_esim_npz
import test_event_recording
import test_fuzz

from enerf_ns.dataparsers.formats.conversion import convert_recording
from enerf_ns.dataparsers.formats.registry import _read_folder
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.inspection.problems import find_problems
from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.time_units import NAMES, NANOSECONDS, Times, check_units

Edit = Callable[[Path, Callable], None]
"""Writes a function of the times, or of the rows x y, into a file."""


def in_table(path: Path, of: Callable) -> None:
    """The first column of a text file, exactly."""
    rows = [line.split(maxsplit=1) for line in path.read_text().splitlines() if line[0] in "0123456789"]
    path.write_text("".join(f"{of(Decimal(time)):f} {' '.join(rest)}\n" for time, *rest in rows))


def in_array(path: Path, of: Callable) -> None:
    np.save(path, of(np.load(path)))


def in_rows(path: Path, of: Callable) -> None:
    """The third column of a file of NumPy."""
    rows = np.load(path).astype(np.float64)
    rows[:, 2] = of(rows[:, 2])
    np.save(path, rows)


def in_archive(name: str) -> Edit:
    def edit(path: Path, of: Callable) -> None:
        arrays = dict(np.load(path))
        np.savez(path, **{**arrays, name: of(arrays[name])})

    return edit


def in_hdf5(path: Path, of: Callable) -> None:
    file: Any
    with h5py.File(path, "r+") as file:
        place = "events/t" if "events" in file else "t"
        times = of(file[place][...])
        del file[place]
        file[place] = times


def thousands_of_events(pixels: tuple[int, int], span: int) -> np.ndarray:
    """x y t p of events at a usual rate, over the poses."""
    number = max(4000, pixels[0] * pixels[1] // 10)
    random = np.random.default_rng(0)
    columns = random.integers(0, pixels[0], number), random.integers(0, pixels[1], number)
    times = np.linspace(0, span, number).astype(np.int64)
    return np.column_stack([*columns, times, random.integers(0, 2, number)])


def fill_hdf5(path: Path, size: tuple[int, int]) -> None:
    file: Any
    with h5py.File(path, "r+") as file:
        group = file["events"] if "events" in file else file
        first, last = (int(group["t"][i]) for i in (0, -1))
        for name, column in zip("xytp", thousands_of_events(size, last - first).T, strict=True):
            kind = group[name].dtype
            del group[name]
            group[name] = (column + first * (name == "t")).astype(kind)


def fill_own(folder: Path) -> None:
    for name, column in zip("xytp", thousands_of_events((24, 18), 10**9).T, strict=True):
        path = folder / f"events/{name}.npy"
        np.save(path, column.astype(np.load(path).dtype))


def fill_esim(folder: Path) -> None:
    rows = thousands_of_events((24, 18), 10**9)
    for file, part in zip(sorted(folder.glob("events/*.npy")), np.array_split(rows, 2), strict=True):
        np.save(file, part)


def fill_davis(folder: Path) -> None:
    rows = thousands_of_events((24, 18), 10**9).tolist()
    (folder / "events.txt").write_text("".join(f"{1 + t / 1e9:.9f} {x} {y} {p}\n" for x, y, t, p in rows))


def fill_npz(folder: Path) -> None:
    times = np.load(folder / "camera_poses.npz")["T_wc_timestamp"]
    x, y, t, p = np.repeat(thousands_of_events((160, 120), int(np.ptp(times))), 40, axis=0).T
    np.savez(folder / "raw_events.npz", position=np.column_stack([x, y]), timestamp=t + times.min(), polarity=p)


@dataclass(frozen=True)
class Layout:
    """Where the times of a layout stand, and in which unit."""

    write: Callable[[Path], object]
    columns: dict[str, tuple[str, str, Edit]]
    """Pattern of the files, unit, and how to change them, for events, poses and frames."""
    fill: Callable[[Path], object] = field(default=lambda folder: None)
    """Puts enough events into the recording."""


def written(name: str) -> Callable[[Path], object]:
    return test_fuzz.LAYOUTS[name].write


LAYOUTS = {
    "eds_raw": Layout(
        written("eds_raw"),
        {
            "events": ("events.h5", "us", in_hdf5),
            "poses": ("stamped_groundtruth.txt", "s", in_table),
            "frames": ("images_timestamps.txt", "us", in_table),
        },
        lambda folder: fill_hdf5(folder / "events.h5", (640, 480)),
    ),
    "eds_prepared": Layout(
        written("eds_prepared"),
        {"events": ("events.h5", "us", in_hdf5), "poses": ("stamped_groundtruth_us.txt", "us", in_table)},
        lambda folder: fill_hdf5(folder / "events.h5", (640, 480)),
    ),
    "tum_vie": Layout(
        written("tum_vie_raw"),
        {
            "events": ("*events_left.h5", "us", in_hdf5),
            "poses": ("*/mocap_data.txt", "us", in_table),
            "frames": ("*/*/image_timestamps_left.txt", "us", in_table),
        },
        lambda folder: fill_hdf5(next(folder.glob("*events_left.h5")), (1280, 720)),
    ),
    "esim": Layout(
        written("esim"),
        {
            "events": ("events/*.npy", "ns", in_rows),
            "poses": ("*poses_all.txt", "ns", in_table),
            "frames": ("images*/image_stamps_ns.txt", "ns", in_table),
        },
        fill_esim,
    ),
    "davis": Layout(
        written("davis"),
        {
            "events": ("events.txt", "s", in_table),
            "poses": ("groundtruth.txt", "s", in_table),
            "frames": ("images.txt", "s", in_table),
        },
        fill_davis,
    ),
    "esim_npz": Layout(
        test_esim_npz.write_npz,
        {
            "events": ("raw_events.npz", "ns", in_archive("timestamp")),
            "poses": ("camera_poses.npz", "ns", in_archive("T_wc_timestamp")),
        },
        fill_npz,
    ),
    "event_recording": Layout(
        lambda folder: test_event_recording.write_recording(folder, ("frames",)),
        {
            "events": ("events/t.npy", "ns", in_array),
            "poses": ("poses.txt", "ns", in_table),
            "frames": ("frames/stamps_ns.txt", "ns", in_table),
        },
        fill_own,
    ),
}
"""All layouts but bags of ROS, whose messages have no unit to mistake."""

CASES = [
    (layout, kinds, unit)
    for layout, about in LAYOUTS.items()
    for kinds in (*((kind,) for kind in about.columns), tuple(about.columns))
    for unit in NANOSECONDS
    if unit != about.columns[kinds[0]][1] and not (layout == "esim_npz" and "poses" in kinds and unit == "s")
]
"""Layout, what is in another unit, and this unit. Whole seconds of poses have no rate that could name them."""


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    @cache
    def write(layout: str) -> Path:
        folder = tmp_path_factory.mktemp("whole") / layout
        LAYOUTS[layout].write(folder)
        LAYOUTS[layout].fill(folder)
        return folder

    return write


def put_into(folder: Path, layout: str, kind: str, unit: str) -> None:
    """Writes the times of a kind in another unit; arrays keep their type."""
    pattern, stated, edit = LAYOUTS[layout].columns[kind]
    times, over = NANOSECONDS[stated], NANOSECONDS[unit]

    def converted(numbers):
        if isinstance(numbers, np.ndarray) and numbers.dtype.kind != "f":
            return numbers * (times // over) if times > over else numbers // (over // times)
        return numbers * times / over

    files = list(folder.glob(pattern))
    assert files
    for file in files:
        edit(file, converted)


def said_of(folder: Path, tmp_path: Path) -> str:
    """What the readers, the index, the conversion or the search for problems say."""
    sentences = []
    try:
        recording = _read_folder.__wrapped__(folder, "auto")
        index_events.__wrapped__(recording)
        sentences = [problem.what for problem in find_problems(recording)]
        convert_recording(folder, tmp_path / "converted")
    except RecordingError as error:
        return str(error)
    return " ".join(sentences)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_whole_recording_is_not_suspected(layout: str, whole, tmp_path: Path):
    said = said_of(whole(layout), tmp_path)
    assert (tmp_path / "converted").is_dir() and "look like" not in said and "seem" not in said


@pytest.mark.parametrize(("layout", "kinds", "unit"), CASES)
def test_another_unit_is_named(layout: str, kinds: tuple[str, ...], unit: str, whole, tmp_path: Path):
    folder = shutil.copytree(whole(layout), tmp_path / "recording")
    for kind in kinds:
        put_into(folder, layout, kind, unit)
    said = said_of(folder, tmp_path)
    assert f"look like {NAMES[unit]}" in said, said
    assert str(folder) in said or len(kinds) > 1


@pytest.mark.parametrize(("seconds", "is_right"), [(1.2, True), (0.6, True), (0.0012, False)])
def test_a_clip_within_a_long_log_of_poses_is_no_wrong_unit(tmp_path: Path, seconds: float, is_right: bool):
    """Of a log of eight minutes. A clip of a millisecond is 1.2 s in another unit."""
    poses = Times.of_rows("poses", tmp_path, "s", np.arange(48_000) * 10**7)
    events = Times.of_events(tmp_path, "us", 200_000, round(seconds * 1e9), 640 * 480)
    with nullcontext() if is_right else pytest.raises(RecordingError, match="does not fit together"):
        check_units(tmp_path, [events, poses])

"""Files of a recording that would be passed over, or read as what they are not, are named."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from recordings import write_esim
from test_writer import LAYOUTS, open_writer, random_events, setup_of, write

from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.inspection.problems import find_problems
from enerf_ns.dataparsers.recording import files
from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.recording import Frames

FOLDERS = [
    *(("esim", name) for name in ("images", "images_corrupted", "depth")),
    *(("event_recording", name) for name in ("frames", "blurred_frames", "depth")),
    ("eds", "images"),
    ("tum_vie", "simulated-vi_gt_data/left_images"),
]


@pytest.mark.parametrize(("layout", "name"), FOLDERS)
def test_a_file_in_the_place_of_a_folder_is_named(tmp_path: Path, layout: str, name: str):
    setup = setup_of(layout)
    write(layout, tmp_path / "recording", setup, random_events(setup.event_camera, 300))
    shutil.rmtree(tmp_path / "recording" / name)
    (tmp_path / "recording" / name).write_text("")
    with pytest.raises(RecordingError, match=rf"{name} is no folder, but a folder of .* was expected there") as error:
        read_recording(tmp_path / "recording")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(("missing", "words"), [((5,), "00004.npy and then 00006.npy"), ((3, 7, 8), "3 are missing")])
def test_a_missing_file_of_events_is_named(tmp_path: Path, missing: tuple[int, ...], words: str):
    setup = setup_of("esim")
    write("esim", tmp_path / "esim", setup, random_events(setup.event_camera, 300))
    for number in missing:
        (tmp_path / f"esim/events/{number:05d}.npy").unlink()
    with pytest.raises(RecordingError, match=words):
        read_recording(tmp_path / "esim")


@pytest.mark.parametrize("names", [("00000", "00010"), ("7", "8"), ("110000000", "400000000"), ("a", "c")])
def test_names_that_do_not_count_on_by_one_are_as_good(tmp_path: Path, names: tuple[str, str]):
    folder = write_esim(tmp_path / "esim")
    for old, new in zip(("00000", "00001"), names, strict=True):
        (folder / f"events/{old}.npy").rename(folder / f"events/{new}_.npy")
    for name in names:
        (folder / f"events/{name}_.npy").rename(folder / f"events/{name}.npy")
    assert read_recording(folder).num_events == 6


@pytest.mark.parametrize("stored", [np.float32, np.float64, np.int64])
def test_times_that_went_through_float32_are_said(tmp_path: Path, stored: type):
    """In whatever type they are stored then."""
    setup = setup_of("esim")
    write("esim", tmp_path / "esim", setup, random_events(setup.event_camera, 3000))
    for file in (tmp_path / "esim/events").iterdir():
        np.save(file, np.load(file).astype(np.float32).astype(stored))
    (found,) = (problem for problem in find_problems(read_recording(tmp_path / "esim")) if "float32" in problem.what)
    assert "resolve 32 ns at 0.333 s" in found.what and "int64" in found.advice


@pytest.mark.parametrize("unit", [1, 1000, 10_000, 1_000_000])
@pytest.mark.parametrize("stored", [np.float64, np.int64])
def test_times_in_whole_units_are_not_taken_for_float32(tmp_path: Path, unit: int, stored: type):
    """Whole milliseconds fit into float32 up to a second."""
    setup = setup_of("esim")
    events = random_events(setup.event_camera, 3000)
    events.t[:] = events.t // unit * unit
    write("esim", tmp_path / "esim", setup, events)
    for file in (tmp_path / "esim/events").iterdir():
        np.save(file, np.load(file).astype(stored))
    assert not [problem for problem in find_problems(read_recording(tmp_path / "esim")) if "float32" in problem.what]


@pytest.mark.parametrize(("layout", "names"), [("eds", "xy"), ("tum_vie", "x"), ("tum_vie", "y")])
def test_coordinates_that_were_cut_to_8_bits_are_said(tmp_path: Path, layout: str, names: str):
    setup = setup_of(layout)
    events = random_events(setup.event_camera, 40_000)
    for name in names:
        getattr(events, name)[:] = getattr(events, name).astype(np.uint8)
    write(layout, tmp_path / "cut", setup, events)
    found = [problem for problem in find_problems(read_recording(tmp_path / "cut")) if "8 bits" in problem.what]
    assert [problem.what.split()[3] for problem in found] == list(names)
    side = {"x": setup.event_camera.width, "y": setup.event_camera.height}
    assert all(f"has {side[name]} pixels" in problem.what for name, problem in zip(names, found, strict=True))


@pytest.mark.parametrize("border", [200, 300, 640])
def test_a_scene_that_ends_before_the_border_is_no_cut(tmp_path: Path, border: int):
    setup = setup_of("eds")
    events = random_events(setup.event_camera, 40_000)
    events.x[:] = events.x % border
    with open_writer("eds", tmp_path, setup) as writer:
        writer.add_events(events)
    assert not [problem for problem in find_problems(read_recording(tmp_path)) if "8 bits" in problem.what]


@pytest.mark.parametrize("layout", LAYOUTS)
def test_companions_of_macos_are_no_files_of_the_recording(tmp_path: Path, layout: str):
    """macOS writes ._NAME beside each file, on disks of other systems and into archives."""
    setup = setup_of(layout)
    for folder in (tmp_path / "plain", tmp_path / "accompanied"):
        write(layout, folder, setup, random_events(setup.event_camera, 300))
    for file in [path for path in (tmp_path / "accompanied").rglob("*") if path.is_file()]:
        (file.parent / f"._{file.name}").write_bytes(b"\0\5\26\7\0\2\0\0Mac OS X        " + bytes(60))
    plain, accompanied = read_recording(tmp_path / "plain"), read_recording(tmp_path / "accompanied")
    assert accompanied.notes == plain.notes
    for kind in ("frames", "blurred_frames"):
        assert (getattr(plain, kind) is None) == (getattr(accompanied, kind) is None)
        if getattr(plain, kind):
            assert names_of(getattr(plain, kind)) == names_of(getattr(accompanied, kind))


@pytest.mark.parametrize("layout", LAYOUTS)
def test_numbers_without_leading_zeros_are_in_order(tmp_path: Path, layout: str):
    setup = setup_of(layout)
    for folder in (tmp_path / "padded", tmp_path / "counted"):
        write(layout, folder, setup, random_events(setup.event_camera, 300))
    renamed = [path for path in (tmp_path / "counted").rglob("*") if re.search("00[0-9]+$", path.stem)]
    for file in renamed:
        file.rename(file.with_stem(re.sub("0+([0-9]+)$", r"\1", file.stem)))
    assert len(renamed) >= len(setup.frame_times)
    padded, counted = read_recording(tmp_path / "padded"), read_recording(tmp_path / "counted")
    frames, of_counted = (one.frames or one.blurred_frames for one in (padded, counted))
    assert frames is not None and of_counted is not None
    assert [number_of(file) for file in of_counted.filenames] == [number_of(file) for file in frames.filenames]
    for depth in (frames.depth_filenames, of_counted.depth_filenames):
        assert [number_of(file) for file in depth or ()] == [number_of(file) for file in frames.filenames if depth]
    for column in "xytp":
        one, other = (
            np.concatenate([getattr(events, column) for events in recording.stream_events()])
            for recording in (padded, counted)
        )
        np.testing.assert_array_equal(one, other)


def number_of(file: Path) -> int:
    return int(re.findall("[0-9]+", file.stem)[-1])


def names_of(frames: Frames) -> list[str]:
    return [file.stem for file in frames.filenames]


def test_all_readers_look_for_files_in_one_way():
    """`files_in` leaves hidden files out, and counts in the names."""
    readers = (Path(files.__file__).parents[1] / "formats").glob("*.py")
    assert [file.name for file in readers if re.search(r"\.(r?glob|scandir|listdir)\(", file.read_text())] == []

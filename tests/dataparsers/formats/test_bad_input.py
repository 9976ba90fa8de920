"""Every bad input gives one sentence that names the file, what was found and what was expected, and changes nothing."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from recordings import HEIGHT, WIDTH, write_davis, write_esim, write_image

from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.files import load_image
from enerf_ns.dataparsers.recording.hdf5_files import load_depth_map, load_picture


@dataclass
class BadInput:
    """A fault to put into a fine recording, and what the message must contain."""

    name: str
    break_it: Callable[[Path], object]
    message: tuple[str, ...]


def edit_line(name: str, number: int, line: str | Callable[[str], str]) -> Callable[[Path], None]:
    """Replaces a line, counted from 1, of a text file."""

    def edit(folder: Path) -> None:
        lines = (folder / name).read_text().splitlines()
        lines[number - 1] = line if isinstance(line, str) else line(lines[number - 1])
        (folder / name).write_text("\n".join(lines) + "\n")

    return edit


def edit_array(name: str, index: tuple, value: float | list) -> Callable[[Path], None]:
    """Sets elements of a .npy file."""

    def edit(folder: Path) -> None:
        array = np.load(folder / name)
        array[index] = value
        np.save(folder / name, array)

    return edit


def save(name: str, array: np.ndarray) -> Callable[[Path], None]:
    return lambda folder: np.save(folder / name, array)


def write(name: str, content: bytes | str) -> Callable[[Path], object]:
    return lambda folder: (folder / name).write_bytes(content.encode() if isinstance(content, str) else content)


def remove(name: str) -> Callable[[Path], None]:
    return lambda folder: shutil.rmtree(folder / name) if (folder / name).is_dir() else (folder / name).unlink()


def truncate(name: str) -> Callable[[Path], object]:
    return lambda folder: (folder / name).write_bytes((folder / name).read_bytes()[:-60])


def resize(name: str) -> Callable[[Path], None]:
    return lambda folder: write_image(folder / name, np.zeros((HEIGHT + 2, WIDTH, 1), np.uint8))


def cell(column: int, value: str) -> Callable[[str], str]:
    """Replaces a cell of a line."""
    return lambda line: " ".join(value if i == column else text for i, text in enumerate(line.split()))


def times_cells(columns: slice, factor: float) -> Callable[[str], str]:
    def scale(line: str) -> str:
        cells = line.split()
        cells[columns] = [repr(float(text) * factor) for text in cells[columns]]
        return " ".join(cells)

    return scale


def spread_out(folder: Path) -> None:
    rows = [f"0.{i}00000000 {i} {i} 1" for i in range(1, 9)]
    (folder / "events.txt").write_text("\n".join(rows))


DAVIS = [
    BadInput("events missing", remove("events.txt"), ("events.txt is missing", "t_s x y p")),
    BadInput("poses missing", remove("groundtruth.txt"), ("groundtruth.txt is missing", "t_s px py pz qx qy qz qw")),
    BadInput("calibration missing", remove("calib.txt"), ("calib.txt is missing", "fx fy cx cy k1 k2 p1 p2 k3")),
    BadInput("events empty", write("events.txt", ""), ("events.txt is empty", "t_s x y p")),
    BadInput("poses empty", write("groundtruth.txt", "\n"), ("groundtruth.txt is empty", "qx qy qz qw")),
    BadInput("calibration empty", write("calib.txt", ""), ("calib.txt is empty", "fx fy")),
    BadInput("list of frames empty", write("images.txt", ""), ("images.txt is empty", "t_s path")),
    BadInput(
        "poses not text",
        write("groundtruth.txt", b"\xff\xfe\x00"),
        ("groundtruth.txt", "cannot be read as a text file"),
    ),
    BadInput(
        "event column missing", edit_line("events.txt", 3, "0.25 3 4"), ("events.txt, line 3 has 3 columns", "but 4")
    ),
    BadInput(
        "first event column missing", edit_line("events.txt", 1, "1 2"), ("events.txt, line 1 has 2 columns", "but 4")
    ),
    BadInput(
        "event column too many", edit_line("events.txt", 3, "0.25 3 4 1 1"), ("events.txt, line 3 has 5 columns",)
    ),
    BadInput("empty line among events", edit_line("events.txt", 3, ""), ("events.txt, line 3 has 0 columns", "but 4")),
    BadInput(
        "event not a number", edit_line("events.txt", 4, cell(1, "3x")), ("events.txt, line 4 holds '3x'", "whole")
    ),
    BadInput("event with part of a pixel", edit_line("events.txt", 4, cell(2, "3.5")), ("line 4 holds '3.5'", "whole")),
    BadInput(
        "event time not a number", edit_line("events.txt", 2, cell(0, "soon")), ("line 2 holds 'soon'", "seconds")
    ),
    BadInput(
        "event time NaN", edit_line("events.txt", 2, cell(0, "nan")), ("events.txt, line 2 holds 'nan'", "seconds")
    ),
    BadInput(
        "event time huge", edit_line("events.txt", 2, cell(0, "1e30")), ("events.txt, line 2 holds '1e30'", "seconds")
    ),
    BadInput(
        "events not text", write("events.txt", b"\x89HDF\r\n\x1a\n"), ("events.txt, line 1 has 1 columns", "but 4")
    ),
    BadInput(
        "event time backwards",
        edit_line("events.txt", 3, cell(0, "0.15")),
        ("events.txt, line 3 goes back in time from 0.200000 s to 0.150000 s", "in time order"),
    ),
    BadInput(
        "x outside",
        edit_line("events.txt", 2, cell(1, "24")),
        ("events.txt, line 2 holds x = 24", "24 x 18 pixels", "0 to 23"),
    ),
    BadInput(
        "x negative",
        edit_line("events.txt", 2, cell(1, "-1")),
        ("events.txt, line 2 holds x = -1", "24 x 18 pixels", "0 to 23"),
    ),
    BadInput(
        "y outside",
        edit_line("events.txt", 6, cell(2, "18")),
        ("events.txt, line 6 holds y = 18", "24 x 18 pixels", "0 to 17"),
    ),
    BadInput("polarity 2", edit_line("events.txt", 5, cell(3, "2")), ("events.txt, line 5 holds polarity 2", "0 or 1")),
    BadInput("polarities 0 and -1", edit_line("events.txt", 1, cell(3, "-1")), ("line 2 holds polarity 0", "-1 or 1")),
    BadInput("never two events at a pixel", spread_out, ("8 events", "never two at one pixel", "at least two")),
    BadInput(
        "poses of another clock",
        write("groundtruth.txt", "1500.0 0 0 0 0 0 0 1\n1501.0 1 0 0 0 0 0 1\n"),
        ("do not cover the events", "from 0.000000 s to 0.790000 s", "from 1499.890000 s to 1500.890000 s"),
    ),
    BadInput("one pose", write("groundtruth.txt", "0 0 0 0 0 0 0 1\n"), ("groundtruth.txt holds 1 pose", "at least 2")),
    BadInput(
        "pose column missing", edit_line("groundtruth.txt", 4, "0.3 0 0 0 0 0 1"), ("line 4 has 7 columns", "but 8")
    ),
    BadInput(
        "pose not a number", edit_line("groundtruth.txt", 4, cell(2, "up")), ("line 4 holds 'up'", "finite number")
    ),
    BadInput(
        "pose time not a number", edit_line("groundtruth.txt", 4, cell(0, "t")), ("line 4 holds 't'", "finite number")
    ),
    BadInput(
        "pose time backwards",
        edit_line("groundtruth.txt", 4, cell(0, "0.1")),
        ("line 4 has the time 0.1 s", "increase"),
    ),
    BadInput(
        "pose time twice", edit_line("groundtruth.txt", 4, cell(0, "0.2")), ("line 4 has the time 0.2 s", "increase")
    ),
    BadInput(
        "quaternion NaN", edit_line("groundtruth.txt", 5, cell(6, "nan")), ("line 5 holds 'nan'", "finite number")
    ),
    BadInput(
        "quaternion not unit",
        edit_line("groundtruth.txt", 5, times_cells(slice(4, 8), 1.01)),
        ("groundtruth.txt, line 5, holds a quaternion of norm 1.01", "unit quaternions"),
    ),
    BadInput(
        "quaternion zero",
        edit_line("groundtruth.txt", 5, times_cells(slice(4, 8), 0.0)),
        ("groundtruth.txt, line 5, holds a quaternion of norm 0", "unit quaternions"),
    ),
    BadInput("calibration short", write("calib.txt", "330 340 11 8"), ("calib.txt, line 1 has 4 columns", "but 9")),
    BadInput(
        "calibration not numbers", write("calib.txt", "1 2 3 4 5 6 7 8 k"), ("calib.txt, line 1 holds 'k'", "number")
    ),
    BadInput("focal length negative", write("calib.txt", "-330 340 11 8 0 0 0 0 0"), ("calib.txt", "-330", "above 0")),
    BadInput(
        "no such lens", write("calib.txt", "10 10 12 9 -0.9 0 0 0 0"), ("calib.txt", "fits no lens", "no inverse")
    ),
    BadInput(
        "listed frame missing",
        remove("images/frame_00000001.png"),
        ("images.txt, line 2 lists", "frame_00000001.png", "missing"),
    ),
    BadInput("list of frames short", edit_line("images.txt", 2, "0.45"), ("images.txt, line 2 has 1 columns", "but 2")),
    BadInput(
        "frame times backwards", edit_line("images.txt", 2, cell(0, "0.1")), ("images.txt, line 2", "0.1 s", "increase")
    ),
    BadInput(
        "frame of another size", resize("images/frame_00000001.png"), ("frame_00000001.png has 24 x 20", "24 x 18")
    ),
    BadInput(
        "frame no image",
        write("images/frame_00000001.png", "hello"),
        ("frame_00000001.png cannot be read as an image",),
    ),
    BadInput("frame empty", write("images/frame_00000000.png", ""), ("frame_00000000.png is empty", "an image")),
    BadInput(
        "frame truncated", truncate("images/frame_00000002.png"), ("frame_00000002.png cannot be read as an image",)
    ),
]

ESIM = [
    BadInput("no event files", remove("events"), ("events holds no .npy files", "x y t_ns p")),
    BadInput("poses missing", remove("0_poses_all.txt"), ("*poses_all*.txt", "qx qy qz qw")),
    BadInput("poses_bounds missing", remove("poses_bounds.npy"), ("poses_bounds.npy is missing",)),
    BadInput("poses empty", write("0_poses_all.txt", "# t px\n"), ("0_poses_all.txt is empty", "qx qy qz qw")),
    BadInput("poses_bounds empty", write("poses_bounds.npy", ""), ("poses_bounds.npy is empty", ".npy")),
    BadInput("event file empty", write("events/00001.npy", ""), ("00001.npy is empty", ".npy")),
    BadInput("event file truncated", truncate("events/00001.npy"), ("00001.npy cannot be read as a NumPy array",)),
    BadInput("event file no array", write("events/00001.npy", "hello"), ("00001.npy cannot be read as a NumPy array",)),
    BadInput("event file of text", save("events/00001.npy", np.array(["a"])), ("00001.npy holds no array of numbers",)),
    BadInput("event file of one dimension", save("events/00001.npy", np.zeros(4)), ("00001.npy", "(4,)", "(n, 4)")),
    BadInput("event column missing", save("events/00001.npy", np.zeros((2, 3))), ("00001.npy", "(2, 3)", "(n, 4)")),
    BadInput(
        "event NaN", edit_array("events/00001.npy", (1, 0), np.nan), ("00001.npy, event 2 holds x = nan", "whole")
    ),
    BadInput(
        "event time NaN", edit_array("events/00001.npy", (1, 2), np.nan), ("00001.npy, event 2 holds t = nan", "ns")
    ),
    BadInput(
        "event with part of a pixel", edit_array("events/00000.npy", (2, 1), 4.5), ("event 3 holds y = 4.5", "whole")
    ),
    BadInput(
        "polarity 0.5", edit_array("events/00000.npy", (0, 3), 0.5), ("00000.npy, event 1 holds p = 0.5", "whole")
    ),
    BadInput(
        "polarity 3", edit_array("events/00001.npy", (0, 3), 3), ("00001.npy, event 1 holds polarity 3", "0 or 1")
    ),
    BadInput(
        "polarities 0 and -1", edit_array("events/00001.npy", (1, 3), 0), ("00001.npy, event 2 holds polarity 0",)
    ),
    BadInput(
        "x outside", edit_array("events/00001.npy", (1, 0), WIDTH), ("00001.npy, event 2 holds x = 24", "24 x 18")
    ),
    BadInput(
        "x far outside", edit_array("events/00001.npy", (1, 0), 2**16 + 1), ("event 2 holds x = 65537", "24 x 18")
    ),
    BadInput("y negative", edit_array("events/00001.npy", (1, 1), -1), ("00001.npy, event 2 holds y = -1", "24 x 18")),
    BadInput(
        "event time backwards between files",
        edit_array("events/00001.npy", (0, 2), 100_000_000),
        ("00001.npy, event 1 goes back in time from 0.250000 s to 0.100000 s",),
    ),
    BadInput(
        "no events",
        lambda folder: [np.save(f, np.zeros((0, 4))) for f in folder.glob("events/*")],
        ("holds no events",),
    ),
    BadInput(
        "poses of another clock",
        write("0_poses_all.txt", "t\n5000000000 0 0 0 0 0 0 1\n6000000000 0 0 0 0 0 0 1\n"),
        ("do not cover the events", "from 0.110000 s to 0.900000 s", "from 5.000000 s to 6.000000 s"),
    ),
    BadInput(
        "pose column missing", edit_line("0_poses_all.txt", 3, "1 2 3"), ("0_poses_all.txt, line 3 has 3", "but 8")
    ),
    BadInput(
        "pose time backwards", edit_line("0_poses_all.txt", 4, cell(0, "7")), ("line 4 has the time 7 ns", "increase")
    ),
    BadInput(
        "quaternion NaN", edit_line("0_poses_all.txt", 4, cell(4, "nan")), ("line 4 holds 'nan'", "finite number")
    ),
    BadInput(
        "quaternion not unit", edit_line("0_poses_all.txt", 4, cell(4, "1")), ("line 4, holds a quaternion", "unit")
    ),
    BadInput(
        "poses_bounds of LLFF without bounds", save("poses_bounds.npy", np.zeros((9, 15))), ("(9, 15)", "(N, 17)")
    ),
    BadInput(
        "sensor without size", edit_array("poses_bounds.npy", (0, 4), 0), ("poses_bounds.npy", "24 x 0 pixels", "whole")
    ),
    BadInput(
        "focal length NaN", edit_array("poses_bounds.npy", (0, 14), np.nan), ("poses_bounds.npy", "nan", "above 0")
    ),
    BadInput("frame too few", remove("images/00001.png"), ("images holds 2 images", "holds 3 stamps")),
    BadInput(
        "frames all gone", lambda folder: [f.unlink() for f in folder.glob("images/*.png")], ("images holds 0 images",)
    ),
    BadInput(
        "blurred frame too few", remove("images_corrupted/00001.png"), ("images_corrupted holds 2 images", "3 stamps")
    ),
    BadInput("stamps missing", remove("images/image_stamps_ns.txt"), ("image_stamps_ns.txt is missing", "t_ns")),
    BadInput("stamps empty", write("images/image_stamps_ns.txt", ""), ("image_stamps_ns.txt is empty", "t_ns")),
    BadInput(
        "stamp not a number", edit_line("images/image_stamps_ns.txt", 2, "x"), ("stamps_ns.txt, line 2 holds 'x'",)
    ),
    BadInput(
        "stamps backwards", edit_line("images/image_stamps_ns.txt", 2, "1"), ("image_stamps_ns.txt, line 2", "increase")
    ),
    BadInput("frame of another size", resize("images/00002.png"), ("00002.png has 24 x 20 pixels", "24 x 18")),
    BadInput("frame truncated", truncate("images_corrupted/00001.png"), ("00001.png cannot be read as an image",)),
    BadInput("depth too few", remove("depth/00001.npy"), ("depth holds 2 depth maps", "3 images")),
    BadInput("depth of another size", save("depth/00001.npy", np.zeros((3, 4))), ("00001.npy", "(3, 4)", "(18, 24)")),
    BadInput("depth truncated", truncate("depth/00001.npy"), ("00001.npy cannot be read as a NumPy array",)),
    BadInput("simulation.json broken", write("simulation.json", "{"), ("simulation.json cannot be read as JSON",)),
    BadInput("simulation.json a list", write("simulation.json", "[]"), ("simulation.json holds a list", "JSON object")),
    BadInput(
        "threshold zero",
        write("simulation.json", json.dumps({"contrast_thresholds": [0.2, 0]})),
        ("simulation.json holds the contrast thresholds 0.2", "and 0 (", "from 0.001 to 10"),
    ),
    BadInput(
        "exposure longer than from frame to frame",
        write("simulation.json", json.dumps({"exposure_ns": 10**30})),
        ("simulation.json holds exposures of 1e+09 ms of frames that are 300 ms apart",),
    ),
    BadInput(
        "exposure no whole number",
        write("simulation.json", json.dumps({"exposure_ns": 2.5})),
        ("simulation.json holds exposure_ns = 2.5, but a whole number of nanoseconds was expected",),
    ),
    BadInput(
        "response unknown",
        write("simulation.json", json.dumps({"response": "log"})),
        ("simulation.json holds the response 'log', but linlog, or",),
    ),
    BadInput(
        "camera without focal length",
        write("simulation.json", json.dumps({"camera": {"width": 24, "height": 18}})),
        ("simulation.json lacks camera.fx",),
    ),
]


def contents(folder: Path) -> dict[str, tuple[str, int]]:
    """Hash and time of change of every file."""
    return {
        str(path.relative_to(folder)): (hashlib.sha256(path.read_bytes()).hexdigest(), path.stat().st_mtime_ns)
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def read_all(folder: Path, format: str) -> None:
    """Reads everything that a recording refers to."""
    recording = read_recording(folder, format)
    len(index_events(recording).events())
    for frames in (recording.frames, recording.blurred_frames):
        for file in frames.filenames if frames else ():
            load_picture(file)
        for file in frames.depth_filenames or () if frames else ():
            load_depth_map(file)


def is_one_sentence(message: str) -> bool:
    return message.endswith(".") and "\n" not in message and not re.search(r"[a-z\d)]\. [A-Z]", message)


@pytest.fixture
def davis(tmp_path: Path) -> Path:
    return write_davis(tmp_path / "recording")


@pytest.fixture
def esim(tmp_path: Path) -> Path:
    return write_esim(tmp_path / "recording", frames=("images", "images_corrupted"), depth=True)


@pytest.mark.parametrize("format", ["davis", "esim"])
def test_without_a_fault_everything_is_read_and_nothing_is_written(format: str, request: pytest.FixtureRequest):
    folder = request.getfixturevalue(format)
    before = contents(folder)
    read_all(folder, "auto")
    assert contents(folder) == before


@pytest.mark.parametrize(
    ("format", "bad"),
    [pytest.param("davis", bad, id=f"davis: {bad.name}") for bad in DAVIS]
    + [pytest.param("esim", bad, id=f"esim: {bad.name}") for bad in ESIM],
)
def test_bad_input_gives_one_clear_sentence_and_changes_nothing(
    format: str, bad: BadInput, request: pytest.FixtureRequest
):
    folder = request.getfixturevalue(format)
    bad.break_it(folder)
    before = contents(folder)
    with pytest.raises(RecordingError) as error:
        read_all(folder, "auto")
    message = str(error.value)
    for part in (str(folder), *bad.message):
        assert part in message
    assert is_one_sentence(message), message
    assert contents(folder) == before


def test_a_folder_of_no_known_format(tmp_path: Path):
    (tmp_path / "transforms.json").touch()
    (tmp_path / "pictures").mkdir()
    with pytest.raises(RecordingError) as error:
        read_recording(tmp_path)
    message = str(error.value)
    for part in (str(tmp_path), "events.txt", "groundtruth.txt", "calib.txt", "events/*.npy", "*poses_all*.txt"):
        assert part in message
    assert "holds pictures/, transforms.json." in message
    assert is_one_sentence(message)


def test_an_empty_folder(tmp_path: Path):
    with pytest.raises(RecordingError, match=r"no known format.* holds nothing\."):
        read_recording(tmp_path)


def test_a_folder_of_two_formats_is_read_as_the_one_that_is_asked_for(tmp_path: Path):
    folder = write_esim(tmp_path / "both", frames=())
    shutil.copytree(write_davis(tmp_path / "davis", frames=False), folder, dirs_exist_ok=True)
    with pytest.raises(RecordingError, match="exactly one format's files"):
        read_recording(folder)
    assert read_recording(folder, "esim").format == "esim"
    assert read_recording(folder, "davis").format == "davis"


def test_no_folder(tmp_path: Path):
    with pytest.raises(RecordingError, match=r"nowhere does not exist; give the folder of a recording\.$"):
        read_recording(tmp_path / "nowhere")


def test_a_file_instead_of_a_folder(tmp_path: Path):
    (tmp_path / "events.txt").touch()
    with pytest.raises(RecordingError, match=r"events\.txt is a file, but a recording is a folder"):
        read_recording(tmp_path / "events.txt")


def test_an_image_that_does_not_exist(tmp_path: Path):
    with pytest.raises(RecordingError, match=r"no\.png is missing; an image was expected there\.$"):
        load_image(tmp_path / "no.png")

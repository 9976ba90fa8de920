"""`enerf convert`, called as a person calls it and, where a disk fills up, in this process."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from aedat4_files import aedat4, events_packet, frame_packet
from recordings import EVENTS, HEIGHT, POSE_TIMES, WIDTH, poses, write_davis, write_esim
from scipy.spatial.transform import Rotation
from test_event_files import BAD, FORMATS, events
from test_event_recording import CAMERA, all_events, copied, same_recording, write_recording

from enerf_ns.dataparsers.formats import event_recording
from enerf_ns.dataparsers.formats.pose_files import PoseFlags
from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.recording.errors import OutputError, RecordingError, UserError
from enerf_ns.dataparsers.recording.recording import Events
from enerf_ns.scripts.convert import Convert
from enerf_ns.scripts.format_options import format_flags
from enerf_ns.scripts.reconstruct import Reconstruct

FILE_CAMERA = {**CAMERA, "width": 640, "height": 480}


def digests(folder: Path) -> dict[str, str]:
    files = sorted(file for file in folder.rglob("*") if file.is_file())
    return {str(file.relative_to(folder)): hashlib.sha256(file.read_bytes()).hexdigest() for file in files}


def refused(tmp_path: Path, convert: Convert) -> str:
    """The sentence with which it ends, with nothing changed and nothing left over."""
    before = digests(tmp_path), sorted(tmp_path.iterdir())
    with pytest.raises(UserError) as caught:
        convert.main()
    assert (digests(tmp_path), sorted(tmp_path.iterdir())) == before
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.fixture
def evt2_file(tmp_path: Path) -> Path:
    path = tmp_path / "events.raw"
    path.write_bytes(FORMATS["EVT2"][1](events()))
    return path


@pytest.mark.parametrize("exists", ["", "empty", "link"])
def test_a_folder_of_another_format(tmp_path: Path, exists: str, capsys: pytest.CaptureFixture[str]):
    source = write_esim(tmp_path / "esim", frames=("images", "images_corrupted"))
    before = digests(source)
    if exists == "empty":
        (tmp_path / "new").mkdir()
    elif exists == "link":
        (tmp_path / "place").mkdir()
        (tmp_path / "new").symlink_to("place")
    Convert(source, tmp_path / "new").main()
    assert digests(source) == before
    same_recording(read_recording(tmp_path / "new"), read_recording(source))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["esim", "new", *["place"] * (exists == "link")]
    printed = capsys.readouterr().out
    assert (
        "6 events, 11 poses and 6 frames are written." in printed
        and f"The recording is in {tmp_path}/{'place' if exists == 'link' else 'new'}" in printed
    )


def test_what_is_left_out_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    source = write_davis(tmp_path / "davis")
    lines = (source / "groundtruth.txt").read_text().splitlines(keepends=True)
    (source / "groundtruth.txt").write_text("".join(lines[:6]))
    Convert(source, tmp_path / "deep" / "new").main()
    printed = capsys.readouterr().out
    assert "1 of 3 frames (33 %) lie outside the poses and are left out." in printed
    assert "\n\n" not in f"\n{printed}"  # a bar of progress would leave an empty line
    np.testing.assert_array_equal(all_events(read_recording(tmp_path / "deep/new")), all_events(read_recording(source)))


def test_held_out_views_are_told_to_be_left_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    from test_esim_npz import write_npz, write_views

    source = write_npz(tmp_path / "npz")
    write_views(source / "views")
    recording = read_recording(source)
    assert recording.held_out_frames is not None
    Convert(source, tmp_path / "new").main()
    assert f"{len(recording.held_out_frames.times)} held-out views are left out" in capsys.readouterr().out
    same_recording(read_recording(tmp_path / "new"), recording)


def test_converting_again_changes_nothing(tmp_path: Path):
    source = write_recording(tmp_path / "own", ("frames",), depth=True, bayer_pattern="RGGB")
    Convert(source, tmp_path / "once").main()
    Convert(tmp_path / "once", tmp_path / "twice").main()
    assert digests(tmp_path / "once") == digests(tmp_path / "twice")


@pytest.mark.slow
def test_slider_depth(tmp_path: Path, shared_data: Path):
    recording = read_recording(shared_data / "slider_depth")
    same_recording(copied(recording, tmp_path / "new"), recording)


@pytest.mark.parametrize("name", ["EVT2", "EVT2.1", "EVT3", "DAT", "AEDAT4"])
def test_event_files(tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]):
    if name in ("EVT3", "AEDAT4"):
        pytest.importorskip({"EVT3": "evt3", "AEDAT4": "aedat"}[name])
    rows = events()
    (tmp_path / "file").write_bytes(FORMATS[name][1](rows))
    Convert(tmp_path / "file", tmp_path / "new").main()
    columns = [np.load(tmp_path / f"new/events/{column}.npy") for column in "txyp"]
    np.testing.assert_array_equal(np.column_stack(columns), (rows - [rows[0, 0], 0, 0, 0]) * [1000, 1, 1, 1])
    assert json.loads((tmp_path / "new/recording.json").read_text()) == {"camera": {"width": 640, "height": 480}}
    printed = " ".join(capsys.readouterr().out.split())
    assert f"{len(rows):,} events" in printed and f"({name})" in printed
    assert f"is {rows[0, 0] * 1000} ns on the clock of the file" in printed
    assert (
        "Before training, add poses.txt and model, fx, fy, cx, cy and distortion of the camera in recording" in printed
    )
    with pytest.raises(RecordingError, match=r"recording\.json lacks model, fx, fy, cx and cy in camera"):
        read_recording(tmp_path / "new", "event_recording")


def write_aedat4(path: Path, frames: list[bytes], streams: tuple[str, ...] = ("EVTS", "FRME")) -> np.ndarray:
    """Writes a file of 24 x 18 pixels, and returns its events (t in microseconds, x, y, p)."""
    rng = np.random.default_rng(0)
    columns = np.sort(rng.integers(0, 10**6, 900)) + 5_000_000, rng.integers(24, size=900), rng.integers(18, size=900)
    rows = np.column_stack([*columns, rng.integers(2, size=900)])
    packets = [(0, events_packet(rows)), *((1, frame) for frame in frames)]
    path.write_bytes(aedat4((24, 18), streams, packets))
    return rows


@pytest.mark.parametrize(
    ("kind", "channels"), [(np.uint8, 1), (np.uint16, 1), (np.uint8, 3), (np.uint16, 3), (np.uint8, 4)]
)
def test_frames_of_an_event_file(tmp_path: Path, kind: type, channels: int, capsys: pytest.CaptureFixture[str]):
    """They lie beside the events, on their clock, and the new folder is read with them."""
    pytest.importorskip("aedat")
    shape = (7, 18, 24) if channels == 1 else (7, 18, 24, channels)
    pictures = np.random.default_rng(1).integers(0, np.iinfo(kind).max, shape, kind, endpoint=True)
    begins = [5_000_000 + 150_000 * number for number in range(len(pictures))]
    frames = [frame_packet(begin, begin + 30_000, pixels) for begin, pixels in zip(begins, pictures, strict=True)]
    frames.insert(3, frame_packet(begins[2] + 5000, begins[2] + 6000, pictures[0][:9]))  # of a part of the sensor
    rows = write_aedat4(tmp_path / "a.aedat4", frames)
    (tmp_path / "camera.json").write_text(
        json.dumps({"width": 24, "height": 18, "model": "pinhole", "fx": 25.0, "fy": 25.0, "cx": 11.5, "cy": 8.5})
    )
    times = np.linspace(4.9, 6.1, 200)
    (tmp_path / "poses.txt").write_text("".join(f"{t} {0.1 * t} 0 0 0 0 0 1\n" for t in times))
    Convert(
        tmp_path / "a.aedat4", tmp_path / "new", poses=tmp_path / "poses.txt", camera=tmp_path / "camera.json"
    ).main()
    printed = " ".join(capsys.readouterr().out.split())
    assert (
        "7 frames are written" in printed
        and "1 of 8 frames are left out, since they are not of the sensor's 24 x 18 pixels" in printed
    )
    recording = read_recording(tmp_path / "new")
    assert recording.frames is not None and recording.frames.exposures is not None
    np.testing.assert_array_equal(recording.frames.times, 1000 * (np.array(begins) + 15_000 - rows[0, 0]))
    assert (recording.frames.exposures == 30_000_000).all()
    for file, pixels in zip(recording.frames.filenames, pictures, strict=True):
        found = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(
            found if channels == 1 else found[..., ::-1], pixels[..., :3] if channels > 1 else pixels
        )


def test_frames_of_an_event_file_give_times_to_poses_of_their_pictures(tmp_path: Path):
    """COLMAP knows the names of the pictures that an earlier conversion wrote."""
    pytest.importorskip("aedat")
    pictures = np.random.default_rng(1).integers(0, 255, (30, 18, 24), np.uint8)
    stamps = [4_990_000 + 40_000 * number for number in range(len(pictures))]
    write_aedat4(
        tmp_path / "a.aedat4", [frame_packet(0, 0, pixels, t) for t, pixels in zip(stamps, pictures, strict=True)]
    )
    Convert(tmp_path / "a.aedat4", tmp_path / "first").main()
    names = sorted(file.name for file in (tmp_path / "first/frames").glob("*.png"))
    assert not (tmp_path / "first/frames/exposures_ns.txt").exists()  # the file states none
    frames = [
        {
            "file_path": f"frames/{name}",
            "transform_matrix": [[1, 0, 0, 0.01 * i], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
        }
        for i, name in enumerate(names)
    ]
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": frames}))
    Convert(tmp_path / "a.aedat4", tmp_path / "new", poses=tmp_path / "transforms.json").main()
    poses = np.loadtxt(tmp_path / "new/poses.txt")
    np.testing.assert_array_equal(poses[:, 0], np.loadtxt(tmp_path / "new/frames/stamps_ns.txt"))
    np.testing.assert_allclose(poses[:, 1], 0.01 * np.arange(len(names)), atol=1e-12)


@pytest.mark.parametrize("name", ["back in time", "two streams"])
def test_frames_of_an_event_file_that_cannot_be_read(tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]):
    pytest.importorskip("aedat")
    frames = [frame_packet(t, t + 10, np.zeros((18, 24), np.uint8)) for t in (5_200_000, 5_100_000)]
    convert = Convert(tmp_path / "a.aedat4", tmp_path / "new")
    if name == "back in time":
        write_aedat4(tmp_path / "a.aedat4", frames)
        assert "holds a frame at 5100005000 ns after one at 5200005000 ns" in refused(tmp_path, convert)
        return
    write_aedat4(tmp_path / "a.aedat4", frames, ("EVTS", "FRME", "FRME"))
    convert.main()
    assert "holds 2 streams of frames, of which none is read" in " ".join(capsys.readouterr().out.split())
    assert not (tmp_path / "new/frames").exists()


@pytest.mark.parametrize(("unit", "nanoseconds"), [("s", 10**9), ("us", 1000), ("ns", 1)])
def test_an_event_file_with_poses_and_calibration(
    tmp_path: Path, evt2_file: Path, unit: str, nanoseconds: int, capsys: pytest.CaptureFixture[str]
):
    rows = events()
    times = np.linspace(rows[0, 0] - 100, rows[-1, 0] + 100, len(POSE_TIMES)).astype(np.int64) * 1000
    stamps = [f"{t // nanoseconds}.{t % nanoseconds:0{len(str(nanoseconds)) - 1}d}" for t in times.tolist()]
    lines = zip(stamps, poses().tolist(), strict=True)
    (tmp_path / "poses.txt").write_text("".join(f"{t} {' '.join(map(repr, pose))}\n" for t, pose in lines))
    camera = {**FILE_CAMERA, "model": "radtan", "distortion": [-0.01, 0.002, 1 / 3000, 0]}
    (tmp_path / "camera.json").write_text(json.dumps({**camera, "fx": 400.5, "fy": 400.25, "cx": 320.0, "cy": 240.0}))
    Convert(
        evt2_file,
        tmp_path / "new",
        poses=tmp_path / "poses.txt",
        pose_flags=PoseFlags(poses_unit=unit),  # type: ignore[arg-type]
        camera=tmp_path / "camera.json",
    ).main()
    recording = read_recording(tmp_path / "new")
    np.testing.assert_array_equal(recording.trajectory.times, times - rows[0, 0] * 1000)
    np.testing.assert_array_equal(recording.trajectory.positions, poses()[:, :3])
    assert recording.camera.distortion == (-0.01, 0.002, 1 / 3000, 0) and recording.camera.fx == 400.5
    assert len(index_events(recording)) == len(rows)
    assert "Before training" not in capsys.readouterr().out


def test_the_calibration_states_the_size_where_the_file_does_not(tmp_path: Path):
    content = FORMATS["EVT2"][1](events()).replace(b"% geometry 640x480\n", b"")
    (tmp_path / "events.raw").write_bytes(content)
    (tmp_path / "camera.json").write_text(json.dumps(FILE_CAMERA))
    sentence = refused(tmp_path, Convert(tmp_path / "events.raw", tmp_path / "new"))
    assert "events.raw does not state the size of its sensor; give a --camera file" in sentence
    Convert(tmp_path / "events.raw", tmp_path / "new", camera=tmp_path / "camera.json").main()
    assert json.loads((tmp_path / "new/recording.json").read_text()) == {"camera": FILE_CAMERA}


# -------------------------------------------------------------------------------------------------------- bad input


def test_a_folder_with_something_in_it_is_not_touched(tmp_path: Path):
    source = write_esim(tmp_path / "esim")
    (tmp_path / "full").mkdir()
    (tmp_path / "full/mine.txt").write_text("mine")
    (tmp_path / "file").write_text("mine")
    for output_dir in (tmp_path / "full", tmp_path / "file"):
        assert "exists already and is not an empty folder" in refused(tmp_path, Convert(source, output_dir))


def test_a_folder_within_the_recording_is_refused(tmp_path: Path):
    source = write_esim(tmp_path / "esim")
    for output_dir in (source, source / "deep" / "new"):
        assert "lies within the recording" in refused(tmp_path, Convert(source, output_dir))


def test_a_folder_that_cannot_be_made_is_told(tmp_path: Path):
    source = write_esim(tmp_path / "esim")
    (tmp_path / "file").write_text("mine")
    sentence = refused(tmp_path, Convert(source, tmp_path / "file" / "new"))
    assert "file/new could not be written (" in sentence


@pytest.mark.parametrize("name", ["missing", "empty", "unknown"])
def test_sources_that_are_none(tmp_path: Path, name: str):
    source = tmp_path / "source"
    if name == "missing":
        expected = "source does not exist; give the folder of a recording or an event file"
    elif name == "empty":
        source.mkdir()
        expected = "is a folder of no known format"
    else:
        source.write_text("events")
        expected = "begins with b'events'"
    assert expected in refused(tmp_path, Convert(source, tmp_path / "new"))


@pytest.mark.parametrize("name", ["EVT2 cut off", "only a header", "EVT3 as EVT2"])
def test_damaged_event_files_leave_nothing(tmp_path: Path, name: str):
    (tmp_path / "events.raw").write_bytes(BAD[name][0])
    assert BAD[name][1] in refused(tmp_path, Convert(tmp_path / "events.raw", tmp_path / "new"))


@pytest.mark.parametrize(
    ("row", "column", "value", "message"),
    [
        (7, 1, 640, "events.raw, event 8, holds x = 640, but from 0 to 639 was expected"),
        (3, 2, 2000, "events.raw, event 4, holds y = 2000"),
        (300, 0, 5_000_100, "events.raw, event 301, goes back in time"),
    ],
)
def test_events_that_cannot_be_are_named(tmp_path: Path, row: int, column: int, value: int, message: str):
    rows = events()
    rows[row, column] = value
    (tmp_path / "events.raw").write_bytes(FORMATS["EVT2"][1](rows))
    assert message in refused(tmp_path, Convert(tmp_path / "events.raw", tmp_path / "new"))


def test_events_of_a_folder_that_cannot_be_are_named(tmp_path: Path):
    source = write_davis(tmp_path / "davis")
    lines = (source / "events.txt").read_text().splitlines(keepends=True)
    (source / "events.txt").write_text("".join([lines[0], "0.15 24 1 1\n", *lines[1:]]))
    assert "events.txt, line 2 holds x = 24" in refused(tmp_path, Convert(source, tmp_path / "new"))


def test_poses_in_another_unit_are_noticed(tmp_path: Path, evt2_file: Path):
    (tmp_path / "poses.txt").write_text("5000000 0 0 0 0 0 0 1\n45000000 1 0 0 0 0 0 1\n")
    convert = Convert(evt2_file, tmp_path / "new", poses=tmp_path / "poses.txt")
    sentence = refused(tmp_path, convert)
    assert "events.raw holds" in sentence and "the times of poses (poses.txt) look like microseconds" in sentence
    assert sentence.endswith("so give --poses-unit us.")


def test_a_calibration_of_another_resolution_is_noticed(tmp_path: Path, evt2_file: Path):
    (tmp_path / "camera.json").write_text(json.dumps(CAMERA))
    sentence = refused(tmp_path, Convert(evt2_file, tmp_path / "new", camera=tmp_path / "camera.json"))
    assert "camera.json is the calibration of 24 x 18 pixels" in sentence and "a sensor of 640 x 480" in sentence


def test_a_bad_calibration_is_told(tmp_path: Path, evt2_file: Path):
    camera = tmp_path / "camera.json"
    camera.write_text(json.dumps({"width": 640, "height": 480}))
    convert = Convert(evt2_file, tmp_path / "new", camera=camera)
    assert "camera.json lacks model, fx, fy, cx and cy; add it" in refused(tmp_path, convert)
    camera.write_text(json.dumps({**FILE_CAMERA, "model": "lookup"}))
    assert 'holds model = "lookup", but one of pinhole, radtan and fisheye' in refused(tmp_path, convert)
    convert = Convert(evt2_file, tmp_path / "new", poses=tmp_path / "poses.txt")
    assert "poses.txt is missing" in refused(tmp_path, convert)


def test_flags_that_cannot_be_followed_are_refused(tmp_path: Path, evt2_file: Path):
    source = write_esim(tmp_path / "esim")
    new = tmp_path / "new"
    assert refused(tmp_path, Convert(source, new, poses=evt2_file)).startswith("--poses is for event files")
    assert refused(tmp_path, Convert(source, new, camera=evt2_file)).startswith("--camera is for event files")
    right = format_flags()(event_camera="right")  # type: ignore[call-arg] - a field made from the options of TUM-VIE
    assert refused(tmp_path, Convert(evt2_file, new, right)).startswith("--event-camera is for folders")


def test_flags_of_poses_that_cannot_be_followed_are_refused(tmp_path: Path, evt2_file: Path):
    source, new = write_davis(tmp_path / "davis"), tmp_path / "new"
    scaled = Convert(source, new, pose_flags=PoseFlags(poses_scale=2.0))
    assert refused(tmp_path, scaled).startswith("--poses-scale is for poses of --poses, which is not given")
    beside_run = Convert(source, new, run=tmp_path / "run", poses=source / "groundtruth.txt")
    assert refused(tmp_path, beside_run) == "--poses is taken from the run of --run; leave it out."
    beside_run = Convert(source, new, run=tmp_path / "run", accept_found=True)
    assert refused(tmp_path, beside_run) == "--accept-found is taken from the run of --run; leave it out."
    assert "give --poses and --camera, too" in refused(tmp_path, Convert(evt2_file, new, accept_found=True))
    own = source / "groundtruth.txt"
    both = Convert(source, new, without_poses=True)
    for flag, other in {
        "--poses": replace(both, poses=own),
        "--run": replace(both, run=tmp_path / "run"),
        "--accept-found": replace(both, accept_found=True),
    }.items():
        assert (
            refused(tmp_path, other)
            == f"--without-poses writes no poses, but {flag} states some; leave one of both out."
        )
    assert "--without-poses is for folders" in refused(tmp_path, Convert(evt2_file, new, without_poses=True))
    of_esim = Convert(write_esim(tmp_path / "esim"), new, without_poses=True)
    assert refused(tmp_path, of_esim).startswith("--without-poses is for recordings of davis, ")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full, the disk that is always full")
@pytest.mark.parametrize("what", ["folder", "file"])
def test_a_full_disk_leaves_nothing(tmp_path: Path, what: str, monkeypatch: pytest.MonkeyPatch, evt2_file: Path):
    source = write_esim(tmp_path / "esim") if what == "folder" else evt2_file
    write_events = event_recording.write_events

    def onto_a_full_disk(stream, folder: Path, *arguments):
        folder.mkdir()
        (folder / "t.npy").symlink_to("/dev/full")
        monkeypatch.setattr(Path, "mkdir", lambda *_, **__: None)
        return write_events(stream, folder, *arguments)

    monkeypatch.setattr(event_recording, "write_events", onto_a_full_disk)
    before = digests(tmp_path)
    with pytest.raises(OutputError, match=r"new could not be written \(.*No space left on device\), and nothing was"):
        Convert(source, tmp_path / "new").main()
    assert digests(tmp_path) == before
    assert not [path for path in tmp_path.iterdir() if "new" in path.name]


@pytest.mark.slow
def test_a_killed_conversion_leaves_no_recording_and_can_be_done_again(tmp_path: Path):
    """Killed while events are written: the folder asked for is not there, and the next attempt finds its place free."""
    rng = np.random.default_rng(0)
    count = 20_000_000
    columns = {
        "x": rng.integers(0, WIDTH, count, dtype=np.uint16),
        "y": rng.integers(0, HEIGHT, count, dtype=np.uint16),
        "t": np.sort(rng.integers(0, 10**9, count)),
        "p": rng.integers(0, 2, count, dtype=np.int8),
    }
    source = write_recording(tmp_path / "own")
    for name, column in columns.items():
        np.save(source / f"events/{name}.npy", column)
    code = "import sys, pathlib, enerf_ns.scripts.convert as c; c.Convert(*map(pathlib.Path, sys.argv[1:])).main()"
    command = [sys.executable, "-c", code, str(source), str(tmp_path / "new")]
    process = subprocess.Popen(command, env={**os.environ, "OMP_NUM_THREADS": "1"})
    while not list(tmp_path.glob(".new.partial-*/events/p.npy")):
        time.sleep(0.002)
        assert process.poll() is None
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert not (tmp_path / "new").exists() and list(tmp_path.glob(".new.partial-*"))
    Convert(source, tmp_path / "new").main()
    assert {path.name for path in tmp_path.iterdir()} == {"new", source.name}, "what was left behind is gone"
    for name, column in columns.items():
        np.testing.assert_array_equal(np.load(tmp_path / f"new/events/{name}.npy"), column)
    shutil.rmtree(tmp_path / "new")


def test_events_are_never_held_as_a_whole(tmp_path: Path):
    """Each piece is written before the next one is asked for."""
    written: list[int] = []

    def stream():
        for start in range(0, 50 * 2**16, 2**16):
            written.append((tmp_path / "events/t.npy").stat().st_size)
            times = np.arange(start, start + 2**16)
            yield Events(times % 24, times % 18, times, times % 2)

    assert event_recording.write_events(stream(), tmp_path / "events", 24, 18, str) == (50 * 2**16, 0, 50 * 2**16 - 1)
    assert written[-1] > 48 * 2**16 * 8
    assert np.load(tmp_path / "events/t.npy").tolist() == list(range(50 * 2**16))


def test_the_command_line(tmp_path: Path):
    """As `enerf` parses it: the source without a flag, the rest with."""
    import tyro

    write_davis(tmp_path / "davis")
    tyro.cli(Convert, args=[str(tmp_path / "davis"), "--output-dir", str(tmp_path / "new")]).main()
    np.testing.assert_array_equal(all_events(read_recording(tmp_path / "new"))[:, :3], EVENTS[:, :3])


def test_without_poses_no_training_is_proposed(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """By both commands, since there is none without poses."""
    Convert(write_recording(tmp_path / "recording"), tmp_path / "new", without_poses=True).main()
    Reconstruct(tmp_path / "new", tmp_path / "frames", frames_per_second=4000.0).main()
    printed = capsys.readouterr().out
    assert printed.count("Before training, add poses.") == 2 and "ns-train" not in printed


def test_poses_of_another_file_on_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """In another unit, scaled, turned by a mount, and on a later clock; too few events for the search."""
    import tyro

    source = write_davis(tmp_path / "davis")
    body = "".join(f"{t / 1e6 + 20} {' '.join(map(repr, row))}\n" for t, row in zip(POSE_TIMES, poses(), strict=True))
    (tmp_path / "poses.txt").write_text(body)
    (tmp_path / "mount.txt").write_text("0 0 0.5 0 0 0 1")
    flags = "--poses-unit ms --poses-scale 2 --poses-delay-ms 20 --accept-found --hand-eye".split()
    arguments = [str(source), "--output-dir", str(tmp_path / "new"), "--poses", str(tmp_path / "poses.txt"), *flags]
    tyro.cli(Convert, args=[*arguments, str(tmp_path / "mount.txt")]).main()
    assert "too few for a search of the convention" in capsys.readouterr().out
    found = read_recording(tmp_path / "new").trajectory
    np.testing.assert_array_equal(found.times, POSE_TIMES)
    forward = Rotation.from_quat(poses()[:, 3:]).apply([0, 0, 0.5])
    np.testing.assert_allclose(found.positions, 2 * poses()[:, :3] + forward, atol=1e-12)

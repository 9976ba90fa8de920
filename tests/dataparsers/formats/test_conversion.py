"""What `enerf convert` does, called from Python; its flags, words and exit codes are tested with the script."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from recordings import EVENTS, FRAME_TIMES, POSE_TIMES, joined, write_davis, write_esim
from test_event_files import FORMATS, events

from enerf_ns.dataparsers.formats.conversion import convert_event_file, convert_recording, new_folder
from enerf_ns.dataparsers.formats.pose_files import GivenPoses, PoseFlags, RestPoses
from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.recording.errors import FlagError, OutputError, RecordingError


def test_a_recording(tmp_path: Path):
    source = write_esim(tmp_path / "esim", frames=("images", "images_corrupted"), depth=True)
    sentences = convert_recording(source, tmp_path / "new")
    assert sentences == ["6 events, 11 poses and 6 frames are written."]
    found = read_recording(tmp_path / "new")
    assert found.format == "event_recording" and found.depth_range == (0.5, 4.0)
    np.testing.assert_array_equal(joined(found.stream_events()).t, EVENTS[:, 2])


def test_an_event_file(tmp_path: Path):
    (tmp_path / "events.raw").write_bytes(FORMATS["EVT2"][1](events()))
    counted, missing = convert_event_file(tmp_path / "events.raw", tmp_path / "new")
    assert f"{len(events()):,} events of" in counted and "(EVT2) are written" in counted
    assert "add poses.txt and model, fx, fy, cx, cy and distortion of the camera in recording.json" in missing
    assert sorted(path.name for path in (tmp_path / "new/events").iterdir()) == ["p.npy", "t.npy", "x.npy", "y.npy"]


def test_poses_on_the_clock_of_the_files_fit_by_the_stated_time_0(tmp_path: Path):
    """As those of a tracker, for a recording that was converted before they were there."""
    source = write_davis(tmp_path / "davis", zero=1_700_000_000 * 10**9)
    first, *_ = convert_recording(source, tmp_path / "first", RestPoses(source))
    zero = int(re.findall(r"Time 0 of the new recording is (\d+) ns", first)[0])
    assert zero == 1_700_000_000 * 10**9 + min(FRAME_TIMES[0], EVENTS[0, 2])
    poses = source / "groundtruth.txt"
    with pytest.raises(RecordingError, match="both must be on one clock"):
        convert_recording(tmp_path / "first", tmp_path / "second", GivenPoses(poses))
    assert not (tmp_path / "second").exists()
    convert_recording(tmp_path / "first", tmp_path / "second", GivenPoses(poses, PoseFlags(poses_delay_ms=zero * 1e-6)))
    times = read_recording(tmp_path / "second").trajectory.times
    assert np.abs(times - (POSE_TIMES + 1_700_000_000 * 10**9 - zero)).max() < 1000  # ns, of float64 milliseconds


@pytest.mark.parametrize("convert", [convert_recording, convert_event_file])
def test_what_cannot_be_written_or_read_leaves_nothing(tmp_path: Path, convert):
    source = write_esim(tmp_path / "esim")
    if convert is convert_event_file:
        source = tmp_path / "events.raw"
        source.write_bytes(FORMATS["EVT2"][1](events()))
    (tmp_path / "full").mkdir()
    (tmp_path / "full/mine").touch()
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(OutputError, match="exists already and is not an empty folder"):
        convert(source, tmp_path / "full")
    with pytest.raises(OutputError, match="could not be written"):
        convert(source, tmp_path / "full/mine/new")
    assert sorted(tmp_path.rglob("*")) == before


def test_a_mount_point_is_refused_before_the_work(tmp_path: Path):
    """As that of docker run -v "$PWD/out:/out". The root of all folders is one on any machine."""
    with pytest.raises(OutputError, match=r"^/ is a mount point, .*; give a folder in it .*such as /recording\.$"):
        convert_recording(tmp_path / "missing", Path("/"))


def test_what_another_command_wrote_meanwhile_stays(tmp_path: Path):
    source, new = write_esim(tmp_path / "esim"), tmp_path / "new"
    with (
        pytest.raises(OutputError, match="new exists already and is not an empty folder"),
        new_folder(source, new) as own,
    ):
        (own / "mine").touch()
        new.mkdir()
        (new / "theirs").touch()
    assert sorted(path.name for path in tmp_path.rglob("*") if path.name not in ("esim", "new")) == sorted(
        ["theirs", *(path.name for path in source.rglob("*"))]
    )


def test_options_that_the_format_lacks_and_folders_within(tmp_path: Path):
    source = write_esim(tmp_path / "esim")
    with pytest.raises(FlagError, match="--event-camera is for recordings of tum_vie, evimo2, "):
        convert_recording(source, tmp_path / "new", event_camera="right")
    with pytest.raises(OutputError, match="lies within the recording"):
        convert_recording(source, source / "new")
    with pytest.raises(RecordingError, match="is a folder of no known format"):
        (tmp_path / "empty").mkdir()
        convert_recording(tmp_path / "empty", tmp_path / "new")
    assert not (tmp_path / "new").exists() and not (source / "new").exists()


@pytest.mark.parametrize("response", ["linlog", "logarithm:0.001"])
def test_the_response_of_the_sensor_is_kept(tmp_path: Path, response: str):
    convert_recording(write_esim(tmp_path / "esim"), tmp_path / "first")
    about = (tmp_path / "first/recording.json").read_text()
    (tmp_path / "first/recording.json").write_text(about.replace("{", f'{{"response": "{response}",', 1))
    convert_recording(tmp_path / "first", tmp_path / "second")
    assert read_recording(tmp_path / "second").response == response
    assert read_recording(tmp_path / "esim").response is None

"""Recordings whose poses nobody knows yet: converted, with frames from their events, and with poses at last."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import test_dsec
import test_m3ed
import test_ros_bag
from recordings import write_davis
from test_bad_input import is_one_sentence
from test_event_recording import write_recording

from enerf_ns.dataparsers.formats.conversion import convert_recording
from enerf_ns.dataparsers.formats.event_recording import rest_poses, write_poses
from enerf_ns.dataparsers.formats.pose_files import GivenPoses, PoseFlags, RestPoses
from enerf_ns.dataparsers.formats.registry import formats, read_recording
from enerf_ns.dataparsers.inspection.page import Inspection
from enerf_ns.dataparsers.recording.errors import RecordingError, UserError
from enerf_ns.reconstruction.reconstruction import reconstruct


def lacking(write: Callable[[Path], object], *files: str) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        write(folder)
        for file in files:
            (folder / file).unlink()

    return make


def write_e2nerf(folder: Path) -> None:
    import test_e2nerf  # here, since it skips where aedat is not installed

    test_e2nerf.write_scene(folder)


MADE: dict[str, tuple[Callable[[Path], object], Callable[[Path], object]]] = {
    "davis": (write_davis, lacking(write_davis, "groundtruth.txt")),
    "event_recording": (
        lambda folder: write_recording(folder, ("frames", "blurred_frames"), depth=True),
        lacking(lambda folder: write_recording(folder, ("frames", "blurred_frames"), depth=True), "poses.txt"),
    ),
    "dsec": (test_dsec.write_dsec, lacking(test_dsec.write_dsec, "poses.txt")),
    "m3ed": (test_m3ed.write_m3ed, lacking(test_m3ed.write_m3ed, "seq_pose_gt.h5")),
    "ros_bag": (
        test_ros_bag.write_bag,
        lambda folder: test_ros_bag.write_bag(folder, test_ros_bag.Bag(poses_topics=())),
    ),
    "e2nerf": (write_e2nerf, write_e2nerf),  # the file of the poses also states the focal length
}
"""How to write a recording of each format with poses, and the same without them."""


def times_of(folder: Path) -> np.ndarray:
    """Times of events, then of frames, from the first event on, read from the files of the layout."""
    events = np.load(folder / "events/t.npy")
    frames = [np.loadtxt(table, np.int64, ndmin=1) for table in sorted(folder.glob("*/stamps_ns.txt"))]
    return np.concatenate([events, *frames]) - events[0]


def test_all_formats_that_take_poses_are_tried():
    assert MADE.keys() == {format.name for format in formats() if format.takes_poses}


@pytest.mark.parametrize("name", MADE)
def test_all_but_the_poses_are_converted(tmp_path: Path, name: str):
    """Poses are given to the new recording later, on its own clock."""
    if name == "e2nerf" and find_spec("aedat") is None:
        pytest.skip("aedat is an optional extra of the project")
    whole, without = MADE[name]
    whole(tmp_path / "whole")
    without(tmp_path / "without")
    if whole is not without:
        with pytest.raises(UserError, match=r"--without-poses"):
            read_recording(tmp_path / "without")
    convert_recording(tmp_path / "whole", tmp_path / "true")
    *_, written, advice = convert_recording(tmp_path / "without", tmp_path / "new", RestPoses(tmp_path / "without"))
    assert " 0 poses and " in written and advice.startswith("Before training, add poses")
    assert not (tmp_path / "new/poses.txt").exists()
    np.testing.assert_array_equal(times_of(tmp_path / "new"), times_of(tmp_path / "true"))

    true = read_recording(tmp_path / "true").trajectory
    first, true_first = (np.load(tmp_path / f"{folder}/events/t.npy")[0] for folder in ("new", "true"))
    own = true.times + first - true_first, true.positions, true.quaternions
    write_poses(tmp_path / "found.txt", *own)
    given = GivenPoses(tmp_path / "found.txt", PoseFlags(poses_unit="ns"))
    found = read_recording(tmp_path / "new", poses=given).trajectory
    np.testing.assert_array_equal(found.times - first, true.times - true_first)
    np.testing.assert_array_equal(found.positions, true.positions)
    look = Inspection.of(read_recording(tmp_path / "new", poses=rest_poses(tmp_path / "new")))
    assert look.found()["poses"] == "none yet" and "Trajectory" not in look.page()


def test_a_clock_below_zero(tmp_path: Path):
    """As that of a recording that counts from its trigger; and a recording without frames."""
    folder = write_recording(tmp_path / "recording")
    np.save(folder / "events/t.npy", np.load(folder / "events/t.npy") - 10**9)
    (folder / "poses.txt").unlink()
    convert_recording(folder, tmp_path / "new", RestPoses(folder))
    np.testing.assert_array_equal(np.load(tmp_path / "new/events/t.npy"), np.load(folder / "events/t.npy"))


def test_sharp_and_blurred_frames_of_the_same_names_are_kept(tmp_path: Path):
    """The blurred ones begin earlier and end later than the events and the sharp ones."""
    folder = write_recording(tmp_path / "recording", ("frames", "blurred_frames"))
    (folder / "blurred_frames/stamps_ns.txt").write_text("-5000000000\n450000000\n5000000000\n")
    (folder / "poses.txt").unlink()
    convert_recording(folder, tmp_path / "new", RestPoses(folder))
    np.testing.assert_array_equal(times_of(tmp_path / "new"), times_of(folder))


@pytest.mark.parametrize("has_frames", [True, False])
def test_frames_from_events_need_no_poses(recording: Path, tmp_path: Path, has_frames: bool):
    """They are those of the same recording with poses from the first to the last event."""
    convert_recording(recording, tmp_path / "with")
    if not has_frames:
        for name in ("frames", "blurred_frames", "depth"):
            shutil.rmtree(tmp_path / "with" / name)
    times = np.load(tmp_path / "with/events/t.npy")
    (tmp_path / "with/poses.txt").write_text("".join(f"{times[i]} 0 0 0 0 0 0 1\n" for i in (0, -1)))
    shutil.copytree(tmp_path / "with", tmp_path / "without")
    (tmp_path / "without/poses.txt").unlink()
    made = {name: tmp_path / f"{name}, frames" for name in ("with", "without")}
    sentences = {name: reconstruct(tmp_path / name, folder) for name, folder in made.items()}
    assert not (made["without"] / "poses.txt").exists()
    assert any(sentence.startswith("Before training, add poses") for sentence in sentences["without"])

    own, expected = (sorted((made[name] / "blurred_frames").iterdir()) for name in ("without", "with"))
    assert [file.name for file in own] == [file.name for file in expected] and len(own) > 2
    assert [file.read_bytes() for file in own] == [file.read_bytes() for file in expected]


def test_events_and_frames_are_inspected(recording: Path, tmp_path: Path):
    """Rows of events, frames and sensor are those of the same recording with poses; so are problems, except those of
    the motion."""
    convert_recording(recording, tmp_path / "with")
    polarity = np.load(tmp_path / "with/events/p.npy")
    np.save(tmp_path / "with/events/p.npy", 1 - polarity.clip(0))
    shutil.copytree(tmp_path / "with", tmp_path / "without")
    (tmp_path / "without/poses.txt").unlink()
    whole = Inspection.of(read_recording(tmp_path / "with"))
    found = Inspection.of(read_recording(tmp_path / "without", poses=rest_poses(tmp_path / "without")))
    assert found.sensor.rows() == whole.sensor.rows()
    assert found.found() == {**whole.found(), "poses": "none yet"}
    assert found.numbers().items() < whole.numbers().items()
    exchanged = [problem for problem in whole.problems if "On and off events are exchanged" in problem.what]
    assert len(exchanged) == 1 and exchanged[0] in found.problems
    assert {problem.what for problem in found.problems} <= {problem.what for problem in whole.problems}
    assert found.focus() == {} and found.edge_depth() is None
    assert "poses" in found.unknown[0].sentence and "there are no poses yet" in found.unknown[0].sentence
    assert "Trajectory from above" in whole.page() and "Trajectory from above" not in found.page()


@pytest.mark.parametrize("number", [1, 2])
def test_few_frames(tmp_path: Path, number: int):
    """One frame shows no span of time that events could be compared with."""
    folder = write_davis(tmp_path / "davis")
    lines = (folder / "images.txt").read_text().splitlines()[:number]
    (folder / "images.txt").write_text("\n".join(lines))
    convert_recording(folder, tmp_path / "new", RestPoses(folder))
    assert len(list((tmp_path / "new/frames").glob("*.png"))) == number


@pytest.mark.parametrize(
    "times", [np.zeros(0, np.int64), np.full(6, np.nan), np.full(6, 2**64 - 1, np.uint64), np.array(3)]
)
def test_times_that_cannot_be(tmp_path: Path, times: np.ndarray):
    folder = write_recording(tmp_path / "recording")
    (folder / "poses.txt").unlink()
    np.save(folder / "events/t.npy", times)
    with pytest.raises(RecordingError) as error:
        reconstruct(folder, tmp_path / "new")
    assert is_one_sentence(f"enerf: {error.value}") and "events" in str(error.value)
    assert not (tmp_path / "new").exists()

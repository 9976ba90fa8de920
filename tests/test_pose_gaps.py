"""A simulated recording of 3 s without the poses of a second: what lies there is left out, counted and shown."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from recordings import changed, joined, write_event_recording
from rich.console import Console
from small_runs import EVENTS, check_two_steps, set_up, small_config

from enerf_ns.choices.table import recording_table
from enerf_ns.dataparsers.event_dataparser import EventDataParserConfig, split_frames
from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.inspection.page import Inspection
from enerf_ns.dataparsers.inspection.problems import find_problems
from enerf_ns.dataparsers.recording.errors import FlagError, RecordingError
from enerf_ns.dataparsers.recording.recording import EventRecording
from enerf_ns.dataparsers.recording.trajectory import Trajectory
from enerf_ns.dataparsers.scene.scene_box import scene_normalisation

CUT = 900_000_000, 1_900_000_000


def without_poses(recording: EventRecording) -> EventRecording:
    """The recording, thirty times slower, without the poses of the second that is cut."""
    whole = changed(recording, slower=30)
    old = whole.trajectory
    known = (old.times < CUT[0]) | (old.times > CUT[1])
    trajectory = Trajectory(old.times[known], old.positions[known], old.quaternions[known])
    frames, blurred = (replace(kind, trajectory=trajectory) for kind in (whole.frames, whole.blurred_frames) if kind)
    return replace(whole, trajectory=trajectory, frames=frames, blurred_frames=blurred)


@pytest.fixture(scope="module")
def folder(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    cut = without_poses(read_recording(recording))
    return write_event_recording(cut, tmp_path_factory.mktemp("gap") / "recording")


@pytest.fixture(scope="module")
def gap(folder: Path) -> tuple[int, int]:
    """The last pose before the cut and the first one after it, ns, by a loop."""
    times = read_recording(folder).trajectory.times.tolist()
    return max(t for t in times if t < CUT[0]), min(t for t in times if t > CUT[1])


def inside(times: torch.Tensor, gap: tuple[int, int]) -> torch.Tensor:
    return (times > gap[0]) & (times < gap[1])


def config_of(folder: Path, output_dir: Path, keep: bool = False, **changes: Any):
    config = small_config(folder, output_dir, **changes)
    config.pipeline.datamanager.dataparser = EventDataParserConfig(data=folder, keep_pose_gaps=keep)
    return config


@pytest.mark.parametrize("keep", [False, True])
@pytest.mark.parametrize("silent", ["pixels", "intervals"])
@pytest.mark.parametrize("mode", ["successor", "partner", "window", "accumulated"])
def test_nothing_is_drawn_from_a_gap_unless_it_is_kept(folder: Path, gap, tmp_path, mode: str, silent: str, keep: bool):
    changes = dict(data__pair_mode=mode, data__window_ms=500.0, data__event_pairs=3000, data__silent_pairs=3000)
    changes["data__silent_mode"] = silent
    pipeline = set_up(config_of(folder, tmp_path, keep, **changes)).pipeline
    events = pipeline.datamanager.next_batch(pipeline.model.sensor).events
    for kind in (events.silent, events.fired):
        assert bool((inside(events.start[kind], gap) | inside(events.end[kind], gap)).any()) == keep
    silent_over = ((events.start <= gap[0]) & (events.end >= gap[1]))[events.silent]
    assert not silent_over.any() or keep


def test_what_is_left_out_is_counted_and_shown(folder: Path, gap, tmp_path: Path):
    recording = read_recording(folder)
    assert recording.frames is not None
    times = joined(recording.stream_events()).t.tolist()
    lost = sum(gap[0] < t < gap[1] for t in times)
    frames = [t for t in recording.frames.times.tolist() if gap[0] < t < gap[1]]
    assert lost > 100 and len(frames) >= 3
    index = index_events(recording)
    assert len(index) == len(times) and index.num_in_gaps == lost
    begin, length = gap[0] * 1e-9, (gap[1] - gap[0]) * 1e-9
    assert index.notes == (
        f"{lost:,} of {len(times):,} events ({100 * lost / len(times):.2g} %) lie in a gap of the poses of "
        f"{length:.2f} s from {begin:.2f} s on, and start or end no pair; --keep-pose-gaps True keeps them.",
        f"{len(frames)} of 11 frames lie in gaps of the poses and are left out; --keep-pose-gaps True keeps them.",
        f"{len(frames)} of 11 blurred frames lie in gaps of the poses and are left out; --keep-pose-gaps True keeps "
        "them.",
    )
    (problem,) = [problem for problem in find_problems(recording) if "no poses for" in problem.what]
    assert problem.what.endswith("events and frames there are left out.") and "--time-range" in problem.advice

    console = Console(record=True, width=200)
    Inspection.of(recording).print_tables(console)
    console.print(recording_table(config_of(folder, tmp_path).pipeline.datamanager.dataparser))
    assert console.export_text().count("--keep-pose-gaps True keeps them") == 6
    (row,) = [row for row in config_of(folder, tmp_path).resolved().pipeline.resolution.choices if "gaps" in row.part]
    assert (row.part, row.kept, row.value) == ("pose gaps", False, "left out") and f"{lost:,} events (" in row.why


def test_what_is_kept_is_said_to_be(folder: Path, tmp_path: Path):
    recording = read_recording(folder, keep_pose_gaps=True)
    assert not any("gap" in note for note in index_events(recording).notes)
    (problem,) = [problem for problem in find_problems(recording) if "no poses for" in problem.what]
    assert problem.what.endswith("events and frames there are used with interpolated poses.")
    (row,) = [
        row for row in config_of(folder, tmp_path, True).resolved().pipeline.resolution.choices if "gaps" in row.part
    ]
    assert (row.kept, row.value) == (True, "used") and row.why.startswith("set by flag; ")
    assert index_events(recording).num_in_gaps == index_events(read_recording(folder)).num_in_gaps > 0


def test_without_gaps_there_is_a_row_and_nothing_else(recording: Path, tmp_path: Path):
    config = small_config(recording, tmp_path, data__silent_pairs=8)
    (row,) = [row for row in config.resolved().pipeline.resolution.choices if row.part == "pose gaps"]
    assert (row.kept, row.value, row.why) == (False, "", "none is longer than 0.1 s")
    whole = read_recording(recording)
    assert len(whole.pose_gaps) == 0 and whole.stretches.tolist() == [list(whole.span)]
    assert not any("gap" in note for note in (*whole.notes, *index_events(whole).notes))
    assert set_up(config).pipeline.datamanager._parts(whole.stretches) is None


@pytest.mark.parametrize("held_out", [False, True])
def test_frames_in_a_gap_are_neither_learnt_from_nor_scored(folder: Path, gap, held_out: bool):
    recording = read_recording(folder)
    for chosen in (None, tuple(range(11))):
        config = EventDataParserConfig(
            data=folder, held_out_every=2, train_frame_indices=chosen, held_out_frame_indices=chosen
        )
        frames, are_frames = split_frames(recording, config, held_out)
        assert are_frames and len(frames.times) and not inside(torch.from_numpy(frames.times), gap).any()
        kept, _ = split_frames(read_recording(folder, keep_pose_gaps=True), config, held_out)
        assert inside(torch.from_numpy(kept.times), gap).any()
        assert set(frames.numbers) <= set(kept.numbers) or not chosen


def test_events_stand_in_for_frames_outside_of_gaps(folder: Path, gap):
    recording = replace(read_recording(folder), frames=None, blurred_frames=None)
    frames, are_frames = split_frames(recording, EventDataParserConfig(held_out_every=2), held_out=False)
    assert not are_frames and len(frames.times) == 24 and not inside(torch.from_numpy(frames.times), gap).any()
    steps = np.diff(recording.instants(1000))
    assert (np.abs(steps - np.median(steps)) <= 1).sum() == 998 and steps.max() > gap[1] - gap[0]


def test_the_box_holds_what_known_poses_see(folder: Path):
    """Wherever a spline flies within the gap: here 100 m away."""
    recording = read_recording(folder)
    old = recording.trajectory

    class Astray(Trajectory):
        def poses(self, times, delays=None):
            poses = super().poses(times, delays)
            poses[torch.from_numpy(self.in_gaps(times.numpy())), 0, 3] += 100.0
            return poses

    astray = Astray(old.times, old.positions, old.quaternions)
    expected = scene_normalisation(recording, 1.0, 2.0)
    for one, other in zip(scene_normalisation(replace(recording, trajectory=astray), 1.0, 2.0), expected, strict=True):
        np.testing.assert_array_equal(one, other)
    kept = replace(recording, trajectory=astray, keep_pose_gaps=True)
    assert scene_normalisation(kept, 1.0, 2.0)[1] < 0.1 * expected[1]


def test_a_range_within_a_gap_is_refused_unless_it_is_kept(folder: Path):
    with pytest.raises(FlagError, match=r"lies within a gap of the poses of .*recording, from 0\.\d+ s to 1\.\d+ s"):
        read_recording(folder, time_range=(1.2, 1.5))
    assert read_recording(folder, time_range=(1.2, 1.5), keep_pose_gaps=True).span == (1_200_000_000, 1_500_000_000)


def test_a_range_that_ends_within_a_gap_is_used_up_to_it(folder: Path, gap, tmp_path: Path):
    config = config_of(folder, tmp_path, data__event_pairs=3000, data__silent_pairs=3000)
    config.pipeline.datamanager.dataparser.time_range = (0.5, 1.5)
    pipeline = set_up(config).pipeline
    assert pipeline.datamanager.recording.stretches.tolist() == [[500_000_000, gap[0]]]
    events = pipeline.datamanager.next_batch(pipeline.model.sensor).events
    assert events.start.min() >= 500_000_000 and gap[0] * 0.9 < events.end.max() <= gap[0]


def test_frames_of_a_gap_alone_are_an_error_of_one_sentence(folder: Path, gap):
    recording = read_recording(folder)
    assert recording.frames is not None
    lost = recording.frames.subset(np.flatnonzero(inside(torch.from_numpy(recording.frames.times), gap).numpy()))
    with pytest.raises(RecordingError, match=r"All frames of .* lie in gaps of the poses") as error:
        split_frames(replace(recording, frames=lost, blurred_frames=None), EventDataParserConfig(), False)
    assert "\n" not in str(error.value)


def test_it_trains(folder: Path, tmp_path: Path):
    check_two_steps(config_of(folder, tmp_path, data__silent_pairs=32), EVENTS | {"no_event_loss"})

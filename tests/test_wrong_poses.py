"""A training with wrong poses says that it does not explain the events, at its start, at its end and in its report."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recordings import write_event_recording
from small_runs import set_up, small_config

from enerf_ns.bench.numerics.points import CAMERA, TURNING, points_between, recording_of_points, shaking
from enerf_ns.dataparsers.inspection.focus import INVERSE
from enerf_ns.dataparsers.recording.recording import EventRecording
from enerf_ns.evaluation.history import read_history
from enerf_ns.report.writing import write_report

CAUSE = "the poses fit the events when they are read as world to camera, the inverse"


@pytest.mark.slow
@pytest.mark.parametrize(("is_wrong", "is_corrected"), [(True, False), (True, True), (False, False)])
def test_a_run_says_at_both_ends_whether_its_poses_are_wrong(
    is_wrong: bool, is_corrected: bool, tmp_path: Path, capsys
):
    events, trajectory, _ = recording_of_points(points_between(1.0, 3.0), shaking(0.1), TURNING)
    events = replace(events, p=np.where(np.arange(len(events)) % 2, 1, -1).astype(np.int8))
    poses = INVERSE.of(trajectory) if is_wrong else trajectory
    recording = EventRecording(tmp_path, "test", CAMERA, poses, lambda: iter([events]), ())
    folder = write_event_recording(recording, tmp_path / "recording")
    config = small_config(folder, tmp_path / "runs", data__held_out_events=0.2)
    config.pipeline.datamanager.dataparser.depth_range = 0.8, 4.0
    config.pipeline.model.sensor.contrast_thresholds = 0.25, 0.25
    config.pipeline.poses.refine_clock = is_corrected or None  # which does not suffice
    config.max_num_iterations = 5
    trainer = set_up(config)
    start = " ".join(capsys.readouterr().out.split())
    trainer.train()
    end = " ".join(capsys.readouterr().out.split())
    (*_, row) = read_history(trainer.base_dir)
    write_report([trainer.base_dir], tmp_path / "report", video=False)
    page, text = ((tmp_path / "report" / name).read_text() for name in ("report.html", "report.md"))
    assert (f"Training may fail to explain the events, because {CAUSE}" in start) == is_wrong
    assert ("Training is done: the events are not explained" in end) == is_wrong
    assert (f"The likely cause: {CAUSE}" in end) == (is_wrong and not is_corrected)
    assert (f"The corrections of clock, poses and lens do not suffice: {CAUSE}" in end) == is_corrected
    assert row.final and row.verdict and row.verdict.split()[0] in end
    assert row.verdict in text and page.index("<h1>") < page.index(row.verdict[:40]) < page.index("<h2>")
    assert row.verdict.startswith("The events are not explained" if is_wrong else "It is not known whether")

"""Mends the poses of a new recording where its events show another convention, or another clock."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.formats import event_recording
from enerf_ns.dataparsers.inspection.agreement import HARMFUL_SHIFT, Agreement
from enerf_ns.dataparsers.inspection.focus import AS_READ, AS_STATED, Hypothesis
from enerf_ns.dataparsers.recording.recording import nanoseconds
from enerf_ns.dataparsers.scene.depth_range import UnknownDepthError, scene_depth_range


def mend_poses(folder: Path, place: Path) -> list[str]:
    """Searches readings and clocks of the poses as an inspection does, and writes the poses that fit the events.

    A reading is written if it alone makes the events clearly sharper, and is no mirror image. A delay is taken off if
    it moves the picture by a pixel, and the frames do not have it, too.

    Args:
        folder: Recording in the layout event_recording, whose poses.txt is written.
        place: Place that the folder will have. Its index is then made already.

    Returns:
        Sentences that state what was found, and what was written.

    Raises:
        RecordingError: The recording cannot be used.
    """
    found = _agreement(folder, place, with_frames=False)
    if found is None:
        return ["The events are too few for a search of the convention and the clock of the poses."]
    sentences, reading = [], found.mended_reading
    if reading is not None:
        gain = found.sharpness[Hypothesis(reading=reading)] / found.sharpness[AS_STATED]
        sentences.append(f"The poses are read as {reading.words}, since events are then {gain:.1f} times as sharp.")
        body = reading.of(found.focus.recording.trajectory)
        turns = Rotation.from_quat(body.quaternions) * Rotation.from_matrix(reading.axes)
        _write(folder, body.times, body.positions, turns.as_quat())
    elif not found.is_clear or AS_READ not in found.readings:
        problems = [f"The poses are as stated, but: {problem.what} {problem.advice}" for problem in found.problems()]
        return problems or [f"The poses are as stated. {found.verdict()}"]
    found = _agreement(folder, place, with_frames=True)
    assert found is not None
    delay, frames = found.pose_delay, found.frame_delay
    if not delay.is_identifiable or found.pixels(delay.value) < HARMFUL_SHIFT or abs(delay.value) < 3 * delay.error:
        sentences.append(f"The poses fit the events: {found.verdict()}.")
    elif frames is not None and frames.is_identifiable and abs(frames.value - delay.value) < abs(delay.value) / 2:
        sentences.append(
            f"Poses and frames are both {delay.value:+.1f} ms late against the events; their clock is left as it is, "
            "and training corrects it."
        )
    else:
        read = found.focus.recording.trajectory
        _write(folder, read.times - nanoseconds(delay.value * 1e-3), read.positions, read.quaternions)
        sentences.append(
            f"The poses were stamped {delay.value:+.1f} ± {delay.error:.1f} ms late against the events, in which the "
            f"picture moves by {found.pixels(delay.value):.1f} pixels; this is taken off their times."
        )
    return sentences


def _write(folder: Path, *rows: np.ndarray) -> None:
    event_recording.write_poses(folder / "poses.txt", *rows)


def _agreement(folder: Path, place: Path, with_frames: bool) -> Agreement | None:
    read = event_recording.read(folder)
    states = tuple((str(place / Path(file).relative_to(folder)), *state) for file, *state in read.event_file_states)
    recording = replace(read, event_file_states=states)  # type: ignore[arg-type]
    try:
        depth_range = scene_depth_range(recording)
    except UnknownDepthError:
        depth_range = None
    return Agreement.of(recording, depth_range, with_frames)

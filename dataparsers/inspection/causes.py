"""Causes why events and poses do not fit together, for a training: the search of an inspection, or its quick part."""

from __future__ import annotations

import math

from enerf_ns.dataparsers.inspection.agreement import Agreement, is_in_focus
from enerf_ns.dataparsers.inspection.problems import Problem
from enerf_ns.dataparsers.recording.errors import RecordingError, quoted
from enerf_ns.dataparsers.recording.recording import EventRecording
from enerf_ns.dataparsers.scene.depth_range import UnknownDepthError, recording_parallax, scene_depth_range


def depth_range_or_cause(
    recording: EventRecording, stated: tuple[float, float] | None = None, as_read: EventRecording | None = None
) -> tuple[float, float]:
    """`scene_depth_range`, with an error that names the cause where poses, clock or calibration contradict the events.

    Args:
        recording, stated: The arguments of `scene_depth_range`.
        as_read: Recording without corrections of poses and calibration, in which the cause is searched. Default: the
            recording itself.

    Raises:
        FlagError: `stated` is no range.
        RecordingError: The events do not show how deep the scene is.
    """
    try:
        return scene_depth_range(recording, stated)
    except UnknownDepthError as error:
        found = _contradiction(as_read or recording, None)
        if found is None:
            raise
        raise RecordingError(
            f"{recording.path}: the depth range of the scene cannot be measured, because {in_a_clause(found)}; enerf "
            f"inspect {quoted(recording.path)} shows this."
        ) from error


def why_not_explained(
    recording: EventRecording, depth_range: tuple[float, float], as_read: EventRecording
) -> str | None:
    """The likely cause why a training cannot explain the events, as a clause with the advice; None if nothing is wrong.

    Takes some seconds if nothing is wrong, and as long as `Agreement.of` otherwise.

    Args:
        recording: The recording as it is trained on. Its index is made if it is not there yet.
        depth_range: Nearest and farthest depth of the scene, metres.
        as_read: The recording without corrections of poses and calibration, in which the cause is searched.
    """
    return why_poses_do_not_fit(recording, depth_range, as_read) or why_depths_do_not_fit(recording, depth_range)


def why_poses_do_not_fit(
    recording: EventRecording, depth_range: tuple[float, float], as_read: EventRecording
) -> str | None:
    """The contradiction of poses, clock or focal length with the events, as `why_not_explained` has it."""
    near, far = depth_range
    if is_in_focus(recording, math.sqrt(near * far)):
        return None
    found = _contradiction(as_read, depth_range)
    return None if found is None else f"{in_a_clause(found)}; enerf inspect {quoted(recording.path)} shows this"


def why_depths_do_not_fit(recording: EventRecording, depth_range: tuple[float, float]) -> str | None:
    """The contradiction of a depth range (m) with the parallax of the events, as `why_not_explained` has it."""
    near, far = depth_range
    parallax = recording_parallax(recording)
    if not parallax.contradicts(depth_range):
        return None
    shown = "{:.3g} m to {:.3g} m".format(*parallax.depth_range)
    advice = "leave out --depth-range, or state it in the unit of the poses"
    if depth_range == recording.depth_range:
        advice = "give --depth-range in the unit of the poses, or correct the range that the recording states"
    return f"the depth range is {near:.3g} m to {far:.3g} m, but the parallax of the events shows {shown}; {advice}"


def _contradiction(recording: EventRecording, depth_range: tuple[float, float] | None) -> Problem | None:
    """The gravest contradiction of poses, clock or focal length with the events; None if there is none."""
    agreement = Agreement.of(recording, depth_range, with_frames=False)
    return next(iter(agreement.problems() if agreement else ()), None)


def in_a_clause(problem: Problem) -> str:
    """A problem and its advice as clauses, which can follow "because"."""
    what, (advice, *_) = problem.what.rstrip("."), problem.advice.rstrip(".").split(". ")
    return f"{what[0].lower()}{what[1:]}; {advice[0].lower()}{advice[1:]}"

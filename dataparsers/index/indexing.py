"""The index of a recording's events: read, checked, sorted and cached."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from functools import cache

import numpy as np
from jaxtyping import Int64
from rich import get_console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from enerf_ns.dataparsers.index.event_index import EventIndex
from enerf_ns.dataparsers.index.event_survey import EventStream, Survey, survey_events
from enerf_ns.dataparsers.index.index_cache import build_index, entry_name, load_index
from enerf_ns.dataparsers.recording.errors import OutputError, RecordingError
from enerf_ns.dataparsers.recording.recording import (
    EVENTS_AT_A_TIME,
    EventRecording,
    Events,
    left_out,
    percent,
    seconds,
)

SILENT_SECONDS = 2.0
"""Seconds of indexing before a progress bar is shown."""


@cache
def index_events(recording: EventRecording) -> EventIndex:
    """All events in a recording's span, checked and sorted by pixel, from the cache on disk if they are there.

    Otherwise it reads all events, which takes minutes if there are many, and shows progress. It makes the index once
    for each recording in a process.

    Args:
        recording: From `read_recording`.

    Raises:
        RecordingError: There are no events, a coordinate lies outside the sensor, time goes backwards, times have
            another unit than those of the poses, a polarity is neither {0, 1} nor ±1, no events lie within the poses,
            or no pixel has two events.
        OutputError: The events need more than a quarter of the memory, and there is no room for their index on disk.
    """
    if recording.as_read is not None:
        return index_events(recording.as_read)
    camera, (start, end) = recording.camera, recording.span
    first = next((int(events.t[0]) for events in recording.stream_events() if len(events)), None)
    if first is None:
        raise RecordingError(f"{recording.path} holds no events; give a recording with some.")
    name = entry_name(
        format=recording.format,
        options=recording.read_with,
        files=recording.event_file_states,
        first=first,
        sensor=[camera.width, camera.height],
        span=[start, end],
        keep_hot_pixels=recording.keep_hot_pixels,
    )
    loaded, notes = load_index(name), []
    if loaded is not None:
        index, survey = loaded
    else:
        stream = _with_progress(recording.stream_events, recording.num_events)
        survey = survey_events(stream, camera.width, camera.height, start, end)
        _check(recording, survey)
        if not recording.keep_hot_pixels:
            survey.leave_out_hot_pixels(camera.height)
            if survey.counts.max() < 2:
                hot = len(survey.hot_pixels)
                raise RecordingError(
                    f"{recording.path} holds {survey.num_events:,} events, of which {survey.num_hot_events:,} are from "
                    f"{hot:,} hot pixel{'s' * (hot > 1)}, with over 10 times the events of the neighbourhood, "
                    "and no other pixel has two; keep hot pixels with --keep-hot-pixels True if they are no fault, "
                    "else give another recording."
                )
        try:
            index = build_index(stream, survey, name, notes)
        except ValueError as error:
            raise RecordingError(f"{recording.path} {error}; wait until it is written, then read it again.") from error
        except OSError as error:
            raise OutputError(
                f"{recording.path} holds {survey.counts.sum():,} events, more than fit into a quarter of the memory, "
                f"and their index cannot be stored ({error}); make room, set ENERF_CACHE to another folder, or "
                "use less of the recording with --time-range."
            ) from error
    outside = 0
    if recording.time_range is None:
        outside = survey.num_events - survey.num_hot_events - int(survey.counts.sum())
    if outside:
        notes.append(left_out(outside, survey.num_events, "events"))
    if len(survey.hot_pixels):
        notes.append(
            f"{len(survey.hot_pixels):,} hot pixels, which fire over 10 times as often as their neighbourhood, are "
            f"left out with {survey.num_hot_events:,} events; --keep-hot-pixels True keeps them."
        )
    in_gaps = _count_in_gaps(recording, index)
    if not recording.keep_pose_gaps:
        notes.extend(_gap_notes(recording, in_gaps, len(index)))
    share = outside / survey.num_events
    return replace(index, notes=tuple(notes), share_outside_poses=share, num_in_gaps=in_gaps)


def _count_in_gaps(recording: EventRecording, index: EventIndex) -> int:
    if not len(recording.pose_gaps):
        return 0
    pieces = (index.times[first : first + EVENTS_AT_A_TIME] for first in range(0, len(index), EVENTS_AT_A_TIME))
    return sum(int(recording.trajectory.in_gaps(times.numpy()).sum()) for times in pieces)


def _gap_notes(recording: EventRecording, num_events: int, total: int) -> Iterator[str]:
    if num_events:
        yield (
            f"{num_events:,} of {total:,} events ({percent(num_events / total)}) lie in "
            f"{describe_gaps(recording.pose_gaps)}, and start or end no pair; --keep-pose-gaps True keeps them."
        )
    for what, frames in {"frames": recording.frames, "blurred frames": recording.blurred_frames}.items():
        if frames is not None and (num_frames := int(recording.trajectory.in_gaps(frames.times).sum())):
            yield (
                f"{num_frames:,} of {len(frames.times):,} {what} lie in gaps of the poses and are left out; "
                "--keep-pose-gaps True keeps them."
            )


def describe_gaps(gaps: Int64[np.ndarray, "gaps 2"]) -> str:
    """The gaps of the poses (ns), at least one, in words."""
    begin, end = gaps[np.argmax(gaps[:, 1] - gaps[:, 0])]
    lasts = f"{(end - begin) * 1e-9:.2f} s from {begin * 1e-9:.2f} s on"
    return f"a gap of the poses of {lasts}" if len(gaps) == 1 else f"{len(gaps)} gaps of the poses, the longest {lasts}"


def _check(recording: EventRecording, survey: Survey) -> None:
    path, camera = recording.path, recording.camera
    x, y, t, p = survey.odd_event
    if survey.outside is not None:
        name, value, size = ("x", x, survey.width) if not 0 <= x < survey.width else ("y", y, camera.height)
        raise RecordingError(
            f"{recording.locate(survey.outside)} holds {name} = {value}, which lies outside the sensor of "
            f"{camera.width} x {camera.height} pixels ({name} from 0 to {size - 1}){_why_outside(recording)}."
        )
    if survey.backwards is not None:
        raise RecordingError(
            f"{recording.locate(survey.backwards)} goes back in time from {seconds(survey.last)} to {seconds(t)}, "
            "but events must be in time order; sort them."
        )
    if survey.odd_polarity is not None:
        raise RecordingError(
            f"{recording.locate(survey.odd_polarity)} holds polarity {p}, but a recording's polarities must all be 0 "
            "or 1, or all be -1 or 1."
        )
    recording.check_units(survey.num_events, survey.last - survey.first)
    if not survey.counts.any():
        raise recording.not_covered(survey.first, survey.last)
    if survey.counts.max() < 2:
        raise RecordingError(
            f"{path} holds {survey.counts.sum():,} events within the poses and never two at one pixel, but "
            "learning needs pixels with at least two; give a longer recording."
        )
    if survey.counts.sum() >= 2**31:
        raise RecordingError(
            f"{path} holds {survey.counts.sum():,} events, but an index holds fewer than 2^31; use less of "
            "the recording with --time-range."
        )


def _why_outside(recording: EventRecording) -> str:
    """Words on why events lie outside the sensor, from the largest x and y of all events; empty if none is known."""
    camera, pieces = recording.camera, list(_largest_of_pieces(recording))
    across, down = (max(column) + 1 for column in zip(*pieces, strict=True))
    found = f"; all x lie below {across:,} and all y below {down:,}"
    if across <= camera.width and down <= camera.height:
        return ""  # numbers below 0
    if across <= camera.height and down <= camera.width:
        if camera.has_sides_swapped:
            return f"{found}, so width and height of the calibration seem to be swapped: exchange them"
        return f"{found}, so x and y of the events seem to be swapped: exchange the two columns"
    if (across, down) == (camera.width + 1, camera.height + 1):
        return f"{found}, so coordinates seem to start at 1: subtract 1 from both"
    return f"{found}: give the calibration of this resolution of the sensor"


def _largest_of_pieces(recording: EventRecording) -> Iterator[tuple[int, int]]:
    """The largest x and y of each piece of the events."""
    return ((int(events.x.max()), int(events.y.max())) for events in recording.stream_events() if len(events))


def _with_progress(stream: EventStream, num_events: int | None) -> EventStream:
    """A stream that shows a progress bar after `SILENT_SECONDS`.

    Args:
        stream: The events.
        num_events: Number of events, if known.
    """

    def watched() -> Iterator[Events]:
        columns = (TextColumn("Indexing {task.completed:,} events"), BarColumn(), TimeRemainingColumn())
        progress = Progress(*columns, transient=True, disable=not get_console().is_terminal)
        task = progress.add_task("", total=num_events)
        begin = time.monotonic()
        try:
            for events in stream():
                yield events
                progress.advance(task, len(events))
                if time.monotonic() - begin > SILENT_SECONDS:
                    progress.start()  # has no effect once it has started
        finally:
            if progress.live.is_started:
                progress.stop()

    return watched

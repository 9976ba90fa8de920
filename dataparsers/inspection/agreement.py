"""Compares clocks, poses and calibration of a recording with its events."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float64
from rich import get_console

from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.inspection.focus import (
    AS_READ,
    AS_STATED,
    INVERSE,
    READINGS,
    ROS,
    SCALAR_FIRST,
    SCALAR_LAST,
    EventFocus,
    Hypothesis,
    Reading,
    largest_delay,
)
from enerf_ns.dataparsers.inspection.frame_edges import FrameEdges
from enerf_ns.dataparsers.inspection.frame_tracks import FrameTracks
from enerf_ns.dataparsers.inspection.problems import OpenQuestion, Problem
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.recording import EventRecording
from enerf_ns.dataparsers.recording.trajectory import Trajectory

MILLISECOND = 1_000_000
COARSE_STEP, FINE_STEP, FINE_REACH = 5 * MILLISECOND, MILLISECOND, 5 * MILLISECOND
"""Steps (ns) of the two searches for a delay, and how far the fine search reaches from the best coarse delay."""

FOCAL_SCALES = (0.8, 0.85, 0.9, 0.95, 1.0, 1.05, 1.1, 1.15, 1.2)
"""Multiples of a focal length that are tried."""

OTHER_LENSES = tuple(1.2**step for step in range(-10, 11) if step)
"""Multiples of the stated focal length, from 0.16 to 6.2, that are tried because the calibration may be of another
lens."""

NEAR_AND_FAR_LENSES = (0.4, 0.83, 1.2, 2.5)
"""Multiples of the stated focal length in the quick check, of which one is nearer to the true one if that is wrong."""

FRAME_SCALES = tuple(1.02**step for step in range(-92, 93))
"""Multiples of the focal length of frames that are tried."""

SMALLEST_FIT = 0.6
"""Smallest value of `FrameTracks.fit` at which frames identify a focal length. If no focal length reaches it, something
else is wrong."""

LENS_GAIN = 1.05
"""Factor by which another lens, or another delay in the quick check, must sharpen the events before the best one is
searched. The factor is 1.1 if the focal length is wrong by a fifth."""

SMALLEST_TURN = math.radians(0.5)
"""Angle by which the camera must turn within a window before another lens is tried. Without turns, the focal length
trades with depth, and the sharpest focal length is far from the true one."""

SCALE_REACH = 0.06
"""Distance from the best scale within which other scales refine it."""

LARGEST_DELAY_ERROR = 3.0
"""Largest standard error (ms) of an identifiable delay."""

LARGEST_SCALE_ERROR, LARGEST_SCALE_ERROR_SHARE = 0.02, 0.1
"""Largest standard error of an identifiable scale of the focal length, and the same as a share of its difference from
1. The scale of another lens need not be known as well."""

FEWEST_SAMPLES = 3
"""Fewest frames, or tiles of windows, that give a standard error."""

HARMFUL_SHIFT = 0.95
"""Pixels by which a clock may shift the picture. In dim light, the latency of a sensor's pixels is some
milliseconds."""

HARMFUL_SCALE = 0.03
"""Share by which a focal length may differ from the best one."""

CLEARLY = 1.25
"""Factor by which the right reading of the poses must be sharper than the wrong ones. It is 1.9 for known poses."""

EXPLAINED = 1.1
"""Factor by which free motion may be sharper than poses that explain the events. It is 0.72 to 1.01 for the right poses
of 16 simulated recordings and slider_depth, 1.07 for one of them at half its resolution, and 1.14 or more for wrong
readings and poses of another time. Strong edges make it 2 for right poses, too."""

STRUCTURED = 1.5
"""Smallest mean free sharpness of windows whose events follow a motion. Where events lie at random places, it is 1.2 to
1.4, since free motion finds more by chance than poses do."""

LONGER_WINDOWS = (1.0, 4.0, 16.0)
"""Multiples of the assumed depth of the scene that are tried until the readings of the poses differ clearly. With too
small a depth, which wrong poses often show, windows are too short for that."""

ALIKE = 0.97
"""Share of the best sharpness above which another reading of the poses is as likely as the best one."""

LIKELY_READINGS = 4
"""Number of readings of the poses with which the delay is searched anew if no reading is clearly the sharpest."""

SHOWN_DELAYS = (-20, -5, 5, 20)
"""Delays of the poses (ms) whose sharpness is shown."""

SHOWN_SCALES = (0.9, 1.1)
"""Multiples of the focal length whose sharpness is shown."""


FITS = "whether poses, clocks and calibration fit the events"
"""The question that the search answers."""


@dataclass(frozen=True)
class Estimate:
    """The value that fits best."""

    value: float
    error: float
    """Standard error, by bootstrap."""
    is_identifiable: bool
    """Whether the recording determines the value. If not, value and error mean nothing."""

    @property
    def may_be_zero(self) -> bool:
        """Whether the value is identifiable and does not differ significantly from 0."""
        return self.is_identifiable and abs(self.value) <= 3 * self.error


@dataclass(frozen=True)
class CornerFit:
    """The agreement of corners of frames with poses and calibration."""

    camera: Camera
    """Camera of the frames."""
    focal_scale: Estimate
    """Best focal length of that camera, as a multiple of the stated one."""
    error: float
    """Median reprojection error of the corners with the stated focal length, pixels."""
    least_error: float
    """Median reprojection error of the corners with the best focal length, pixels."""


class _Trials:
    """Sharpness of the hypotheses that were tried, each computed once."""

    def __init__(self, focus: EventFocus):
        self.focus = focus
        self.tried: dict[Hypothesis, Float64[np.ndarray, " samples"]] = {}

    def curve(self, hypotheses: list[Hypothesis]) -> Float64[np.ndarray, "hypotheses samples"]:
        """The sharpness of each sample of events under each hypothesis."""
        for hypothesis in hypotheses:
            if hypothesis not in self.tried:
                self.tried[hypothesis] = self.focus.sharpness(hypothesis)
        return np.stack([self.tried[hypothesis] for hypothesis in hypotheses])

    def height(self, hypothesis: Hypothesis) -> float:
        """The sharpness of all events under a hypothesis."""
        return float(self.curve([hypothesis]).sum())

    def delay(self, reading: Reading, scale: float) -> Estimate:
        """The best delay of the poses (ms) for one focal length."""
        return _best_delay(
            lambda delays: self.curve([Hypothesis(delay, scale, reading) for delay in delays.tolist()]),
            self.focus.largest_delay,
        )

    def delayed(self, reading: Reading) -> list[Hypothesis]:
        """The reading with its best delay; none if that is close to the largest, since the sharpness of wrong poses may
        grow up to there."""
        delay = round(self.delay(reading, 1.0).value * MILLISECOND)
        return [Hypothesis(delay, reading=reading)] if abs(delay) <= self.focus.largest_delay - FINE_REACH else []

    def focal_scale(self, reading: Reading, delay: Estimate, lens: float) -> Estimate:
        """The best focal length around that of a lens, both as multiples of the stated one.

        Args:
            reading: Of the poses.
            delay: Of the poses, ms. It counts only if it is identifiable.
            lens: Focal length of the lens.
        """
        scales, known = [lens * scale for scale in FOCAL_SCALES], delay.value * delay.is_identifiable
        scales = [scale for scale in scales if self.focus.allows(scale)]
        curves = self.curve([Hypothesis(round(known * MILLISECOND), scale, reading) for scale in scales])
        largest = max(LARGEST_SCALE_ERROR, LARGEST_SCALE_ERROR_SHARE * abs(lens - 1))
        return _estimate(np.array(scales), curves, lens * SCALE_REACH, largest)

    def clock_and_lens(self, reading: Reading, lens: float) -> tuple[Estimate, Estimate]:
        """The best delay of the poses (ms), and the best focal length around that of a lens.

        If the focal length is wrong, both are searched once more, since either error hides a part of the other.
        """
        delay = self.delay(reading, lens)
        scale = self.focal_scale(reading, delay, lens)
        if scale.is_identifiable and abs(scale.value - 1) > HARMFUL_SCALE / 2:
            delay = self.delay(reading, scale.value)
            scale = self.focal_scale(reading, delay, lens)
        return delay, scale


def clock_and_lens(recording: EventRecording, distance: float) -> tuple[Estimate, Estimate] | None:
    """The delay of the poses (ms), and the focal length (a multiple of the stated one), that make events sharpest.

    Takes about two seconds.

    Args:
        recording: Its index is made if it is not there yet.
        distance: Usual depth of the scene, metres.

    Returns:
        None if the events are too few, or the recording is too short. If the camera hardly turns, the focal length is
        not identifiable.
    """
    trials = _Trials(EventFocus(recording, distance))
    if not trials.focus.windows:
        return None
    if trials.focus.turn < SMALLEST_TURN:
        return trials.delay(AS_READ, 1.0), Estimate(1.0, math.inf, False)
    return trials.clock_and_lens(AS_READ, 1.0)


def is_in_focus(recording: EventRecording, distance: float) -> bool:
    """Whether events are sharpest with poses, clock and focal length as stated. Takes about a second.

    Args:
        recording: Its index is made if it is not there yet.
        distance: Usual depth of the scene, metres.

    Returns:
        True also if there are too few events to compare.
    """
    trials = _Trials(EventFocus(recording, distance))
    if not trials.focus.windows:
        return True
    focus, heights = trials.focus, {one: trials.height(Hypothesis(reading=one)) for one in (AS_READ, *READINGS)}
    readings, is_clear = _best_readings(recording.trajectory, heights, focus.turn < SMALLEST_TURN)
    if AS_READ not in readings:
        return False
    delays = [delay * MILLISECOND for delay in SHOWN_DELAYS if abs(delay) * MILLISECOND <= focus.largest_delay]
    others, as_stated = [trials.height(Hypothesis(delay)) for delay in delays], heights[AS_READ]
    if not (is_clear or focus.has_strong_edges or _is_as_sharp_as_can_be(focus, as_stated, others)):
        return False
    if _is_unsharp(focus, max([as_stated, *others])):
        return False
    if focus.turn >= SMALLEST_TURN:
        others += [trials.height(Hypothesis(focal_scale=lens)) for lens in NEAR_AND_FAR_LENSES if focus.allows(lens)]
    return all(other < LENS_GAIN * as_stated for other in others)


def _is_as_sharp_as_can_be(focus: EventFocus, as_stated: float, delayed: list[float]) -> bool:
    """Whether no motion makes the events much sharper than the stated poses do, and no delay a little sharper.

    Poses may be right then, although dense texture or an even slide leaves other readings of them almost as sharp.

    Args:
        focus: Of the recording.
        as_stated: Sharpness with the poses as stated.
        delayed: Sharpness with each of `SHOWN_DELAYS`.
    """
    return focus.free_sharpness < EXPLAINED * as_stated and ALIKE * max(delayed, default=0.0) < as_stated


def _is_unsharp(focus: EventFocus, sharpest: float) -> bool:
    """Whether free motion makes the events much sharper than the best of some hypotheses, and not by chance.

    Poses with a drift of several pixels are so, although other readings of them may be clearly less sharp.
    """
    least = max(EXPLAINED * sharpest, STRUCTURED * len(focus.windows))
    return not focus.chance and focus.free_sharpness >= least


def clock_of_frames(recording: EventRecording, depth_range: tuple[float, float]) -> Estimate | None:
    """Milliseconds by which frames are stamped later than events of the same instant, from edges in both.

    Args:
        recording: Its index is made if it is not there yet.
        depth_range: Nearest and farthest depth, metres.

    Returns:
        None if there are too few frames, or events.
    """
    edges = FrameEdges.of(recording, depth_range, largest_delay(recording))
    return None if edges is None else _plane_and_frame_delay(edges, largest_delay(recording))[1]


def _plane_and_frame_delay(edges: FrameEdges, largest: int) -> tuple[int, Estimate]:
    """Number of the plane at which events fit frames best, and by how many milliseconds frames are stamped late."""
    plane = edges.best_plane(_coarse_delays(largest))
    early = _best_delay(lambda delays: edges.likeness(delays, plane), largest)
    return plane, replace(early, value=-early.value)


def usual_depth(recording: EventRecording, depth_range: tuple[float, float] | None) -> float:
    """The geometric mean of a depth range, metres; the extent of the camera's path if the range is unknown."""
    near, far = depth_range or 2 * (float(np.linalg.norm(np.ptp(recording.trajectory.positions, axis=0))) or 1.0,)
    return math.sqrt(near * far)


def why_no_search(recording: EventRecording, depth_range: tuple[float, float] | None) -> OpenQuestion | None:
    """The reason why events cannot be compared with poses and calibration; None if they can.

    Args:
        recording: Its index is made if it is not there yet.
        depth_range: Nearest and farthest depth, metres, if known.
    """
    camera, focus = recording.camera, EventFocus(recording, usual_depth(recording, depth_range))
    if focus.windows:
        return None
    why = "no part of the recording has enough events while the picture moves a little"
    if focus.is_small:
        why = f"a sensor of {camera.width} x {camera.height} pixels shows too little, or {why}"
    return OpenQuestion(FITS, why)


@dataclass(frozen=True, eq=False)
class Agreement:
    """The agreement of poses, clocks and focal length of a recording with its events."""

    focus: EventFocus
    edges: FrameEdges | None
    """None without frames."""
    plane: int
    """Number of the plane of `edges` at which events are drawn."""
    sharpness: dict[Hypothesis, float]
    """Sharpness of each hypothesis that was tried. Only ratios have a meaning."""
    readings: list[Reading]
    """Readings of the poses that make events sharpest, all about as sharp. `AS_READ` is the first if nothing is
    wrong."""
    is_clear: bool
    """Whether these readings are clearly sharper than all others."""
    pose_delay: Estimate
    """Milliseconds by which the poses are stamped later than events of the same instant."""
    frame_delay: Estimate | None
    """Milliseconds by which frames are stamped later than events of the same instant. None without frames."""
    focal_scale: Estimate
    """Best focal length, as a multiple of the stated one."""
    corners: CornerFit | None
    """None without frames in which the same corners are found."""

    @classmethod
    def of(
        cls, recording: EventRecording, depth_range: tuple[float, float] | None, with_frames: bool = True
    ) -> Agreement | None:
        """Tries other clocks, readings of the poses and focal lengths.

        Takes some seconds, and a minute or two if no reading is clearly the sharpest. A terminal shows that it is at
        work.

        Args:
            recording: Its index is made if it is not there yet.
            depth_range: Nearest and farthest depth, metres, if known.
            with_frames: Whether frames are compared, too.

        Returns:
            None if the events are too few, or the recording is too short.
        """
        usual = usual_depth(recording, depth_range)
        near, far = depth_range or (usual, usual)
        index_events(recording)  # which may show a bar of its own
        with get_console().status("Comparing the events with poses, clocks and calibration"):
            search = _search(recording, usual)
            if search is None:
                return None
            trials, readings, is_clear, lens = search
            focus = trials.focus
            pose_delay, focal_scale = trials.clock_and_lens(readings[0], lens)
            trials.curve([hypothesis for hypothesis in shown_hypotheses() if focus.allows(hypothesis.focal_scale)])
        total = {hypothesis: float(curves.sum()) for hypothesis, curves in trials.tried.items()}
        of_events = cls(focus, None, 0, total, readings, is_clear, pose_delay, None, focal_scale, None)
        if not with_frames:
            return of_events

        edges, plane, frame_delay, apart = FrameEdges.of(recording, (near, far), focus.largest_delay), 0, None, 0
        if edges is not None:
            plane, frame_delay = _plane_and_frame_delay(edges, focus.largest_delay)
            if frame_delay.is_identifiable and pose_delay.is_identifiable:
                apart = round((pose_delay.value - frame_delay.value) * MILLISECOND)
        tracks = FrameTracks.of(recording)
        corners = None if tracks is None else _fit_corners(tracks, near / 2, apart)
        return replace(of_events, edges=edges, plane=plane, frame_delay=frame_delay, corners=corners)

    def verdict(self) -> str:
        """One sentence on whether poses, clocks and calibration agree with the events."""
        if found := self.problems():
            return found[0].what
        if not self.is_clear:
            return self.unknown()[0].sentence
        unknown = self._unidentified
        apart = self.pixels(float(np.ptp([*self._lateness().values()])))
        verdict = f"poses, clocks and calibration agree with the events to {apart:.1f} pixels"
        if unknown:
            verb = "is" if len(unknown) == 1 else "are"
            verdict += f"; {' and '.join(unknown)} {verb} not identifiable from this recording"
        return verdict

    @property
    def _why_open(self) -> str:
        """The reason why it stays open whether poses fit if no reading of them is clearly the sharpest, as a clause;
        empty if they do not fit."""
        delayed = [height for one, height in self.sharpness.items() if one in shown_hypotheses() and one.delay]
        if _is_as_sharp_as_can_be(self.focus, self.sharpness[AS_STATED], delayed):
            return "no motion makes the events much sharper than the poses do"
        return self.focus.chance

    @property
    def _unidentified(self) -> list[str]:
        """Names of the values that this recording does not identify."""
        delays = {"the clock of the poses": self.pose_delay, "the clock of the frames": self.frame_delay}
        unknown = [what for what, delay in delays.items() if delay is not None and not delay.is_identifiable]
        is_unknown = not self.focal_scale.is_identifiable and self._by_frames is None
        return unknown + ["the focal length"] * is_unknown

    def unknown(self) -> list[OpenQuestion]:
        """Questions that the search leaves open. None if it found a problem."""
        if self.problems():
            return []
        if not self.is_clear:
            alike = "other readings of the poses make the events about as sharp"
            return [OpenQuestion(FITS, f"{self._why_open}, and {alike}")]
        others = [reading for reading in self.readings if reading is not AS_READ]
        alike = [OpenQuestion("how the poses are to be read", f"{_either(others)} fit as well")] if others else []
        why = "this recording does not identify it"
        return alike + [OpenQuestion(f"whether {what} is right", why) for what in self._unidentified]

    def rows(self) -> dict[str, str]:
        """The measurements in words, by name."""
        others = "; ".join(reading.words for reading in self.readings if reading is not AS_READ)
        if not self.is_clear:
            poses = f"{'other readings are about as' if self._why_open else 'no reading makes the events'} sharp"
        elif AS_READ in self.readings:
            poses = "sharpest as they were read"
        else:
            poses, others = f"sharpest as {others}", ""
        rows = {"verdict": self.verdict(), "poses": poses}
        if others:
            rows["equally sharp"] = others
        for what, delay in (("poses", self.pose_delay), ("frames", self.frame_delay)):
            if delay is not None:
                rows[f"clock of {what}"] = self._clock(delay)
        scale = self.focal_scale
        rows["focal length"] = (
            f"{scale.value:.3f} ± {scale.error:.3f} of the stated one fits best"
            if scale.is_identifiable
            else "not identifiable from this recording: if the camera hardly turns, the focal length trades with depth"
        )
        if self.corners is not None:
            fit, scale = self.corners, self.corners.focal_scale
            rows["focal length by frames"] = f"reprojection error of corners {fit.error:.2f} pixels" + (
                f"; {fit.least_error:.2f} pixels with the best focal length, {scale.value:.3f} ± {scale.error:.3f} of "
                "the stated one"
                if scale.is_identifiable
                else ", which does not identify the focal length"
            )
        shown = "; ".join(f"{name}: {value}" for name, value in self.shown().items())
        rows["sharpness"] = f"as stated: 100 %; {shown}"
        return rows

    def shown(self) -> dict[str, str]:
        """Sharpness with wrong clocks and focal lengths, in per cent of the sharpness as stated, by name."""
        stated = self.sharpness[AS_STATED]
        return {
            hypothesis.words: f"{100 * self.sharpness[hypothesis] / stated:.1f} %"
            for hypothesis in shown_hypotheses()
            if hypothesis in self.sharpness
        }

    def problems(self) -> list[Problem]:
        """Contradictions between recording and events, the gravest first."""
        focal = list(self._focal_problems())
        is_unsharp = _is_unsharp(self.focus, max(self.sharpness.values()))
        if focal and not FOCAL_SCALES[0] <= self.focal_scale.value <= FOCAL_SCALES[-1] and not is_unsharp:
            return focal  # with the calibration of another lens, poses and clocks do not fit either
        if is_unsharp or not (self.is_clear or self._why_open):
            return [
                Problem(
                    "No reading of the poses makes the events sharp, with any delay of their clock within "
                    f"{self.focus.largest_delay * 1e-6:.0f} ms or any focal length: poses and events do not belong "
                    "together, or the poses drift.",
                    "Check that the poses are those of this recording, the unit of their times, and the calibration.",
                )
            ]
        if not self.is_clear:
            return [*self._pose_problems()]
        of_frames = [] if focal and self._is_one_camera else self._frame_focal_problems()
        return [*self._pose_problems(), *self._clock_problems(), *focal, *of_frames]

    def _pose_problems(self) -> Iterator[Problem]:
        if AS_READ not in self.readings:
            gain = self.sharpness[Hypothesis(reading=self.readings[0])] / self.sharpness[AS_STATED]
            yield Problem(
                f"The poses fit the events when they are read as {_either(self.readings)}: events are then "
                f"{gain:.1f} times as sharp.",
                f"{self._mend_of_readings()}; poses are read camera to world, with quaternions x y z w and OpenCV's "
                "axes of the camera (x right, y down, z forward).",
            )
        elif SCALAR_FIRST in self.readings and _is_half_turn(self.focus.recording.trajectory):
            yield Problem(
                "All poses are turned by half a turn about x: their quaternions x y z w are 1 0 0 0, which in the "
                "order w x y z, or with OpenGL's axes of the camera, is no turn at all.",
                "Check the order of the quaternions and the axes, which this motion does not show. Learning is as good "
                "either way, but the scene may stand upside down.",
            )

    @property
    def mended_reading(self) -> Reading | None:
        """The convention that alone fits the poses, if it is another one than they were read in, and no mirror
        image."""
        reading, *others = self.readings
        return reading if self.is_clear and reading is not AS_READ and not others and reading.is_rotation else None

    def _mend_of_readings(self) -> str:
        """The advice if the events contradict the reading in which the poses were read."""
        likeliest, *others = self.readings
        fault = likeliest.fault_of_events and f"if the poses are right, {likeliest.fault_of_events}"
        if others:
            return "This motion does not show which of these readings is right" + (f"; {fault}" if fault else "")
        if likeliest.exchanges:
            return fault[0].upper() + fault[1:]
        is_of_camera = self.focus.recording.trajectory.body is None  # else the poses in the file are those of a body
        accepts = self.mended_reading is not None and is_of_camera
        mended = ", or let enerf convert --accept-found write a recording with poses that fit" if accepts else ""
        return f"{_mend(likeliest)} in their file{mended}" + (f"; or, {fault}" if fault else "")

    def _clock_problems(self) -> Iterator[Problem]:
        late = self._lateness()
        apart = max(late.values()) - min(late.values())
        error = max(
            (delay.error for delay in (self.pose_delay, self.frame_delay) if delay and delay.is_identifiable), default=0
        )
        if self.pixels(apart) < HARMFUL_SHIFT or apart < 3 * error:
            return
        clocks = " and ".join(
            f"the {what} are stamped {_late(delay)}" for what, delay in late.items() if what != "events"
        )
        rest = {what: [late[other] for other in late if other != what] for what in late}
        alone = [what for what, others in rest.items() if len(others) == 1 or np.ptp(others) < apart / 4]
        advice = "Shift the times of poses and frames by these amounts"
        if alone:
            by = late[alone[0]] - float(np.mean(rest[alone[0]]))
            shift = f"Take {by:.1f} ms off" if by > 0 else f"Add {-by:.1f} ms to"
            advice = f"{shift} the times of the {alone[0]}"
        yield Problem(
            f"The clocks disagree by {apart:.1f} ± {error:.1f} ms, in which the picture moves by "
            f"{self.pixels(apart):.1f} pixels: {clocks} against the events of the same instant.",
            f"{advice}, or look for the cause of the delay. Training with enerf corrects a clock by itself.",
        )

    def _focal_problems(self) -> Iterator[Problem]:
        scale, by_frames = self.focal_scale, self._by_frames
        if _is_wrong(scale) and (by_frames is None or _is_wrong(by_frames)):
            yield Problem(
                f"The focal length is wrong: {scale.value:.3f} ± {scale.error:.3f} of the stated one fits the events "
                f"best, {scale.value * self.focus.recording.camera.fx:.1f} pixels.",
                f"Multiply fx and fy of the calibration by {scale.value:.3f}, if it is of another lens or another "
                "resolution of the sensor.",
            )

    def _frame_focal_problems(self) -> Iterator[Problem]:
        if self.corners is None or AS_READ not in self.readings:
            return
        fit, scale = self.corners, self.corners.focal_scale
        if _is_wrong(scale):
            yield Problem(
                f"The focal length of the frames is wrong: with {scale.value:.3f} ± {scale.error:.3f} of the stated "
                f"one, {scale.value * fit.camera.fx:.1f} pixels, the reprojection error of corners is "
                f"{fit.least_error:.1f} pixels, and {fit.error:.1f} pixels with the stated one.",
                "Check the calibration, and whether it is of this lens and the resolution of these frames.",
            )

    @property
    def _by_frames(self) -> Estimate | None:
        """The focal length that frames of the same camera identify, better than events do; None if they do not."""
        if self.corners is None or not self._is_one_camera or not self.corners.focal_scale.is_identifiable:
            return None
        return self.corners.focal_scale

    @property
    def _is_one_camera(self) -> bool:
        """Whether frames and events come from one camera, so that frames identify the focal length of both."""
        return self.corners is not None and self.corners.camera == self.focus.recording.camera

    def _lateness(self) -> dict[str, float]:
        """Milliseconds by which each identifiable clock is late against the clock of the events, by name."""
        delays = {"poses": self.pose_delay, "frames": self.frame_delay}
        known = {what: delay.value for what, delay in delays.items() if delay is not None and delay.is_identifiable}
        return known | {"events": 0.0}

    def _clock(self, delay: Estimate) -> str:
        if not delay.is_identifiable:
            return "not identifiable from this recording"
        return (
            f"{_late(delay.value)} (± {delay.error:.1f} ms) against the events: {self.pixels(delay.value):.1f} pixels"
        )

    def pixels(self, delay: float) -> float:
        """Pixels by which the picture moves during a delay (ms) while the camera is fast."""
        return abs(delay) * 1e-3 * self.focus.speed


def _search(recording: EventRecording, distance: float) -> tuple[_Trials, list[Reading], bool, float] | None:
    """The trials of readings of the poses; the best readings; whether they are clear; and a lens around which the focal
    length is searched, as a multiple of the stated one.

    Args:
        recording: Its index is made if it is not there yet.
        distance: Usual depth of the scene, metres.

    Returns:
        None if the events are too few, or the recording is too short.
    """
    found = None
    for longer in LONGER_WINDOWS:
        trials = _Trials(EventFocus(recording, longer * distance))
        if not trials.focus.windows:
            continue
        tried_for_all = [Hypothesis(), *trials.delayed(AS_READ)]
        other = _other_lens(trials, tried_for_all) if trials.focus.turn >= SMALLEST_TURN else None
        tried_for_all += [] if other is None else [other]
        heights = {
            reading: float(trials.curve([replace(one, reading=reading) for one in tried_for_all]).sum(1).max())
            for reading in (AS_READ, *READINGS)
        }
        slides = trials.focus.turn < SMALLEST_TURN
        readings, is_clear = _best_readings(recording.trajectory, heights, slides)
        if trials.focus.has_strong_edges and not is_clear:
            return trials, readings, is_clear, 1.0  # no further search can tell readings apart
        if not is_clear:  # the delay was searched with the poses as they were read
            for reading in sorted(heights, key=heights.__getitem__, reverse=True)[:LIKELY_READINGS]:
                for delayed in trials.delayed(reading):
                    heights[reading] = max(heights[reading], trials.height(delayed))
            readings, is_clear = _best_readings(recording.trajectory, heights, slides)
        if not is_clear and max(heights, key=heights.__getitem__) is AS_READ:
            is_clear = trials.delay(AS_READ, 1.0).may_be_zero
        lens = other.focal_scale if other is not None and AS_READ in readings else 1.0
        if found is None or is_clear:
            found = trials, readings, is_clear, lens
        if is_clear:
            break
    return found


def shown_hypotheses() -> list[Hypothesis]:
    """Wrong clocks and focal lengths whose sharpness is shown beside that of the stated ones."""
    return [
        *(Hypothesis(delay * MILLISECOND) for delay in SHOWN_DELAYS),
        *(Hypothesis(focal_scale=scale) for scale in SHOWN_SCALES),
    ]


def _late(delay: float) -> str:
    return f"{abs(delay):.1f} ms {'late' if delay > 0 else 'early'}"


def _is_wrong(scale: Estimate) -> bool:
    """Whether the best focal length differs from the stated one, significantly and by more than is harmless."""
    return scale.is_identifiable and abs(scale.value - 1) > max(HARMFUL_SCALE, 3 * scale.error)


def _coarse_delays(largest: int) -> np.ndarray:
    return np.arange(-(largest // COARSE_STEP), largest // COARSE_STEP + 1) * COARSE_STEP


def _best_delay(curve: Callable[[np.ndarray], np.ndarray], largest: int) -> Estimate:
    """The delay (ms) at which a curve is highest, from a coarse search and a fine one.

    A delay close to the largest one is not identifiable, since the true one may lie beyond.

    Args:
        curve: Gives the height of each sample (delays, samples) at some delays (ns).
        largest: Largest delay, ns.
    """
    delays = _coarse_delays(largest)
    curves = curve(delays)
    best = int(delays[curves.sum(1).argmax()])
    around = np.arange(best - FINE_REACH, best + FINE_REACH + 1, FINE_STEP)
    around = np.setdiff1d(around[np.abs(around) <= largest], delays)
    if len(around):
        curves, delays = np.concatenate([curves, curve(around)]), np.append(delays, around)
    order = np.argsort(delays)
    found = _estimate(delays[order] / MILLISECOND, curves[order], FINE_REACH / MILLISECOND, LARGEST_DELAY_ERROR)
    within = MILLISECOND * abs(found.value) <= largest - FINE_REACH
    return replace(found, is_identifiable=found.is_identifiable and within)


def _other_lens(trials: _Trials, stated: list[Hypothesis]) -> Hypothesis | None:
    """The hypothesis of another lens that makes events clearly sharper than the stated one. None if there is none.

    Args:
        trials: Of the recording.
        stated: Hypotheses with the stated focal length.
    """
    lenses = [lens for lens in OTHER_LENSES if trials.focus.allows(lens)]
    if not lenses:
        return None
    hypotheses = [replace(hypothesis, focal_scale=lens) for lens in lenses for hypothesis in stated]
    heights = trials.curve(hypotheses).sum(1).reshape(len(lenses), -1)
    best = int(heights.max(1).argmax())
    is_top = 0 < best < len(lenses) - 1
    if not is_top or heights[best].max() < LENS_GAIN * trials.curve(stated).sum(1).max():
        return None
    return replace(stated[heights[best].argmax()], focal_scale=lenses[best])


def _fit_corners(tracks: FrameTracks, nearest: float, delay: int) -> CornerFit:
    """The focal length with the least reprojection errors of corners.

    Args:
        tracks: Corners that were followed.
        nearest: Least depth of the scene, metres.
        delay: How much later the poses are stamped than frames of the same instant, ns.
    """
    fits = np.stack([tracks.fit(nearest, scale, delay) for scale in FRAME_SCALES])
    found = _estimate(np.log(FRAME_SCALES), fits, SCALE_REACH, math.inf)
    scale, error = math.exp(found.value), math.exp(found.value) * found.error
    largest = max(LARGEST_SCALE_ERROR, LARGEST_SCALE_ERROR_SHARE * abs(scale - 1))
    is_identifiable = found.is_identifiable and error <= largest and fits.mean(1).max() >= SMALLEST_FIT
    errors = (float(np.median(np.concatenate(tracks.reprojection_errors(nearest, one, delay)))) for one in (1.0, scale))
    return CornerFit(tracks.frames.camera, Estimate(scale, error, is_identifiable), *errors)


def _estimate(
    values: Float64[np.ndarray, " values"], curves: Float64[np.ndarray, "values samples"], reach: float, largest: float
) -> Estimate:
    """The value at which the sum of curves is highest, refined by a parabola through the values within reach of it.

    The error is the standard deviation over 200 bootstraps of the samples.

    Args:
        values: In ascending order.
        curves: Height of each sample at each value.
        reach: Distance from the highest value within which others refine it.
        largest: Largest error of an identifiable value.
    """
    generator = np.random.default_rng(0)
    number = curves.shape[1]
    weights = np.concatenate([np.ones((1, number)), generator.multinomial(number, np.full(number, 1 / number), 200)])
    heights = weights @ curves.T
    tops = np.array([_top(values, height, reach) for height in heights])
    at_the_edge = heights[0].argmax() in (0, len(values) - 1)
    error = float(tops[1:].std())
    return Estimate(float(tops[0]), error, number >= FEWEST_SAMPLES and not at_the_edge and error <= largest)


def _top(values: np.ndarray, heights: np.ndarray, reach: float) -> float:
    highest = values[heights.argmax()]
    near = np.abs(values - highest) <= reach
    if near.sum() < 3 or not heights.max():
        return float(highest)
    square, linear, _ = np.polyfit(values[near] - highest, heights[near] / heights.max(), 2)
    return float(highest + np.clip(-linear / (2 * square), -reach, reach)) if square < 0 else float(highest)


def _best_readings(trajectory: Trajectory, heights: dict[Reading, float], slides: bool) -> tuple[list[Reading], bool]:
    """The readings that make events sharpest, the likeliest first, and whether they are clearly sharper than others.

    Args:
        trajectory: As it was read.
        heights: Sharpness of each reading.
        slides: Whether the camera hardly turns. Readings that turn or mirror the scene about the slide are then nearly
            as sharp, and up to half of all readings need not be clearly less sharp.
    """
    level = np.all(np.abs(_quaternions(trajectory)[:, :3]) < 1e-6)  # another order would turn each pose by half a turn
    plausible = [reading for reading in heights if not (level and reading in (SCALAR_FIRST, SCALAR_LAST))]
    best = max(heights[reading] for reading in plausible)
    if best <= CLEARLY * heights[AS_READ]:
        best = heights[AS_READ]
    sharpest = [reading for reading in plausible if heights[reading] > ALIKE * best]
    ladder = sorted((heights[reading] for reading in plausible), reverse=True)
    first, last = len(sharpest), max(len(sharpest), len(ladder) // 2 if slides else 0)
    steps = list(pairwise([*ladder, 0.0]))[first - 1 : last]
    return sharpest, any(sharper > CLEARLY * other for sharper, other in steps)


def _either(readings: list[Reading]) -> str:
    words = [reading.words for reading in readings[:3]]
    return ", or ".join(words) + (", or otherwise turned or mirrored" if len(readings) > 3 else "")


def _mend(reading: Reading) -> str:
    """Change of a file of poses in this reading to the convention in which files are read, as an instruction."""
    if reading is INVERSE:
        return "Invert each pose, R to its transpose R' and t to -R' t,"
    if reading is SCALAR_FIRST:
        return "Move the first number of each quaternion behind the other three"
    if reading is SCALAR_LAST:
        return "Move the last number of each quaternion before the other three"
    if reading is ROS:
        return "Multiply the rotation matrix of each pose from the right by ((0, 0, 1), (-1, 0, 0), (0, -1, 0))"
    signs = f"diag({', '.join(f'{sign:g}' for sign in reading.signs)})"
    if np.prod(reading.signs) < 0:  # a rotation stays one only if an axis of the world is mirrored, too
        return f"Mirror each pose, R to M R M and t to M t with M = {signs},"
    return f"Multiply the rotation matrix of each pose from the right by {signs}"


def _is_half_turn(trajectory: Trajectory) -> bool:
    return bool(np.all(np.abs(_quaternions(trajectory)[:, 1:]) < 1e-6))


def _quaternions(trajectory: Trajectory) -> Float64[np.ndarray, "poses 4"]:
    """Quaternions x y z w as they were read: of the body, if the camera is mounted on one."""
    return (trajectory.body[0] if trajectory.body else trajectory).quaternions

"""Whether clock, poses and calibration of a recording agree with its events, in numbers and in words."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64

from enerf_ns.dataparsers.inspection.focus import (
    AS_READ,
    AS_STATED,
    READINGS,
    SCALAR_FIRST,
    SCALAR_LAST,
    EventFocus,
    Hypothesis,
    Reading,
)
from enerf_ns.dataparsers.inspection.frame_edges import FrameEdges
from enerf_ns.dataparsers.inspection.frame_tracks import FrameTracks
from enerf_ns.dataparsers.inspection.problems import Problem
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.recording import EventRecording
from enerf_ns.dataparsers.recording.trajectory import Trajectory

MILLISECOND = 1_000_000
COARSE_STEP, FINE_STEP, FINE_REACH = 5 * MILLISECOND, MILLISECOND, 5 * MILLISECOND
"""Steps (ns) in which delays are searched: over all, and then around the best."""

FOCAL_SCALES = (0.8, 0.85, 0.9, 0.95, 1.0, 1.05, 1.1, 1.15, 1.2)
"""Multiples of a focal length among which the best is looked for."""

OTHER_LENSES = tuple(1.2**step for step in range(-10, 11) if step)
"""Multiples of the stated focal length, from 0.16 to 6.2, that are tried since a calibration may be of another lens."""

FRAME_SCALES = tuple(1.02**step for step in range(-92, 93))
"""Multiples of the focal length of frames that are tried."""

SMALLEST_FIT = 0.6
"""Share of all corners' possible misses by which they must be missed less, for frames to tell a focal length: where no
focal length fits, something else is wrong."""

LENS_GAIN = 1.05
"""Factor by which events must be sharper with another lens than with the stated one for the best to be looked for
there; they are so by 1.1 where the focal length is wrong by a fifth."""

SMALLEST_TURN = math.radians(0.5)
"""By how much the camera must turn within a window for another lens to be looked for: without turns it trades with
depth, and the sharpest one is far off."""

SCALE_REACH = 0.06
"""How far from the best scale others count when it is refined."""

LARGEST_DELAY_ERROR = 3.0
"""Milliseconds of standard error up to which a delay is said to be told."""

LARGEST_SCALE_ERROR, LARGEST_SCALE_ERROR_SHARE = 0.02, 0.1
"""Standard error up to which the scale of the focal length is said to be told, and the same as a share of how far off
it is: of another lens, less needs to be known."""

FEWEST_SAMPLES = 3
"""Fewest frames, or tiles of windows, from which an error can be estimated."""

HARMFUL_SHIFT = 0.95
"""Pixels that clocks may shift the picture; the latency of a sensor's pixels in dim light is some milliseconds."""

HARMFUL_SCALE = 0.03
"""Share by which a focal length may differ from the best."""

CLEARLY = 1.25
"""Factor by which the right reading of the poses is sharper than wrong ones; it is 1.9 where they are known."""

ALIKE = 0.97
"""Share of the best reading's sharpness above which the motion does not tell another one from it."""

SHOWN_DELAYS = (-20, -5, 5, 20)
"""Delays of the poses' clock, milliseconds, whose sharpness is shown."""

SHOWN_SCALES = (0.9, 1.1)
"""Scales of the focal length whose sharpness is shown."""


@dataclass(frozen=True)
class Estimate:
    """A value that fits best."""

    value: float
    error: float
    """Its standard error, by bootstrap."""
    is_told: bool
    """Whether the recording tells it."""


@dataclass(frozen=True)
class CornerFit:
    """Whether corners of frames go where poses and calibration let them."""

    camera: Camera
    """Of the frames."""
    focal_scale: Estimate
    """Best focal length, as a multiple of the stated one."""
    miss: float
    """Median distance of corners from where they can be, pixels; `least_miss` is that with the best focal length."""
    least_miss: float


class _Trials:
    """What was tried of a recording, each hypothesis once."""

    def __init__(self, focus: EventFocus):
        self.focus = focus
        self.tried: dict[Hypothesis, Float64[np.ndarray, " samples"]] = {}

    def curve(self, hypotheses: list[Hypothesis]) -> Float64[np.ndarray, "hypotheses samples"]:
        """The sharpness of each sample of events under each hypothesis."""
        for hypothesis in hypotheses:
            if hypothesis not in self.tried:
                self.tried[hypothesis] = self.focus.sharpness(hypothesis)
        return np.stack([self.tried[hypothesis] for hypothesis in hypotheses])

    def delay(self, reading: Reading, scale: float) -> Estimate:
        """Of the poses, milliseconds, with a focal length."""
        return _delay(
            lambda delays: self.curve([Hypothesis(delay, scale, reading) for delay in delays.tolist()]),
            self.focus.largest_delay,
        )

    def focal_scale(self, reading: Reading, delay: Estimate, lens: float) -> Estimate:
        """The best focal length around that of a lens, both as multiples of the stated one, with a delay if told."""
        scales, known = [lens * scale for scale in FOCAL_SCALES], delay.value * delay.is_told
        scales = [scale for scale in scales if self.focus.allows(scale)]
        curves = self.curve([Hypothesis(round(known * MILLISECOND), scale, reading) for scale in scales])
        largest = max(LARGEST_SCALE_ERROR, LARGEST_SCALE_ERROR_SHARE * abs(lens - 1))
        return _estimate(np.array(scales), curves, lens * SCALE_REACH, largest)


def clock_and_lens(recording: EventRecording, distance: float) -> tuple[Estimate, Estimate] | None:
    """The delay of the poses (ms), and the focal length (a multiple of the stated one), that make events sharpest.

    Takes about two seconds.

    Args:
        recording: Its index is made if it is not there yet.
        distance: Usual depth of the scene, metres.

    Returns:
        None where the events are too few, or the time is too short, to say anything. A camera that hardly turns does
        not tell a focal length.
    """
    trials = _Trials(EventFocus(recording, distance))
    if not trials.focus.windows:
        return None
    delay = trials.delay(AS_READ, 1.0)
    if trials.focus.turn < SMALLEST_TURN:
        return delay, Estimate(1.0, math.inf, False)
    scale = trials.focal_scale(AS_READ, delay, 1.0)
    if scale.is_told and abs(scale.value - 1) > HARMFUL_SCALE / 2:  # either hides some of the other
        delay = trials.delay(AS_READ, scale.value)
        scale = trials.focal_scale(AS_READ, delay, 1.0)
    return delay, scale


def clock_of_frames(recording: EventRecording, depth_range: tuple[float, float]) -> Estimate | None:
    """Milliseconds by which frames are stamped later than events of the same instant, by their edges.

    Args:
        recording: Its index is made if it is not there yet.
        depth_range: Nearest and farthest depth, metres.

    Returns:
        None where there are too few frames, or events, to say anything.
    """
    focus = EventFocus(recording, math.sqrt(depth_range[0] * depth_range[1]))
    edges = FrameEdges.of(recording, depth_range, focus.largest_delay)
    if edges is None:
        return None
    plane = edges.best_plane(_coarse(focus.largest_delay))
    early = _delay(lambda delays: edges.likeness(delays, plane), focus.largest_delay)
    return Estimate(-early.value, early.error, early.is_told)


@dataclass(frozen=True, eq=False)
class Agreement:
    """What events say about poses, clocks and the focal length."""

    focus: EventFocus
    edges: FrameEdges | None
    """None without frames."""
    plane: int
    """Number of the plane of `edges` at which events are drawn."""
    sharpness: dict[Hypothesis, float]
    """Of each hypothesis that was tried; only ratios mean anything."""
    readings: list[Reading]
    """Those that make events sharpest, and cannot be told apart; `AS_READ` among them if nothing is wrong."""
    is_clear: bool
    """Whether these are clearly sharper than all others."""
    pose_delay: Estimate
    """Milliseconds by which the poses are stamped later than events of the same instant."""
    frame_delay: Estimate | None
    """Milliseconds by which frames are stamped later than events of the same instant; None without frames."""
    focal_scale: Estimate
    """Best focal length, as a multiple of the stated one."""
    corners: CornerFit | None
    """None without frames in which the same corners are found."""

    @classmethod
    def of(cls, recording: EventRecording, depth_range: tuple[float, float] | None) -> Agreement | None:
        """Tries other clocks, readings of the poses and focal lengths; takes some seconds.

        Args:
            recording: Its index is made if it is not there yet.
            depth_range: Nearest and farthest depth, metres, if known.

        Returns:
            None where the events are too few, or the time is too short, to say anything.
        """
        near, far = depth_range or 2 * (float(np.linalg.norm(np.ptp(recording.trajectory.positions, axis=0))) or 1.0,)
        focus = EventFocus(recording, math.sqrt(near * far))
        if not focus.windows:
            return None
        trials = _Trials(focus)
        curve, delay_of, scale_of = trials.curve, trials.delay, trials.focal_scale
        pose_delay = delay_of(AS_READ, 1.0)
        stated = [Hypothesis(), Hypothesis(round(pose_delay.value * MILLISECOND))]
        other = _other_lens(focus, stated, curve) if focus.turn >= SMALLEST_TURN else None
        tried_for_all = stated if other is None else [*stated, other]
        heights = {
            reading: float(curve([replace(one, reading=reading) for one in tried_for_all]).sum(1).max())
            for reading in (AS_READ, *READINGS)
        }
        readings, is_clear = _best_readings(recording.trajectory, heights)
        lens = other.focal_scale if other is not None and AS_READ in readings else 1.0
        if AS_READ not in readings or lens != 1.0:
            pose_delay = delay_of(readings[0], lens)
        focal_scale = scale_of(readings[0], pose_delay, lens)
        if focal_scale.is_told and abs(focal_scale.value - 1) > HARMFUL_SCALE / 2:  # either hides some of the other
            pose_delay = delay_of(readings[0], focal_scale.value)
            focal_scale = scale_of(readings[0], pose_delay, lens)
        curve([hypothesis for hypothesis in shown_hypotheses() if focus.allows(hypothesis.focal_scale)])

        edges, plane, frame_delay = FrameEdges.of(recording, (near, far), focus.largest_delay), 0, None
        if edges is not None:
            plane = edges.best_plane(_coarse(focus.largest_delay))
            early = _delay(lambda delays: edges.likeness(delays, plane), focus.largest_delay)
            frame_delay = Estimate(-early.value, early.error, early.is_told)
        told = frame_delay is not None and frame_delay.is_told and pose_delay.is_told
        apart = round((pose_delay.value - frame_delay.value) * MILLISECOND) if told and frame_delay else 0
        tracks = FrameTracks.of(recording)
        corners = None if tracks is None else _fit_corners(tracks, near / 2, apart)
        total = {hypothesis: float(curves.sum()) for hypothesis, curves in trials.tried.items()}
        return cls(focus, edges, plane, total, readings, is_clear, pose_delay, frame_delay, focal_scale, corners)

    def verdict(self) -> str:
        """What events say about poses, clocks and calibration, in a sentence."""
        untold = [
            what
            for what, delay in (
                ("the clock of the poses", self.pose_delay),
                ("the clock of the frames", self.frame_delay),
            )
            if delay is not None and not delay.is_told
        ]
        by_frames = self.corners is not None and self.corners.focal_scale.is_told and self._is_one_camera
        untold += ["the focal length"] * (not self.focal_scale.is_told and not by_frames)
        found = self.problems()
        if found:
            return found[0].what
        apart = self.pixels(float(np.ptp([*self._lateness().values()])))
        agree = f"poses, clocks and calibration fit the events to {apart:.1f} pixels"
        return agree + (f"; {' and '.join(untold)} cannot be told from this recording" if untold else "")

    def rows(self) -> dict[str, str]:
        """What was measured, by name."""
        others = "; ".join(reading.words for reading in self.readings if reading is not AS_READ)
        if not self.is_clear:
            poses = "no reading of them brings the events into focus"
        elif AS_READ in self.readings:
            poses = "sharpest as they were read"
        else:
            poses, others = f"sharpest as {others}", ""
        rows = {"verdict": self.verdict(), "poses": poses}
        if others:
            rows["not told from"] = others
        for what, delay in (("poses", self.pose_delay), ("frames", self.frame_delay)):
            if delay is not None:
                rows[f"clock of {what}"] = self._clock(delay)
        scale = self.focal_scale
        rows["focal length"] = (
            f"{scale.value:.3f} ± {scale.error:.3f} of the stated one fits best"
            if scale.is_told
            else "cannot be told from this recording: where the camera hardly turns, it trades with depth"
        )
        if self.corners is not None:
            fit, scale = self.corners, self.corners.focal_scale
            rows["focal length by frames"] = f"corners are {fit.miss:.2f} pixels off where they can be, " + (
                f"{fit.least_miss:.2f} with the best, {scale.value:.3f} ± {scale.error:.3f} of the stated one"
                if scale.is_told
                else "which does not tell it"
            )
        rows["sharpness"] = "; ".join(f"{name}: {value}" for name, value in self.shown().items())
        return rows

    def shown(self) -> dict[str, str]:
        """Sharpness of wrong clocks and focal lengths in per cent of that which is stated, by name."""
        stated = self.sharpness[AS_STATED]
        return {
            hypothesis.words: f"{100 * self.sharpness[hypothesis] / stated:.1f} %"
            for hypothesis in shown_hypotheses()
            if hypothesis in self.sharpness
        }

    def problems(self) -> list[Problem]:
        """What contradicts the events, the gravest first."""
        focal = list(self._focal_problems())
        if focal and not FOCAL_SCALES[0] <= self.focal_scale.value <= FOCAL_SCALES[-1]:
            return focal  # as long as the lens is another one, poses and clocks do not fit either
        if not self.is_clear:
            return [
                Problem(
                    "No reading of the poses brings the events into focus, whatever their clock within "
                    f"{self.focus.largest_delay * 1e-6:.0f} ms: poses and events do not belong together.",
                    "Check that the poses are those of this recording, the unit of their times, and the calibration.",
                )
            ]
        of_frames = [] if focal and self._is_one_camera else self._frame_focal_problems()
        return [*self._pose_problems(), *self._clock_problems(), *focal, *of_frames]

    def _pose_problems(self) -> Iterator[Problem]:
        if AS_READ not in self.readings:
            gain = self.sharpness[Hypothesis(reading=self.readings[0])] / self.sharpness[AS_STATED]
            yield Problem(
                f"The poses fit the events when they are read as {_either(self.readings)}: events are then {gain:.1f} "
                "times as sharp.",
                "State the poses camera to world, with quaternions x y z w and OpenCV's axes of the camera (x right, y "
                "down, z forward)"
                + ("; this motion does not tell which of these it is." if len(self.readings) > 1 else "."),
            )
        elif SCALAR_FIRST in self.readings and _is_half_turn(self.focus.recording.trajectory):
            yield Problem(
                "All poses are turned by half a turn about x: their quaternions x y z w are 1 0 0 0, which in the "
                "order w x y z, or with OpenGL's axes of the camera, is no turn at all.",
                "Check the order of the quaternions and the axes, which cannot be told from this motion; nothing is "
                "learnt worse from it, but the scene may stand upside down.",
            )

    def _clock_problems(self) -> Iterator[Problem]:
        late = self._lateness()
        apart = max(late.values()) - min(late.values())
        error = max(
            (delay.error for delay in (self.pose_delay, self.frame_delay) if delay and delay.is_told), default=0
        )
        if self.pixels(apart) < HARMFUL_SHIFT or apart < 3 * error:
            return
        clocks = " and ".join(
            f"the {what} are stamped {_late(delay)}" for what, delay in late.items() if what != "events"
        )
        rest = {what: [late[other] for other in late if other != what] for what in late}
        alone = [what for what, others in rest.items() if len(others) == 1 or np.ptp(others) < apart / 4]
        advice = "Shift the times of poses and frames by what is said here"
        if alone:
            by = late[alone[0]] - float(np.mean(rest[alone[0]]))
            shift = f"Take {by:.1f} ms off" if by > 0 else f"Add {-by:.1f} ms to"
            advice = f"{shift} the times of the {alone[0]}"
        yield Problem(
            f"The clocks disagree by {apart:.1f} ± {error:.1f} ms, in which the picture moves by "
            f"{self.pixels(apart):.1f} pixels: {clocks} against the events of the same instant.",
            f"{advice}, or look for what delays them. Training with enerf corrects a clock by itself.",
        )

    def _focal_problems(self) -> Iterator[Problem]:
        scale = self.focal_scale
        if scale.is_told and abs(scale.value - 1) > max(HARMFUL_SCALE, 3 * scale.error):
            yield Problem(
                f"The focal length is wrong: {scale.value:.3f} ± {scale.error:.3f} of the stated one fits the events "
                f"best, {scale.value * self.focus.recording.camera.fx:.1f} pixels.",
                "Check the calibration, and whether it is of this lens and this resolution of the sensor.",
            )

    def _frame_focal_problems(self) -> Iterator[Problem]:
        if self.corners is None or AS_READ not in self.readings:
            return
        fit, scale = self.corners, self.corners.focal_scale
        if scale.is_told and abs(scale.value - 1) > max(HARMFUL_SCALE, 3 * scale.error):
            yield Problem(
                f"The focal length of the frames is wrong: with {scale.value:.3f} ± {scale.error:.3f} of the stated "
                f"one, {scale.value * fit.camera.fx:.1f} pixels, corners are {fit.least_miss:.1f} pixels off where the "
                f"poses let them be, and {fit.miss:.1f} as stated.",
                "Check the calibration, and whether it is of this lens and the resolution of these frames.",
            )

    @property
    def _is_one_camera(self) -> bool:
        """Whether what frames tell of their camera holds for that of the events."""
        return self.corners is not None and self.corners.camera == self.focus.recording.camera

    def _lateness(self) -> dict[str, float]:
        """By how many milliseconds each clock that is told is late against that of the events."""
        delays = {"poses": self.pose_delay, "frames": self.frame_delay, "events": None}
        return {
            what: 0.0 if delay is None else delay.value
            for what, delay in delays.items()
            if what == "events" or (delay is not None and delay.is_told)
        }

    def _clock(self, delay: Estimate) -> str:
        if not delay.is_told:
            return "cannot be told from this recording"
        return (
            f"{_late(delay.value)} (± {delay.error:.1f} ms) against the events: {self.pixels(delay.value):.1f} pixels"
        )

    def pixels(self, delay: float) -> float:
        """How far the picture moves in a delay (ms) when the camera is fast."""
        return abs(delay) * 1e-3 * self.focus.speed


def shown_hypotheses() -> list[Hypothesis]:
    """Wrong clocks and focal lengths that are shown beside what is stated."""
    return [
        *(Hypothesis(delay * MILLISECOND) for delay in SHOWN_DELAYS),
        *(Hypothesis(focal_scale=scale) for scale in SHOWN_SCALES),
    ]


def _late(delay: float) -> str:
    return f"{abs(delay):.1f} ms {'late' if delay > 0 else 'early'}"


def _coarse(largest: int) -> np.ndarray:
    return np.arange(-(largest // COARSE_STEP), largest // COARSE_STEP + 1) * COARSE_STEP


def _delay(curve: Callable[[np.ndarray], np.ndarray], largest: int) -> Estimate:
    """The delay (ms) of the highest curve, searched in coarse steps and then in fine ones.

    It is not told where the top is so close to the largest delays that it may lie beyond them.
    """
    delays = _coarse(largest)
    curves = curve(delays)
    best = int(delays[curves.sum(1).argmax()])
    around = np.arange(best - FINE_REACH, best + FINE_REACH + 1, FINE_STEP)
    around = np.setdiff1d(around[np.abs(around) <= largest], delays)
    curves, delays = np.concatenate([curves, curve(around)]), np.append(delays, around)
    order = np.argsort(delays)
    found = _estimate(delays[order] / MILLISECOND, curves[order], FINE_REACH / MILLISECOND, LARGEST_DELAY_ERROR)
    within = MILLISECOND * abs(found.value) <= largest - FINE_REACH
    return replace(found, is_told=found.is_told and within)


def _other_lens(
    focus: EventFocus,
    stated: list[Hypothesis],
    curve: Callable[[list[Hypothesis]], Float64[np.ndarray, "hypotheses samples"]],
) -> Hypothesis | None:
    """The focal length, far from the stated one, that makes events clearly sharper; None if there is none."""
    lenses = [lens for lens in OTHER_LENSES if focus.allows(lens)]
    if not lenses:
        return None
    hypotheses = [replace(hypothesis, focal_scale=lens) for lens in lenses for hypothesis in stated]
    heights = curve(hypotheses).sum(1).reshape(len(lenses), -1)
    best = int(heights.max(1).argmax())
    is_top = 0 < best < len(lenses) - 1
    if not is_top or heights[best].max() < LENS_GAIN * curve(stated).sum(1).max():
        return None
    return replace(stated[heights[best].argmax()], focal_scale=lenses[best])


def _fit_corners(tracks: FrameTracks, nearest: float, delay: int) -> CornerFit:
    """The focal length with which corners go where they can.

    Args:
        tracks: Corners that were followed.
        nearest: Least depth of the scene, metres.
        delay: How much later the poses are stamped than frames of the same instant, ns.
    """
    fits = np.stack([tracks.fit(nearest, scale, delay) for scale in FRAME_SCALES])
    found = _estimate(np.log(FRAME_SCALES), fits, SCALE_REACH, math.inf)
    scale, error = math.exp(found.value), math.exp(found.value) * found.error
    largest = max(LARGEST_SCALE_ERROR, LARGEST_SCALE_ERROR_SHARE * abs(scale - 1))
    is_told = found.is_told and error <= largest and fits.mean(1).max() >= SMALLEST_FIT
    miss, least = (float(np.median(np.concatenate(tracks.misses(nearest, one, delay)))) for one in (1.0, scale))
    return CornerFit(tracks.frames.camera, Estimate(scale, error, is_told), miss, least)


def _estimate(
    values: Float64[np.ndarray, " values"], curves: Float64[np.ndarray, "values samples"], reach: float, largest: float
) -> Estimate:
    """Where the sum of curves is highest, refined by a parabola through the values within reach of the highest one.

    The error is the standard deviation over 200 bootstraps of the samples.
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
    if near.sum() < 3:
        return float(highest)
    square, linear, _ = np.polyfit(values[near] - highest, heights[near] / heights.max(), 2)
    return float(highest + np.clip(-linear / (2 * square), -reach, reach)) if square < 0 else float(highest)


def _best_readings(trajectory: Trajectory, heights: dict[Reading, float]) -> tuple[list[Reading], bool]:
    """The readings that make events sharpest, the likeliest first; and whether they are clearly sharper than others.

    Args:
        trajectory: As it was read.
        heights: Sharpness of each reading.
    """
    body = trajectory.body[0] if trajectory.body else trajectory
    level = np.all(np.abs(body.quaternions[:, :3]) < 1e-6)  # another order would turn every pose by half a turn
    plausible = [reading for reading in heights if not (level and reading in (SCALAR_FIRST, SCALAR_LAST))]
    best = max(heights[reading] for reading in plausible)
    if best <= CLEARLY * heights[AS_READ]:
        best = heights[AS_READ]
    sharpest = [reading for reading in plausible if heights[reading] > ALIKE * best]
    return sharpest, best > CLEARLY * max((heights[other] for other in plausible if other not in sharpest), default=0.0)


def _either(readings: list[Reading]) -> str:
    words = [reading.words for reading in readings[:3]]
    return ", or ".join(words) + (", or otherwise turned or mirrored" if len(readings) > 3 else "")


def _is_half_turn(trajectory: Trajectory) -> bool:
    body = trajectory.body[0] if trajectory.body else trajectory
    return bool(np.all(np.abs(body.quaternions[:, 1:]) < 1e-6))

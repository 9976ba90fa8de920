"""Rows of the poses: the time that is used, their noise, their clock, and the lens."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

from enerf_ns.choices.events import hides_changes
from enerf_ns.choices.scene import DATAPARSER, Scene, path_extent
from enerf_ns.dataparsers.index.indexing import describe_gaps
from enerf_ns.dataparsers.inspection.agreement import Estimate, clock_of_frames
from enerf_ns.dataparsers.inspection.agreement import clock_and_lens as sharpest_clock_and_lens
from enerf_ns.dataparsers.recording.errors import FlagError
from enerf_ns.dataparsers.recording.pose_noise import PoseNoise, pose_noise
from enerf_ns.dataparsers.recording.recording import EventRecording, percent
from enerf_ns.dataparsers.scene.depth_range import recording_parallax
from enerf_ns.poses.corrections import Corrections
from enerf_ns.poses.refiner import turns_about_two_axes
from enerf_ns.sensor.lag import SHARE_IN_THE_DARK, delay_of

LARGEST_NOISE = 0.1
"""Distance (pixels) by which the noise of the poses may move the picture before it is smoothed."""

LARGEST_LAG_MS = 5.0
"""Largest delay (ms) of the events that is attributed to the lag of the photoreceptor, if that is learned. To first
order a lag and a wrong clock have the same effect. A photoreceptor of 200 Hz lags by 2.3 ms, averaged over the
brightness that it sees."""

SMALLEST_DELAY, SMALLEST_SCALE = 2.0, 0.06
"""Smallest delay (ms) of a clock, and smallest share of the focal length, that are corrected before training; the
refinement finds smaller ones itself. On simulated recordings without errors, the sharpest events are off by up to 1.1
ms and 4.5 %, several times their standard errors."""

PARTS = {"clock": "clock of the poses", "mount": "mount", "lens": "lens", "drift": "drift of the poses"}
"""Names of the rows of what is refined, by the names of their settings."""


def selection(scene: Scene) -> None:
    """Which part of the recording is used, and are its poses smoothed? `noise` has the row."""
    scene.use(f"{DATAPARSER}.train_frames", lambda: "blurred")
    time_range = scene.use(f"{DATAPARSER}.time_range", lambda: None)
    parser, whole = scene.parser, scene.recording
    selected = time_range, parser.keep_hot_pixels, parser.keep_pose_gaps, parser.undistort
    scene.recording = whole.selected(*selected)
    found = scene.once(noise_of_poses)  # before they are smoothed

    def is_noisy() -> bool:
        return found is not None and _pixels(scene, found) > LARGEST_NOISE

    if scene.use(f"{DATAPARSER}.smooth_poses", is_noisy):
        scene.recording = whole.selected(*selected, smooth_poses=True)


def pose_gaps(scene: Scene) -> None:
    """Are the events between poses that are far apart used?"""
    recording, name, kept = scene.recording, f"{DATAPARSER}.keep_pose_gaps", scene.parser.keep_pose_gaps
    gaps = recording.pose_gaps
    if not len(gaps):
        why = f"none is longer than {recording.trajectory.longest_step * 1e-9:.3g} s"
        scene.row("pose gaps", False, "", why, name)
        return
    index = scene.index
    why = f"{index.num_in_gaps:,} events ({percent(index.num_in_gaps / len(index))}) lie in {describe_gaps(gaps)}"
    scene.row("pose gaps", kept, "used" if kept else "left out", "set by flag; " * kept + why, name)


def noise(scene: Scene) -> None:
    """Is the white noise of the poses smoothed?"""
    name, found = f"{DATAPARSER}.smooth_poses", scene.once(noise_of_poses)
    smooth = bool(scene.value(name))
    if found is None:
        scene.row("noise of poses", smooth, "", "there are too few poses, or too many, to estimate it", name)
        return
    value = f"{1e3 * found.position:.2g} mm and {math.degrees(found.rotation):.2g} degrees are smoothed"
    value += "; the remaining noise is refined" * (scene.value("poses.refine_drift") is not False)
    why = f"it moves the picture by {_pixels(scene, found):.2g} pixels"
    scene.row("noise of poses", smooth, value * smooth, scene.why(name, why), name)


def noise_of_poses(scene: Scene) -> PoseNoise | None:
    """White noise of the poses of the recording; None if it cannot be estimated."""
    return pose_noise(scene.recording.trajectory)


def _pixels(scene: Scene, found: PoseNoise) -> float:
    """Distance (pixels) by which noise of the poses moves the picture."""
    return found.pixels(scene.recording.camera.fx, _distance(scene))


def _distance(scene: Scene) -> float:
    """Rough distance (m) of the scene before it is measured: as far as the camera goes; if it only turns, far away."""
    recording = scene.recording
    depths = scene.parser.depth_range or recording.depth_range
    if depths is None:
        parallax = recording_parallax(recording)
        depths = parallax.panorama_range if parallax.is_ruled_out else 2 * (path_extent(recording) or 1.0,)
    return math.sqrt(depths[0] * depths[1])


@dataclass
class _Start:
    """Corrections before training, and the words on them."""

    clock: float = 0.0
    """Time (ms) by which poses are stamped late."""
    frame_delay: float = 0.0
    """Time (ms) by which frames are stamped late."""
    scale: float = 1.0
    """The focal length as a multiple of the stated one."""
    on_clock: list[str] = field(default_factory=list)
    on_lens: list[str] = field(default_factory=list)


def clock_and_lens(scene: Scene) -> None:
    """Which errors of clock, mount, lens and drift are corrected, before and during training?

    Raises:
        FlagError: A flag asks for a correction by events, which the field does not learn from.
    """
    poses, refines = scene.config.poses, scene.defaults.refines_poses and scene.use_events
    wanted = [part for part in PARTS if getattr(poses, f"refine_{part}")]
    if wanted and not scene.use_events:
        raise FlagError(
            f"--pipeline.refine-{wanted[0]} True compares events with renderings, but the field learns from frames "
            "alone; leave it out, or give --pipeline.datamanager.supervision events+frames."
        )
    is_blind = scene.use_events and scene.once(hides_changes)
    stated = {"clock": poses.clock_ms, "lens": poses.focal_scale}
    for part in PARTS:
        fixed = part == "lens" and scene.use_frames  # frames are undistorted once
        if getattr(poses, f"refine_{part}") is None and (
            stated.get(part) is not None or not refines or is_blind or fixed
        ):
            scene.values[f"poses.refine_{part}"] = False
    refined = [part for part in PARTS if scene.value(f"poses.refine_{part}") is not False]
    start = _start(scene, refines and poses.clock_ms is None and poses.refine_clock is not False, "lens" in refined)
    clock = scene.use("poses.clock_ms", lambda: start.clock)
    late = scene.use("poses.frame_delay_ms", lambda: start.frame_delay)
    scale = scene.use("poses.focal_scale", lambda: start.scale)

    words = {"clock": start.on_clock, "lens": start.on_lens}
    started = {"clock": bool(clock or late), "lens": scale != 1.0}
    flags = {"clock": (poses.clock_ms, poses.frame_delay_ms), "lens": (poses.focal_scale,)}
    for part, name in PARTS.items():
        setting = f"poses.refine_{part}"
        value = "corrected before training" * started.get(part, False)
        if part in refined:
            value = "corrected if events show that it is wrong"
        why = "events are compared with renderings of them" if part in refined else "taken as stated"
        why = "; ".join(words.get(part, [])) or why
        if is_blind and part not in refined:
            why += "; pixels are blind after events, which hides other errors"
        if any(flag is not None for flag in (scene.given(setting), *flags.get(part, ()))):
            why = "set by flag"
        elif not refines:
            why = "not part of the method" if scene.use_events else "the field learns from frames alone"
        scene.row(name, bool(value), value, why, setting)


def corrected_recording(scene: Scene) -> EventRecording:
    """The recording with the corrections before training, which `clock_and_lens` decides.

    Raises:
        FlagError: The lens has no inverse with the focal length that a flag states.
    """
    recording, scale = scene.recording, scene.value("poses.focal_scale")
    delay, frame_delay = scene.value("poses.clock_ms"), scene.value("poses.frame_delay_ms")
    corrections = Corrections(delay, frame_delay, focal_scale=scale)
    try:
        corrections.camera(recording.camera)
    except ValueError as error:
        raise FlagError(f"--pipeline.focal-scale {scale:g} gives {recording.path} {error}") from error
    return corrections.recording(recording)


def _start(scene: Scene, with_clock: bool, with_lens: bool) -> _Start:
    """Errors of the clock and the lens that the sharpest events, and edges in frames, show."""
    start, recording, distance = _Start(), scene.recording, _distance(scene)
    if not (with_clock or with_lens):
        return start
    found = sharpest_clock_and_lens(recording, distance)
    if found is None:
        return start
    delay, lens = found
    if with_clock and delay.is_identifiable:
        has_frames = recording.has_frames and not recording.reconstructed_by
        frames = clock_of_frames(recording, (distance, distance)) if has_frames else None
        if frames is not None and frames.is_identifiable:
            lag = min(frames.value, 0.0)
            if abs(delay.value - frames.value) < 2.0 * delay.error:
                delay = frames  # frames and poses share a clock, which frames determine better
        else:
            lag = min(delay.value, 0.0)
        if frames is not None and not _is_wrong(frames, 0.0, SMALLEST_DELAY):
            frames = None
        if -_largest_lag(scene) < lag < 0.0:
            start.on_clock.append(f"events are {-lag:.2f} ms late, which is attributed to the lag of the pixels")
            delay = replace(delay, value=delay.value - lag)
            frames = None
        if frames is not None:
            start.frame_delay = frames.value
            start.on_clock.append(f"frames are stamped {frames.value:+.2f} ± {frames.error:.2f} ms late")
        if _is_wrong(delay, 0.0, SMALLEST_DELAY):
            start.clock = delay.value
            start.on_clock.append(f"poses are stamped {delay.value:+.2f} ± {delay.error:.2f} ms late")
    turns = scene.config.poses.refine_lens or turns_about_two_axes(recording)
    if with_lens and turns and _is_wrong(lens, 1.0, SMALLEST_SCALE):
        start.scale = lens.value
        start.on_lens.append(f"the focal length is {lens.value:.3f} ± {lens.error:.3f} of the stated one")
    return start


def _largest_lag(scene: Scene) -> float:
    """Largest delay (ms) of the events that is attributed to the lag of pixels: of a stated one, that in the dark."""
    learned = scene.value("model.sensor.learn_cutoff_frequency")
    stated, second = (scene.value(f"model.sensor.{name}cutoff_frequency") for name in ("", "second_"))
    largest = LARGEST_LAG_MS if learned else delay_of(stated) / SHARE_IN_THE_DARK
    return largest + delay_of(second)


def _is_wrong(estimate: Estimate, stated: float, smallest: float) -> bool:
    """Whether a value differs from what is stated significantly, and by more than the smallest that matters."""
    apart = abs(estimate.value - stated)
    return estimate.is_identifiable and apart > max(smallest, 3.0 * estimate.error)

"""Rows of the frames: the split, their loss, their camera and their exposures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from enerf_ns.choices.events import frames_determine_more
from enerf_ns.choices.extent import depths
from enerf_ns.choices.scene import DATAPARSER, Scene
from enerf_ns.dataparsers.event_dataparser import (
    DEFAULT_HELD_OUT_EVERY,
    EventDataParserConfig,
    check_trained_frames,
    split_frames,
)
from enerf_ns.dataparsers.recording.errors import FlagError
from enerf_ns.dataparsers.recording.recording import Frames
from enerf_ns.dataparsers.sensor_estimates.frame_contrast import EXPOSURE_CHANGES, exposure_change
from enerf_ns.poses.motion import exposure_motion

FRAME_LOSS_WEIGHT = 10.0
"""Weight of the frame loss beside the regularisers."""

PIXELS_PER_INSTANT = 2.0
"""Distance (pixels) that the picture moves during an exposure for each instant of it that is rendered."""

MOST_INSTANTS = 16
"""Largest number of instants of an exposure that is chosen."""


def split(scene: Scene) -> None:
    """Which frames are for training, and which are held out? This has no row.

    Raises:
        FlagError: The recording holds no frames to learn from, or too few for the split, or none of them is chosen.
    """
    recording, supervision = scene.recording, scene.config.datamanager.supervision
    if scene.use_frames and not recording.has_frames:
        raise FlagError(
            f"{recording.path}: the recording holds no frames, but --pipeline.datamanager.supervision {supervision} "
            "learns from them; use --pipeline.datamanager.supervision events"
        )
    for name in ("train_frame_indices", "held_out_frame_indices"):
        scene.use(f"{DATAPARSER}.{name}", lambda: None)
    every = scene.parser.held_out_every if scene.parser.held_out_every is not None else DEFAULT_HELD_OUT_EVERY
    frames = recording.blurred_frames or recording.frames
    num_frames = len(frames.times) if frames else 0
    if scene.use_frames and not 1 <= every // 2 < num_frames:
        raise FlagError(
            f"{recording.path}: --held-out-every {every} splits none of {num_frames} frames off; it must be at least 2 "
            "and less than twice their number, where the field learns from frames"
        )
    if scene.use_frames:
        check_trained_frames(recording, scene.parser, split_frames(recording, scene.parser, held_out=False)[0])


def frame_loss(scene: Scene) -> None:
    """Does the field learn from frames, and with which weight?"""
    recording, defaults, name = scene.recording, scene.defaults, "datamanager.supervision"
    noisy = scene.once(frames_determine_more)
    beside = scene.use_events and scene.use_frames and not noisy
    rays = defaults.rays_beside_events if beside else defaults.train_num_rays_per_batch
    scene.use("datamanager.train_num_rays_per_batch", lambda: rays)
    if not (scene.use_events and scene.use_frames and scene.config.model.event_loss_weight):
        scene.use("model.frame_loss_weight", lambda: FRAME_LOSS_WEIGHT)
    why = f"supervision is {scene.config.datamanager.supervision}"
    if not scene.use_frames:
        scene.row("frame loss", False, "", why if recording.has_frames else "the recording holds no frames", name)
        return
    value = "sharp frames"
    if _are_blurred(scene):
        value = "blurred frames"
        if recording.reconstructed_by is not None:
            value = f"frames that {recording.reconstructed_by} reconstructed from the events"
    if scene.use_events and scene.config.model.frame_loss_weight is None:
        value += ", with a weight from the errors of events and frames"
    if noisy:
        why += "; frames have the rays of most pairs, since events are noisy"
    scene.row("frame loss", True, value, why, name)


def second_camera(scene: Scene) -> None:
    """Did a second camera take the frames?"""
    frames, recording = _frames(scene), scene.recording
    if frames is None or not (scene.use_events and scene.use_frames):
        return
    second = frames.trajectory is not recording.trajectory or frames.camera != recording.camera
    value = f"{frames.camera.width} x {frames.camera.height}, {frames.camera.model}" if second else ""
    why = "the calibration states it" if second else "frames and events are of one camera"
    scene.row("second camera", second, value, why, "datamanager.supervision")


def exposure_of_frames(scene: Scene) -> None:
    """Is the exposure of each frame learned?"""
    if not scene.use_frames:
        return
    name, change = "model.learn_exposure", None
    if scene.learns_sensor and _frames(scene) is not None and scene.recording.reconstructed_by is None:
        trained, _ = split_frames(scene.recording, scene.parser, held_out=False)
        change = exposure_change(scene.recording, trained)
    learns = scene.use(name, lambda: change is not None and change > EXPOSURE_CHANGES)
    why = "nothing shows whether the exposure of frames changes"
    if change is not None:
        why = f"pixels without events change by {100 * change:.2g} % from frame to frame"
    value = "a gain and an offset of each frame are learned" if learns else ""
    scene.row("exposure of frames", bool(learns), value, scene.why(name, why), name)


def exposure(scene: Scene) -> None:
    """Over how many instants of its exposure is each frame averaged?

    Raises:
        FlagError: A flag asks for several instants, but the recording states no exposures.
    """
    if not scene.use_frames:
        return
    name = "datamanager.exposure_samples"
    parser = scene.resolved().datamanager.dataparser
    assert isinstance(parser, EventDataParserConfig)
    frames, _ = split_frames(scene.recording, parser, held_out=False)
    if frames.exposures is None:
        if (scene.config.datamanager.exposure_samples or 1) > 1:
            raise FlagError(
                f"{scene.recording.path}: the recording states no exposures, but "
                "--pipeline.datamanager.exposure-samples averages over them; state them with event-data --exposure-ms"
            )
        why = "the recording states no exposures; --exposure-ms does"
        scene.row("exposure", False, "each frame is taken as an instant", why, f"{DATAPARSER}.exposure_ms")
        return
    all_frames, _ = split_frames(scene.recording, replace(parser, exposure_ms=0.0), held_out=False)
    num_left_out = len(all_frames.times) - len(frames.times)
    motion = float(np.median(exposure_motion(frames, *scene.once(depths))))
    instants = scene.use(name, lambda: min(max(1, round(motion / PIXELS_PER_INSTANT)), MOST_INSTANTS))
    value = f"each frame is the mean over {instants} instants" if instants > 1 else "each frame is taken as an instant"
    why = (
        f"{'set by flag; ' * (parser.exposure_ms is not None)}within {np.median(frames.exposures) * 1e-6:.3g} ms "
        f"the picture moves by {motion:.3g} pixels"
    )
    if num_left_out:
        why += f"; {num_left_out} frames whose exposures reach beyond the poses are left out"
    scene.row("exposure", instants > 1, value, scene.why(name, why), name)


def _are_blurred(scene: Scene) -> bool:
    """Whether the field learns from blurred frames."""
    return scene.value(f"{DATAPARSER}.train_frames") == "blurred" and scene.recording.blurred_frames is not None


def _frames(scene: Scene) -> Frames | None:
    """The frames that the field learns from."""
    return scene.recording.blurred_frames if _are_blurred(scene) else scene.recording.frames

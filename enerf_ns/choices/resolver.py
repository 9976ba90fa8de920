"""Decides once what is used for a scene, and why, from the recording and the settings of the user.

If a setting is None, the preset decides; without a preset, the recording; and without an answer from the recording, the
method. A setting of the user stands, also if it equals a default.

A row of the table of choices is a function of a `Scene`. Its docstring is the question; it decides the settings, and
adds the answer, the reason and the flag that forces it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from enerf_ns.choices import brightness, events, extent, frames, poses, rays, sensor
from enerf_ns.choices.resolution import PipelineConfig, Resolution
from enerf_ns.choices.scene import Scene
from enerf_ns.choices.summary import flags_to_state, in_words
from enerf_ns.dataparsers.recording.recording import EventRecording

ROWS: tuple[Callable[[Scene], None], ...] = (
    poses.selection,
    frames.split,
    poses.pose_gaps,
    events.held_out_events,
    events.missed_changes,
    events.event_pairs,
    events.any_instants,
    events.silent_pixels,
    sensor.parts,
    brightness.level,
    sensor.colour_filter,
    poses.clock_and_lens,
    poses.noise,
    brightness.dynamic_range,
    frames.frame_loss,
    frames.second_camera,
    frames.exposure_of_frames,
    brightness.colour,
    extent.undistortion,
    extent.panorama,
    extent.box,
    extent.explainable,
    extent.contraction,
    frames.exposure,
    extent.hash_grid,
    rays.proposal_network,
    rays.opacity_loss,
    rays.edge_start,
)
"""Rows in the order in which they are decided: each may depend on those before it."""


def resolve(
    config: PipelineConfig,
    recording: EventRecording,
    preset: str | None = None,
    probe: rays.Probe | None = None,
    batch_factor: Callable[[Any], int] = lambda config: 1,
) -> Resolution:
    """Decides all that a config leaves open. Nothing is changed; the same arguments give the same answer.

    Args:
        config: The settings of the user, and None for the rest.
        recording: The recording that the field learns from.
        preset: A sequence of the paper whose selections are used.
        probe: Measures the gain of a brightness that depends on the viewing direction; asked if the camera goes around
            the scene. None: there is no gain.
        batch_factor: Returns the factor by which a step may have more rays on the device than the method has, for a
            config in which all else is decided.

    Returns:
        Values for all settings that were open, and a row for each choice.

    Raises:
        RecordingError: The depth of the scene cannot be measured, or a preset selects frames that the recording does
            not have.
        FlagError: A setting asks for something that the recording does not have, or that does not exist.
    """
    scene = Scene(config, recording, preset)
    for row in ROWS:
        row(scene)
    rays.view_direction(scene, probe)
    rays.larger_batch(scene, batch_factor)
    return Resolution(
        scene.values, tuple(scene.choices), tuple(scene.selection), in_words(scene), flags_to_state(scene), scene.cause
    )

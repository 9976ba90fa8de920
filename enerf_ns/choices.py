"""What a scene needs and what is left out: decided once, from the recording, when training starts."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from enerf_ns.dataparsers.errors import RecordingError
from enerf_ns.dataparsers.event_dataparser import EventDataParserConfig, depth_range, scene_normalisation
from enerf_ns.dataparsers.files import load_image
from enerf_ns.dataparsers.indexing import index_events
from enerf_ns.dataparsers.recording import EventRecording
from enerf_ns.sensor.sensor_model import thresholds_from_polarity

if TYPE_CHECKING:
    from enerf_ns.enerf_pipeline import EnerfPipelineConfig


@dataclass(frozen=True)
class Choice:
    """One part of the method: whether it is kept for this scene, and why."""

    part: str
    kept: bool
    value: str
    why: str


def fill_in_choices(config: EnerfPipelineConfig, recording: EventRecording) -> list[Choice]:
    """Fill in what the configuration leaves open, from the recording; what is set already stands.

    Args:
        config: Changed in place, so that config.yml holds what the run used.
        recording: Read and checked; its events are needed only for what is open.

    Returns:
        One row for each choice, to be shown and stored.

    Raises:
        RecordingError: if the configuration asks for what the recording does not have.
    """
    data, model = config.datamanager, config.model
    choices: list[Choice] = []

    def add(part: str, kept: bool, value: str, why: str) -> None:
        choices.append(Choice(part, kept, value, why))

    use_events, use_frames = "events" in data.supervision, "frames" in data.supervision
    has_frames = recording.has_frames
    if use_frames and not has_frames:
        raise RecordingError(
            f"{recording.path}: the recording holds no frames, but --pipeline.datamanager.supervision "
            f"{data.supervision} learns from them; use --pipeline.datamanager.supervision events"
        )
    parser = data.dataparser
    assert isinstance(parser, EventDataParserConfig)
    frames = recording.blurred_frames or recording.frames
    num_frames = len(frames.times) if frames else 0
    if parser.held_out_every < 1 or (use_frames and not 1 <= parser.held_out_every // 2 < num_frames):
        raise RecordingError(
            f"{recording.path}: --held-out-every {parser.held_out_every} splits none of {num_frames} frames off; it "
            "must be at least 1, and where the field learns from frames at least 2 and less than twice their number"
        )
    if model.contrast_thresholds is not None and min(model.contrast_thresholds) <= 0.0:
        raise RecordingError(f"--contrast-thresholds are {model.contrast_thresholds}, but both must be above 0")

    if data.pair_mode is None:
        data.pair_mode = "successor" if recording.refractory_period else "partner"
    if use_events:
        values = {
            "successor": "each event with the pixel's next",
            "partner": f"each event with one of the pixel's next {data.max_pair_distance}",
            "window": f"each event with the pixel's last in {data.window_ms:g} ms",
        }
        why = "learns from events"
        if recording.refractory_period:
            why += f"; pixels are blind for {recording.refractory_period * 1e-6:g} ms after an event"
            if data.pair_mode != "successor":
                why += ", for which only datamanager.pair-mode successor is exact"
        add("event loss", True, f"{data.event_pairs} pairs a step: {values[data.pair_mode]}", why)
    else:
        add("event loss", False, "", f"supervision is {data.supervision}")

    if model.contrast_thresholds is not None:
        why = "set by flag"
    elif recording.contrast_thresholds is not None:
        model.contrast_thresholds, why = recording.contrast_thresholds, "the recording states them"
    else:
        num_on = index_events(recording).num_positive
        num_off = len(index_events(recording)) - num_on
        model.contrast_thresholds = thresholds_from_polarity(num_on, num_off)
        why = f"{num_on:,} on and {num_off:,} off events; their mean is assumed"
    add("contrast thresholds", use_events, "on {:.3f}, off {:.3f}".format(*model.contrast_thresholds), why)

    if use_events and data.silent_pairs:
        add("no-event loss", True, f"{data.silent_pairs} silent pairs a step", "keeps surfaces without texture even")
    else:
        why = "datamanager.silent-pairs is 0; silent pixels are not searched" if use_events else "no events are used"
        add("no-event loss", False, "", why)
    if use_frames:
        blurred = data.dataparser.train_frames == "blurred" and recording.blurred_frames is not None
        add("frame loss", True, "blurred frames" if blurred else "sharp frames", f"supervision is {data.supervision}")
    else:
        add(
            "frame loss",
            False,
            "",
            "supervision is events; add frames by datamanager.supervision events+frames"
            if has_frames
            else "the recording holds no frames",
        )

    colour_events = use_events and recording.bayer_pattern is not None
    if colour_events and model.num_channels == 1:
        raise RecordingError(
            f"{recording.path}: the sensor has a colour filter ({recording.bayer_pattern}), but "
            "--pipeline.model.num-channels is 1; leave that flag out, or set it to 3"
        )
    if model.num_channels is None:
        colour_frames = use_frames and frames is not None and is_colour(load_image(frames.filenames[0]))
        model.num_channels = 3 if colour_events or colour_frames else 1
    why = "the field learns from colour frames" if model.num_channels == 3 else "nothing here is in colour"
    if colour_events:
        why = f"the sensor has a colour filter ({recording.bayer_pattern})"
    add("colour", model.num_channels == 3, f"{model.num_channels} channel(s)", why)

    add(
        "undistortion",
        recording.camera.model != "pinhole",
        recording.camera.model,
        "the calibration states it",
    )
    add(
        "view direction",
        model.view_direction,
        "",
        "model.view-direction" + ("" if model.view_direction else " is off: brightness as of matt surfaces"),
    )

    if parser.depth_range is not None:
        why = "set by flag"
    else:
        why = "the recording states it" if recording.depth_range else "measured from events and poses"
        parser.depth_range = depth_range(recording, parser)
    near, far = parser.depth_range
    _, scale, _ = scene_normalisation(recording, near, far, parser.box)
    box = f"box of depths {near:.2f} m to {far:.2f} m" if parser.box is None else f"cube of {2 * parser.box[3]:g} m"
    add("contraction", False, box, why if parser.box is None else "set by flag or preset")
    if model.near_plane is None:
        model.near_plane = near * scale
    if model.max_res is None:
        footprint = math.sqrt(near * far) / recording.camera.fx * scale
        finest = 2 ** round(math.log2(2.0 * 2.0 / footprint))
        model.max_res = min(max(finest, 2 * model.base_res), 4096)
    add("hash grid", True, f"{model.num_levels} levels, {model.base_res} to {model.max_res} cells", "sensor's pixels")
    return choices


def is_colour(image) -> bool:
    """Whether a picture (height, width, channels) holds anything but grey."""
    return image.shape[2] >= 3 and bool((image[..., :1] != image[..., 1:3]).any())


def absolute(path: Path) -> Path:
    """The path with `~` and the working directory put in."""
    return path.expanduser().resolve()

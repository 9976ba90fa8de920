"""Rows of brightness: its level, its range and its colour."""

from __future__ import annotations

from enerf_ns.choices.scene import Scene
from enerf_ns.dataparsers.event_dataparser import split_frames
from enerf_ns.dataparsers.recording.errors import FlagError
from enerf_ns.dataparsers.sensor_estimates.frame_contrast import mean_brightness
from enerf_ns.sensor.learned_response import seen_range
from enerf_ns.sensor.part import GREY

MEAN_BRIGHTNESS = 0.3
"""Geometric mean of brightness near which a field is held if neither frames nor a flag state it. Brightness three times
above and below it then lies where both the field and linlog are logarithmic."""


def level(scene: Scene) -> None:
    """Near which level is brightness held, which events leave open?"""
    name, found = "model.level_loss_weight", None
    alone = scene.use_events and not scene.use_frames
    weight = scene.use(name, lambda: scene.defaults.level_loss_weight if alone else 0.0)
    why = "events leave the level of brightness open" if alone else "frames determine the level of brightness"

    def measured() -> float:
        nonlocal found
        found = _mean_of_frames(scene) if weight else None
        return MEAN_BRIGHTNESS if found is None else found

    mean = scene.use("model.mean_brightness", measured)
    why = scene.why("model.mean_brightness", why) if weight else why
    value = f"held near {mean:.3g}"
    if found is not None:
        value += ", the geometric mean of the frames"
    scene.row("level of brightness", bool(weight), value, scene.why(name, why), name)


def _mean_of_frames(scene: Scene) -> float | None:
    """Geometric mean of the brightness of the frames that are not held out; None if they do not show it."""
    if not scene.recording.has_frames or scene.recording.reconstructed_by:
        return None
    frames, _ = split_frames(scene.recording, scene.parser, held_out=False)
    data = scene.resolved().datamanager
    assert data.event_pairs is not None
    pairs = data.event_pairs + (data.instant_pairs or 0) + (data.silent_pairs or 0)
    return mean_brightness(scene.recording, frames, data.event_pairs / pairs)


def dynamic_range(scene: Scene) -> None:
    """Does the brightness of the field have an upper limit?"""
    name, is_high, why = "model.brightness", False, "no events are used"
    if scene.use_events:
        span, why = scene.once(seen_range)
        is_high = span > scene.limited_range
        why += f", {'more' if is_high else 'less'} than {scene.limited_range:g}"
    activation = scene.use(name, lambda: "exponential" if is_high else "log-sigmoid")
    scene.row("high dynamic range", activation == "exponential", activation, scene.why(name, why), name)


def colour(scene: Scene) -> None:
    """How many colour channels does the field have?

    Raises:
        FlagError: A flag asks for one channel behind a colour filter.
    """
    recording, name = scene.recording, "model.num_channels"
    pattern = scene.value("model.sensor.bayer_pattern")
    colour_events = scene.use_events and pattern != GREY
    if colour_events and scene.given(name) == 1:
        raise FlagError(
            f"{recording.path}: the sensor has a colour filter ({pattern}), but --pipeline.model.num-channels is 1; "
            "leave that flag out, or set it to 3"
        )
    frames = recording.blurred_frames or recording.frames

    def needed() -> int:
        colour_frames = scene.use_frames and frames is not None and is_colour(frames.image(0))
        return 3 if colour_events or colour_frames else 1

    channels = scene.use(name, needed)
    why = "the field learns from colour frames" if channels == 3 else "neither events nor frames are in colour"
    if colour_events:
        why = f"the sensor has a colour filter ({pattern})"
    scene.row("colour", channels == 3, f"{channels} channel(s)", scene.why(name, why), name)


def is_colour(image) -> bool:
    """Whether a picture (height, width, channels) holds anything but grey."""
    return image.shape[2] >= 3 and bool((image[..., :1] != image[..., 1:3]).any())

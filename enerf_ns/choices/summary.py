"""The choices for a scene in a few sentences, and the flags by which the user can state what is not known of it."""

from __future__ import annotations

from dataclasses import fields

from enerf_ns.choices.poses import PARTS
from enerf_ns.choices.scene import DATAPARSER, Scene
from enerf_ns.dataparsers.event_dataparser import EventDataParserConfig, split_frames
from enerf_ns.sensor.thresholds import chosen_thresholds

MOST_FLAGS = 3
"""Most flags that are shown; those before are worth more."""


def in_words(scene: Scene) -> tuple[str, ...]:
    """Sentences on the data that the field learns from, on what is assumed, and on what is learned beside it. What
    limits the result most stands first.

    Args:
        scene: In which all rows have been decided.
    """
    panorama = ""
    if scene.value("model.panorama"):
        panorama = (
            "The camera only turns, so that the field is a panorama: it has no depth and no mesh, and its pictures are "
            "right only for views from where the camera was."
        )
    return tuple(sentence for sentence in (panorama, _limits(scene), _data(scene), _learned(scene)) if sentence)


def flags_to_state(scene: Scene) -> tuple[str, ...]:
    """Flags that state what is assumed or measured of a scene, or that use more of its recording.

    Args:
        scene: In which all rows have been decided.
    """
    recording, parser = scene.recording, scene.parser
    has_box = scene.value(f"{DATAPARSER}.box") is not None
    flags = {
        "--pipeline.model.contrast-thresholds ON OFF": _assumes_threshold(scene),
        "--pipeline.datamanager.supervision events+frames": _holds_frames(scene) and not scene.use_frames,
        "--pipeline.model.mean-brightness MEAN": _assumes_level(scene),
        "event-data --depth-range NEAR FAR": not (recording.depth_range or parser.depth_range or has_box)
        and not scene.value("model.panorama"),
    }
    return tuple(flag for flag, is_open in flags.items() if is_open)[:MOST_FLAGS]


def _holds_frames(scene: Scene) -> bool:
    """Whether a camera took frames, rather than a reconstruction from the events."""
    return scene.recording.has_frames and scene.recording.reconstructed_by is None


def _assumes_threshold(scene: Scene) -> bool:
    learns = bool(scene.value("model.sensor.learn_mean_threshold"))
    return scene.use_events and scene.once(chosen_thresholds).is_assumed and not learns


def _assumes_level(scene: Scene) -> bool:
    is_open = scene.use_events and not scene.use_frames and not _holds_frames(scene)
    return is_open and scene.given("model.mean_brightness") is None


def _limits(scene: Scene) -> str:
    """Facts that the recording does not hold, and their effect."""
    known = [] if _holds_frames(scene) else ["the recording holds no frames"]
    if _assumes_threshold(scene):
        mean = 0.5 * sum(scene.once(chosen_thresholds).values)
        known.append(f"the mean contrast threshold is assumed ({mean:.3g})")
    if not known:
        return ""
    open_up_to = ["a power"] * _assumes_threshold(scene) + ["a scale"] * _assumes_level(scene)
    sentence = _listed(known)
    sentence = sentence[0].upper() + sentence[1:]
    if open_up_to:
        sentence += f": brightness is known up to {_listed(open_up_to)}"
    return sentence + "."


def _data(scene: Scene) -> str:
    """The events and the frames from which the field learns."""
    sources = []
    if scene.use_events:
        first, last = scene.index.span
        sources.append(f"{len(scene.index):,} events over {(last - first) * 1e-9:.3g} s")
    parser = scene.resolved().datamanager.dataparser
    assert isinstance(parser, EventDataParserConfig)
    if scene.use_frames:
        frames, _ = split_frames(scene.recording, parser, held_out=False)
        sources.append(f"{len(frames.times)} frames")
    sentence = f"The field learns from {_listed(sources)}"
    held_out, are_frames = split_frames(scene.recording, parser, held_out=True)
    if are_frames:
        sentence += f", and is scored at {len(held_out.times)} held-out frames"
    return sentence + "."


def _learned(scene: Scene) -> str:
    """The parts of the sensor, the frames and the poses that are learned beside the field."""
    sensor = scene.config.model.sensor
    learned = [
        field.name.removeprefix("learn_").replace("_", " ")
        for field in fields(sensor)
        if field.name.startswith("learn_") and scene.value(f"model.sensor.{field.name}")
    ]
    learned += ["exposure of each frame"] * bool(scene.value("model.learn_exposure"))
    corrected = [part for part in PARTS if scene.value(f"poses.refine_{part}") is not False]
    sentences = [f"Training also learns the {_listed(learned)}."] if learned else []
    if corrected:
        sentences.append(f"Training corrects {_listed(corrected)} of the poses if events show that they are wrong.")
    return " ".join(sentences)


def _listed(words: list[str]) -> str:
    """Words as a list in a sentence."""
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)

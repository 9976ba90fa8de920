"""What is used for a scene, and why: decided once, from the recording and from what the user set.

Where a setting is None, the preset decides; where that does not, the recording; and where that does not either, the
method. Whatever the user set stands, also where it equals a default.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, field
from operator import attrgetter
from typing import Any, Protocol, TypeVar

from enerf_ns.dataparsers.depth_range import scene_depth_range
from enerf_ns.dataparsers.errors import FlagError
from enerf_ns.dataparsers.event_dataparser import DEFAULT_HELD_OUT_EVERY, EventDataParserConfig
from enerf_ns.dataparsers.files import load_image
from enerf_ns.dataparsers.indexing import index_events
from enerf_ns.dataparsers.recording import EventRecording
from enerf_ns.dataparsers.scene_box import scene_normalisation
from enerf_ns.enerf_datamanager import EnerfDataManagerConfig
from enerf_ns.enerf_model import EnerfModelConfig
from enerf_ns.paper_selections import preset_named, selections
from enerf_ns.sensor.response import ColourFilter, response_named
from enerf_ns.sensor.sensor_model import GREY, thresholds_from_polarity
from enerf_ns.supervision.event_supervision import EVENT_LOSSES

DATAPARSER = "datamanager.dataparser"


@dataclass(frozen=True)
class MethodDefaults:
    """What a method uses where neither the user nor a preset says otherwise; the fields are those of its config."""

    event_pairs: int = 1024
    silent_pairs: int = 341
    train_num_rays_per_batch: int = 1024
    event_loss: str = "huber"
    no_event_loss_weight: float = 0.1
    no_event_margin: float = 0.0
    paper_batch: bool = False
    """Whether presets bring their batch sizes, which are for a GPU."""


DEFAULT_SILENCE_MS = 20.0

LARGEST_RESOLUTION = 4096
"""Most cells along the box that are chosen for the finest level of the hash grid."""


class PipelineConfig(Protocol):
    """The config of a pipeline, which is what gets resolved."""

    datamanager: EnerfDataManagerConfig
    model: EnerfModelConfig
    defaults: MethodDefaults


ConfigT = TypeVar("ConfigT", bound=PipelineConfig)


@dataclass(frozen=True)
class Choice:
    """One part of the method: whether it is kept for this scene, and why."""

    part: str
    kept: bool
    value: str
    why: str


@dataclass(frozen=True)
class Resolution:
    """What is used where a config leaves it open, and all choices; empty before anything was resolved."""

    values: dict[str, Any] = field(default_factory=dict)
    """What is used, by the name of the setting within the config of the pipeline, such as model.num_channels."""
    choices: tuple[Choice, ...] = ()
    """What was chosen and why, a row for each part of the method."""
    selection: tuple[str, ...] = ()
    """What there is to say about the preset, one sentence each."""

    def applied_to(self, config: ConfigT) -> ConfigT:
        """A copy of a pipeline's config in which nothing is open."""
        filled = deepcopy(config)
        for name, value in self.values.items():
            section, _, attribute = name.rpartition(".")
            part = attrgetter(section)(filled)
            if getattr(part, attribute) is None:
                setattr(part, attribute, value)
        return filled


def resolve(config: PipelineConfig, recording: EventRecording, preset: str | None = None) -> Resolution:
    """Decides all that a config leaves open. Nothing is changed; the same arguments give the same answer.

    Args:
        config: What the user set, and None for the rest.
        recording: What is learnt from. Its events are indexed only for what is open.
        preset: A sequence of the paper whose selections are used.

    Returns:
        What is used, and a row for each choice.

    Raises:
        RecordingError: The depth of the scene cannot be measured, or a preset selects frames that are not there.
        FlagError: A setting asks for what there is not.
    """
    return _Resolver(config, recording, preset).resolution()


class _Resolver:
    def __init__(self, config: PipelineConfig, recording: EventRecording, preset: str | None):
        self.config = config
        self.values: dict[str, Any] = {}
        self.choices: list[Choice] = []
        self.selection: list[str] = []
        self.preset_values: dict[str, Any] = {}
        if preset is not None:
            name, paper_batch = preset_named(preset), config.defaults.paper_batch
            self.preset_values, self.selection = selections(name, recording, self.parser, paper_batch)
            self._note_flags()
        time_range = self.use(f"{DATAPARSER}.time_range", lambda: None)
        self.recording = recording.selected(time_range, self.parser.keep_hot_pixels)

    @property
    def parser(self) -> EventDataParserConfig:
        parser = self.config.datamanager.dataparser
        assert isinstance(parser, EventDataParserConfig)
        return parser

    def use(self, name: str, otherwise: Callable[[], Any]) -> Any:
        """What is used for a setting: what the user set, else what the preset says, else what is given here."""
        value = attrgetter(name)(self.config)
        if value is not None:
            return value
        value = self.preset_values[name] if name in self.preset_values else otherwise()
        if value is not None:
            self.values[name] = value
        return value

    def why(self, name: str, otherwise: str) -> str:
        """Who decided a setting."""
        if attrgetter(name)(self.config) is not None:
            return "set by flag"
        return "the preset states it" if name in self.preset_values else otherwise

    def row(self, part: str, kept: bool, value: str, why: str) -> None:
        self.choices.append(Choice(part, kept, value, why))

    def resolution(self) -> Resolution:
        self._split()
        self._events()
        self._sensor()
        self._supervision()
        self._field()
        return Resolution(self.values, tuple(self.choices), tuple(self.selection))

    def _note_flags(self) -> None:
        """Says which settings of the preset the user set otherwise."""
        flags = [
            "--" + name.rpartition(".")[2].replace("_", "-")
            for name, value in self.preset_values.items()
            if attrgetter(name)(self.config) not in (None, value)
        ]
        if self.parser.held_out_every is not None:
            flags.append("--held-out-every")
        if flags:
            self.selection.append(f"Set by flag, not by the preset: {', '.join(flags)}.")

    def _split(self) -> None:
        """Which frames there are to learn from, and which are held out."""
        supervision, recording = self.config.datamanager.supervision, self.recording
        if "frames" in supervision and not recording.has_frames:
            raise FlagError(
                f"{recording.path}: the recording holds no frames, but --pipeline.datamanager.supervision "
                f"{supervision} learns from them; use --pipeline.datamanager.supervision events"
            )
        for name in ("train_frame_indices", "held_out_frame_indices"):
            self.use(f"{DATAPARSER}.{name}", lambda: None)
        every = self.parser.held_out_every if self.parser.held_out_every is not None else DEFAULT_HELD_OUT_EVERY
        frames = recording.blurred_frames or recording.frames
        num_frames = len(frames.times) if frames else 0
        if "frames" in supervision and not 1 <= every // 2 < num_frames:
            raise FlagError(
                f"{recording.path}: --held-out-every {every} splits none of {num_frames} frames off; it "
                "must be at least 2 and less than twice their number, where the field learns from frames"
            )

    def _events(self) -> None:
        """Which pairs are drawn."""
        data, defaults, recording = self.config.datamanager, self.config.defaults, self.recording
        pairs = self.use("datamanager.event_pairs", lambda: defaults.event_pairs)
        blind = self.use("model.sensor.refractory_period_ns", lambda: recording.refractory_period)
        mode = self.use("datamanager.pair_mode", lambda: "successor" if blind else "partner")
        if "events" not in data.supervision:
            self.row("event loss", False, "", f"supervision is {data.supervision}")
            return
        values = {
            "successor": "each event with the pixel's next",
            "partner": f"each event with one of the pixel's next {data.max_pair_distance}",
            "window": f"each event with the pixel's last in {data.window_ms:g} ms",
        }
        why = "learns from events"
        if blind:
            why += f"; pixels are blind for {blind * 1e-6:g} ms after an event"
            if mode != "successor":
                why += ", for which only datamanager.pair-mode successor is exact"
        self.row("event loss", True, f"{pairs} pairs a step: {values[mode]}", why)

    def _sensor(self) -> None:
        """What the sensor is like that made the events."""
        recording, use_events = self.recording, "events" in self.config.datamanager.supervision
        name = "model.sensor.contrast_thresholds"
        counts = None

        def from_recording() -> tuple[float, float]:
            nonlocal counts
            if recording.contrast_thresholds is not None:
                return recording.contrast_thresholds
            index = index_events(recording)
            counts = index.num_positive, len(index) - index.num_positive
            return thresholds_from_polarity(*counts)

        thresholds = self.use(name, from_recording)
        why = "the recording states them"
        if counts is not None:
            why = f"{counts[0]:,} on and {counts[1]:,} off events; their mean is assumed"
        self.row("contrast thresholds", use_events, "on {:.3f}, off {:.3f}".format(*thresholds), self.why(name, why))

        name = "model.sensor.response"
        response = self.use(name, lambda: recording.response or "linlog")
        _check("--pipeline.model.response", lambda: response_named(response))
        why = "the recording states it" if recording.response else "the response of E-NeRF"
        self.row("response", use_events, response, self.why(name, why))

        name = "model.sensor.bayer_pattern"
        pattern = self.use(name, lambda: recording.bayer_pattern or GREY)
        self.use("model.sensor.width", lambda: recording.camera.width)
        if pattern != GREY:
            _check("--pipeline.model.bayer-pattern", lambda: ColourFilter(pattern, recording.camera.width))

    def _supervision(self) -> None:
        """Which losses there are."""
        data, model, defaults, recording = (
            self.config.datamanager, self.config.model, self.config.defaults, self.recording,
        )  # fmt: skip
        use_events, use_frames = "events" in data.supervision, "frames" in data.supervision
        loss = self.use("model.event_loss", lambda: defaults.event_loss)
        if loss not in EVENT_LOSSES:
            raise FlagError(
                f"--pipeline.model.event-loss is {loss!r}, but one of {', '.join(EVENT_LOSSES)} was expected."
            )
        self.use("model.no_event_loss_weight", lambda: defaults.no_event_loss_weight)
        self.use("model.no_event_margin", lambda: defaults.no_event_margin)
        silent_pairs = self.use("datamanager.silent_pairs", lambda: defaults.silent_pairs)
        self.use("datamanager.silence_ms", lambda: DEFAULT_SILENCE_MS)
        if use_events and silent_pairs:
            self.row(
                "no-event loss", True, f"{silent_pairs} silent pairs a step", "keeps surfaces without texture even"
            )
        else:
            why = (
                "datamanager.silent-pairs is 0; silent pixels are not searched" if use_events else "no events are used"
            )
            self.row("no-event loss", False, "", why)

        self.use("datamanager.train_num_rays_per_batch", lambda: defaults.train_num_rays_per_batch)
        if use_frames:
            blurred = self.parser.train_frames == "blurred" and recording.blurred_frames is not None
            what = "blurred frames" if blurred else "sharp frames"
            self.row("frame loss", True, what, f"supervision is {data.supervision}")
        else:
            why = "supervision is events; add frames by datamanager.supervision events+frames"
            self.row("frame loss", False, "", why if recording.has_frames else "the recording holds no frames")

        pattern = model.sensor.bayer_pattern or self.values["model.sensor.bayer_pattern"]
        colour_events = use_events and pattern != GREY
        if colour_events and model.num_channels == 1:
            raise FlagError(
                f"{recording.path}: the sensor has a colour filter ({pattern}), but "
                "--pipeline.model.num-channels is 1; leave that flag out, or set it to 3"
            )
        frames = recording.blurred_frames or recording.frames
        channels = self.use(
            "model.num_channels",
            lambda: (
                3
                if colour_events or (use_frames and frames is not None and is_colour(load_image(frames.filenames[0])))
                else 1
            ),
        )
        why = "the field learns from colour frames" if channels == 3 else "nothing here is in colour"
        if colour_events:
            why = f"the sensor has a colour filter ({pattern})"
        self.row("colour", channels == 3, f"{channels} channel(s)", self.why("model.num_channels", why))

    def _field(self) -> None:
        """What the field is like, and the box that it fills."""
        model, recording = self.config.model, self.recording
        lens = recording.camera.model
        self.row("undistortion", lens != "pinhole", lens, "the calibration states it")
        why = "model.view-direction" + ("" if model.view_direction else " is off: brightness as of matt surfaces")
        self.row("view direction", model.view_direction, "", why)

        name = f"{DATAPARSER}.depth_range"
        box = self.use(f"{DATAPARSER}.box", lambda: None)
        stated = self.use(name, lambda: None)
        near, far = scene_depth_range(recording, stated)
        if stated is None:
            self.values[name] = near, far
        _, scale, _ = scene_normalisation(recording, near, far, box)
        if box is None:
            value = f"box of depths {near:.2f} m to {far:.2f} m"
            why = "the recording states it" if recording.depth_range else "measured from events and poses"
            why = self.why(name, why)
        else:
            value, why = f"cube of {2 * box[3]:g} m", self.why(f"{DATAPARSER}.box", "")
        self.row("contraction", False, value, why)

        self.use("model.near_plane", lambda: near * scale)
        footprint = math.sqrt(near * far) / recording.camera.fx * scale
        finest = 2 ** round(math.log2(2.0 * 2.0 / footprint))
        name = "model.max_res"
        resolution = self.use(name, lambda: min(max(finest, 2 * model.base_res), LARGEST_RESOLUTION))
        levels = f"{model.num_levels} levels, {model.base_res} to {resolution} cells"
        self.row("hash grid", True, levels, self.why(name, "sensor's pixels"))


def _check(flag: str, make: Callable[[], object]) -> None:
    """Raises FlagError with what is wrong with a flag, where making what it names does not work."""
    try:
        make()
    except ValueError as error:
        raise FlagError(f"{flag} is {error}") from error


def is_colour(image) -> bool:
    """Whether a picture (height, width, channels) holds anything but grey."""
    return image.shape[2] >= 3 and bool((image[..., :1] != image[..., 1:3]).any())

"""What is used for a scene, and why: decided once, from the recording and from what the user set.

Where a setting is None, the preset decides; where that does not, the recording; and where that does not either, the
method. Whatever the user set stands, also where it equals a default.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, field, replace
from functools import cached_property
from operator import attrgetter
from typing import Any, Protocol, TypeVar

import numpy as np

from enerf_ns.choices.presets import preset_named, selections
from enerf_ns.dataparsers.event_dataparser import DEFAULT_HELD_OUT_EVERY, EventDataParserConfig, split_frames
from enerf_ns.dataparsers.index.indexing import describe_gaps, index_events
from enerf_ns.dataparsers.inspection.agreement import Estimate as AgreementEstimate
from enerf_ns.dataparsers.inspection.agreement import clock_and_lens, clock_of_frames
from enerf_ns.dataparsers.recording.errors import FlagError
from enerf_ns.dataparsers.recording.pose_noise import pose_noise
from enerf_ns.dataparsers.recording.recording import EventRecording, Frames, percent
from enerf_ns.dataparsers.scene.depth_range import scene_depth_range, share_beyond
from enerf_ns.dataparsers.scene.scene_box import scene_normalisation
from enerf_ns.dataparsers.sensor_estimates.estimates import (
    Estimate,
    contrast_thresholds,
    errors_of_learning,
    median_interval,
    noise_per_event,
    refractory_period,
    scene_variance,
    threshold_spread,
)
from enerf_ns.dataparsers.sensor_estimates.frame_contrast import EXPOSURE_CHANGES, exposure_change, mean_brightness
from enerf_ns.events.statistics import border_rate, log_brightness_range, silent_share
from enerf_ns.poses.corrections import Corrections
from enerf_ns.poses.motion import exposure_motion
from enerf_ns.poses.refiner import RefinerConfig, turns_about_two_axes
from enerf_ns.rendering.field import LOG_SIGMOID_RANGE
from enerf_ns.sensor.response import ColourFilter, response_named
from enerf_ns.sensor.sensor_model import GREY
from enerf_ns.supervision.event_supervision import EVENT_LOSSES

DATAPARSER = "datamanager.dataparser"

MEAN_BRIGHTNESS = 0.3
"""Geometric mean of brightness near which a field is held where neither frames nor a flag tell it: both what is three
times as bright and what is a third as bright lie where the field and linlog are logarithmic."""

FRAME_LOSS_WEIGHT = 10.0
"""Weight of the frame loss beside the regularisers."""

HELD_OUT_SPANS = 8
"""Number of spans of time whose events are kept from training."""


@dataclass(frozen=True)
class MethodDefaults:
    """What a method uses where neither the user nor a preset says otherwise; the fields are those of its config."""

    event_pairs: int = 1024
    silent_pairs: int = 341
    train_num_rays_per_batch: int = 1024
    instants: bool = True
    """Whether half of all pairs are of any two instants, in place of silent ones, where the field learns from events
    alone and pixels are never blind."""
    silent_pairs_beside_frames: int = 128
    """Silent pairs where the field learns from frames, too, which tell of plain surfaces as well."""
    rays_beside_events: int = 426
    """Rays of frames where the field learns from events, too: those that silent pairs have less."""
    noisy_pairs_beside_frames: int = 256
    """Pairs of noisy events where the field learns from frames, too, which tell more and have as many rays as by
    themselves; silent pairs in proportion."""
    event_loss: str = "huber"
    no_event_loss_weight: float = 0.1
    no_event_margin: float = 0.0
    level_loss_weight: float = 0.1
    """Where the field learns from events alone."""
    refines_poses: bool = True
    """Whether clock, mount, lens and drift of the poses are corrected where events show that they are wrong."""
    learns_sensor: bool = True
    """Whether what the recording does not state of its sensor is measured and learned, instead of assumed."""
    whole_preset: bool = False
    """Whether presets bring their box and batch sizes, too, which are those of the paper's network."""
    settings: tuple[tuple[str, Any], ...] = ()
    """What the method sets, which presets and recordings leave alone: names within the config of the pipeline, such as
    model.sampling, and values."""


USUAL_RESPONSE = "logarithm:0.01"
"""Response of a sensor that states none, where events alone are learnt from. With linlog, which is linear up to 8 % of
full brightness, slider_depth comes out 1.2 dB worse, and its contrast 1.36 times too small in place of 1.06 times."""

DEFAULT_SILENCE_MS = 20.0
DEFAULT_WINDOW_MS = 60.0

LONGEST_ACCUMULATION = 0.05
"""Longest window of accumulated events, as a share of the recording's time: EventNeRF's 50 of 1000 views."""

LONGEST_DISTANCE = 10
"""Most events that are chosen for a partner to lie ahead; at least 2."""

MOST_NOISE = 0.1
"""Variance, in squared thresholds, of what noise adds to the events of a pair that is as far apart as any."""

MOST_NOISE_BETWEEN, NOISE_OF_SCENE = 1.0, 0.125
"""The same of pairs of any two instants, whose brightness is not known much better; and what it may be as a share of
the variance of the brightness that a pixel sees, where that is more."""

LEARNED_WITHIN = {"threshold_ratio": 0.05, "leak_rate": 0.5, "cutoff_frequency": 1.0}
"""Largest standard errors (`errors_of_learning`) with which something is learned of an unknown sensor; a parameter that
a recording is too short to tell keeps what it starts from."""

LEAST_LAG = 0.05
"""Least delay of pixels, as a share of the median interval between their events, that is worth a lag in the model: a
twentieth of a threshold."""

LARGEST_RESOLUTION = 4096
"""Most cells along the box that are chosen for the finest level of the hash grid."""

MOST_LEVELS = 10
"""Most levels that are chosen for the hash grid."""

SMALLEST_GROWTH = 1.4
"""Least factor by which a level of the hash grid is finer than the one before; closer ones hold nearly the same."""

SHARE_BEYOND = 0.05
"""Share of the events from beyond the box above which there is space there."""

PIXELS_PER_INSTANT = 2.0
"""Pixels that the picture moves during an exposure for each instant of it that is rendered."""

MOST_INSTANTS = 16
"""Most instants of an exposure that are chosen to be rendered."""

SEEN_AROUND = math.radians(30)
"""Angle (rad) over which the middle of the scene must be seen before gloss is looked for: within less, what gloss adds
looks like texture."""

SMALLEST_GAIN = 0.02
"""Least share by which a part must lower the error of held-out pairs to be kept."""

SMALLEST_SILENT_SHARE = 0.01
"""Least share of the time that pixels must be silent for silent pixels to be searched; below, hardly one is found."""

SILENT_BORDER = 0.02
"""Share of a sensor's mean events a pixel below which its border is silent, as around an object before nothing."""


LARGEST_LAG_MS = 5.0
"""Milliseconds up to which events that are late against all else are taken to be late by the lag of pixels, where that
is learned: to first order it cannot be told from a clock. A photoreceptor of 200 Hz lags by 2.3 ms in the mean over
what it sees."""

LARGEST_NOISE = 0.1
"""Pixels by which noise of the poses may move the picture before it is taken off."""

SMALLEST_DELAY, SMALLEST_SCALE = 2.0, 0.06
"""Delay (ms) of a clock, and share of the focal length, from which on refinement starts there; less it finds itself.
On simulated recordings that are right, sharpest events are off by up to 1.1 ms and 4.5 %, several times their standard
errors."""


class PipelineConfig(Protocol):
    """The config of a pipeline, which is what gets resolved. Its parts stand above this room."""

    datamanager: Any
    model: Any
    poses: RefinerConfig
    defaults: MethodDefaults


ConfigT = TypeVar("ConfigT", bound=PipelineConfig)


@dataclass(frozen=True)
class Choice:
    """One part of the method: whether it is kept for this scene, and why."""

    part: str
    kept: bool
    value: str
    why: str
    flag: str = ""
    """Flag of `ns-train` by which it is forced; those of event-data come last on the command line."""


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


Probe = Callable[[Any], "tuple[float, float]"]
"""What gains a part of the model: a function of the config of a pipeline, with all but that part decided, that gives by
which share the part lowers the error of held-out pairs, and the standard error of that."""


def resolve(
    config: PipelineConfig,
    recording: EventRecording,
    preset: str | None = None,
    probe: Probe | None = None,
    batch_factor: Callable[[Any], int] = lambda config: 1,
) -> Resolution:
    """Decides all that a config leaves open. Nothing is changed; the same arguments give the same answer.

    Args:
        config: What the user set, and None for the rest.
        recording: What is learnt from.
        preset: A sequence of the paper whose selections are used.
        probe: What letting brightness depend on the direction gains; asked where the camera goes around the scene.
            None: nothing.
        batch_factor: How many times the rays of the method a step may have on the device, of a config in which all else
            is decided.

    Returns:
        What is used, and a row for each choice.

    Raises:
        RecordingError: The depth of the scene cannot be measured, or a preset selects frames that are not there.
        FlagError: A setting asks for what there is not.
    """
    return _Resolver(config, recording, preset, probe, batch_factor).resolution()


class _Resolver:
    def __init__(
        self,
        config: PipelineConfig,
        recording: EventRecording,
        preset: str | None,
        probe: Probe | None,
        batch_factor: Callable[[Any], int],
    ):
        self.config, self.probe, self.batch_factor = config, probe, batch_factor
        self.values: dict[str, Any] = {}
        self.choices: list[Choice] = []
        self.selection: list[str] = []
        self.preset_values: dict[str, Any] = {}
        self._blind_why = ""
        self._frames_tell_more = False
        self._level_from = ""
        self._blind = 0
        if preset is not None:
            name, whole = preset_named(preset), config.defaults.whole_preset
            self.preset_values, self.selection = selections(name, recording, self.parser, whole)
            self._note_flags()
        self.train_frames = self.use(f"{DATAPARSER}.train_frames", lambda: "blurred")
        time_range = self.use(f"{DATAPARSER}.time_range", lambda: None)
        parser = self.parser
        selection = time_range, parser.keep_hot_pixels, parser.keep_pose_gaps, parser.undistort
        self.recording = recording.selected(*selection)
        self._of_poses = pose_noise(self.recording.trajectory)
        name = f"{DATAPARSER}.smooth_poses"
        if self.use(name, self._is_noisy):
            self.recording = recording.selected(*selection, smooth_poses=True)

    @property
    def use_events(self) -> bool:
        return "events" in self.config.datamanager.supervision

    @property
    def use_frames(self) -> bool:
        return "frames" in self.config.datamanager.supervision

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

    def _value(self, name: str) -> Any:
        """What is used for a setting, as far as it is decided by now."""
        value = attrgetter(name)(self.config)
        return self.values.get(name) if value is None else value

    def why(self, name: str, otherwise: str) -> str:
        """Who decided a setting."""
        value = attrgetter(name)(self.config)
        if value is not None:
            return "set by the method" if (name, value) in self.config.defaults.settings else "set by flag"
        return "the preset states it" if name in self.preset_values else otherwise

    def row(self, part: str, kept: bool, value: str, why: str, name: str) -> None:
        """Adds a choice.

        Args:
            part, kept, value, why: As of `Choice`.
            name: Of the setting that forces it, within the config of the pipeline.
        """
        prefix, _, setting = name.rpartition(".")
        prefix = {DATAPARSER: "event-data --", "model.sensor": "--pipeline.model.", "poses": "--pipeline."}.get(
            prefix, f"--pipeline.{prefix}."
        )
        self.choices.append(Choice(part, kept, value, why, prefix + setting.replace("_", "-")))

    def resolution(self) -> Resolution:
        self._split()
        self._poses()
        self._events()
        self._silent_pixels()
        self._sensor()
        self._clock_and_lens()
        self._pose_noise()
        self._dynamic_range()
        self._frames()
        self._colour()
        self._box()
        self._exposure()
        self._grid()
        self._rays()
        self._gloss()
        self._batch()
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

    def _poses(self) -> None:
        """Whether what lies between poses that are far apart is used."""
        recording, name, kept = self.recording, f"{DATAPARSER}.keep_pose_gaps", self.parser.keep_pose_gaps
        gaps = recording.pose_gaps
        if not len(gaps):
            why = f"none is longer than {recording.trajectory.longest_step * 1e-9:.3g} s"
            self.row("pose gaps", False, "", why, name)
            return
        index = index_events(recording)
        why = f"{index.num_in_gaps:,} events ({percent(index.num_in_gaps / len(index))}) lie in {describe_gaps(gaps)}"
        self.row("pose gaps", kept, "used" if kept else "left out", "set by flag; " * kept + why, name)

    def _is_noisy(self) -> bool:
        """Whether noise of the poses matters."""
        noise = self._of_poses
        return noise is not None and noise.pixels(self.recording.camera.fx, self._distance) > LARGEST_NOISE

    @property
    def _distance(self) -> float:
        """About how far away (m) the scene is, before that is known: as far as the camera goes."""
        near, far = self.parser.depth_range or self.recording.depth_range or 2 * (_path_extent(self.recording) or 1.0,)
        return math.sqrt(near * far)

    def _pose_noise(self) -> None:
        """Whether what is white noise of the poses is taken off."""
        name = f"{DATAPARSER}.smooth_poses"
        smooth = bool(self._value(name))
        noise = self._of_poses
        if noise is None:
            self.row("noise of poses", smooth, "", "there are too few poses, or too many, to tell it", name)
            return
        pixels = noise.pixels(self.recording.camera.fx, self._distance)
        value = f"{1e3 * noise.position:.2g} mm and {math.degrees(noise.rotation):.2g} degrees are taken off"
        value += "; what that leaves is refined" * (self._value("poses.refine_drift") is not False)
        why = f"it moves the picture by {pixels:.2g} pixels"
        self.row("noise of poses", smooth, value * smooth, self.why(name, why), name)

    def _clock_and_lens(self) -> None:
        """Where the refinement of poses and lens starts."""
        poses, recording, refines = self.config.poses, self.recording, self.config.defaults.refines_poses
        parts = ("clock", "mount", "lens", "drift")
        is_blind = self.use_events and 1e-6 * self._blind > LEAST_LAG * median_interval(index_events(recording))
        for part in parts:
            stated = {"clock": poses.clock_ms, "lens": poses.focal_scale}.get(part)
            refined = getattr(poses, f"refine_{part}")
            given = part == "lens" and self.use_frames  # whose pictures are undistorted once
            if refined is None and (stated is not None or not refines or not self.use_events or is_blind or given):
                self.values[f"poses.refine_{part}"] = False
        kept = [part for part in parts if self._value(f"poses.refine_{part}") is not False]
        starts = refines and self.use_events and poses.clock_ms is None and poses.refine_clock is not False
        found = clock_and_lens(recording, self._distance) if starts or "lens" in kept else None
        clock, late, scale = 0.0, 0.0, 1.0
        words: dict[str, list[str]] = {"clock": [], "lens": []}
        if found is not None:
            delay, lens = found
            if starts and delay.is_identifiable:
                has_frames = recording.has_frames and not recording.reconstructed_by
                frames = clock_of_frames(recording, (self._distance, self._distance)) if has_frames else None
                if frames is not None and frames.is_identifiable:
                    lag = min(frames.value, 0.0)
                    if abs(delay.value - frames.value) < 2.0 * delay.error:
                        delay = frames  # on one clock, which frames tell better
                else:
                    lag = min(delay.value, 0.0)
                if frames is not None and not _is_wrong(frames, 0.0, SMALLEST_DELAY):
                    frames = None
                if self._value("model.sensor.learn_cutoff_frequency") and -LARGEST_LAG_MS < lag < 0.0:
                    words["clock"].append(f"{-lag:.2f} ms by which events are late are left to the lag of the pixels")
                    delay = replace(delay, value=delay.value - lag)
                    frames = None
                if frames is not None:
                    late = frames.value
                    words["clock"].append(f"frames are stamped {late:+.2f} ± {frames.error:.2f} ms late")
                if _is_wrong(delay, 0.0, SMALLEST_DELAY):
                    clock = delay.value
                    words["clock"].append(f"poses are stamped {clock:+.2f} ± {delay.error:.2f} ms late")
            turns = poses.refine_lens or turns_about_two_axes(recording.trajectory)
            if "lens" in kept and turns and _is_wrong(lens, 1.0, SMALLEST_SCALE):
                scale = lens.value
                words["lens"].append(f"the focal length is {scale:.3f} ± {lens.error:.3f} of the stated one")
        clock = self.use("poses.clock_ms", lambda: clock)
        late = self.use("poses.frame_delay_ms", lambda: late)
        scale = self.use("poses.focal_scale", lambda: scale)
        self._say_refined(kept, words, {"clock": bool(clock or late), "lens": scale != 1.0}, is_blind)
        self._posed = Corrections(delay=clock, frame_delay=late, focal_scale=scale).recording(recording)

    def _say_refined(
        self, kept: list[str], found: dict[str, list[str]], starts: dict[str, bool], is_blind: bool
    ) -> None:
        """A row for each thing that may be wrong with the poses, and whether it is corrected.

        Args:
            kept: What is corrected where events show that it is wrong.
            found: What the sharpest events say of it before training.
            starts: Whether it is corrected before training.
            is_blind: Whether pixels are blind after events.
        """
        poses = self.config.poses
        names = {"clock": "clock of the poses", "mount": "mount", "lens": "lens", "drift": "drift of the poses"}
        stated = {"clock": (poses.clock_ms, poses.frame_delay_ms), "lens": (poses.focal_scale,)}
        for part, name in names.items():
            setting = f"poses.refine_{part}"
            value = "corrected before training" * starts.get(part, False)
            why = "events are compared with what is rendered of them" if part in kept else "taken as it is stated"
            why = "; ".join(found.get(part, [])) or why
            if part in kept:
                value = "corrected where events show that it is wrong"
            elif is_blind:
                why += "; pixels are blind after events, which hides what else is wrong"
            if any(flag is not None for flag in (getattr(poses, f"refine_{part}"), *stated.get(part, ()))):
                why = "set by flag"
            elif not self.config.defaults.refines_poses or not self.use_events:
                why = "not part of the method" if self.use_events else "learns from frames alone"
            self.row(name, bool(value), value, why, setting)

    def _events(self) -> None:
        """Which pairs are drawn."""
        data, defaults, recording = self.config.datamanager, self.config.defaults, self.recording
        share = data.held_out_events
        value = f"{100 * share:.3g} % of the time, in {HELD_OUT_SPANS} spans" if share else ""
        why = "what is learnt is checked by them" if share else "the correlation of events is that of training pairs"
        self.row("held-out events", bool(share), value, why, "datamanager.held_out_events")
        blind = self.use("model.sensor.refractory_period_ns", self._refractory_period)
        mode = self.use("datamanager.pair_mode", lambda: "successor" if blind else "partner")
        longest = LONGEST_ACCUMULATION * 1e-6 * (recording.span[1] - recording.span[0])
        distance, noise = LONGEST_DISTANCE, ""
        if mode == "partner" and defaults.learns_sensor and self.use_events:
            found = self._noise.value
            distance = max(2, min(LONGEST_DISTANCE, round(MOST_NOISE / max(found, 1e-9))))
            noise = f"; their noise adds {found:.2g} squared thresholds an event"
            self._frames_tell_more = self.use_frames and distance < LONGEST_DISTANCE
        more = self._frames_tell_more
        alone = mode == "partner" and defaults.instants and self.use_events and not self.use_frames and not blind
        alone = alone and data.silent_pairs is None
        both = defaults.event_pairs + defaults.silent_pairs
        instants = self.use("datamanager.instant_pairs", lambda: (data.event_pairs or both // 2) if alone else 0)
        usual = both - both // 2 if instants else defaults.event_pairs
        pairs = self.use("datamanager.event_pairs", lambda: defaults.noisy_pairs_beside_frames if more else usual)
        distance = self.use("datamanager.max_pair_distance", lambda: distance)
        window = self.use("datamanager.window_ms", lambda: longest if mode == "accumulated" else DEFAULT_WINDOW_MS)
        if not self.use_events:
            self.row("event loss", False, "", f"supervision is {data.supervision}", "datamanager.supervision")
            return
        values = {
            "successor": "each event with the pixel's next",
            "partner": f"each event with one of the pixel's next {distance}",
            "window": f"each event with the pixel's last in {window:g} ms",
            "accumulated": f"the sum of a pixel's events over up to {window:g} ms",
        }
        why = "learns from events" + noise
        if blind and mode != "successor":
            why += "; while pixels are blind after an event, only datamanager.pair-mode successor is exact"
        self.row("event loss", True, f"{pairs} pairs a step: {values[mode]}", why, "datamanager.supervision")
        self._instants(instants, bool(blind))

    def _instants(self, pairs: int, blind: bool) -> None:
        """How far any two instants may be apart whose events are summed."""
        name, value = "datamanager.instant_pairs", ""
        apart = self.use("datamanager.instants_apart_ms", self._longest_worth_summing if pairs else lambda: 0.0)
        if pairs:
            value = f"{pairs} pairs a step, up to {apart:.3g} ms apart, whatever fired between them"
        why = "between edges a ray sees what a pixel sees"
        if blind:
            why = "pixels that are blind after an event miss changes between their events"
        elif self.use_frames:
            why = "frames tell of what lies between edges"
        elif not self.config.defaults.instants:
            why = "the method does without"
        elif not pairs:
            why = "other pairs are set by flag"
        self.row("any instants", bool(pairs), value, self.why(name, why), name)

    def _longest_worth_summing(self) -> float:
        """Time (ms) in which the noise of a pixel's events adds up to what is worth it; the whole recording at most."""
        index, noise = index_events(self.recording), self._noise.value
        first, last = index.span
        a_pixel = len(index) / max(int((index.offsets.diff() > 0).sum()), 1)
        scene = scene_variance(index, self._balanced_thresholds, noise)
        most = max(MOST_NOISE_BETWEEN, NOISE_OF_SCENE * scene)
        share = min(max(2.0, most / max(noise, 1e-9)) / a_pixel, 1.0)
        return max(1e-6 * (last - first) * share, 1e-6)

    def _silent_pixels(self) -> None:
        """Whether pixels that stay silent are learnt from, and how."""
        defaults, name = self.config.defaults, "datamanager.silent_pairs"
        loss = self.use("model.event_loss", lambda: defaults.event_loss)
        if loss not in EVENT_LOSSES:
            raise FlagError(
                f"--pipeline.model.event-loss is {loss!r}, but one of {', '.join(EVENT_LOSSES)} was expected."
            )
        self.use("model.no_event_loss_weight", lambda: defaults.no_event_loss_weight)
        self.use("model.no_event_margin", lambda: defaults.no_event_margin)
        silence = self.use("datamanager.silence_ms", lambda: DEFAULT_SILENCE_MS)
        if not self.use_events:
            self.use(name, lambda: 0)
            self.row("silent pixels", False, "", "no events are used", "datamanager.supervision")
            return
        share = silent_share(index_events(self.recording), round(silence * 1e6))
        between = self.config.datamanager.silent_mode == "intervals"
        found = between or share > SMALLEST_SILENT_SHARE
        usual = defaults.silent_pairs_beside_frames if self.use_frames else defaults.silent_pairs
        instants = self.config.datamanager.instant_pairs or self.values.get("datamanager.instant_pairs")
        if instants:
            usual = 0
        if self._frames_tell_more:
            usual = usual * defaults.noisy_pairs_beside_frames // defaults.event_pairs
        silent_pairs = self.use(name, lambda: usual if found else 0)
        value = f"{silent_pairs} pairs a step" if silent_pairs else "they are not searched"
        why = f"pixels are silent for {silence:g} ms and longer during {100 * share:.1f} % of the time"
        if between:
            value += ", between successive events" if silent_pairs else ""
            why = "all pixels are silent between their events"
        if not defaults.silent_pairs:
            why = "the method does without"
        elif instants:
            why = "pairs of any instants tell of silence, too"
        self.row("silent pixels", bool(silent_pairs), value, self.why(name, why), name)

    @cached_property
    def _noise(self) -> Estimate:
        return noise_per_event(index_events(self.recording), self._balanced_thresholds)

    @cached_property
    def _seen_range(self) -> tuple[float, str]:
        """The range of log brightness that a pixel sees by its events, once thresholds are chosen, and a reason."""
        thresholds = self.config.model.sensor.contrast_thresholds or self.values["model.sensor.contrast_thresholds"]
        index = index_events(self.recording)
        learns = self.config.defaults.learns_sensor
        if learns and self._blind:  # what pixels miss is seldom as much of either polarity
            on, off = self._balanced_thresholds
            thresholds = 0.5 * sum(thresholds) * on, 0.5 * sum(thresholds) * off
        sums = span = log_brightness_range(index, thresholds)
        why = f"events of a pixel span {sums:.2g} of log brightness"
        if learns:
            half = log_brightness_range(index, thresholds, parts=2)
            span = max(2.0 * half - sums, 0.0)
            why += f", {half:.2g} in half of the time: {span:.2g} without what drifts"
        return span, f"{why}, {'more' if span > LOG_SIGMOID_RANGE else 'less'} than {LOG_SIGMOID_RANGE:g}"

    @property
    def _balanced_thresholds(self) -> tuple[float, float]:
        """Thresholds with a mean of 1 under which all events together cancel."""
        index = index_events(self.recording)
        num_on = max(index.num_positive, 1)
        num_off = max(len(index) - index.num_positive, 1)
        return 2.0 * num_off / (num_on + num_off), 2.0 * num_on / (num_on + num_off)

    def _refractory_period(self) -> int:
        """The recording's own, else what its events tell, ns."""
        self._blind_why = "the recording states it"
        if self.recording.refractory_period or not (self.use_events and self.config.defaults.learns_sensor):
            return self.recording.refractory_period
        found = refractory_period(index_events(self.recording))
        self._blind_why = found.why if found else ""
        return round(found.value) if found else 0

    def _sensor(self) -> None:
        """What the sensor is like that made the events, and what of it is learned."""
        recording = self.recording
        learns = self.use_events and self.config.defaults.learns_sensor
        name = "model.sensor.refractory_period_ns"
        blind = self._blind = attrgetter(name)(Resolution(self.values).applied_to(self.config))
        value = f"blind for {blind * 1e-6:.4g} ms after an event" if blind else ""
        why = self._blind_why if blind else "the recording states none, and its events show none"
        self.row("refractory period", self.use_events and bool(blind), value, self.why(name, why), name)

        name = "model.sensor.contrast_thresholds"
        assumed: tuple[Estimate, Estimate, bool] | None = None

        def from_recording() -> tuple[float, float]:
            nonlocal assumed
            if recording.contrast_thresholds is not None:
                return recording.contrast_thresholds
            assumed = contrast_thresholds(recording, blind)
            return assumed[0].value, assumed[1].value

        on, off = self.use(name, from_recording)
        index = index_events(recording) if learns and assumed is not None else None
        errors = errors_of_learning(index) if index is not None else {}
        tells = errors.get("threshold_ratio", math.inf) <= LEARNED_WITHIN["threshold_ratio"]
        ratio = self.use("model.sensor.learn_threshold_ratio", lambda: tells and bool(blind))
        # where pixels are never blind, counts tell it better: on slider_depth what was learned drifted by a fifth
        mean = self.use("model.sensor.learn_mean_threshold", lambda: tells and self.use_frames)
        why = self.why(name, "the recording states them" if assumed is None else assumed[0].why)
        if index is not None and not tells:
            why += f"; {len(index):,} events are too few to learn more"
        learned = " and ".join(["their ratio"] * ratio + ["their mean"] * mean)
        value = f"on {on:.3f}, off {off:.3f}" if on != off else f"{on:.3f} for both"
        value += f"; {learned} {'are' if ratio and mean else 'is'} learned" if learned else ""
        self.row("threshold per polarity", self.use_events and (on != off or ratio), value, why, name)

        name = "model.sensor.learn_threshold_map"
        spread = threshold_spread(index, (on, off)) if index is not None else None
        kept = self.use(name, lambda: spread is not None)
        why = spread.why if spread else "events do not show that the thresholds of pixels differ"
        value = "thresholds of each pixel are learned" if kept else ""
        self.row("threshold map", kept, value, self.why(name, why), name)

        lag_hides = blind and "pixels that are blind after events miss what would tell how far they lag"
        leaks, lags = "what the memory of pixels loses by itself", "how far pixels lag behind brightness"
        for part, setting, what, stated, unit, hidden in (
            ("leak", "leak_rate", leaks, "{:g} on events a second", "on events a second", ""),
            ("bandwidth", "cutoff_frequency", lags, "cut off at {:g} Hz", "ms", lag_hides or ""),
        ):
            name = f"model.sensor.learn_{setting}"
            given = attrgetter(f"model.sensor.{setting}")(self.config)
            error = errors.get(setting, math.inf)
            tells = error <= LEARNED_WITHIN[setting]
            kept = self.use(name, lambda learns=tells and not given and not hidden: learns)
            why = "the sensor is known" if learns else "the method does without"
            if index is not None:
                few = "" if tells else ", too few to learn it"
                why = (
                    hidden or f"the sensor is unknown, and {len(index):,} events tell it within {error:.2g} {unit}{few}"
                )
            why = "set by flag" if given else self.why(name, why)
            value = f"{what} is learned" if kept else stated.format(given) if given else ""
            if part == "bandwidth" and kept and index is not None and attrgetter(name)(self.config) is None:
                found = LEAST_LAG * median_interval(index)
                least = self.use("model.sensor.least_delay", lambda found=found: found)
                value += f", and left out if it is less than {least:.2g} ms" if least else ""
            self.row(part, self.use_events and bool(kept or given), value, why, name)

        name = "model.sensor.second_cutoff_frequency"
        second = attrgetter(name)(self.config)
        if second:
            self.row(
                "second stage",
                self.use_events,
                f"pixels lag by {1e3 / (2 * math.pi * second):.3g} ms more",
                "set by flag",
                name,
            )

        name = "model.sensor.response"
        usual, why, stated = "linlog", "the response of E-NeRF", recording.response if self.use_frames else None
        if learns and not self.use_frames and self._seen_range[0] > LOG_SIGMOID_RANGE:
            # worth 1.1 dB on statue beside the response that it states
            why = f"pixels see more than {LOG_SIGMOID_RANGE:g} of log brightness; linlog bounds what the darkest counts"
        elif learns and not self.use_frames:
            usual, why, stated = USUAL_RESPONSE, "pixels see the logarithm of brightness", recording.response
        response = self.use(name, lambda: stated or usual)
        _check("--pipeline.model.response", lambda: response_named(response))
        if stated:
            why = "the recording states it"
        elif recording.response and not learns:
            why += f"; {recording.response}, which the recording states, matters where frames tell brightness"
        unknown = index is not None and self.config.model.sensor.response is None and not stated
        learned = self.use("model.sensor.learn_response", lambda: unknown and tells and self.use_frames)
        value = f"learned, starting from {response}" if learned else response
        why += "; frames tell it better" if learned else ""
        self.row("response", self.use_events, value, self.why(name, why), name)

        name = "model.level_loss_weight"
        alone = self.use_events and not self.use_frames
        weight = self.use(name, lambda: self.config.defaults.level_loss_weight if alone else 0.0)
        why = "events leave the level of brightness open" if alone else "frames tell the level of brightness"
        level = self.use("model.mean_brightness", self._mean_brightness if weight else lambda: MEAN_BRIGHTNESS)
        why = self.why("model.mean_brightness", why) if weight else why
        value = f"held near {level:.3g}{self._level_from}"
        self.row("level of brightness", bool(weight), value, self.why(name, why), name)

        name = "model.sensor.bayer_pattern"
        pattern = self.use(name, lambda: recording.bayer_pattern or GREY)
        self.use("model.sensor.width", lambda: recording.camera.width)
        self.use("model.sensor.height", lambda: recording.camera.height)
        if pattern != GREY:
            _check("--pipeline.model.bayer-pattern", lambda: ColourFilter(pattern, recording.camera.width))

    def _mean_brightness(self) -> float:
        """What the frames that are not held out show; `MEAN_BRIGHTNESS` where they tell nothing of it."""
        if not self.recording.has_frames or self.recording.reconstructed_by:
            return MEAN_BRIGHTNESS
        frames, _ = split_frames(self.recording, self.parser, held_out=False)
        data = Resolution(self.values).applied_to(self.config).datamanager
        assert data.event_pairs is not None
        pairs = data.event_pairs + (data.instant_pairs or 0) + (data.silent_pairs or 0)
        found = mean_brightness(self.recording, frames, data.event_pairs / pairs)
        if found is None:
            return MEAN_BRIGHTNESS
        self._level_from = ", the geometric mean of the frames"
        return found

    def _dynamic_range(self) -> None:
        """Whether brightness has an upper limit."""
        name = "model.brightness"
        span, why = self._seen_range if self.use_events else (0.0, "no events are used")
        activation = self.use(name, lambda: "exponential" if span > LOG_SIGMOID_RANGE else "log-sigmoid")
        self.row("high dynamic range", activation == "exponential", activation, self.why(name, why), name)

    def _frames(self) -> None:
        """Whether frames are learnt from, and whether a second camera took them."""
        data, recording, name = self.config.datamanager, self.recording, "datamanager.supervision"
        defaults = self.config.defaults
        beside = self.use_events and self.use_frames and not self._frames_tell_more
        rays = defaults.rays_beside_events if beside else defaults.train_num_rays_per_batch
        self.use("datamanager.train_num_rays_per_batch", lambda: rays)
        if not (self.use_events and self.use_frames and self.config.model.event_loss_weight):
            self.use("model.frame_loss_weight", lambda: FRAME_LOSS_WEIGHT)
        if not self.use_frames:
            why = f"supervision is {data.supervision}" if recording.has_frames else "the recording holds no frames"
            self.row("frame loss", False, "", why, name)
            return
        blurred = self.train_frames == "blurred" and recording.blurred_frames is not None
        what = "blurred frames" if blurred else "sharp frames"
        if blurred and recording.reconstructed_by is not None:
            what = f"frames of events, by {recording.reconstructed_by}"
        if self.use_events and self.config.model.frame_loss_weight is None:
            what += ", whose weight the errors of events and frames make"
        why = f"supervision is {data.supervision}"
        if self._frames_tell_more:
            why += "; they have the rays of most pairs, since events are noisy"
        self.row("frame loss", True, what, why, name)
        frames = recording.blurred_frames if blurred else recording.frames
        if frames is not None and self.use_events:
            second = frames.trajectory is not recording.trajectory or frames.camera != recording.camera
            value = f"{frames.camera.width} x {frames.camera.height}, {frames.camera.model}" if second else ""
            why = "the calibration states it" if second else "frames and events are of one camera"
            self.row("second camera", second, value, why, name)
        self._exposure_of_frames(frames)

    def _exposure_of_frames(self, frames: Frames | None) -> None:
        """Whether the exposure of each frame is learned."""
        name = "model.learn_exposure"
        change, learns = None, self.use_events and self.config.defaults.learns_sensor
        if learns and frames is not None and self.recording.reconstructed_by is None:
            trained, _ = split_frames(self.recording, self.parser, held_out=False)
            change = exposure_change(self.recording, trained)
        learns = self.use(name, lambda: change is not None and change > EXPOSURE_CHANGES)
        why = "nothing tells whether the exposure of frames changes"
        if change is not None:
            why = f"pixels without events change by {100 * change:.2g} % from frame to frame"
        value = "a gain and an offset of each are learned" if learns else ""
        self.row("exposure of frames", bool(learns), value, self.why(name, why), name)

    def _colour(self) -> None:
        """How many colour channels the field has."""
        recording, name = self.recording, "model.num_channels"
        pattern = self.config.model.sensor.bayer_pattern or self.values["model.sensor.bayer_pattern"]
        colour_events = self.use_events and pattern != GREY
        if colour_events and self.config.model.num_channels == 1:
            raise FlagError(
                f"{recording.path}: the sensor has a colour filter ({pattern}), but "
                "--pipeline.model.num-channels is 1; leave that flag out, or set it to 3"
            )
        frames = recording.blurred_frames or recording.frames
        channels = self.use(
            name,
            lambda: (
                3 if colour_events or (self.use_frames and frames is not None and is_colour(frames.image(0))) else 1
            ),
        )
        why = "the field learns from colour frames" if channels == 3 else "nothing here is in colour"
        if colour_events:
            why = f"the sensor has a colour filter ({pattern})"
        self.row("colour", channels == 3, f"{channels} channel(s)", self.why(name, why), name)

    def _box(self) -> None:
        """Where the scene lies, and whether it goes on beyond."""
        recording = self.recording
        lens = recording.camera.model
        why = "the calibration states it" if self.parser.undistort else "set by flag"
        self.row("undistortion", lens != "pinhole", lens, why, f"{DATAPARSER}.undistort")

        name = f"{DATAPARSER}.depth_range"
        box = self.use(f"{DATAPARSER}.box", lambda: None)
        stated = self.use(name, lambda: None)
        near, far = self._depth_range = scene_depth_range(self._posed, stated)
        if stated is None:
            self.values[name] = near, far
        _, self._scale, _ = scene_normalisation(recording, near, far, box)
        if box is None:
            value = f"depths {near:.2f} m to {far:.2f} m"
            why = self.why(name, "the recording states them" if recording.depth_range else "measured from the events")
        else:
            name = f"{DATAPARSER}.box"
            value, why = f"cube of {2 * box[3]:g} m", self.why(name, "")
        self.row("box", True, value, why, name)
        self.use("model.near_plane", lambda: near * self._scale)

        name = "model.contraction"
        share = 0.0 if box is not None else share_beyond(recording, (near, far))
        self._contracted = self.use(name, lambda: share > SHARE_BEYOND)
        why = "the box is set" if box is not None else f"{100 * share:.1f} % of the events come from beyond {far:.3g} m"
        self.row("contraction", self._contracted, "space beyond the box" * self._contracted, self.why(name, why), name)

    def _exposure(self) -> None:
        """Over how many instants of its exposure each frame is averaged."""
        if not self.use_frames:
            return
        name = "datamanager.exposure_samples"
        parser = Resolution(self.values).applied_to(self.config).datamanager.dataparser
        assert isinstance(parser, EventDataParserConfig)
        frames, _ = split_frames(self.recording, parser, held_out=False)
        if frames.exposures is None:
            if (self.config.datamanager.exposure_samples or 1) > 1:
                raise FlagError(
                    f"{self.recording.path}: the recording states no exposures, but "
                    "--pipeline.datamanager.exposure-samples averages over them; state them with event-data "
                    "--exposure-ms"
                )
            why = "the recording states no exposures; --exposure-ms does"
            self.row("exposure", False, "each frame is taken as an instant", why, f"{DATAPARSER}.exposure_ms")
            return
        all_frames, _ = split_frames(self.recording, replace(parser, exposure_ms=0.0), held_out=False)
        num_left_out = len(all_frames.times) - len(frames.times)
        motion = float(np.median(exposure_motion(frames, *self._depth_range)))
        instants = self.use(name, lambda: min(max(1, round(motion / PIXELS_PER_INSTANT)), MOST_INSTANTS))
        value = f"each frame is the mean over {instants} instants" if instants > 1 else "taken as an instant"
        why = (
            f"{'set by flag; ' * (parser.exposure_ms is not None)}within {np.median(frames.exposures) * 1e-6:.3g} ms "
            f"the picture moves by {motion:.3g} pixels"
        )
        if num_left_out:
            why += f"; {num_left_out} frames whose exposures reach beyond the poses are left out"
        self.row("exposure", instants > 1, value, self.why(name, why), name)

    def _grid(self) -> None:
        """How fine the scene is."""
        model, (near, far) = self.config.model, self._depth_range
        footprint = math.sqrt(near * far) / self.recording.camera.fx * self._scale
        finest = 2 ** round(math.log2(2.0 * 2.0 / footprint))
        resolution = self.use("model.max_res", lambda: min(max(finest, 2 * model.base_res), LARGEST_RESOLUTION))
        name = "model.num_levels"
        ratio = max(resolution / model.base_res, 1.0)
        levels = self.use(name, lambda: min(1 + round(math.log(ratio) / math.log(SMALLEST_GROWTH)), MOST_LEVELS))
        growth = ratio ** (1 / (levels - 1)) if levels > 1 else 1.0
        why = f"as fine as the sensor's pixels, each {growth:.2f} times as fine as the one before"
        why = self.why("model.max_res" if model.max_res is not None else name, why)
        self.row("hash grid", True, f"{levels} levels, {model.base_res} to {resolution} cells", why, name)

    def _rays(self) -> None:
        """Where rays are sampled, and whether all meet a surface."""
        model, recording, (near, far) = self.config.model, self.recording, self._depth_range
        name = "model.sampling"
        nearness = 1 / near - (0.0 if self._contracted else 1 / far)
        disparity = recording.camera.fx * _path_extent(recording) * nearness
        sampling = self.use(
            name, lambda: "proposal"
        )  # also where these pixels are few: even samples lost 2 to 5 dB at 11
        value = f"{model.num_proposal_samples} + {model.num_samples} samples a ray"
        if sampling == "uniform":
            value = f"{model.num_samples} samples a ray, evenly spaced"
        why = f"the path moves the nearest point by {disparity:.0f} pixels against the farthest"
        self.row("proposal network", sampling == "proposal", value, self.why(name, why), name)

        name = "model.opacity_loss_weight"
        why, before_nothing = "learns from frames alone", False
        if self.use_events:
            share = border_rate(index_events(recording), recording.camera.height)
            before_nothing = share < SILENT_BORDER
            what = "an object before nothing" if before_nothing else "rays meet surfaces there too"
            why = f"pixels at the sensor's border fired {share:.2g} times as often as the others: {what}"
        weight = self.use(name, lambda: 0.0 if before_nothing else 1.0)
        self.row("opacity loss", bool(weight), f"weight {weight:g}" if weight else "", self.why(name, why), name)

    def _gloss(self) -> None:
        """Whether brightness depends on the direction from which a point is seen."""
        name, width = "model.view_direction", _angle_of_view(self.recording, *self._depth_range)
        why = f"the camera goes {math.degrees(width):.0f} degrees around the scene"
        kept = attrgetter(name)(self.config)
        if kept is None and width < SEEN_AROUND:
            why += ", too little to tell gloss from texture"
        elif kept is None and self.probe is None:
            why += ", but nothing was trained to probe it"
        elif kept is None and self.probe is not None:
            gain, error = self.probe(Resolution(self.values).applied_to(self.config))
            kept = gain > max(SMALLEST_GAIN, 2.0 * error)
            why += f", and it lowers the error of held-out pairs by {100 * gain:.1f} ± {100 * error:.1f} %"
        kept = self.use(name, lambda: bool(kept))
        self.row("view direction", kept, "", self.why(name, why), name)

    def _batch(self) -> None:
        """How many rays a step has, where neither the user nor a preset nor the paper says."""
        numbers = ("event_pairs", "instant_pairs", "silent_pairs", "train_num_rays_per_batch")
        names = [f"datamanager.{name}" for name in numbers]
        chosen = [name for name in names if name in self.values and name not in self.preset_values]
        if self.config.defaults.whole_preset or chosen != names:
            return
        factor = self.batch_factor(Resolution(self.values).applied_to(self.config))
        if factor > 1:
            self.values |= {name: factor * self.values[name] for name in names}
            value = f"{factor} times the pairs and rays of the method"
            self.row("larger batch", True, value, "a step takes hardly longer with them", names[0])


def _is_wrong(estimate: AgreementEstimate, stated: float, smallest: float) -> bool:
    """Whether a value is told to differ from what is stated, and by more than the smallest that matters."""
    apart = abs(estimate.value - stated)
    return estimate.is_identifiable and apart > max(smallest, 3.0 * estimate.error)


def _path_extent(recording: EventRecording) -> float:
    """Diagonal of the box around the path of the camera while it is used, metres."""
    times, (start, end) = recording.trajectory.times, recording.span
    positions = recording.trajectory.positions[(times >= start) & (times <= end)]
    return float(np.linalg.norm(np.ptp(positions, axis=0))) if len(positions) else 0.0


def _angle_of_view(recording: EventRecording, near: float, far: float) -> float:
    """Angle (rad) under which the path of the camera is seen from the middle of the scene."""
    return 2.0 * math.atan(0.5 * _path_extent(recording) / math.sqrt(near * far))


def _check(flag: str, make: Callable[[], object]) -> None:
    """Raises FlagError with what is wrong with a flag, where making what it names does not work."""
    try:
        make()
    except ValueError as error:
        raise FlagError(f"{flag} is {error}") from error


def is_colour(image) -> bool:
    """Whether a picture (height, width, channels) holds anything but grey."""
    return image.shape[2] >= 3 and bool((image[..., :1] != image[..., 1:3]).any())

"""A scene as the rows of the table of choices see it."""

from __future__ import annotations

from collections.abc import Callable
from operator import attrgetter
from typing import Any, TypeVar

import numpy as np

from enerf_ns.choices.presets import preset_named, selections
from enerf_ns.choices.resolution import Choice, MethodDefaults, PipelineConfig, Resolution
from enerf_ns.dataparsers.event_dataparser import EventDataParserConfig
from enerf_ns.dataparsers.index.event_index import EventIndex
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.recording.recording import EventRecording
from enerf_ns.rendering.field import LOG_SIGMOID_RANGE

DATAPARSER = "datamanager.dataparser"
"""Place of the data parser within the config of the pipeline."""

T = TypeVar("T")


class Scene:
    """The recording, the settings of the user, of the method and of the preset, and what the rows before decided.

    A setting is named by its place within the config of the pipeline, such as model.num_channels.

    Args:
        config: The config of a pipeline; None for the settings that are to be decided.
        recording: The recording that the field learns from.
        preset: Name of a sequence of the paper whose selections are used.

    Raises:
        FlagError: The preset does not exist.
        RecordingError: The preset selects frames that the recording does not have.
    """

    limited_range = LOG_SIGMOID_RANGE
    """Range of log brightness that a field with an upper limit of brightness renders."""

    def __init__(self, config: PipelineConfig, recording: EventRecording, preset: str | None):
        self.config = config
        self.recording = recording
        """The recording; rows at the start select a part of it."""
        self.values: dict[str, Any] = {}
        """Decided values of the settings that the config leaves open."""
        self.choices: list[Choice] = []
        self.selection: list[str] = []
        """Notes about the preset."""
        self.cause = ""
        """Likely cause why the events cannot be explained, as a clause; empty if nothing is known to be wrong."""
        self.preset_values: dict[str, Any] = {}
        self._found: dict[Callable[[Scene], Any], Any] = {}
        if preset is not None:
            name, whole = preset_named(preset), config.defaults.whole_preset
            self.preset_values, self.selection = selections(name, recording, self.parser, whole)
            self._note_flags()

    def _note_flags(self) -> None:
        """Notes the settings of the preset that the user set otherwise."""
        flags = [
            "--" + name.rpartition(".")[2].replace("_", "-")
            for name, value in self.preset_values.items()
            if self.given(name) not in (None, value)
        ]
        if self.parser.held_out_every is not None:
            flags.append("--held-out-every")
        if flags:
            self.selection.append(f"Set by flag, not by the preset: {', '.join(flags)}.")

    @property
    def defaults(self) -> MethodDefaults:
        """Values that the method uses."""
        return self.config.defaults

    @property
    def parser(self) -> EventDataParserConfig:
        """The data parser as the user set it."""
        parser = self.config.datamanager.dataparser
        assert isinstance(parser, EventDataParserConfig)
        return parser

    @property
    def index(self) -> EventIndex:
        """The events of the recording by pixel."""
        return index_events(self.recording)

    @property
    def use_events(self) -> bool:
        """Whether the field learns from events."""
        return "events" in self.config.datamanager.supervision

    @property
    def use_frames(self) -> bool:
        """Whether the field learns from frames."""
        return "frames" in self.config.datamanager.supervision

    @property
    def learns_sensor(self) -> bool:
        """Whether the method measures and learns what the recording does not state of its sensor."""
        return self.use_events and self.defaults.learns_sensor

    def given(self, name: str) -> Any:
        """The value that the user or the method set; None if neither did."""
        return attrgetter(name)(self.config)

    def value(self, name: str) -> Any:
        """The value of a setting as it is decided by now; None if it is not."""
        value = self.given(name)
        return self.values.get(name) if value is None else value

    def use(self, name: str, otherwise: Callable[[], Any]) -> Any:
        """Decides a setting: the given value, else the preset's, else what `otherwise` returns."""
        value = self.given(name)
        if value is not None:
            return value
        value = self.preset_values[name] if name in self.preset_values else otherwise()
        if value is not None:
            self.values[name] = value
        return value

    def why(self, name: str, otherwise: str) -> str:
        """The reason for a setting: who set it, else the reason given here."""
        value = self.given(name)
        if value is not None:
            return "set by the method" if (name, value) in self.defaults.settings else "set by flag"
        return "the preset states it" if name in self.preset_values else otherwise

    def row(self, part: str, kept: bool, value: str, why: str, name: str) -> None:
        """Adds a row to the table of choices.

        Args:
            part, kept, value, why: The fields of `Choice`.
            name: The setting that forces it.
        """
        prefix, _, setting = name.rpartition(".")
        prefix = {DATAPARSER: "event-data --", "model.sensor": "--pipeline.model.", "poses": "--pipeline."}.get(
            prefix, f"--pipeline.{prefix}."
        )
        self.choices.append(Choice(part, kept, value, why, prefix + setting.replace("_", "-")))

    def once(self, measure: Callable[[Any], T]) -> T:
        """The result of a function of this scene, which is called once."""
        if measure not in self._found:
            self._found[measure] = measure(self)
        return self._found[measure]

    def resolved(self) -> PipelineConfig:
        """The config with what is decided by now."""
        return Resolution(self.values).applied_to(self.config)


def path_extent(recording: EventRecording) -> float:
    """Diagonal (m) of the box around the path of the camera while the recording is used."""
    times, (start, end) = recording.trajectory.times, recording.span
    positions = recording.trajectory.positions[(times >= start) & (times <= end)]
    return float(np.linalg.norm(np.ptp(positions, axis=0))) if len(positions) else 0.0

"""The values that a resolution is made from, and those that it holds."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass, field
from operator import attrgetter
from typing import Any, Protocol, TypeVar

from enerf_ns.poses.refiner import RefinerConfig
from enerf_ns.sensor.sensor_model import SensorModelConfig


@dataclass(frozen=True)
class MethodDefaults:
    """Values that a method uses unless the user or a preset states others; the fields are those of its config."""

    event_pairs: int = 1024
    silent_pairs: int = 341
    train_num_rays_per_batch: int = 1024
    instants: bool = True
    """Whether half of all pairs are of any two instants, in place of silent ones, if the field learns from events alone
    and pixels are never blind."""
    silent_pairs_beside_frames: int = 128
    """Silent pairs if the field learns from frames as well, which constrain untextured surfaces, too."""
    rays_beside_events: int = 426
    """Rays of frames if the field learns from events as well: as many as silent pairs are reduced by."""
    noisy_pairs_beside_frames: int = 256
    """Pairs of noisy events if the field learns from frames as well. Frames then have as many rays as without events,
    and silent pairs are reduced in proportion."""
    event_loss: str = "huber"
    no_event_loss_weight: float = 0.1
    no_event_margin: float = 0.0
    level_loss_weight: float = 0.1
    """Weight of the level loss if the field learns from events alone."""
    refines_poses: bool = True
    """Whether clock, mount, lens and drift of the poses are corrected if events show that they are wrong."""
    learns_sensor: bool = True
    """Whether the method measures and learns what the recording does not state of its sensor, or assumes it."""
    whole_preset: bool = False
    """Whether presets set the box and the batch sizes as well, which are those of the paper's network."""
    settings: tuple[tuple[str, Any], ...] = ()
    """Settings of the method that presets and recordings do not change: names within the config of the pipeline, such
    as model.sampling, and values."""


class DataSettings(Protocol):
    """The part of the config of a data manager that choices depend on."""

    @property
    def dataparser(self) -> Any: ...  # Nerfstudio types it as one of all data parsers
    @property
    def supervision(self) -> str: ...
    @property
    def held_out_events(self) -> float: ...
    @property
    def silent_mode(self) -> str: ...
    @property
    def event_pairs(self) -> int | None: ...
    @property
    def instant_pairs(self) -> int | None: ...
    @property
    def silent_pairs(self) -> int | None: ...
    @property
    def exposure_samples(self) -> int | None: ...


class ModelSettings(Protocol):
    """The part of the config of a model that choices depend on."""

    @property
    def sensor(self) -> SensorModelConfig: ...
    @property
    def event_loss_weight(self) -> float: ...
    @property
    def frame_loss_weight(self) -> float | None: ...
    @property
    def num_channels(self) -> int | None: ...
    @property
    def base_res(self) -> int: ...
    @property
    def max_res(self) -> int | None: ...
    @property
    def num_samples(self) -> int: ...
    @property
    def num_proposal_samples(self) -> int: ...


class PipelineConfig(Protocol):
    """The config of a pipeline, whose open settings are resolved. The classes of its parts stand above this room."""

    @property
    def datamanager(self) -> DataSettings: ...
    @property
    def model(self) -> ModelSettings: ...
    @property
    def poses(self) -> RefinerConfig: ...
    @property
    def defaults(self) -> MethodDefaults: ...


ConfigT = TypeVar("ConfigT", bound=PipelineConfig)


@dataclass(frozen=True)
class Choice:
    """One part of the method: whether it is kept for this scene, and why."""

    part: str
    kept: bool
    value: str
    why: str
    flag: str = ""
    """Flag of `ns-train` that forces it; flags of event-data come last on the command line."""


@dataclass(frozen=True)
class Resolution:
    """Values for the settings that a config leaves open, and all choices; empty before anything was resolved."""

    values: dict[str, Any] = field(default_factory=dict)
    """Values by the name of the setting within the config of the pipeline, such as model.num_channels."""
    choices: tuple[Choice, ...] = ()
    """A row for each part of the method."""
    selection: tuple[str, ...] = ()
    """Notes about the preset, one sentence each."""
    summary: tuple[str, ...] = ()
    """Sentences on the data that the field learns from, on what is assumed, and on what is learned beside it."""
    flags_to_state: tuple[str, ...] = ()
    """Flags of `ns-train` that state what the recording does not."""
    cause: str = ""
    """Likely cause why the events cannot be explained, as a clause; empty if nothing is known to be wrong."""

    def applied_to(self, config: ConfigT) -> ConfigT:
        """A copy of a pipeline's config in which the open settings are filled in."""
        filled = deepcopy(config)
        for name, value in self.values.items():
            section, _, attribute = name.rpartition(".")
            part = attrgetter(section)(filled)
            if getattr(part, attribute) is None:
                setattr(part, attribute, value)
        return filled

"""The base of the parts that a sensor model is made of.

A part is one property of an event sensor, such as its leak rate, in one module: a dataclass with its settings, and a
subclass of `SensorPart` with its parameters, what it changes between brightness and events, its learning rates, the
ranges of its settings, and its row in the table of choices. `enerf_ns.sensor.sensor_model` lists the parts.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, Optional, Protocol, TypeVar

import tyro
from jaxtyping import Float, Int64
from torch import Tensor, nn

from enerf_ns.dataparsers.index.event_index import EventIndex
from enerf_ns.dataparsers.recording.recording import EventRecording
from enerf_ns.events.batch import EventBatch
from enerf_ns.sensor.response import ColourFilter, pixel_brightness

GREY = "grey"
"""Name in place of a Bayer pattern for a sensor without a colour filter."""

OTHER_LEARNING_RATE = 1e-3
"""Learning rate of the group "sensor", which holds the parameters of parts that name no group."""

T = TypeVar("T")


class Trained(NamedTuple):
    """A parameter that a part may have."""

    parameter: str
    """Name within the sensor model, as in a checkpoint."""
    learning_rate: float
    """First learning rate of Adam; it falls to a tenth over a run."""


class SensorChoices(Protocol):
    """The view of a scene that the row of a part has. `enerf_ns.choices.scene.Scene` implements it."""

    @property
    def recording(self) -> EventRecording:
        """The recording that the field learns from."""
        ...

    @property
    def index(self) -> EventIndex:
        """Its events by pixel."""
        ...

    @property
    def use_events(self) -> bool:
        """Whether the field learns from events."""
        ...

    @property
    def use_frames(self) -> bool:
        """Whether the field learns from frames."""
        ...

    @property
    def learns_sensor(self) -> bool:
        """Whether the method measures and learns what the recording does not state of its sensor."""
        ...

    @property
    def limited_range(self) -> float:
        """Range of log brightness that a field with an upper limit of brightness renders."""
        ...

    def given(self, name: str) -> Any:
        """The value that the user or the method set; None if neither did."""
        ...

    def use(self, name: str, otherwise: Callable[[], Any]) -> Any:
        """Decides a setting: the given value, else the preset's, else what `otherwise` returns."""
        ...

    def why(self, name: str, otherwise: str) -> str:
        """The reason for a setting: who set it, else the reason given here."""
        ...

    def row(self, part: str, kept: bool, value: str, why: str, name: str) -> None:
        """Adds a row to the table of choices; `name` is the setting that forces it."""
        ...

    def once(self, measure: Callable[[Any], T]) -> T:
        """The result of a function of this scene, which is called once."""
        ...


@dataclass
class SensorPartConfig:
    """Size and colour filter of the sensor."""

    bayer_pattern: Optional[str] = None  # noqa: UP045
    """Colours of the pixels (0, 0), (1, 0), (0, 1) and (1, 1), such as RGGB; grey for a sensor without a colour filter.
    Default: the pattern that the recording states, else grey."""
    width: tyro.conf.Suppress[Optional[int]] = None  # noqa: UP045
    """Width of the sensor, pixels."""
    height: tyro.conf.Suppress[Optional[int]] = None  # noqa: UP045
    """Height of the sensor, pixels."""


class SensorPart(nn.Module):
    """The pixels of a sensor and their colour filter, on which every part builds.

    A part overrides the properties and methods that it changes, and calls `super()` in each for the parts below it.

    Args:
        config: Without a setting that is still open.

    Raises:
        ValueError: The colour filter does not exist.
    """

    trained: ClassVar[Mapping[str, Trained]] = {}
    """Parameters of this part by the name of their group of the optimizer."""
    setting_ranges: ClassVar[Mapping[str, tuple[float, float]]] = {}
    """Lowest and highest value of each setting of this part that is a number, or several."""

    def __init__(self, config: SensorPartConfig):
        super().__init__()
        assert config.bayer_pattern is not None
        self.colour_filter = None
        if config.bayer_pattern != GREY:
            assert config.width is not None
            self.colour_filter = ColourFilter(config.bayer_pattern, config.width)

    @classmethod
    def choose(cls, scene: SensorChoices) -> None:
        """Decides the settings of this part for a scene, and adds its rows to the table of choices."""

    @classmethod
    def parts(cls) -> list[type[SensorPart]]:
        """The classes that this sensor model is made of, in the order of their rows in the table of choices."""
        return [part for part in reversed(cls.__mro__) if issubclass(part, SensorPart)]

    @classmethod
    def ranges(cls) -> dict[str, tuple[float, float]]:
        """Lowest and highest value of each number in the config of this sensor model, by the name of its field."""
        of_size = {"width": (1, 2**15), "height": (1, 2**15)}
        return of_size | {name: limits for part in cls.parts() for name, limits in part.setting_ranges.items()}

    @classmethod
    def learning_rates(cls) -> dict[str, float]:
        """Learning rate of each group of parameters; all parameters are of the order of 1."""
        rates = {group: found.learning_rate for part in cls.parts() for group, found in part.trained.items()}
        return rates | {"sensor": OTHER_LEARNING_RATE}

    def get_param_groups(self) -> dict[str, list[nn.Parameter]]:
        """Parameters that are learned, by the name of their group; "sensor" holds those that no part names."""
        left = dict(self.named_parameters())
        named = {group: found.parameter for part in self.parts() for group, found in part.trained.items()}
        groups = {group: [left.pop(name)] for group, name in named.items() if name in left}
        return groups | {"sensor": list(left.values())} if left else groups

    def brightness(
        self, rgb: Float[Tensor, "*batch channels"], pixels: Int64[Tensor, "*batch"]
    ) -> Float[Tensor, "*batch"]:
        """Brightness that pixels see of one or three colour channels.

        Args:
            rgb: Linear brightness.
            pixels: Numbers of the pixels, y * width + x.
        """
        channel = None if self.colour_filter is None else self.colour_filter.channels(pixels)
        return pixel_brightness(rgb, channel)

    def observe(self, change: Float[Tensor, " pairs"], batch: EventBatch) -> None:
        """Learns, from what a training step rendered, what is not learned by gradients.

        Args:
            change: Rendered change of log brightness of each pair.
            batch: The pairs and their events.
        """

    def learned(self) -> dict[str, float]:
        """Values of the sensor that were learned, by name; empty if none was."""
        return {}


def choose_number(
    scene: SensorChoices,
    part: str,
    setting: str,
    words: tuple[str, str],
    is_unknown: bool,
    standard_error: tuple[float, float, str],
    hidden: str = "",
    when_learned: Callable[[], str] = lambda: "",
) -> None:
    """Decides whether a number is learned that an ideal sensor does not have, and adds its row.

    Args:
        part: Name of the row.
        setting: Name of the number in the config; learn_NAME is the setting that is decided.
        words: What is learned, and how a stated number is shown, with a place for it.
        is_unknown: Whether the recording does not state its sensor, and the method learns.
        standard_error: With which the events determine the number, the largest with which it is learned, and the unit.
        hidden: Why events do not determine it on this sensor; empty if they do.
        when_learned: Decides what else there is to decide if it is learned, and returns what the row says of it.
    """
    name, stated = f"model.sensor.learn_{setting}", scene.given(f"model.sensor.{setting}")
    error, largest, unit = standard_error
    enough = error <= largest
    kept = bool(scene.use(name, lambda: is_unknown and enough and not stated and not hidden))
    why = "the sensor is known" if scene.learns_sensor else "the method leaves it out"
    if is_unknown:
        few = "" if enough else ", too few to learn it"
        why = f"the sensor is unknown, and {len(scene.index):,} events determine it within {error:.2g} {unit}{few}"
        why = hidden or why
    why = "set by flag" if stated else scene.why(name, why)
    value = f"{words[0]} is learned{when_learned()}" if kept else words[1].format(stated) if stated else ""
    scene.row(part, scene.use_events and bool(kept or stated), value, why, name)

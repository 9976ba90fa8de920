"""A part is added to a sensor as docs/extending.md says: a class, its settings, and both in the lists of bases."""

from __future__ import annotations

import copy
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import pytest
import torch
from torch import Tensor, nn

from enerf_ns.choices.ranges import check_ranges
from enerf_ns.choices.resolver import resolve
from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.recording.errors import FlagError
from enerf_ns.method.config import enerf
from enerf_ns.sensor.part import SensorChoices, SensorPart, SensorPartConfig, Trained
from enerf_ns.sensor.sensor_model import SensorModel, SensorModelConfig


@dataclass
class DarkCurrentConfig(SensorPartConfig):
    dark_current: float = 0.0
    """Brightness that a pixel sees of darkness."""
    learn_dark_current: bool | None = None


class DarkCurrent(SensorPart):
    trained: ClassVar = {"dark_current": Trained("dark", 5e-3)}
    setting_ranges: ClassVar = {"dark_current": (0.0, 1.0)}

    def __init__(self, config: DarkCurrentConfig):
        super().__init__(config)
        self.dark: Tensor | float = config.dark_current
        if config.learn_dark_current:
            self.dark = nn.Parameter(torch.tensor(config.dark_current))

    @classmethod
    def choose(cls, scene: SensorChoices) -> None:
        name = "model.sensor.learn_dark_current"
        kept = scene.use(name, lambda: scene.use_events)
        scene.row("dark current", kept, "it is learned", scene.why(name, "darkness is seldom black"), name)

    def brightness(self, rgb: Tensor, pixels: Tensor) -> Tensor:
        return super().brightness(rgb, pixels) + self.dark

    def learned(self) -> dict[str, float]:
        found = super().learned()
        if isinstance(self.dark, Tensor):
            found["dark_current"] = float(self.dark.detach())
        return found


class DarkSensor(DarkCurrent, SensorModel):
    """All parts, and one more."""


@dataclass
class DarkSensorConfig(DarkCurrentConfig, SensorModelConfig):
    _target: type[SensorModel] = field(default_factory=lambda: DarkSensor)


def config(**changes: Any) -> Any:
    trainer: Any = copy.deepcopy(enerf.config)
    trainer.pipeline.model.sensor = DarkSensorConfig(**changes)
    return trainer


def test_an_added_part_has_its_row_group_rate_range_and_place_in_a_checkpoint(recording: Path):
    pipeline = config().pipeline
    resolution = resolve(pipeline, read_recording(recording))
    rows = {choice.part: choice for choice in resolution.choices}
    assert rows["dark current"].flag == "--pipeline.model.learn-dark-current"
    assert rows["dark current"].kept and rows["dark current"].why == "darkness is seldom black"
    sensor = resolution.applied_to(pipeline).model.sensor.setup()
    assert isinstance(sensor, DarkSensor) and "dark" in sensor.state_dict()
    assert sensor.get_param_groups() == {"dark_current": [sensor.dark]} and sensor.learned() == {"dark_current": 0.0}
    assert sensor.learning_rates() == SensorModel.learning_rates() | {"dark_current": 5e-3}
    rgb, pixels = torch.rand(5, 3), torch.arange(5)
    with torch.no_grad():
        sensor.dark += 0.25
    seen = sensor.log_brightness(rgb[:, :1], pixels)
    torch.testing.assert_close(seen, sensor.response(rgb[:, 0] + 0.25))
    torch.testing.assert_close(sensor.brightness(rgb[:, :1], pixels), rgb[:, 0] + 0.25)
    with pytest.raises(FlagError, match=r"^--pipeline\.model\.dark-current is 2, but must be from 0 to 1\.$"):
        check_ranges(config(dark_current=2.0))


def test_a_sensor_without_the_part_has_none_of_it(recording: Path):
    assert "dark_current" not in SensorModel.learning_rates() | SensorModel.ranges()
    resolution = resolve(enerf.config.pipeline, read_recording(recording))  # type: ignore[arg-type]
    assert "dark current" not in {choice.part for choice in resolution.choices}


def test_parts_stand_in_the_order_of_their_rows():
    names = [part.__name__ for part in SensorModel.parts()]
    expected = ["RefractoryPeriod", "Thresholds", "PixelThresholds", "Leak", "Lag", "PixelResponse"]
    assert [name for name in names if name in expected] == expected

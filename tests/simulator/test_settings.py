"""Tests of `settings.resolve`."""

from __future__ import annotations

import math
from dataclasses import fields
from pathlib import Path
from typing import Any, get_type_hints

import pytest

from enerf_ns.dataparsers.recording.errors import FlagError
from enerf_ns.simulator.event_sensor import SensorSettings
from enerf_ns.simulator.frames import FrameSettings
from enerf_ns.simulator.settings import SimulationSettings, resolve


@pytest.mark.parametrize(
    ("settings", "layout"),
    [
        (dict(scene="shapes"), "esim"),
        (dict(scene="mesh.glb"), "esim"),
        (dict(scene="shapes", layout="tum_vie"), "tum_vie"),
        (dict(scene="shapes", bayer_pattern="RGGB"), "event_recording"),
        (dict(scene="clip.MP4"), "event_recording"),
        (dict(scene="."), "event_recording"),
        (dict(from_run=Path("config.yml")), "event_recording"),
        (dict(from_run=Path("config.yml"), layout="esim"), "esim"),
    ],
)
def test_the_layout_is_one_that_can_hold_the_recording(settings: dict[str, Any], layout: str):
    assert resolve(SimulationSettings(**settings)).layout == layout


def test_thresholds_are_given_or_those_of_the_preset_or_of_the_sensor():
    assert resolve(SimulationSettings("shapes")).sensor.contrast_thresholds == (0.25, 0.25)
    assert resolve(SimulationSettings("spiral1")).sensor.contrast_thresholds == (0.2, 0.2)
    given = SimulationSettings("spiral1", contrast_thresholds=(0.3, 0.4))
    assert resolve(given).sensor.contrast_thresholds == (0.3, 0.4)


def test_what_is_resolved_stays_as_it_is():
    resolved = resolve(SimulationSettings("spiral1", duration=0.5))
    assert resolve(resolved) == resolved


def test_pictures_have_no_poses_for_other_layouts():
    with pytest.raises(FlagError, match=r"^clip\.mp4 has pictures but no poses, which --layout esim needs; give"):
        resolve(SimulationSettings("clip.mp4", layout="esim"))


NUMBERS = {
    (kind, field.name): "tuple" in str(hint)
    for kind in (SimulationSettings, SensorSettings, FrameSettings)
    for field in fields(kind)
    if any(number in str(hint := get_type_hints(kind)[field.name]) for number in ("int", "float"))
}
"""Every setting that is a number, and whether it is several."""


def test_all_numbers_are_found():
    assert len(NUMBERS) > 20 and {"duration", "seed", "saturation"} <= {name for _, name in NUMBERS}


@pytest.mark.parametrize(("kind", "name"), NUMBERS)
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, -1, 1e300])
def test_numbers_that_no_setting_takes_are_refused_by_flag(kind: type, name: str, value: float):
    changes: Any = {name: (0.2, value) if NUMBERS[kind, name] else value}
    part = "sensor" if kind is SensorSettings else "frame" if kind is FrameSettings else None
    flag = "--" + ("frame." if kind is FrameSettings else "") + name.replace("_", "-")
    with pytest.raises(FlagError, match=rf"^{flag} is .*, but must be .*\.$"):
        if part is not None:
            changes = {part: kind(**changes)}
        resolve(SimulationSettings("shapes", **changes))

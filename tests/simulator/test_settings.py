"""What settings come to."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from enerf_ns.dataparsers.errors import FlagError
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
    with pytest.raises(FlagError, match=r"^clip\.mp4 has pictures and no poses, which --layout esim needs; give"):
        resolve(SimulationSettings("clip.mp4", layout="esim"))

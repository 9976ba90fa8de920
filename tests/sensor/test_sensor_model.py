from __future__ import annotations

from typing import Any

import pytest
import torch

from enerf_ns.events.batch import EventBatch
from enerf_ns.sensor.part import GREY
from enerf_ns.sensor.response import linlog, luma
from enerf_ns.sensor.sensor_model import SensorModel, SensorModelConfig


def sensor(**changes: Any) -> SensorModel:
    settings: dict[str, Any] = {
        "contrast_thresholds": (0.2, 0.35),
        "response": "linlog",
        "refractory_period_ns": 0,
        "bayer_pattern": GREY,
        "width": 4,
    }
    return SensorModelConfig(**settings | changes).setup()


@pytest.mark.parametrize("thresholds", [(0.25, 0.25), (0.2, 0.35)])
def test_measured_change_of_a_ramp(thresholds: tuple[float, float]):
    """A pixel that brightens, and then darkens, by 2.0 in log brightness, one event each time a threshold is passed."""
    rises, falls = int(2.0 / thresholds[0]), int(2.0 / thresholds[1])
    on, off, pixels = torch.tensor([rises, 0, rises]), torch.tensor([0, falls, falls]), torch.tensor([0, 1, 2])
    batch = EventBatch(pixels, torch.zeros(3), torch.ones(3), on, off)
    changes = sensor(contrast_thresholds=thresholds).measured_change(batch)
    assert changes[0].item() == pytest.approx(2.0, abs=thresholds[0])
    assert changes[1].item() == pytest.approx(-2.0, abs=thresholds[1])
    assert changes[2].item() == pytest.approx(changes[0].item() + changes[1].item(), abs=1e-6)


def test_a_grey_sensor_compares_luma():
    rgb = torch.rand(6, 3)
    torch.testing.assert_close(sensor().log_brightness(rgb, torch.arange(6)), linlog(luma(rgb)), rtol=0, atol=0)


def test_behind_a_colour_filter_every_pixel_compares_its_own_channel():
    rgb = torch.rand(8, 3)
    seen = sensor(bayer_pattern="GRBG").log_brightness(rgb, torch.arange(8))
    expected = torch.stack([rgb[i, "RGB".index(letter)] for i, letter in enumerate("GRGRBGBG")])
    torch.testing.assert_close(seen, linlog(expected), rtol=0, atol=0)


def test_the_response_is_the_one_that_is_named():
    rgb = torch.rand(6, 1)
    seen = sensor(response="logarithm:0.01").log_brightness(rgb, torch.arange(6))
    torch.testing.assert_close(seen, torch.log(rgb[:, 0] + 0.01))


def test_a_pixel_is_blind_for_the_refractory_period_but_sees_the_last_nanosecond():
    start, end = torch.tensor([0, 0, 0]), torch.tensor([100, 60, 1])
    blind = sensor(refractory_period_ns=70).blind_after(start, end)
    assert blind is not None and blind.dtype == torch.float64
    assert blind.tolist() == [70.0, 59.0, 0.0]
    assert sensor().blind_after(start, end) is None


def test_it_has_no_parameters_and_stores_nothing():
    grey, colour = sensor(), sensor(bayer_pattern="RGGB")
    assert not list(grey.parameters()) and not grey.state_dict() and not colour.state_dict()
    assert grey.mean_threshold == pytest.approx(0.275)

from __future__ import annotations

import pytest
import torch

from enerf_ns.sensor.sensor_model import DEFAULT_CONTRAST_THRESHOLD, measured_change, thresholds_from_polarity


@pytest.mark.parametrize("thresholds", [(0.25, 0.25), (0.2, 0.35)])
def test_measured_change_of_a_ramp(thresholds: tuple[float, float]):
    """A pixel that brightens, and then darkens, by 2.0 in log brightness, one event each time a threshold is passed."""
    rises, falls = int(2.0 / thresholds[0]), int(2.0 / thresholds[1])
    changes = measured_change(torch.tensor([rises, 0, rises]), torch.tensor([0, falls, falls]), thresholds)
    assert changes[0].item() == pytest.approx(2.0, abs=thresholds[0])
    assert changes[1].item() == pytest.approx(-2.0, abs=thresholds[1])
    assert changes[2].item() == pytest.approx(changes[0].item() + changes[1].item(), abs=1e-6)


def test_thresholds_balance_the_polarities():
    on, off = thresholds_from_polarity(100, 141)
    assert 100 * on == pytest.approx(141 * off)
    assert (on + off) / 2 == pytest.approx(DEFAULT_CONTRAST_THRESHOLD)


@pytest.mark.parametrize("counts", [(0, 0), (7, 0), (0, 7), (7, 7)])
def test_thresholds_are_equal_where_polarities_are_or_one_is_missing(counts: tuple[int, int]):
    assert thresholds_from_polarity(*counts) == (DEFAULT_CONTRAST_THRESHOLD, DEFAULT_CONTRAST_THRESHOLD)

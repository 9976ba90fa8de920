"""The weight of frames beside events against the likelihood that it comes from."""

from typing import Any

import pytest
import torch
from scipy.optimize import minimize_scalar

from enerf_ns.supervision.balance import ErrorBalance


@pytest.mark.parametrize(("noise_of_events", "noise_of_frames"), [(1.0, 0.01), (0.3, 0.3), (0.05, 0.5)])
def test_what_is_fitted_is_the_most_likely_where_nobody_knows_the_noise(noise_of_events: float, noise_of_frames: float):
    """Of a number that two instruments measure, each with noise of its own, and one of them with an offset."""
    draw = torch.Generator().manual_seed(0)
    events = 1.0 + noise_of_events * torch.randn(300, generator=draw, dtype=torch.float64)
    frames = 1.2 + noise_of_frames * torch.randn(100, generator=draw, dtype=torch.float64)

    def unlikelihood(value: float) -> float:
        squares = ((measured - value).square().mean() for measured in (events, frames))
        return sum(
            len(measured) * float(square.log()) for measured, square in zip((events, frames), squares, strict=True)
        )

    found: Any = minimize_scalar(unlikelihood, bounds=(0.5, 1.7), method="bounded")
    expected = found.x

    value, balance = torch.tensor(1.1, dtype=torch.float64, requires_grad=True), ErrorBalance()
    for _ in range(3000):
        of_events, of_frames = ((measured - value).square().mean() for measured in (events, frames))
        weight = balance(of_events, len(events), of_frames, len(frames))
        (slope,) = torch.autograd.grad(of_events + weight * of_frames, value)
        with torch.no_grad():
            value -= 0.2 * slope / (1.0 + weight)
    assert float(value) == pytest.approx(expected, abs=1e-4)


def test_the_first_step_has_the_weight_of_its_own_errors():
    weight = ErrorBalance()(torch.tensor(2.0), 1000, torch.tensor(0.05), 100)
    assert float(weight) == pytest.approx(100 / 1000 * 2.0 / 0.05)


def test_steps_that_are_not_finite_are_not_remembered():
    balance = ErrorBalance()
    balance(torch.tensor(2.0), 10, torch.tensor(0.5), 10)
    before = balance.errors.clone()
    balance(torch.tensor(2.0), 10, torch.tensor(float("nan")), 10)
    balance(torch.tensor(float("inf")), 10, torch.tensor(0.5), 10)
    assert torch.equal(balance.errors, before)


def test_evaluation_looks_and_does_not_remember():
    balance = ErrorBalance()
    balance(torch.tensor(2.0), 10, torch.tensor(0.5), 10)
    before = balance.errors.clone()
    balance.eval()
    assert float(balance(torch.tensor(9.0), 10, torch.tensor(0.1), 10)) == pytest.approx(4.0)
    assert torch.equal(balance.errors, before)


def test_the_weight_has_no_gradient_and_is_finite_where_frames_are_met_exactly():
    error = torch.tensor(0.0, requires_grad=True)
    weight = ErrorBalance()(torch.tensor(1.0, requires_grad=True), 1, error, 1)
    assert not weight.requires_grad and bool(weight.isfinite())

"""Cases of brightness, thresholds and losses: the knee of linlog, darkness, zero changes."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from enerf_ns.bench.numerics.case import case
from enerf_ns.sensor.response import Gamma, Linlog, Logarithm, Response
from enerf_ns.supervision.event_supervision import EVENT_LOSSES
from enerf_ns.supervision.losses import no_event_loss, normalised_event_loss

KNEE = 20.0 / 255.0


@case("brightness at the knee of linlog", "one value from both sides, in float32", 1e-6)
def knee() -> float:
    around = KNEE * (1.0 + torch.linspace(-1e-4, 1e-4, 2001, dtype=torch.float64))
    slope = math.log(20.0) / 20.0
    closed = torch.where(around < KNEE, 255.0 * around * slope, torch.log(255.0 * around))
    return float((Linlog()(around.float()).double() - closed).abs().max())


@case("brightness of 1e-30, 0 and below", "finite log brightness and gradients under every response")
def darkness() -> float:
    wrong = 0
    negative, dark = [-1.0, -1e-30], [0.0, 1e-30, 1e-12]
    for response, values in ((Linlog(), negative + dark), (Logarithm(1e-9), dark), (Gamma(2.2, 1e-9), negative + dark)):
        brightness = torch.tensor(values, requires_grad=True)
        changes = response(brightness)
        (gradient,) = torch.autograd.grad(changes.sum(), brightness)
        wrong += int((~changes.isfinite()).sum() + (~gradient.isfinite()).sum())
    return wrong


@case("log brightness from 0 to 80", "relative error after inverting the response, in float32", 2e-5)
def back_again() -> float:
    responses: tuple[Response, ...] = (Linlog(), Logarithm(0.001), Logarithm(1.0), Gamma(2.2, 1e-5))
    values = torch.linspace(0.01, 80.0, 4001)
    return max(float(((response(response.inverse(values)) - values) / values).abs().max()) for response in responses)


@case("thresholds of 0.001 and of 10, changes of 0 to 1e4", "finite event losses and gradients")
def thresholds() -> float:
    wrong = 0
    for threshold in (0.001, 10.0):
        for loss in EVENT_LOSSES.values():
            predicted = torch.tensor([0.0, 1e-30, -1e-7, 1.0, 1e4], requires_grad=True)
            value = loss(predicted, torch.tensor([threshold, 0.0, -threshold, 100 * threshold, 1e4]), threshold)
            (gradient,) = torch.autograd.grad(value, predicted)
            wrong += int(not value.isfinite()) + int((~gradient.isfinite()).sum())
    return wrong


@case("the normalised loss where nothing changes", "between 0 and 4, with a finite gradient")
def normalised_at_zero() -> float:
    return sum(
        _outside(predicted, measured)
        for predicted in (torch.zeros(8), torch.full((8,), 1e-30), torch.ones(8))
        for measured in (torch.zeros(8), torch.full((8,), 0.25))
    )


def _outside(predicted: Tensor, measured: Tensor) -> int:
    predicted = predicted.requires_grad_()
    loss = normalised_event_loss(predicted, measured)
    (gradient,) = torch.autograd.grad(loss, predicted)
    return int(not 0.0 <= loss.item() <= 4.0) + int((~gradient.isfinite()).sum())


@case("silent pixels that change by exactly nothing", "no loss, a finite gradient")
def silent_at_zero() -> float:
    predicted = torch.zeros(8, requires_grad=True)
    loss = no_event_loss(predicted, (0.2, 0.3), margin=0.0)
    (gradient,) = torch.autograd.grad(loss, predicted)
    return loss.item() + int((~gradient.isfinite()).sum())

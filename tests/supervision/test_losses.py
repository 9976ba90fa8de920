from __future__ import annotations

import pytest
import torch
from nerfstudio.model_components.losses import lossfun_distortion

from enerf_ns.supervision.losses import (
    distortion_loss,
    frame_loss,
    huber_event_loss,
    no_event_loss,
    normalised_event_loss,
    squared_event_loss,
)

PREDICTED = torch.tensor([0.5, -0.25, 0.0])
MEASURED = torch.tensor([0.25, -0.5, 0.5])


def test_event_loss_is_the_squared_error_in_thresholds():
    assert squared_event_loss(PREDICTED, MEASURED, 0.25).item() == pytest.approx((1 + 1 + 4) / 3)
    assert squared_event_loss(MEASURED, MEASURED, 0.25).item() == 0.0


def test_event_loss_does_not_depend_on_the_unit_of_brightness():
    loss = squared_event_loss(PREDICTED, MEASURED, 0.25)
    torch.testing.assert_close(squared_event_loss(3 * PREDICTED, 3 * MEASURED, 0.75), loss)


@pytest.mark.parametrize(
    ("error", "expected"),  # in thresholds: e^2 up to one, 2|e| - 1 beyond
    [(0.0, 0.0), (0.5, 0.25), (-1.0, 1.0), (3.0, 5.0), (-10.0, 19.0)],
)
def test_huber_event_loss_is_squared_within_one_threshold_and_linear_beyond(error: float, expected: float):
    measured = torch.tensor([0.7])
    assert huber_event_loss(measured + 0.25 * error, measured, 0.25).item() == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize(
    ("predicted", "measured", "expected"),
    [
        ([3.0, 4.0], [3.0, 4.0], 0.0),
        ([3.0, 4.0], [-3.0, -4.0], 4.0),
        ([1.0, 0.0], [0.0, 7.0], 2.0),
        ([3.0, 4.0], [5.0, 0.0], (0.6 - 1.0) ** 2 + 0.8**2),
    ],
)
def test_normalised_loss_of_unit_vectors(predicted: list[float], measured: list[float], expected: float):
    loss = normalised_event_loss(torch.tensor(predicted), torch.tensor(measured))
    assert loss.item() == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("scale", [1e-2, 7.0, 1e3])
def test_normalised_loss_does_not_change_with_scale(scale: float):
    loss = normalised_event_loss(PREDICTED, MEASURED)
    assert loss.item() > 0.1
    torch.testing.assert_close(normalised_event_loss(scale * PREDICTED, MEASURED), loss)
    torch.testing.assert_close(normalised_event_loss(PREDICTED, scale * MEASURED), loss)


def test_normalised_loss_of_a_constant_field_has_a_finite_gradient():
    predicted = torch.zeros(3, requires_grad=True)
    normalised_event_loss(predicted, MEASURED).backward()
    assert predicted.grad is not None and predicted.grad.isfinite().all()


@pytest.mark.parametrize(
    ("change", "margin", "expected"),
    [
        (0.2, 1.0, 0.0),  # C_on = 0.2, C_off = 0.4, mean 0.3
        (0.5, 1.0, 0.3 / 0.3),
        (-0.4, 1.0, 0.0),
        (-0.7, 1.0, 0.3 / 0.3),
        (0.2, 0.5, 0.1 / 0.3),
        (-0.3, 0.5, 0.1 / 0.3),
        (0.2, 0.0, 0.2 / 0.3),
        (-0.3, 0.0, 0.3 / 0.3),
    ],
)
def test_no_event_loss_beyond_the_margin_of_each_polarity(change: float, margin: float, expected: float):
    assert no_event_loss(torch.tensor([change]), (0.2, 0.4), margin).item() == pytest.approx(expected, abs=1e-6)


def test_no_event_loss_is_a_mean_over_pairs():
    assert no_event_loss(torch.tensor([0.5, 0.0]), (0.2, 0.4)).item() == pytest.approx(0.5)


RENDERED, RECORDED = torch.tensor([[0.0, 0.5, 1.0]]), torch.tensor([[0.5, 0.25, 0.5]])


def test_frames_in_colour_are_compared_channel_by_channel():
    assert frame_loss(RENDERED, RECORDED, grey=False).item() == pytest.approx((0.25 + 0.0625 + 0.25) / 3)


def test_a_grey_field_is_compared_by_brightness():
    difference = 0.299 * -0.5 + 0.587 * 0.25 + 0.114 * 0.5
    assert frame_loss(RENDERED, RECORDED, grey=True).item() == pytest.approx(difference**2)


@pytest.mark.parametrize("grey", [False, True])
def test_what_a_frame_shows_as_white_may_be_any_brighter(grey: bool):
    white, darker = torch.ones(1, 3), torch.full((1, 3), 0.5)
    assert frame_loss(torch.full((1, 3), 40.0), white, grey).item() == pytest.approx(0.0, abs=1e-12)
    assert frame_loss(torch.full((1, 3), 0.5), white, grey).item() == pytest.approx(0.25)
    assert frame_loss(torch.full((1, 3), 40.0), darker, grey).item() == pytest.approx(39.5**2)


@pytest.mark.parametrize("samples", [1, 2, 24, 300])
def test_distortion_loss_is_nerfstudio_s_sum_over_all_pairs(samples: int):
    generator = torch.Generator().manual_seed(samples)
    weights = torch.rand(40, samples, generator=generator, dtype=torch.float64) ** 4
    edges = torch.rand(40, samples + 1, generator=generator, dtype=torch.float64).sort(dim=-1).values
    weights[1], weights[2] = 0.0, 1.0
    weights[3, 0] = 0.0
    found, expected = [], []
    for loss, results in ((distortion_loss, found), (lambda w, t: lossfun_distortion(t, w).mean(), expected)):
        leaves = [weights.clone().requires_grad_(), edges.clone().requires_grad_()]
        value = loss(*leaves)
        results += [value, *torch.autograd.grad(value, leaves)]
    for value, true in zip(found, expected, strict=True):
        torch.testing.assert_close(value, true, rtol=1e-9, atol=1e-12)


def test_distortion_of_one_place_far_along_the_ray_is_none():
    """In float32 what is summed up cancels to a ten-millionth of the ray."""
    edges = torch.linspace(0.0, 1.0, 25).repeat(8, 1)
    weights = torch.zeros(8, 24)
    weights[:, 20] = 1.0
    assert distortion_loss(weights, edges).item() == pytest.approx(1 / 24 / 3, rel=1e-5)

"""The field: its box, its ranges of density and brightness, and its gradients."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from nerfstudio.cameras.rays import Frustums, RaySamples
from nerfstudio.field_components.activations import trunc_exp
from nerfstudio.field_components.field_heads import FieldHeadNames

from enerf_ns.rendering.field import (
    DARKEST,
    LARGEST_EXPONENT,
    Brightness,
    EnerfField,
    HashDensity,
    brightness_of,
    limited_exp,
)
from enerf_ns.sensor.response import Linlog, Logarithm, Response
from enerf_ns.supervision.losses import huber_event_loss

AABB = torch.tensor([[-1.0, -2.0, -1.0], [1.0, 2.0, 1.0]])
GRID: dict[str, Any] = {"num_levels": 3, "min_res": 4, "max_res": 16, "log2_table_size": 10, "hidden_dim": 16}


def field(**changes: Any) -> EnerfField:
    torch.manual_seed(0)
    settings: dict[str, Any] = {"num_channels": 3, "view_direction": False, "hidden_dim_colour": 16, "num_features": 7}
    made = EnerfField(AABB, **{**settings, "brightness": "log-sigmoid", **GRID, **changes})
    torch.nn.init.normal_(made.geometry.grid.table)
    return made


def samples(positions: torch.Tensor, directions: torch.Tensor) -> RaySamples:
    zeros = torch.zeros(len(positions), 1)
    return RaySamples(frustums=Frustums(positions, directions, zeros, zeros, zeros))


def test_there_is_nothing_outside_the_box_and_something_inside():
    density = HashDensity(AABB, **GRID).density_fn
    inside = torch.tensor([[0.0, 0.0, 0.0], [0.9, -1.9, 0.9]])
    outside = torch.tensor([[1.1, 0.0, 0.0], [0.0, 2.1, 0.0], [0.0, 0.0, -5.0]])
    assert (density(inside) > 0).all() and (density(outside) == 0).all()
    assert density(inside).mean().item() == pytest.approx(1.0, rel=0.5), "neither transparent nor opaque at the start"


@pytest.mark.parametrize(("brightness", "darkest"), [("log-sigmoid", DARKEST), ("sigmoid", 0.0)])
@pytest.mark.parametrize("channels", [1, 3])
def test_brightness_stays_within_what_it_spans(channels: int, brightness: str, darkest: float):
    made = field(num_channels=channels, brightness=brightness)
    positions = 2 * torch.rand(500, 3) - 1
    colour = made(samples(positions, torch.tensor([[0.0, 0.0, 1.0]]).expand(500, 3)))[FieldHeadNames.RGB]
    assert colour.shape == (500, channels)
    assert (colour >= darkest - 1e-6).all() and (colour <= 1).all()


@pytest.mark.parametrize(("distance", "kept"), [(0.2, 3), (0.3, 2), (0.5, 2), (0.6, 1), (1.1, 0)])
def test_slopes_over_a_distance(distance: float, kept: int):
    """The levels have cells of 1, 1/2 and 1/4 along the longest side of the box, which is 4."""
    geometry, points = field().geometry, 2 * torch.rand(50, 3) - 1
    within = (16 * geometry.unit(points)) % 1  # not on a face of a cell, where slopes jump
    points = points[((within - 0.5).abs() < 0.45).all(dim=1)].requires_grad_()
    (whole,) = torch.autograd.grad(geometry.density_fn(points).log().sum(), points)
    with geometry.slopes_over(distance):
        density = geometry.density_fn(points)
    assert torch.equal(density, geometry.density_fn(points))
    (found,) = torch.autograd.grad(density.log().sum(), points)
    with torch.no_grad():
        steps = 1e-4 * torch.eye(3)
        features = geometry.grid(geometry.unit(points))
        moved = torch.stack([geometry.grid(geometry.unit(points + s * step)) for step in steps for s in (-1, 1)])
        moved[..., 2 * kept :] = features[:, 2 * kept :]
        ends = geometry.network(moved.flatten(0, 1))[:, 0].view(3, 2, -1)
        expected = ((ends[:, 1] - ends[:, 0]) / 2e-4).t()
    torch.testing.assert_close(found, expected, atol=0.03 * float(whole.abs().max()), rtol=0.0)
    assert torch.equal(found, whole) == (kept == 3)

    with pytest.raises(KeyError), geometry.slopes_over(distance):
        raise KeyError
    (again,) = torch.autograd.grad(geometry.density_fn(points).log().sum(), points)
    assert torch.equal(again, whole)


LOGITS = torch.cat([torch.linspace(-1e4, 1e4, 401), torch.linspace(-100.0, 100.0, 401), torch.tensor([-1e30, 1e30])])


def test_the_exponential_of_any_number_is_finite_and_so_is_its_gradient():
    """Below the limit it equals Nerfstudio's to the bit; above it there is still a gradient."""
    logits = LOGITS.clone().requires_grad_()
    limited = limited_exp(logits)
    limited.sum().backward()
    below = logits <= LARGEST_EXPONENT
    assert torch.equal(limited[below], trunc_exp(logits[below]))
    torch.testing.assert_close(
        limited[~below].double(), torch.full_like(limited[~below], LARGEST_EXPONENT).double().exp()
    )
    assert logits.grad is not None
    torch.testing.assert_close(logits.grad.double(), LOGITS.double().clamp(-15, 15).exp())


@pytest.mark.parametrize("length", [0.0, 1e-38, 1e-4, 1.0, 1e4])
def test_weights_of_any_density_and_length_are_those_of_the_closed_form(length: float):
    """Their gradients are right, too. Densities are 0, subnormal and as large as possible."""
    generator = torch.Generator().manual_seed(0)
    logits = LOGITS[torch.randint(len(LOGITS), (200, 12), generator=generator)]
    logits[0], logits[1], logits[2] = 1e4, -1e4, -100.0
    cotangent = torch.rand(200, 12, 1, generator=generator)
    found, given = weights_of(limited_exp(leaf := logits.clone().requires_grad_()), length), leaf
    (found * cotangent).sum().backward()

    exact = logits.double().clamp(max=LARGEST_EXPONENT).exp().requires_grad_()
    depth = length * exact
    through = torch.exp(torch.cat([torch.zeros_like(depth[:, :1]), -depth.cumsum(1)[:, :-1]], dim=1))
    expected = ((1 - torch.exp(-depth)) * through)[..., None]
    (expected * cotangent.double()).sum().backward()
    assert exact.grad is not None and given.grad is not None
    torch.testing.assert_close(found.double(), expected, atol=1e-6, rtol=1e-4)
    gradient = exact.grad * logits.double().clamp(-15, 15).exp()
    torch.testing.assert_close(given.grad.double(), gradient, atol=1e-6, rtol=1e-3)


def weights_of(density: torch.Tensor, length: float) -> torch.Tensor:
    """Returns the weights of samples that all have the same length."""
    zeros, deltas = torch.zeros(*density.shape, 1), torch.full((*density.shape, 1), length)
    rays = RaySamples(frustums=Frustums(zeros.expand(-1, -1, 3), zeros, zeros, zeros, zeros), deltas=deltas)
    return rays.get_weights(density[..., None])


@pytest.mark.parametrize("logit", [-1e4, 88.8, 1e4, 1e30])
def test_density_is_finite_inside_and_outside_of_the_box_and_an_excess_of_it_can_be_undone(logit: float):
    made = HashDensity(AABB, **GRID)
    bias: Any = made.network.layers[-1].bias
    with torch.no_grad():
        bias[0] = logit
    density = made.density_fn(torch.tensor([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0]]))
    density.sum().backward()
    assert density.isfinite().all() and density[1] == 0
    assert all(parameter.grad is not None and parameter.grad.isfinite().all() for parameter in made.parameters())
    assert bias.grad[0] > 0


@pytest.mark.parametrize("response", [Linlog(), Logarithm(0.001)])
@pytest.mark.parametrize(("brightness", "least", "most"), [("exponential", 0.0, 0.1), ("log-sigmoid", 0.9, 1.2)])
def test_only_the_exponential_reaches_a_log_range_of_ten(
    brightness: Brightness, least: float, most: float, response: Response
):
    """Free outputs, without a network, are fitted to differences of log brightness that is uniform over the range."""
    torch.manual_seed(0)
    expected = 10.0 * torch.rand(1024)
    outputs = torch.nn.Parameter(torch.zeros(1024))
    optimizer = torch.optim.Adam([outputs], lr=0.1, betas=(0.9, 0.99))
    for _ in range(600):
        order = torch.randperm(1024)
        change = response(brightness_of(outputs, brightness))[order].diff()
        optimizer.zero_grad()
        huber_event_loss(change, expected[order].diff(), 0.25).backward()
        optimizer.step()
    error = response(brightness_of(outputs.detach(), brightness)) - expected
    assert least <= error.std().item() <= most


def test_with_contraction_there_may_be_something_at_any_distance():
    """Density is finite everywhere, differs between distances in one direction, and needs no further parameter."""
    torch.manual_seed(0)
    made, bounded = HashDensity(AABB / 2, **GRID, contraction=True), HashDensity(AABB / 2, **GRID)
    torch.nn.init.normal_(made.grid.table)
    distances = torch.tensor([0.0, 0.5, 0.99, 1.01, 3.0, 6.0, 1e3, 1e30])
    density = made.density_fn(distances[:, None] * torch.tensor([0.3, -1.0, 0.4]))
    assert density.isfinite().all() and (density > 0).all()
    assert len(density[:6].unique()) == 6
    assert {name: value.shape for name, value in made.state_dict().items()} == {
        name: value.shape for name, value in bounded.state_dict().items()
    }


@pytest.mark.parametrize("view_direction", [False, True])
def test_colour_depends_on_the_direction_where_asked(view_direction: bool):
    made = field(view_direction=view_direction)
    positions = torch.tensor([[0.2, 0.3, -0.4]]).expand(2, 3)
    outputs = made(samples(positions, torch.eye(3)[:2]))
    first, second = outputs[FieldHeadNames.RGB]
    assert torch.equal(first, second) != view_direction
    density = outputs[FieldHeadNames.DENSITY]
    assert torch.equal(density[0], density[1])

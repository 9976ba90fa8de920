"""A field that starts from edges: empty before them, opaque at them, and the same each time."""

from __future__ import annotations

import copy

import torch

from enerf_ns.rendering.edge_start import start_from_edges
from enerf_ns.rendering.field import HashDensity

AABB = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
NEAR = 0.1


def density() -> HashDensity:
    torch.manual_seed(0)
    return HashDensity(AABB, num_levels=4, min_res=8, max_res=64, log2_table_size=12, hidden_dim=16)


def edges_on_two_walls(number: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Places of a camera that moves in the plane z = -0.9, and points of a near wall (x < 0) and of a far one."""
    generator = torch.Generator().manual_seed(1)
    places = 0.4 * torch.rand(number, 3, generator=generator) - 0.2
    places[:, 2] = -0.9
    points = 1.6 * torch.rand(number, 3, generator=generator) - 0.8
    points[:, 2] = torch.where(points[:, 0] < 0.0, 0.0, 0.7)
    return places, points


def optical_depth(of: HashDensity, places: torch.Tensor, points: torch.Tensor, begin: float, end: float):
    """Integral of density between two shares of the way from places to points, by a fine sum."""
    shares = torch.linspace(begin, end, 2001)[:, None, None]
    found = of.density_fn(places + shares * (points - places))[..., 0].mean(dim=0)
    return found * (end - begin) * (points - places).norm(dim=1)


@torch.no_grad()
def test_rays_are_free_up_to_an_edge_and_end_at_it():
    places, points = edges_on_two_walls(4000)
    networks = [density(), density()]
    with torch.enable_grad():
        start_from_edges(networks, places[:3900], points[:3900], NEAR)
    others = places[3900:], points[3900:]
    for network in networks:
        before = torch.exp(-optical_depth(network, *others, 0.2, 0.9))
        at = 1.0 - torch.exp(-optical_depth(network, *others, 0.95, 1.05))
        assert before.median() > 0.8 and before.mean() > 0.75
        assert at.median() > 0.85 and at.mean() > 0.8
    fresh = density()
    assert torch.exp(-optical_depth(fresh, *others, 0.2, 0.9)).median() < 0.6  # the field did not start that way
    assert torch.exp(-optical_depth(fresh, *others, 0.95, 1.05)).median() > 0.8


def test_the_same_edges_start_the_same_field_whatever_was_drawn_before():
    first, second = density(), density()
    start_from_edges([first], *edges_on_two_walls(600), NEAR)
    torch.rand(7)
    state = torch.get_rng_state()
    start_from_edges([second], *edges_on_two_walls(600), NEAR)
    assert torch.equal(torch.get_rng_state(), state)
    for one, other in zip(first.parameters(), second.parameters(), strict=True):
        assert torch.equal(one, other) and other.grad is None


def test_edges_nearer_than_the_near_plane_or_outside_the_box_leave_finite_densities():
    places, points = edges_on_two_walls(600)
    points[:200] = places[:200] + 0.5 * NEAR * torch.nn.functional.normalize(points[:200] - places[:200], dim=1)
    points[200:400] *= 100.0
    network = density()
    before = copy.deepcopy(network.state_dict())
    start_from_edges([network], places, points, NEAR)
    assert all(parameter.isfinite().all() for parameter in network.parameters())
    assert any(not torch.equal(before[name], value) for name, value in network.state_dict().items())

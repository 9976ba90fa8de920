from __future__ import annotations

from typing import Any

import pytest
import torch
from nerfstudio.cameras.rays import Frustums, RaySamples
from nerfstudio.field_components.field_heads import FieldHeadNames

from enerf_ns.enerf_field import DARKEST, EnerfField, HashDensity

AABB = torch.tensor([[-1.0, -2.0, -1.0], [1.0, 2.0, 1.0]])
GRID: dict[str, Any] = {"num_levels": 3, "min_res": 4, "max_res": 16, "log2_table_size": 10, "hidden_dim": 16}


def field(**changes: Any) -> EnerfField:
    torch.manual_seed(0)
    settings: dict[str, Any] = {"num_channels": 3, "view_direction": False, "hidden_dim_colour": 16, "num_features": 7}
    made = EnerfField(AABB, **{**settings, "log_sigmoid": True, **GRID, **changes})
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
    assert density(inside).mean().item() == pytest.approx(0.01, rel=0.5), "the field starts without fog"


@pytest.mark.parametrize(("log_sigmoid", "darkest"), [(True, DARKEST), (False, 0.0)])
@pytest.mark.parametrize("channels", [1, 3])
def test_brightness_stays_within_what_it_spans(channels: int, log_sigmoid: bool, darkest: float):
    made = field(num_channels=channels, log_sigmoid=log_sigmoid)
    positions = 2 * torch.rand(500, 3) - 1
    colour = made(samples(positions, torch.tensor([[0.0, 0.0, 1.0]]).expand(500, 3)))[FieldHeadNames.RGB]
    assert colour.shape == (500, channels)
    assert (colour >= darkest - 1e-6).all() and (colour <= 1).all()


@pytest.mark.parametrize("view_direction", [False, True])
def test_colour_depends_on_the_direction_where_asked(view_direction: bool):
    made = field(view_direction=view_direction)
    positions = torch.tensor([[0.2, 0.3, -0.4]]).expand(2, 3)
    outputs = made(samples(positions, torch.eye(3)[:2]))
    first, second = outputs[FieldHeadNames.RGB]
    assert torch.equal(first, second) != view_direction
    density = outputs[FieldHeadNames.DENSITY]
    assert torch.equal(density[0], density[1])

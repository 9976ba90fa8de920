"""Densities within voxels against SciPy's interpolation of the network's densities at the corners."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from scipy.interpolate import RegularGridInterpolator

from enerf_ns.rendering.density_voxels import VOXELS, DensityVoxels
from enerf_ns.rendering.field import HashDensity

BOX = torch.tensor([[-1.0, -0.5, -0.25], [1.0, 0.5, 0.75]])


def network(**settings: Any) -> HashDensity:
    torch.manual_seed(0)
    made = HashDensity(BOX, num_levels=3, min_res=4, max_res=32, log2_table_size=12, hidden_dim=8, **settings)
    torch.nn.init.normal_(made.grid.table)
    return made


@pytest.mark.parametrize("contraction", [False, True])
def test_density_is_linear_between_what_the_network_says_at_corners(contraction: bool):
    density = network(contraction=contraction)
    voxels = DensityVoxels(density)
    half = BOX[1] - BOX[0]
    positions = BOX.mean(dim=0) + half * (torch.rand(200, 3) - 0.5) * (5.0 if contraction else 1.0)
    shape = (VOXELS,) * 3 if contraction else (VOXELS, VOXELS // 2, VOXELS // 2)
    axes = [np.linspace(0.0, 1.0, number + 1) for number in shape]
    corners = torch.from_numpy(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)).float()
    with torch.no_grad():
        known = density.at(corners)[0][..., 0].double().numpy()
        unit = density.unit(positions).double().numpy()
        found = voxels(positions)
    expected = RegularGridInterpolator(axes, known)(unit)
    np.testing.assert_allclose(found[:, 0].numpy(), expected, rtol=1e-3, atol=1e-4)
    assert not found.requires_grad


def test_in_the_middle_of_a_corner_is_the_network():
    density = network()
    corner = BOX[0] + (BOX[1] - BOX[0]) * torch.tensor([[12 / VOXELS, 0.5, 0.25]])
    torch.testing.assert_close(DensityVoxels(density)(corner), density.density_fn(corner), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("change", ["step", "fused step", "loaded"])
def test_what_the_network_learns_is_seen(change: str):
    density = network()
    voxels, position = DensityVoxels(density), BOX.mean(dim=0, keepdim=True)
    before = voxels(position)
    assert voxels.values() is voxels.values()
    if change == "loaded":
        other = network()
        torch.nn.init.normal_(other.grid.table, std=3.0)
        density.load_state_dict(other.state_dict())
    else:
        density.density_fn(position).sum().backward()
        torch.optim.Adam(density.parameters(), lr=0.5, fused=change == "fused step").step()
    assert not torch.allclose(voxels(position), before)
    torch.testing.assert_close(voxels(position), density.density_fn(position), rtol=1e-4, atol=1e-5)

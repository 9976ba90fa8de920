"""Rendering from front to back against Nerfstudio's weights of all samples."""

from __future__ import annotations

import pytest
import torch
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor

from enerf_ns.rendering.front_to_back import front_to_back

EDGES = torch.linspace(0.0, 1.0, 25)


def samples(num_rays: int):
    directions = torch.tensor([[0.0, 0.0, 1.0]]).expand(num_rays, 3)
    rays = RayBundle(torch.zeros(num_rays, 3), directions, torch.ones(num_rays, 1))
    edges = EDGES.expand(num_rays, -1)[..., None]
    return rays.get_ray_samples(bin_starts=edges[:, :-1], bin_ends=edges[:, 1:])


@pytest.mark.parametrize("samples_at_once", [None, 16])
@pytest.mark.parametrize("wall", [0.0, 1e2, 1e5, 1e9, 1e13])
def test_weights_of_a_veil_before_a_wall_are_nerfstudios(wall: float, samples_at_once: int | None):
    """Also if the wall is so dense that the veil is lost in the sum of both."""
    along = samples(4)
    veil = torch.tensor([0.0, 0.7, 2.0, 5.0])[:, None, None]

    def density(positions: Tensor) -> tuple[Tensor, Tensor]:
        z = positions[..., 2:]
        return torch.where(z > 0.6, wall, 1.0) * torch.ones_like(z), z

    assert along.deltas is not None
    along.deltas = along.deltas * (veil + 1.0)
    expected = along.get_weights(density(along.frustums.get_positions())[0])
    found = front_to_back(along, density, 1e-4, samples_at_once=samples_at_once)
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-4)


def test_nothing_is_asked_behind_a_wall_and_only_what_is_not_thin_is_seen():
    along, asked, seen = samples(3), [], []

    def density(positions: Tensor) -> tuple[Tensor, Tensor]:
        asked.append(positions[..., 2])
        z = positions[..., 2:]
        return torch.where(z > 0.2, 1e6, 0.0) * torch.ones_like(z), z

    front_to_back(along, density, 1e-3, lambda ray, weight, z: seen.append((ray, weight, z)))
    assert max(float(z.max()) for z in asked) < 0.4
    rays, weights, places = (torch.cat(parts) for parts in zip(*seen, strict=True))
    assert rays.tolist() == [0, 1, 2]
    torch.testing.assert_close(weights, torch.ones(3, 1))
    assert ((places > 0.2) & (places < 0.25)).all()

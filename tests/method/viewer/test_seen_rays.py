from __future__ import annotations

import torch

from enerf_ns.method.viewer.seen_rays import NOWHERE, SeenRays
from enerf_ns.rendering.seen_volume import SeenVolume

BOX = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
VOXEL = 2.0 / 64


def half_seen() -> SeenRays:
    """Of the box, what lies in -0.5 < x < 0.25 and above z = 0 was seen."""
    is_seen = torch.zeros(64, 64, 64, dtype=torch.bool)
    is_seen[16:40, :, 32:] = True
    return SeenRays(SeenVolume(BOX, is_seen, torch.zeros(64, 64, 64), 0.0))


def test_rays_begin_and_end_around_what_was_seen():
    """Of parallel rays along x, those above z = 0 do, a voxel or two early and late; those well below pass nothing."""
    heights = torch.linspace(-0.9, 0.9, 50)
    origins = torch.stack([torch.full((50, 60), -3.0), torch.zeros(50, 60), heights[:, None].expand(-1, 60)], dim=-1)
    directions = torch.tensor([1.0, 0.0, 0.0]).expand(50, 60, 3)
    nears, fars = half_seen().span(origins, directions)
    above, below = heights > 0.0, heights < -0.1
    assert nears.shape == fars.shape == (50, 60, 1)
    assert ((nears[above] <= 2.5) & (nears[above] > 2.5 - 2 * VOXEL)).all()
    assert ((fars[above] >= 3.25) & (fars[above] < 3.25 + 3 * VOXEL)).all()
    assert (nears[below] == NOWHERE).all() and (fars[below] == NOWHERE).all()

    unbounded = half_seen().span(origins, directions, beyond=(0.5, 100.0))
    torch.testing.assert_close(unbounded[0], nears.where(nears < NOWHERE, 0.5))
    assert (unbounded[1] == 100.0).all()


def test_no_ray_loses_what_was_seen():
    """Rays from within and without, in a large picture of which few are looked at: a point in the middle of a voxel
    that was seen lies between their ends."""
    rays = half_seen()
    random = torch.Generator().manual_seed(0)
    for origin in (torch.tensor([0.0, 0.3, 0.4]), torch.tensor([-2.0, 1.5, 0.7])):
        slopes = torch.meshgrid(torch.linspace(-0.8, 0.8, 240), torch.linspace(-0.8, 0.8, 320), indexing="ij")
        directions = torch.nn.functional.normalize(torch.stack([torch.ones(240, 320), *slopes], dim=-1), dim=-1)
        nears, fars = rays.span(origin.expand(240, 320, 3), directions)
        distances = 4.0 * torch.rand(240, 320, 1, generator=random)
        points = origin + distances * directions
        inside = (points[..., 0] > -0.5) & (points[..., 0] < 0.25) & (points[..., 2] > 0.0) & (points.abs() < 1).all(-1)
        inside = inside[..., None]
        assert inside.sum() > 1000
        assert ((nears <= distances) & (fars >= distances))[inside].all()


def test_surfaces_may_lie_in_the_next_voxel():
    points = torch.tensor([[0.0, 0.0, 0.5], [0.25 + 0.5 * VOXEL, 0.0, 0.5], [0.25 + 1.5 * VOXEL, 0.0, 0.5], [0, 0, 2]])
    assert half_seen().may_be_surface(points).tolist() == [True, True, False, False]
    assert half_seen().may_be_surface(points, beyond=True).tolist() == [True, True, False, True]

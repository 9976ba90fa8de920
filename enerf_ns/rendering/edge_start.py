"""Starts a field from the depth of edges that events show before any training."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from enerf_ns.kernels.precision import full_precision
from enerf_ns.rendering.field import HashDensity

STEPS = 150
"""Steps of the optimiser. After 60, rays are not free yet: at first the loss makes all of space denser."""

LEARNING_RATE = 2e-3
"""Learning rate of Adam. With 1e-2, surfaces that are wrong stay to the end of training."""

RAYS = 512
"""Rays of a step."""

SAMPLES = 32
"""Samples before an edge, and as many around it."""

BAND = 0.05
"""Half of the band around the depth of an edge in which there is a surface, as a share of the depth."""


@full_precision
def start_from_edges(
    densities: Sequence[HashDensity],
    origins: Float[Tensor, "edges 3"],
    edges: Float[Tensor, "edges 3"],
    near: float,
) -> None:
    """Trains densities so that rays pass through empty space up to an edge, and end at it.

    The loss of a ray is the optical depth before the band around its edge, and the negative logarithm of the opacity of
    the band.

    Args:
        densities: They are trained in place.
        origins: Places that the edges were seen from, scene units.
        edges: The edges, scene units.
        near: Distance from the origins at which samples begin, scene units.
    """
    generator = torch.Generator(edges.device).manual_seed(0)
    parameters = [parameter for density in densities for parameter in density.parameters()]
    optimizer = torch.optim.Adam(parameters, lr=LEARNING_RATE, eps=1e-15)
    device = edges.device
    cells = torch.arange(SAMPLES, device=device)
    for _ in range(STEPS):
        chosen = torch.randint(len(edges), (RAYS,), generator=generator, device=device)
        start, ray = origins[chosen], edges[chosen] - origins[chosen]
        depth = ray.norm(dim=1, keepdim=True)
        nearest = (near / depth).clamp(max=1.0 - BAND)
        jitter = torch.rand(2, RAYS, SAMPLES, generator=generator, device=device)
        before_share, within_share = (cells + jitter) / SAMPLES
        before_width, within_width = 1.0 - BAND - nearest, 2.0 * BAND
        shares = torch.cat([nearest + before_width * before_share, 1.0 - BAND + within_width * within_share], dim=1)
        points = start[:, None] + shares[..., None] * ray[:, None]
        lengths = depth / SAMPLES
        loss = edges.new_zeros(())
        for density in densities:
            found = density.density_fn(points)[..., 0]
            before = (before_width * lengths * found[:, :SAMPLES]).sum(dim=1)
            within = (within_width * lengths * found[:, SAMPLES:]).sum(dim=1)
            loss = loss + (before - torch.log(1e-3 - torch.expm1(-within))).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    optimizer.zero_grad()

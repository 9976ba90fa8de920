"""Volume rendering from front to back: a ray stops where its transmittance is almost 0.

`enerf_ns.rendering.front_to_back_numba` renders the same pictures by compiled kernels. So a change here needs a change
there.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float
from nerfstudio.cameras.rays import RaySamples
from torch import Tensor

ROUNDS = 8
"""Largest number of rounds. After each round, rays without transmittance are left out."""

FEWEST_SAMPLES = 8
"""Smallest number of samples of a ray in one round."""


def front_to_back(
    samples: RaySamples,
    density: Callable[[Tensor], tuple[Tensor, Tensor]],
    faint: float,
    see: Callable[[Tensor, Tensor, Tensor], None] | None = None,
    samples_at_once: int | None = None,
) -> Float[Tensor, "rays samples 1"]:
    """Returns the weights of `RaySamples.get_weights`, but 0 where a ray's transmittance is almost 0.

    Args:
        samples: Samples, shape (rays, samples per ray).
        density: Function that returns density, shape (*batch, 1), and features, shape (*batch, features), at positions,
            shape (*batch, 3).
        faint: Transmittance, from 0 to 1, at which a ray ends. `see` leaves out samples of small weight; their sum is
            at most `faint`, too.
        see: Function that is called with all other samples: the index of their ray, shape (seen), their weight, shape
            (seen, 1), and their features, shape (seen, features).
        samples_at_once: Number of samples for one call of density; at least those of one ray and round. Default: all
            samples of a round.
    """
    assert samples.shape is not None and samples.deltas is not None
    num_rays, num_samples = samples.shape
    positions, deltas = samples.frustums.get_positions(), samples.deltas[..., 0]
    weights, transmittance = torch.zeros_like(deltas), torch.ones_like(deltas[:, 0])
    lit = torch.arange(num_rays, device=deltas.device)
    step = max(FEWEST_SAMPLES, -(-num_samples // ROUNDS))
    rays_at_once = num_rays if samples_at_once is None else max(1, samples_at_once // step)
    for first in range(0, num_samples, step):
        here = slice(first, first + step)
        for ray in lit.split(rays_at_once):
            densities, features = density(positions[ray, here])
            thickness = densities[..., 0] * deltas[ray, here]
            behind = thickness.cumsum(dim=-1)
            before = torch.nn.functional.pad(behind[:, :-1], (1, 0))  # behind - thickness would lose digits
            weight = transmittance[ray, None] * torch.exp(-before) * (1.0 - torch.exp(-thickness))
            weights[ray, here] = weight
            transmittance[ray] = transmittance[ray] * torch.exp(-behind[:, -1])
            if see is not None:
                seen = ~(weight <= faint / num_samples)  # NaN counts as seen
                see(ray[:, None].expand_as(seen)[seen], weight[seen][:, None], features[seen])
        lit = lit[~(transmittance[lit] <= faint)]
        if not len(lit):
            break
    return weights[..., None].nan_to_num()

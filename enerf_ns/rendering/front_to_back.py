"""Pictures without what nobody sees of them: samples along rays, from the camera on until hardly any light is left."""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float
from nerfstudio.cameras.rays import RaySamples
from torch import Tensor

ROUNDS = 8
"""Times, at most, that it is looked what light is left."""

FEWEST_SAMPLES = 8
"""Of a ray that are asked for at once, unless memory forbids."""


def front_to_back(
    samples: RaySamples,
    density: Callable[[Tensor], tuple[Tensor, Tensor]],
    faint: float,
    see: Callable[[Tensor, Tensor, Tensor], None] | None = None,
    samples_at_once: int | None = None,
) -> Float[Tensor, "rays samples 1"]:
    """Weights of samples as of `RaySamples.get_weights`, but 0 behind what lets hardly any light through.

    Args:
        samples: Shape (rays, samples a ray).
        density: Density, shape (*batch, 1), and features, shape (*batch, features), at positions, shape (*batch, 3).
        faint: Share of a ray's light, from 0 to 1, that may be missed for what lies behind, and as much for what is
            thin.
        see: Is told of samples that are not thin: the index of their ray, their weight, shape (seen, 1), and features.
        samples_at_once: For which density is asked. None: all of a round.
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
            before = torch.nn.functional.pad(behind[:, :-1], (1, 0))  # not behind - thickness, which cancels
            weight = transmittance[ray, None] * torch.exp(-before) * (1.0 - torch.exp(-thickness))
            weights[ray, here] = weight
            transmittance[ray] = transmittance[ray] * torch.exp(-behind[:, -1])
            if see is not None:
                seen = ~(weight <= faint / num_samples)  # also what is no number
                see(ray[:, None].expand_as(seen)[seen], weight[seen][:, None], features[seen])
        lit = lit[~(transmittance[lit] <= faint)]
        if not len(lit):
            break
    return weights[..., None].nan_to_num()

"""A density known at the corners of voxels: where surfaces may be, in a few reads of memory instead of a network."""

from __future__ import annotations

from typing import cast

import torch
from jaxtyping import Float
from torch import Tensor

from enerf_ns.rendering.field import HashDensity

VOXELS = 96
"""Along the longest side of the space. A picture whose samples they place is as near to the integral along its rays as
one whose samples the network places (`benchmarks/rendering.py`)."""

AT_ONCE = 2**16
"""Positions for which a network is asked at once."""


class DensityVoxels:
    """Densities of a network, which may learn on, linear within voxels. They are asked again when its parameters have
    changed.

    Args:
        network: Whose densities they are.
    """

    def __init__(self, network: HashDensity):
        self._network = network
        self._asked: tuple[list[Tensor], Tensor] | None = None

    def values(self) -> Float[Tensor, "z y x"]:
        """Densities in 1 / scene unit, at the corners of all voxels, the outer ones on the faces of the box, or of
        contracted space; without gradients."""
        parameters = list(self._network.parameters())
        # by value: PyTorch's fused optimizers do not count versions
        if self._asked is None or not all(map(torch.equal, parameters, self._asked[0])):
            self._asked = [parameter.detach().clone() for parameter in parameters], self._ask()
        return self._asked[1]

    @torch.no_grad()
    def _ask(self) -> Tensor:
        size = self._network.aabb[1] - self._network.aabb[0]
        if self._network.contraction is not None:
            size = torch.ones_like(size)
        x, y, z = (max(1, round(VOXELS * float(side / size.max()))) + 1 for side in size)
        sides = [torch.linspace(0.0, 1.0, number, device=size.device) for number in (z, y, x)]
        corners = torch.stack(torch.meshgrid(*sides, indexing="ij")[::-1], dim=-1).view(-1, 3)
        found = [self._network.at(part)[0] for part in corners.split(AT_ONCE)]
        return torch.cat(found).float().view(z, y, x)

    def __call__(self, positions: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 1"]:
        """Density at positions in scene units; those outside the space have that of its faces."""
        unit = self._network.unit(positions).view(1, 1, 1, -1, 3)
        found = torch.nn.functional.grid_sample(
            self.values().to(unit)[None, None], 2.0 * unit - 1.0, padding_mode="border", align_corners=True
        )
        return cast("Tensor", found).view(*positions.shape[:-1], 1)

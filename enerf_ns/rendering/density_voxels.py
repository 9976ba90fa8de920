"""Density at the corners of voxels: a few reads of memory show where surfaces may be, in place of a network."""

from __future__ import annotations

from typing import cast

import torch
from jaxtyping import Float
from torch import Tensor

from enerf_ns.rendering.field import HashDensity

VOXELS = 96
"""Voxels along the longest side of the space. With samples placed by these voxels, a picture is as near to the integral
along its rays as with samples placed by the network (`benchmarks/rendering.py`)."""

AT_ONCE = 2**16
"""Number of positions that the network computes at once."""


class DensityVoxels:
    """Density of a network, interpolated linearly within voxels.

    The network may continue to learn: the densities are computed again after its parameters have changed.

    Args:
        network: The network that gives the density at the corners.
    """

    def __init__(self, network: HashDensity):
        self._network = network
        self._known: tuple[list[Tensor], Tensor] | None = None

    def values(self) -> Float[Tensor, "z y x"]:
        """Returns the densities at the corners of all voxels, in 1 / scene unit, without gradients.

        The outermost corners lie on the faces of the box, or of the contracted space.
        """
        parameters = list(self._network.parameters())
        # compared by value, since PyTorch's fused optimizers do not increase the version of a parameter
        if self._known is None or not all(map(torch.equal, parameters, self._known[0])):
            self._known = [parameter.detach().clone() for parameter in parameters], self._at_corners()
        return self._known[1]

    @torch.no_grad()
    def _at_corners(self) -> Tensor:
        size = self._network.aabb[1] - self._network.aabb[0]
        if self._network.contraction is not None:
            size = torch.ones_like(size)
        x, y, z = (max(1, round(VOXELS * float(side / size.max()))) + 1 for side in size)
        sides = [torch.linspace(0.0, 1.0, number, device=size.device) for number in (z, y, x)]
        corners = torch.stack(torch.meshgrid(*sides, indexing="ij")[::-1], dim=-1).view(-1, 3)
        found = [self._network.at(part)[0] for part in corners.split(AT_ONCE)]
        return torch.cat(found).float().view(z, y, x)

    def __call__(self, positions: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 1"]:
        """Returns the density, in 1 / scene unit, at positions in scene units; beyond a face, that of the face."""
        unit = self._network.unit(positions).view(1, 1, 1, -1, 3)
        found = torch.nn.functional.grid_sample(
            self.values().to(unit)[None, None], 2.0 * unit - 1.0, padding_mode="border", align_corners=True
        )
        return cast("Tensor", found).view(*positions.shape[:-1], 1)

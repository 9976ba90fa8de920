"""The parts of rays that the camera of the events saw, so that a picture shows no fog where it never looked."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from enerf_ns.rendering.seen_volume import SeenVolume

COARSE = 80
"""Number of rays along the longer side of a picture that are computed; rays between take the value of a neighbour."""

PLACES = 96
"""Number of points on a ray through the box that are tested; their distance is about a voxel."""

NOWHERE = 1e9
"""Distance at which a ray begins and ends if nothing was seen on it."""


class SeenRays:
    """Computes the part of a ray that lies in the seen volume.

    A surface is rendered a little nearer or farther from another side, so that it may lie in a voxel that touches a
    seen one.

    Args:
        seen: The volume that the camera of the events saw.
    """

    def __init__(self, seen: SeenVolume):
        self._seen = seen
        padded = torch.nn.functional.max_pool3d(seen.is_seen[None].float(), 3, stride=1, padding=1)
        self._around = replace(seen, is_seen=padded[0] > 0.0)

    def may_be_surface(self, points: Float[Tensor, "*batch 3"], beyond: bool = False) -> Bool[Tensor, "*batch"]:
        """Whether points (scene units) lie in seen voxels, or in voxels that touch seen ones.

        Args:
            points: Points in the scene.
            beyond: Whether points beyond the box, of which the seen volume says nothing, count, too.
        """
        found = self._around.seen(points)
        if beyond:
            low, high = self._seen.aabb
            found = found | ((points < low) | (points > high)).any(dim=-1)
        return found

    def span(
        self,
        origins: Float[Tensor, "height width 3"],
        directions: Float[Tensor, "height width 3"],
        beyond: tuple[float, float] | None = None,
    ) -> tuple[Float[Tensor, "height width 1"], Float[Tensor, "height width 1"]]:
        """Near and far distances between which the rays of a picture pass seen voxels, with some margin.

        Args:
            origins: Origins of the rays, scene units.
            directions: Directions of the rays, of length 1.
            beyond: Nearest and farthest distance of a sample where surfaces may lie beyond the box. Rays then end at
                the farthest, and those that pass no seen voxel begin at the nearest.

        Returns:
            Two tensors in scene units; without `beyond`, both are `NOWHERE` for rays that pass no seen voxel.
        """
        height, width = origins.shape[:2]
        step = -(-max(height, width) // COARSE)
        rows, columns = (torch.arange(0, side + step - 1, step, device=origins.device) for side in (height, width))
        grid = torch.meshgrid(rows.clamp(max=height - 1), columns.clamp(max=width - 1), indexing="ij")
        origins, directions = origins[grid], directions[grid]
        to_faces = (self._seen.aabb[:, None, None] - origins) / directions.where(directions.abs() > 1e-12, 1e-12)
        begins = to_faces.amin(0).amax(-1).clamp(min=0.0)
        lengths = (to_faces.amax(0).amin(-1) - begins).clamp(min=0.0) / PLACES
        places = begins + torch.arange(PLACES, device=begins.device)[:, None, None] * lengths
        points = origins + directions * (places + 0.5 * lengths)[..., None]
        nears = places.where(self._seen.seen(points), NOWHERE).amin(0)
        fars = (places + lengths).where(self._around.seen(points), -NOWHERE).amax(0)
        around = torch.nn.functional.max_pool2d(torch.stack([-nears, fars]), 3, stride=1, padding=1)
        rows, columns = (
            ((torch.arange(side, device=nears.device) + step // 2) // step).clamp(max=number - 1)
            for side, number in zip((height, width), nears.shape, strict=True)
        )
        nears, fars = around[:, rows][:, :, columns, None]
        if beyond is not None:
            return (-nears).where(nears > -NOWHERE, beyond[0]), torch.full_like(fars, beyond[1])
        return -nears, fars.where(fars > 0.0, NOWHERE)

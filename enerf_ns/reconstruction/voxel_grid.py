"""Voxel grids of events, the input of networks that reconstruct frames."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from enerf_ns.dataparsers.recording.recording import Events


def voxel_grid(events: Events, num_bins: int, width: int, height: int) -> Float32[Tensor, "num_bins height width"]:
    """Sums of polarities by pixel and time bin; each event is split linearly between two bins (Zhu et al., CVPR 2019).

    Args:
        events: Events in order of time. The first lies in the middle of the first bin, the last in the middle of the
            last bin.
        num_bins: Number of time bins, at least 2.
        width, height: Size of the sensor, pixels.
    """
    since_first = (events.t - events.t[:1]).astype(np.float64)
    places = since_first * ((num_bins - 1) / since_first.max(initial=1.0))
    bins = np.minimum(places.astype(np.int64), num_bins - 2)
    later = (places - bins) * np.where(events.p > 0, 1.0, -1.0)
    earlier = np.where(events.p > 0, 1.0, -1.0) - later
    voxels = (bins * height + events.y) * width + events.x
    size = num_bins * height * width
    grid = np.bincount(voxels, earlier, size) + np.bincount(voxels + height * width, later, size)
    return torch.from_numpy(grid.reshape(num_bins, height, width)).float()


def normalised(grid: Float32[Tensor, "*shape"]) -> Float32[Tensor, "*shape"]:
    """The grid, scaled so that its nonzero voxels have mean 0 and standard deviation 1; zeros stay 0.

    A grid whose nonzero voxels are all equal is returned as it is.
    """
    filled = grid != 0
    values = grid[filled]
    deviation = values.std(correction=0) if len(values) else 0.0
    return torch.where(filled, (grid - values.mean()) / deviation, 0.0) if deviation > 0 else grid

"""What the two rays of an event pair have in common while they are sampled."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from nerfstudio.cameras.rays import RayBundle
from torch.overrides import TorchFunctionMode


@dataclass
class PairedRayBundle(RayBundle):
    """Rays of shape (2 * num_pairs + frame rays): all starts, all ends, then the rays of frames."""

    num_pairs: int = 0


class SharedJitter(TorchFunctionMode):
    """Within it, both rays of every pair draw the same random numbers.

    Any Nerfstudio sampler draws its jitter with `torch.rand((rays, ...))`; here the second `num_pairs` rows repeat the
    first, so that the change of brightness between the two rays holds no noise of the sampling.
    """

    def __init__(self, num_pairs: int):
        super().__init__()
        self.num_pairs = num_pairs

    def __torch_function__(self, func, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        if func is torch.rand and self.num_pairs:
            rays, *rest = args[0]
            drawn = func((rays - self.num_pairs, *rest), **kwargs)
            return torch.cat([drawn[: self.num_pairs], drawn])
        return func(*args, **kwargs)

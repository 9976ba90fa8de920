"""How much frames count beside events."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.distributed import all_reduce, get_world_size, is_initialized

MEMORY = 0.99
"""Share of the mean error that one step leaves of that before it."""


class FrameBalance(nn.Module):
    """Weight of the frames' loss beside the events', so that each counts as its own error says.

    Where errors of pairs and of pixels of frames are independent, with variances that nobody knows, the likelihood of
    both, with those that make it largest, is the product of each mean squared error to the power of minus half their
    number. Its logarithm has the gradient of the sum of both losses, each weighted by its number over its mean (as the
    learned variances of Kendall, Gal, Cipolla, CVPR 2018, of which these are the optimum). The means are followed as
    they fall during training.
    """

    errors: Tensor

    def __init__(self):
        super().__init__()
        self.register_buffer("errors", torch.zeros(3))  # of events, of frames, and what their weights add up to

    def forward(
        self, events: Float[Tensor, ""], num_pairs: int, frames: Float[Tensor, ""], num_pixels: int
    ) -> Float[Tensor, ""]:
        """Weight of the frames' loss beside a loss of events of weight 1, without a gradient.

        Args:
            events: Mean error of this step's pairs, about squared: a loss without its weight.
            num_pairs: Their number.
            frames: Mean squared error of this step's pixels of frames.
            num_pixels: Their number.
        """
        seen = torch.stack([events.detach(), frames.detach(), torch.ones_like(events)]).to(self.errors)
        if self.training:
            if is_initialized():
                all_reduce(seen)  # of as many pairs and pixels in each process; only one of them evaluates
                seen = seen / get_world_size()
            self.errors += (1.0 - MEMORY) * (torch.where(seen.isfinite().all(), seen, self.errors) - self.errors)
        means = torch.where(self.errors[2] > 0.0, self.errors, seen)
        return num_pixels / num_pairs * means[0] / means[1].clamp(min=1e-12)

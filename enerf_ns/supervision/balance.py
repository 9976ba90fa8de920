"""How much one kind of measurement counts beside another."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.distributed import all_reduce, get_world_size, is_initialized

MEMORY = 0.99
"""Share of the mean error that one step leaves of that before it."""


class ErrorBalance(nn.Module):
    """Weight of a second loss beside a first one, so that each counts as its own error says: that of frames beside that
    of events, or that of pairs of any instants beside that of pairs of events.

    Where the errors of two kinds of measurement are independent, with variances that nobody knows, the likelihood of
    both, with those that make it largest, is the product of each mean squared error to the power of minus half their
    number. Its logarithm has the gradient of the sum of both losses, each weighted by its number over its mean (as the
    learned variances of Kendall, Gal, Cipolla, CVPR 2018, of which these are the optimum). The means are followed as
    they fall during training.
    """

    errors: Tensor

    def __init__(self):
        super().__init__()
        self.register_buffer("errors", torch.zeros(3))  # of the first, of the second, and what their weights add up to

    def forward(
        self, first: Float[Tensor, ""], num_first: int, second: Float[Tensor, ""], num_second: int
    ) -> Float[Tensor, ""]:
        """Weight of the second loss beside a first one of weight 1, without a gradient.

        Args:
            first: Mean error of the first kind in this step, about squared: a loss without its weight.
            num_first: Number of its measurements.
            second: The same of the second kind.
            num_second: Number of its measurements.
        """
        seen = torch.stack([first.detach(), second.detach(), torch.ones_like(first)]).to(self.errors)
        if self.training:
            if is_initialized():
                all_reduce(seen)  # of as many of each kind in each process; only one of them evaluates
                seen = seen / get_world_size()
            self.errors += (1.0 - MEMORY) * (torch.where(seen.isfinite().all(), seen, self.errors) - self.errors)
        means = torch.where(self.errors[2] > 0.0, self.errors, seen)
        return num_second / num_first * means[0] / means[1].clamp(min=1e-12)

"""Automatic weight of one loss relative to another."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.distributed import all_reduce, get_world_size, is_initialized

MEMORY = 0.99
"""Weight of the earlier mean error in the running mean of each step."""


class ErrorBalance(nn.Module):
    """Weight of a second loss relative to a first one, from the errors of both.

    It weights the loss of frames relative to the loss of events, or the loss of pairs of any instants relative to the
    loss of pairs of events.

    Let two kinds of measurement have n_1 and n_2 independent errors of unknown variances. The likelihood, maximised
    over both variances, is MSE_1^(-n_1/2) * MSE_2^(-n_2/2). The gradient of its negative logarithm is the gradient of
    the sum of both losses with the weights n / MSE. These variances are the optimum of the learned ones of Kendall, Gal
    and Cipolla, CVPR 2018. Running means follow both errors as they fall during training.
    """

    errors: Tensor

    def __init__(self):
        super().__init__()
        self.register_buffer("errors", torch.zeros(3))  # first, second, and the sum of the weights of the running means

    def forward(
        self, first: Float[Tensor, ""], num_first: int, second: Float[Tensor, ""], num_second: int
    ) -> Float[Tensor, ""]:
        """Weight of the second loss for a weight 1 of the first one, without a gradient.

        Args:
            first: Mean (about squared) error of the first kind in this step: a loss without its weight.
            num_first: Number of measurements of the first kind.
            second: Mean error of the second kind.
            num_second: Number of measurements of the second kind.
        """
        seen = torch.stack([first.detach(), second.detach(), torch.ones_like(first)]).to(self.errors)
        if self.training:
            if is_initialized():
                all_reduce(seen)  # all processes have as many measurements; only one process evaluates
                seen = seen / get_world_size()
            self.errors += (1.0 - MEMORY) * (torch.where(seen.isfinite().all(), seen, self.errors) - self.errors)
        means = torch.where(self.errors[2] > 0.0, self.errors, seen)
        return num_second / num_first * means[0] / means[1].clamp(min=1e-12)

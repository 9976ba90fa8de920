"""Auto-exposure: a learned gain and offset for each frame."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn


class FrameExposure(nn.Module):
    """A learned gain and offset from rendered brightness to each frame.

    The geometric mean of all gains is 1, and the mean of all offsets is 0, so that the field keeps the level of the
    frames. NeRF in the Wild (Martin-Brualla et al., CVPR 2021) learns the appearance of each picture in a similar way,
    with a network in place of two numbers.

    Args:
        num_frames: Number of frames to learn from.
    """

    times: Tensor
    """Times of the frames, ns."""

    def __init__(self, num_frames: int):
        super().__init__()
        self.log_gain = nn.Parameter(torch.zeros(num_frames))
        self.offset = nn.Parameter(torch.zeros(num_frames))
        self.register_buffer("times", torch.zeros(num_frames, dtype=torch.int64))

    def forward(
        self, rendered: Float[Tensor, "pixels channels"], frames: Int64[Tensor, " pixels"]
    ) -> Float[Tensor, "pixels channels"]:
        """Brightness in the frames.

        Args:
            rendered: Rendered linear brightness.
            frames: Number of the frame of each pixel.
        """
        gain, offset = self._of_frames()
        return gain[frames, None] * rendered + offset[frames, None]

    @torch.no_grad()
    def at(self, time: int) -> tuple[float, float]:
        """Gain and offset at any instant (ns).

        The logarithm of the gain, and the offset, are interpolated linearly between frames. Before the first and after
        the last frame, they are constant.
        """
        order = self.times.argsort()
        gain, offset = (values[order].double().cpu().numpy() for values in self._of_frames())
        times = self.times[order].double().cpu().numpy()
        return float(np.exp(np.interp(time, times, np.log(gain)))), float(np.interp(time, times, offset))

    def _of_frames(self) -> tuple[Float[Tensor, " frames"], Float[Tensor, " frames"]]:
        return (self.log_gain - self.log_gain.mean()).exp(), self.offset - self.offset.mean()

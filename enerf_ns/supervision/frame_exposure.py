"""What changes from frame to frame though the scene does not: auto-exposure."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn


class FrameExposure(nn.Module):
    """A gain and an offset for each frame, by which a camera made its picture of what the field shows; in the mean over
    all frames they are 1 and 0, so that the field keeps the level of the frames.

    Learned as the appearance of each picture is in other radiance fields (Martin-Brualla et al., NeRF in the Wild, CVPR
    2021), with two numbers in place of a network.

    Args:
        num_frames: That are learnt from.
    """

    times: Tensor

    def __init__(self, num_frames: int):
        super().__init__()
        self.log_gain = nn.Parameter(torch.zeros(num_frames))
        self.offset = nn.Parameter(torch.zeros(num_frames))
        self.register_buffer("times", torch.zeros(num_frames, dtype=torch.int64))

    def forward(
        self, rendered: Float[Tensor, "pixels channels"], frames: Int64[Tensor, " pixels"]
    ) -> Float[Tensor, "pixels channels"]:
        """What the camera made of rendered brightness.

        Args:
            rendered: Linear brightness.
            frames: Number of the frame of each pixel.
        """
        gain, offset = self._of_frames()
        return gain[frames, None] * rendered + offset[frames, None]

    @torch.no_grad()
    def at(self, time: int) -> tuple[float, float]:
        """Gain and offset of a frame at another instant (ns), in a straight line between those of its neighbours; of a
        frame before or after all, those of the first or last."""
        order = self.times.argsort()
        gain, offset = (values[order].double().cpu().numpy() for values in self._of_frames())
        times = self.times[order].double().cpu().numpy()
        return float(np.exp(np.interp(time, times, np.log(gain)))), float(np.interp(time, times, offset))

    def _of_frames(self) -> tuple[Float[Tensor, " frames"], Float[Tensor, " frames"]]:
        return (self.log_gain - self.log_gain.mean()).exp(), self.offset - self.offset.mean()

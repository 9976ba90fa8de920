"""The sensor model: how an event camera sees brightness.

Brightness is linear radiance in [0, 1]; the sensor compares its logarithm, `linlog(255 * brightness)`, at two instants
and fires one event per contrast threshold crossed (Klenk et al., E-NeRF, RA-L 2023, equations 1 to 3).
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float, Int, Int64
from torch import Tensor

LINEAR_UNTIL = 20.0
"""B of the paper: the map is linear below this brightness (of 255) and logarithmic above."""

DEFAULT_CONTRAST_THRESHOLD = 0.25
"""Mean threshold assumed where a recording does not state one. Events fix brightness only up to this factor."""


def linlog(brightness: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Log brightness of the sensor: I ln(B)/B below B, ln(I) above, with I = 255 * brightness and B = 20.

    Continuous and increasing, with slope ln(B)/B per grey level at zero; its slope jumps to 1/B at B.

    Args:
        brightness: Linear brightness, usually in [0, 1]; negative values extend the linear part.
    """
    level = 255.0 * brightness
    slope = math.log(LINEAR_UNTIL) / LINEAR_UNTIL
    return torch.where(level < LINEAR_UNTIL, level * slope, torch.log(level.clamp(min=LINEAR_UNTIL)))


def inverse_linlog(log_brightness: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Linear brightness whose `linlog` is the argument."""
    slope = math.log(LINEAR_UNTIL) / LINEAR_UNTIL
    knee = math.log(LINEAR_UNTIL)
    return torch.where(log_brightness < knee, log_brightness / slope, torch.exp(log_brightness.clamp(min=knee))) / 255.0


LUMA = (0.299, 0.587, 0.114)
"""Shares of red, green and blue in what a grey sensor sees (ITU-R BT.601)."""


def luma(rgb: Float[Tensor, "*batch channels"]) -> Float[Tensor, "*batch"]:
    """Brightness that a grey sensor sees of one or three colour channels (ITU-R BT.601 weights)."""
    if rgb.shape[-1] == 1:
        return rgb[..., 0]
    return rgb @ rgb.new_tensor(LUMA)


def color_channels(pattern: str, width: int, height: int) -> Int64[Tensor, " pixels"]:
    """Colour channel, 0, 1 or 2, that each pixel of a sensor with a colour filter sees, by pixel number.

    Args:
        pattern: Letters R, G and B of the pixels (0, 0), (1, 0), (0, 1) and (1, 1) as x, y, such as RGGB; the filter
            repeats them.
        width, height: Of the sensor, pixels.

    Raises:
        ValueError: The pattern is not four of these letters.
    """
    if len(pattern) != 4 or not set(pattern) <= set("RGB"):
        raise ValueError(f"A colour filter is four letters of R, G and B, such as RGGB, not {pattern!r}.")
    tile = torch.tensor(["RGB".index(letter) for letter in pattern]).reshape(2, 2)
    return tile.repeat(-(-height // 2), -(-width // 2))[:height, :width].flatten()


def pixel_brightness(
    rgb: Float[Tensor, "*batch 3"], channel: Int64[Tensor, "*batch"] | None
) -> Float[Tensor, "*batch"]:
    """Brightness that pixels see of three colour channels: each its own channel, or luma where that is None."""
    return luma(rgb) if channel is None else rgb.gather(-1, channel[..., None])[..., 0]


def measured_change(
    on: Int[Tensor, "*batch"], off: Int[Tensor, "*batch"], thresholds: tuple[float, float]
) -> Float[Tensor, "*batch"]:
    """Change of log brightness that a pixel reported: C_on * (on events) - C_off * (off events).

    Args:
        on: Number of positive events after the first instant, up to and with the second.
        off: Number of negative events in the same interval.
        thresholds: Contrast thresholds (C_on, C_off), both positive, in units of log brightness.
    """
    return thresholds[0] * on - thresholds[1] * off


def thresholds_from_polarity(num_on: int, num_off: int) -> tuple[float, float]:
    """Contrast thresholds (C_on, C_off) under which a whole recording brightens as much as it darkens.

    Over a long recording every pixel's changes nearly cancel, so num_on * C_on = num_off * C_off; the mean of the two,
    which events cannot tell, is `DEFAULT_CONTRAST_THRESHOLD`. A recording without one of the polarities gives equal
    thresholds.
    """
    if num_on == 0 or num_off == 0:
        return DEFAULT_CONTRAST_THRESHOLD, DEFAULT_CONTRAST_THRESHOLD
    on = 2.0 * DEFAULT_CONTRAST_THRESHOLD * num_off / (num_on + num_off)
    return on, 2.0 * DEFAULT_CONTRAST_THRESHOLD - on

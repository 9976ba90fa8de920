"""The response of a pixel to brightness, and the colour filter before it.

Brightness is linear radiance, usually in [0, 1]. The field and the simulator use the same functions. Responses take
tensors or NumPy arrays of any shape and type of float, and return the same kind: tensors are differentiable, and the
logarithm of NumPy is the same for any number of threads. The other functions take tensors.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor

from enerf_ns.dataparsers.recording.picture_depth import LUMA
from enerf_ns.kernels.precision import full_precision

LINEAR_UNTIL = 20.0
"""Brightness (of 255) below which linlog is linear, and above which it is logarithmic; B of the E-NeRF paper."""

Array = TypeVar("Array", Tensor, np.ndarray)
"""Array type of PyTorch or of NumPy."""

SMALLEST_OFFSET, LARGEST_OFFSET = 1e-9, 1.0
"""Smallest and largest offset of `Logarithm` and of `Gamma`."""

LARGEST_EXPONENT = 3.0
"""Largest exponent of `Gamma`; the smallest is 1. To this power, all brightness that a field renders is finite in
float32."""


class Response(Protocol):
    """An increasing function from brightness to the log brightness that a pixel compares."""

    @property
    def name(self) -> str:
        """Name of the response, as `response_named` reads it."""
        ...

    def __call__(self, brightness: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """Log brightness, in the units of contrast thresholds."""
        ...

    def inverse(self, log_brightness: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """Linear brightness whose log brightness is the argument."""
        ...


@dataclass(frozen=True)
class Linlog:
    """The response of E-NeRF (Klenk et al., RA-L 2023, after v2e): `linlog`."""

    @property
    def name(self) -> str:
        """Name of the response, as `response_named` reads it."""
        return "linlog"

    def __call__(self, brightness: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """Log brightness of E-NeRF; see `linlog`."""
        return linlog(brightness)

    def inverse(self, log_brightness: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """Linear brightness whose log brightness is the argument; see `inverse_linlog`."""
        return inverse_linlog(log_brightness)


@dataclass(frozen=True)
class Logarithm:
    """ln(brightness + offset), the response of simulators (ESIM: Rebecq, Gehrig, Scaramuzza, CoRL 2018)."""

    offset: float = 0.001

    @property
    def name(self) -> str:
        """Name of the response, as `response_named` reads it."""
        return f"logarithm:{self.offset!r}"

    def __call__(self, brightness: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """Log brightness of brightness above -offset."""
        return _library(brightness).log(brightness + self.offset)

    def inverse(self, log_brightness: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """Linear brightness whose log brightness is the argument."""
        return _library(log_brightness).exp(log_brightness) - self.offset


@dataclass(frozen=True)
class Gamma:
    """ln(brightness^exponent + offset) of gamma-encoded brightness, as in pictures (EventNeRF: Rudnev et al., CVPR
    2023).

    A field that is trained with it renders gamma-encoded brightness. The response is the `Logarithm` of its power.
    """

    exponent: float = 2.2
    offset: float = 1e-5

    @property
    def name(self) -> str:
        """Name of the response, as `response_named` reads it."""
        return f"gamma:{self.exponent!r}:{self.offset!r}"

    def __call__(self, brightness: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """Log brightness of gamma-encoded brightness; negative values are as dark as 0."""
        library = _library(brightness)
        return library.log(library.clip(brightness, 0.0, None) ** self.exponent + self.offset)

    def inverse(self, log_brightness: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """Gamma-encoded brightness whose log brightness is the argument."""
        library = _library(log_brightness)
        return library.clip(library.exp(log_brightness) - self.offset, 0.0, None) ** (1.0 / self.exponent)


def response_named(name: str) -> Response:
    """The response that a flag or a recording names: `linlog`, `logarithm:OFFSET` such as `logarithm:0.001`, or
    `gamma:EXPONENT:OFFSET` such as `gamma:2.2:0.1`.

    Raises:
        ValueError: The name is none of these. The message can follow the name of a file or flag.
    """
    kind, *arguments = name.split(":")
    try:
        numbers = [float(argument) for argument in arguments]
    except ValueError:
        numbers = []
    fine = bool(numbers) and SMALLEST_OFFSET <= numbers[-1] <= LARGEST_OFFSET
    if name == "linlog":
        return Linlog()
    if kind == "logarithm" and len(numbers) == 1 and fine:
        return Logarithm(*numbers)
    if kind == "gamma" and len(numbers) == 2 and fine and 1.0 <= numbers[0] <= LARGEST_EXPONENT:
        return Gamma(*numbers)
    raise ValueError(
        f"the response {name!r}, but linlog, or logarithm:OFFSET with an offset from {SMALLEST_OFFSET:g} to "
        f"{LARGEST_OFFSET:g}, such as logarithm:0.001, or gamma:EXPONENT:OFFSET with an exponent from 1 to "
        f"{LARGEST_EXPONENT:g}, such as gamma:2.2:1e-05, was expected."
    )


def linlog(brightness: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Log brightness of E-NeRF: I ln(B)/B below B, ln(I) above, with I = 255 * brightness and B = 20.

    Continuous and increasing, with slope ln(B)/B per grey level at zero; its slope jumps to 1/B at B (equation 2 of the
    paper).

    Args:
        brightness: Linear brightness, usually in [0, 1]; negative values extend the linear part.
    """
    level = 255.0 * brightness
    slope = math.log(LINEAR_UNTIL) / LINEAR_UNTIL
    library = _library(brightness)
    return library.where(level < LINEAR_UNTIL, level * slope, library.log(library.clip(level, LINEAR_UNTIL, None)))


def inverse_linlog(log_brightness: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Linear brightness whose `linlog` is the argument."""
    slope = math.log(LINEAR_UNTIL) / LINEAR_UNTIL
    knee = math.log(LINEAR_UNTIL)
    library = _library(log_brightness)
    above = library.exp(library.clip(log_brightness, knee, None))
    return library.where(log_brightness < knee, log_brightness / slope, above) / 255.0


def _library(values: Tensor | np.ndarray) -> Any:
    """The module whose functions take these values."""
    return torch if isinstance(values, Tensor) else np


@full_precision
def luma(rgb: Float[Tensor, "*batch channels"]) -> Float[Tensor, "*batch"]:
    """Brightness that a grey sensor sees of one or three colour channels (ITU-R BT.601 weights)."""
    if rgb.shape[-1] == 1:
        return rgb[..., 0]
    return rgb @ rgb.new_tensor(LUMA)


class ColourFilter:
    """The colour filter before a sensor's pixels.

    Args:
        pattern: Letters R, G and B of the pixels (0, 0), (1, 0), (0, 1) and (1, 1) as x, y, such as RGGB; the filter
            repeats them.
        width: Width of the sensor, pixels.

    Raises:
        ValueError: The pattern is not four of these letters.
    """

    def __init__(self, pattern: str, width: int):
        if len(pattern) != 4 or not set(pattern) <= set("RGB"):
            raise ValueError(
                f"a colour filter {pattern!r}, but four letters of R, G and B, such as RGGB, were expected."
            )
        self.width = width
        self._tile = torch.tensor(["RGB".index(letter) for letter in pattern])

    def channels(self, pixels: Int64[Tensor, "*batch"]) -> Int64[Tensor, "*batch"]:
        """Colour channel, 0, 1 or 2, that each pixel (y * width + x) sees."""
        x, y = pixels % self.width, pixels // self.width
        return self._tile.to(pixels.device)[2 * (y % 2) + x % 2]


def pixel_brightness(
    rgb: Float[Tensor, "*batch 3"], channel: Int64[Tensor, "*batch"] | None
) -> Float[Tensor, "*batch"]:
    """Brightness that pixels see of three colour channels: their own channel, or luma if `channel` is None."""
    return luma(rgb) if channel is None else rgb.gather(-1, channel[..., None])[..., 0]

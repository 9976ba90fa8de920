"""Named protocols: what is done to the brightness of renders before they are compared with frames, and how."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float64
from scipy.optimize import least_squares
from torch import Tensor

from enerf_ns.sensor.response import inverse_linlog, linlog

FLAT = 1e-12
"""Variance of log brightness up to which nothing can be fitted to pictures."""

DARKEST = 1e-4
"""Brightness up to which the power of gamma-affine takes everything as equally dark."""

GAMMA, EVENTNERF_OFFSET = 2.2, 0.1
"""Gamma of pictures, and what is added to linear brightness before its logarithm, in EventNeRF's evaluation."""

COLOURS = ("_red", "_green", "_blue")
"""What follows the names of the parameters of each channel that is fitted by itself."""

Pixels = Float64[Tensor, "pixels channels"]
"""Brightness of many pixels, a column for each channel that is fitted by itself."""


@dataclass(frozen=True)
class Correction:
    """A correction of brightness, fitted to pictures."""

    parameters: dict[str, Tensor]
    """By name, one number, or one for each channel that was fitted by itself."""
    apply: Callable[[Tensor], Tensor]
    """From linear brightness (..., channels) to linear brightness."""


Fit = Callable[[Pixels, Pixels], "Correction | str"]
"""Fits a correction of what was rendered to what was recorded; or a clause that says why there is none."""


@dataclass(frozen=True)
class Protocol:
    """How a set of renders is compared with recorded frames; both are linear brightness, frames in [0, 1]."""

    description: str
    """One sentence for whoever reads the scores."""
    fit: Fit | None = None
    """The correction of brightness; None: renders are compared as they are."""
    each_picture: bool = False
    """Whether each picture has a fit of its own; otherwise there is one over the set."""
    each_channel: bool = False
    """Whether channels are always fitted by themselves; otherwise they are where the sensor has a colour filter, since
    events then leave the log brightness of each open."""
    encode: Callable[[Tensor], Tensor] = field(default=lambda brightness: brightness)
    """From linear brightness to that in which pictures are compared."""
    clips: bool = True
    """Whether PSNR is of renders clipped to [0, 1]; SSIM and LPIPS always are."""
    pooled: bool = False
    """Whether PSNR is of the mean squared error over all pixels of all pictures, not the mean of each picture's."""


@dataclass(frozen=True)
class Aligned:
    """A set of pictures as a protocol compares them."""

    rendered: list[Tensor]
    """Corrected where there is a fit, and not clipped."""
    recorded: list[Tensor]
    faults: list[str | None]
    """Of each picture, why there is no fit; None where there is one, or need not be."""
    parameters: dict[str, float]
    """Of the one fit over the set, by name; of a channel by itself, NAME_red and so on."""


def align(
    rendered: Sequence[Float[Tensor, "height width channels"]],
    recorded: Sequence[Float[Tensor, "height width channels"]],
    protocol: str,
    colour_filter: bool = False,
) -> Aligned:
    """Fits brightness as a protocol says, in float64, and applies the fit.

    Renders that are not finite are left out of the fit, and stay as they are.

    Args:
        rendered: Linear brightness, 0 or more.
        recorded: Linear brightness in [0, 1].
        protocol: Name of one of `PROTOCOLS`.
        colour_filter: Whether the sensor has a colour filter.
    """
    chosen = PROTOCOLS[protocol]
    aligned = list(rendered)
    faults: list[str | None] = [None] * len(rendered)
    parameters: dict[str, float] = {}
    finite = [number for number, image in enumerate(rendered) if image.isfinite().all()]
    columns = rendered[0].shape[-1] if chosen.each_channel or colour_filter else 1
    for group in [[number] for number in finite] if chosen.each_picture else [finite] if finite else []:
        if chosen.fit is None:
            break
        x, y = (
            torch.cat([images[number].detach().double().reshape(-1, columns) for number in group])
            for images in (rendered, recorded)
        )
        correction = chosen.fit(x, y)
        for number in group:
            if isinstance(correction, str):
                faults[number] = correction
            else:
                image = rendered[number]
                aligned[number] = correction.apply(image.double()).to(image.dtype)
        if isinstance(correction, Correction) and not chosen.each_picture:
            for name, values in correction.parameters.items():
                names = [name + colour for colour in COLOURS] if len(values) > 1 else [name]
                parameters |= dict(zip(names, values.tolist(), strict=True))
    encoded = [[chosen.encode(image) for image in images] for images in (aligned, recorded)]
    return Aligned(encoded[0], encoded[1], faults, parameters)


def _fault(x: Pixels, y: Pixels) -> str | None:
    """Why nothing can be fitted to log brightness, where one channel is flat."""
    variances = [torch.mean((values - values.mean(dim=0)) ** 2, dim=0) for values in (x, y)]
    if float(torch.cat(variances).min()) <= FLAT:
        return "no brightness fits, since what is rendered or recorded is flat; check that the field has learnt"
    return None


def _negative(scale: float) -> str:
    return (
        f"the render is a negative of the frame (brightness scale {scale:.3g}); check the polarity of the events, the "
        "contrast thresholds, and that the field has learnt"
    )


def _line(x: Pixels, y: Pixels) -> tuple[Tensor, Tensor] | str:
    """Scale and offset of the line through each column, by ordinary least squares; or why there is none."""
    fault = _fault(x, y)
    if fault is not None:
        return fault
    deviation = x - x.mean(dim=0)
    scale = torch.mean(deviation * (y - y.mean(dim=0)), dim=0) / torch.mean(deviation**2, dim=0)
    if float(scale.min()) <= 0.0:
        return _negative(float(scale.min()))
    return scale, y.mean(dim=0) - scale * x.mean(dim=0)


def _log_affine(x: Pixels, y: Pixels) -> Correction | str:
    line = _line(linlog(x), linlog(y))
    if isinstance(line, str):
        return line
    scale, offset = line
    parameters = {"brightness_scale": scale, "brightness_offset": offset}
    return Correction(parameters, lambda brightness: inverse_linlog(scale * linlog(brightness) + offset))


def _log_offset(x: Pixels, y: Pixels) -> Correction | str:
    x, y = linlog(x), linlog(y)
    fault = _fault(x, y)
    if fault is not None:
        return fault
    offset = y.mean(dim=0) - x.mean(dim=0)
    return Correction({"brightness_offset": offset}, lambda brightness: inverse_linlog(linlog(brightness) + offset))


def _eventnerf(x: Pixels, y: Pixels) -> Correction | str:
    line = _line(torch.log(x + EVENTNERF_OFFSET), torch.log(y + EVENTNERF_OFFSET))
    if isinstance(line, str):
        return line
    scale, offset = line

    def apply(brightness: Tensor) -> Tensor:
        return torch.exp(scale * torch.log(brightness + EVENTNERF_OFFSET) + offset) - EVENTNERF_OFFSET

    return Correction({"brightness_scale": scale, "brightness_offset": offset}, apply)


def _gamma_encoded(brightness: Tensor) -> Tensor:
    return brightness.clamp(min=0.0) ** (1.0 / GAMMA)


def _gamma_affine(x: Pixels, y: Pixels) -> Correction | str:
    """y = a * x^b + c by Levenberg-Marquardt, a and c of each column, b of all; from the least squares of logarithms.

    x is divided by its geometric mean meanwhile, so that a and b hardly depend on each other.
    """
    logarithms, of_target = torch.log(x.clamp(min=DARKEST)), torch.log(y.clamp(min=DARKEST))
    if fault := _fault(logarithms, of_target):
        return fault
    line = _line(*((values - values.mean(dim=0)).reshape(-1, 1) for values in (logarithms, of_target)))
    if isinstance(line, str):
        return line
    columns, mean = x.shape[1], logarithms.mean()
    powers, target = (logarithms - mean).numpy(), y.numpy()

    def residuals(parameters: np.ndarray) -> np.ndarray:
        return (
            parameters[1 : columns + 1] * np.exp(parameters[0] * powers) + parameters[columns + 1 :] - target
        ).ravel()

    def jacobian(parameters: np.ndarray) -> np.ndarray:
        matrix = np.zeros((*powers.shape, len(parameters)))
        power = np.exp(parameters[0] * powers)
        matrix[..., 0] = parameters[1 : columns + 1] * powers * power
        for column in range(columns):
            matrix[:, column, 1 + column], matrix[:, column, 1 + columns + column] = power[:, column], 1.0
        return matrix.reshape(-1, len(parameters))

    gamma = float(line[0])
    factors = torch.exp(of_target.mean(dim=0) - gamma * (logarithms.mean(dim=0) - mean))
    start = np.concatenate([[gamma], factors.numpy(), np.zeros(columns)])
    solve: Any = least_squares  # SciPy's annotations know no function as jac
    found = torch.from_numpy(solve(residuals, start, jacobian, method="lm", xtol=1e-12, ftol=1e-12, gtol=1e-12).x)
    power, factor, shift = found[:1], found[1 : columns + 1] * torch.exp(-found[0] * mean), found[columns + 1 :]
    steepest = float((power * factor).min())
    if steepest <= 0.0:
        return _negative(steepest)
    parameters = {"gamma_factor": factor, "gamma_power": power, "gamma_offset": shift}
    return Correction(parameters, lambda brightness: factor * brightness.clamp(min=DARKEST) ** power + shift)


PROTOCOLS: dict[str, Protocol] = {
    "log-affine-set": Protocol(
        "One scale and offset of log brightness (linlog) is fitted over all held-out frames, of each colour channel by "
        "itself where the sensor has a colour filter; renders are clipped to [0, 1], PSNR is the mean over frames.",
        _log_affine,
    ),
    "log-affine-image": Protocol(
        "One scale and offset of log brightness (linlog) is fitted to each held-out frame by itself, of each colour "
        "channel by itself where the sensor has a colour filter; renders are clipped to [0, 1], PSNR is the mean over "
        "frames.",
        _log_affine,
        each_picture=True,
    ),
    "log-offset": Protocol(
        "One offset of log brightness (linlog), whose scale stays 1, is fitted over all held-out frames, of each "
        "colour channel by itself where the sensor has a colour filter, as E-3DGS does; renders are clipped to [0, 1], "
        "PSNR is the mean over frames.",
        _log_offset,
    ),
    "eventnerf": Protocol(
        "One scale and offset of log(brightness + 0.1) is fitted over all held-out frames, of each colour channel by "
        "itself, as EventNeRF does: linear brightness of renders and frames stands for its png^2.2, pictures are "
        "compared after max(0, brightness)^(1/2.2), and PSNR is of the mean squared error over all pixels of all "
        "frames, before clipping.",
        _eventnerf,
        each_channel=True,
        encode=_gamma_encoded,
        clips=False,
        pooled=True,
    ),
    "gamma-affine": Protocol(
        "Brightness is corrected to a * brightness^b + c, fitted to linear brightness over all held-out frames by "
        "Levenberg-Marquardt, b shared and a and c of each colour channel where the sensor has a colour filter, as "
        "Deblur e-NeRF does, with exposures and gains taken as equal; PSNR is the mean over frames, before clipping.",
        _gamma_affine,
        clips=False,
    ),
    "raw": Protocol(
        "Renders are compared as they are, without alignment of brightness; they are clipped to [0, 1], PSNR is the "
        "mean over frames."
    ),
}
"""Protocols by name."""

DEFAULT_PROTOCOL = "log-affine-set"
"""Name of the protocol of every run, whatever it learnt from, so that scores can be compared."""

EVENTS_PROTOCOL = "events"
"""Name of the protocol of recordings without frames, whose scores are the `event_scores`."""


def described(protocol: str) -> str:
    """A sentence that says how scores were made.

    Args:
        protocol: Name of one of `PROTOCOLS`, or `EVENTS_PROTOCOL`.
    """
    if protocol == EVENTS_PROTOCOL:
        return (
            "Protocol events: there are no frames; rendered changes of log brightness are compared with those that "
            "pairs of events measured, as they are."
        )
    return f"Protocol {protocol}: {PROTOCOLS[protocol].description}"

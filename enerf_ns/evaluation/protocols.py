"""Named protocols of scoring: how the brightness of renders is corrected before they are compared with frames."""

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
"""Variance of log brightness up to which a picture is flat, so that no correction can be fitted."""

DARKEST = 1e-4
"""Brightness to which the protocol gamma-affine raises all darker values."""

GAMMA, EVENTNERF_OFFSET = 2.2, 0.1
"""Gamma of pictures, and offset of linear brightness before its logarithm, in EventNeRF's evaluation."""

COLOURS = ("_red", "_green", "_blue")
"""Suffixes of the parameters of channels that are fitted separately."""

Pixels = Float64[Tensor, "pixels channels"]
"""Brightness of pixels, with a column for each channel that is fitted separately."""


@dataclass(frozen=True)
class Correction:
    """A correction of brightness that was fitted to pictures."""

    parameters: dict[str, Tensor]
    """Parameters by name: one number, or one for each separately fitted channel."""
    apply: Callable[[Tensor], Tensor]
    """Map of linear brightness (..., channels) to linear brightness."""


Fit = Callable[[Pixels, Pixels], "Correction | str"]
"""Fits a correction of rendered to recorded brightness. Returns it, or the reason why there is none, as a clause."""


@dataclass(frozen=True)
class Protocol:
    """Comparison of renders with frames. Both hold linear brightness, frames in [0, 1]."""

    description: str
    """Sentences for readers of the scores."""
    fit: Fit | None = None
    """Fit of the correction of brightness. None: renders are not corrected."""
    each_picture: bool = False
    """Whether each picture has its own fit. Otherwise, one fit is over all pictures."""
    each_channel: bool = False
    """Whether channels are always fitted separately. Otherwise, they are only if the sensor has a colour filter,
    because events then do not determine the offsets between channels."""
    encode: Callable[[Tensor], Tensor] = field(default=lambda brightness: brightness)
    """Map of linear brightness to the values that are compared."""
    clips: bool = True
    """Whether renders are clipped to [0, 1] for PSNR. For SSIM and LPIPS they always are."""
    pooled: bool = False
    """Whether PSNR is that of the mean squared error over all pictures, instead of the mean PSNR of pictures."""


@dataclass(frozen=True)
class Aligned:
    """Pictures after the correction of a protocol."""

    rendered: list[Tensor]
    """Renders, corrected if there is a fit, and not clipped."""
    recorded: list[Tensor]
    """Frames."""
    faults: list[str | None]
    """Reason why a picture has no fit; None if it has one or the protocol needs none."""
    parameters: dict[str, float]
    """Parameters of the fit over all pictures by name; NAME_red, NAME_green and NAME_blue for separate channels."""


def align(
    rendered: Sequence[Float[Tensor, "height width channels"]],
    recorded: Sequence[Float[Tensor, "height width channels"]],
    protocol: str,
    colour_filter: bool = False,
    encoded: bool = True,
) -> Aligned:
    """Fits and applies the correction of brightness of a protocol, in float64.

    Renders that are not finite are left out of the fit and not corrected.

    Args:
        rendered: Linear brightness, 0 or more.
        recorded: Linear brightness in [0, 1].
        protocol: Name of one of `PROTOCOLS`.
        colour_filter: Whether the sensor has a colour filter.
        encoded: Whether the pictures become the values that the protocol compares; otherwise they stay linear.
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
    frames = list(recorded)
    if encoded:
        aligned, frames = ([chosen.encode(image) for image in images] for images in (aligned, frames))
    return Aligned(aligned, frames, faults, parameters)


def _fault(x: Pixels, y: Pixels) -> str | None:
    """The reason why nothing can be fitted to log brightness, if a channel is flat; otherwise None."""
    variances = [torch.mean((values - values.mean(dim=0)) ** 2, dim=0) for values in (x, y)]
    if float(torch.cat(variances).min()) <= FLAT:
        return (
            "no correction of brightness can be fitted, since the render or the frame is flat; check that the field "
            "has learnt"
        )
    return None


def _negative(scale: float) -> str:
    return (
        f"the render is a negative of the frame (brightness scale {scale:.3g}); check the polarity of the events, the "
        "contrast thresholds, and that the field has learnt"
    )


def _line(x: Pixels, y: Pixels) -> tuple[Tensor, Tensor] | str:
    """Scale and offset of the line through each column by ordinary least squares, or the reason why there is none."""
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
    """Fits y = a * x^b + c by Levenberg-Marquardt, with a and c for each column and one b.

    The fit starts from the least squares solution for logarithms. x is divided by its geometric mean during the fit, so
    that a and b are almost independent.
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
        "One scale and offset of log brightness (linlog) is fitted over all held-out frames, separately for each "
        "colour channel if the sensor has a colour filter. Renders are clipped to [0, 1]. PSNR is the mean over "
        "frames.",
        _log_affine,
    ),
    "log-affine-image": Protocol(
        "A scale and offset of log brightness (linlog) is fitted to each held-out frame, separately for each colour "
        "channel if the sensor has a colour filter. Renders are clipped to [0, 1]. PSNR is the mean over frames.",
        _log_affine,
        each_picture=True,
    ),
    "log-offset": Protocol(
        "One offset of log brightness (linlog) is fitted over all held-out frames, separately for each colour channel "
        "if the sensor has a colour filter, and the scale stays 1, as in E-3DGS. Renders are clipped to [0, 1]. PSNR "
        "is the mean over frames.",
        _log_offset,
    ),
    "eventnerf": Protocol(
        "One scale and offset of log(brightness + 0.1) is fitted over all held-out frames, separately for each colour "
        "channel, as in EventNeRF. Linear brightness of renders and frames replaces its png^2.2. Pictures are compared "
        "after max(0, brightness)^(1/2.2). PSNR is that of the mean squared error over all pixels of all frames, "
        "before clipping.",
        _eventnerf,
        each_channel=True,
        encode=_gamma_encoded,
        clips=False,
        pooled=True,
    ),
    "gamma-affine": Protocol(
        "The correction a * brightness^b + c is fitted to linear brightness over all held-out frames by "
        "Levenberg-Marquardt, as in Deblur e-NeRF with equal exposures and gains. If the sensor has a colour filter, "
        "each colour channel has its own a and c. PSNR is the mean over frames, before clipping.",
        _gamma_affine,
        clips=False,
    ),
    "raw": Protocol(
        "The brightness of renders is not corrected. Renders are clipped to [0, 1]. PSNR is the mean over frames."
    ),
}
"""Protocols by name."""

DEFAULT_PROTOCOL = "log-affine-set"
"""Name of the protocol of every run, whatever its training data, so that scores of runs are comparable."""

EVENTS_PROTOCOL = "events"
"""Name of the protocol for recordings without frames. Its scores are the `event_scores`."""


def described(protocol: str) -> str:
    """Sentences that describe a protocol.

    Args:
        protocol: Name of one of `PROTOCOLS`, or `EVENTS_PROTOCOL`.
    """
    if protocol == EVENTS_PROTOCOL:
        return (
            "Protocol events: Rendered changes of log brightness are compared with those that pairs of held-out events "
            "measured, without correction."
        )
    return f"Protocol {protocol}: {PROTOCOLS[protocol].description}"

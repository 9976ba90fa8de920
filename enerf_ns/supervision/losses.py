"""The losses of E-NeRF (Klenk et al., RA-L 2023), as pure functions of tensors, computed in float32 or better."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from enerf_ns.kernels.precision import full_precision
from enerf_ns.sensor.response import luma


@full_precision
def squared_event_loss(
    predicted: Float[Tensor, " pairs"], measured: Float[Tensor, " pairs"], mean_threshold: float | Tensor
) -> Float[Tensor, ""]:
    """Mean squared error of the change of log brightness, in units of the contrast threshold.

    Equation 5 of the paper divided by the squared mean threshold (as in Robust e-NeRF, Low and Lee, ICCV 2023), so that
    the same learning rate and regularisation serve every threshold.

    Args:
        predicted: Rendered change of log brightness between the two instants of each pair.
        measured: Sum of the pixel's events between the two instants, in log brightness.
        mean_threshold: Mean contrast threshold, positive.
    """
    return torch.mean(((predicted - measured) / mean_threshold) ** 2)


@full_precision
def huber_event_loss(
    predicted: Float[Tensor, " pairs"], measured: Float[Tensor, " pairs"], mean_threshold: float | Tensor
) -> Float[Tensor, ""]:
    """Mean Huber loss of the change of log brightness, in units of the contrast threshold.

    It is `squared_event_loss` for errors below one threshold, and linear beyond, so that pairs with wrong or missing
    events count less. So it is twice the Huber loss with delta 1 of the error in units of the mean threshold, which is
    the loss of Deblur e-NeRF (Low and Lee, ECCV 2024). The arguments are those of `squared_event_loss`.
    """
    error = (predicted - measured) / mean_threshold
    return 2.0 * torch.nn.functional.huber_loss(error, torch.zeros_like(error))


@full_precision
def normalised_event_loss(
    predicted: Float[Tensor, " pairs"], measured: Float[Tensor, " pairs"], eps: float = 1e-9
) -> Float[Tensor, ""]:
    """Squared distance of the two changes after each is divided by its norm over the batch, for unknown thresholds.

    Equation 6 of the paper. It lies in [0, 4] and does not change when either argument is scaled by a positive number.
    """
    difference = predicted / (predicted.norm() + eps) - measured / (measured.norm() + eps)
    return torch.sum(difference**2)


@full_precision
def no_event_loss(
    predicted: Float[Tensor, " pairs"], thresholds: tuple[float | Tensor, float | Tensor], margin: float = 1.0
) -> Float[Tensor, ""]:
    """Mean excess of a silent pixel's rendered change over the threshold, beyond which it would fire.

    Equation 7 of the paper with a threshold per polarity, in units of the mean threshold:
    relu(change - margin * C_on) + relu(-change - margin * C_off). With margin 0 it is the mean absolute change, the
    total variation of Deblur e-NeRF (Low and Lee, ECCV 2024), which also smooths changes below the threshold.

    Args:
        predicted: Rendered change of log brightness between two instants with no event between them.
        thresholds: Contrast thresholds (C_on, C_off).
        margin: Share of the threshold that costs nothing, from 0 to 1.
    """
    on, off = thresholds
    excess = torch.relu(predicted - margin * on) + torch.relu(-predicted - margin * off)
    unit = 0.5 * (on + off)
    # the unit gets no gradient, since silence does not identify thresholds
    return torch.mean(excess) / (unit.detach() if isinstance(unit, Tensor) else unit)


@full_precision
def frame_loss(rendered: Float[Tensor, "rays 3"], recorded: Float[Tensor, "rays 3"], grey: bool) -> Float[Tensor, ""]:
    """Mean squared error between rendered and recorded pixels. Saturated pixels (recorded as 1) may be any brighter.

    Args:
        rendered: Rendered brightness, 0 or more.
        recorded: Brightness in the frames, in [0, 1].
        grey: Compare luma alone, for a grey field or grey frames.
    """
    rendered = torch.where(recorded >= 1.0, rendered.clamp(max=1.0), rendered)
    if grey:
        rendered, recorded = luma(rendered)[..., None], luma(recorded)[..., None]
    return torch.mean((rendered - recorded) ** 2)


@full_precision
def distortion_loss(
    weights: Float[Tensor, "rays samples"], edges: Float[Tensor, "rays samples+1"]
) -> Float[Tensor, ""]:
    """The distortion loss of mip-NeRF 360 (Barron et al., CVPR 2022, equation 15): the spread of a ray's weights.

    Sums up to each sample give it in one pass along the ray (Sun et al., Improved Direct Voxel Grid Optimization,
    2022).

    Args:
        weights: Rendering weights of the samples of each ray.
        edges: Ends of the samples in ascending order, as shares of the ray.
    """
    middles = (edges[:, 1:] + edges[:, :-1]) / 2.0
    before = weights.cumsum(dim=-1) - weights
    moment_before = (weights * middles).cumsum(dim=-1) - weights * middles
    between = 2.0 * weights * (middles * before - moment_before)
    within = weights.square() * (edges[:, 1:] - edges[:, :-1]) / 3.0
    return (between + within).sum(dim=-1).mean()

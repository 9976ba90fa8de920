"""Scores of rendered against recorded pictures, or why there are none."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from enerf_ns.sensor.response import inverse_linlog, linlog

Score = float | str
"""A score, or why there is none; a clause about one picture."""

NOT_FINITE = "the render is not finite"

SSIM_SIDE = 11
"""Pixels along each side of the window of SSIM."""

FLAT = 1e-12
"""Variance of log brightness up to which nothing can be fitted to pictures."""


def align_brightness(
    rendered: Sequence[Float[Tensor, "height width channels"]],
    recorded: Sequence[Float[Tensor, "height width channels"]],
) -> tuple[list[Float[Tensor, "height width channels"]], tuple[float, float]]:
    """Fit one scale and offset of log brightness over a whole set of pictures, and apply them.

    Events fix log brightness only up to an offset, and up to a factor where the threshold is unknown. The fit is
    ordinary least squares in float64 over all pixels of all pictures: log(recorded) = scale * log(rendered) + offset,
    with `linlog` as the logarithm (E-NeRF, section IV; Robust e-NeRF evaluates so too).

    Returns:
        The aligned pictures, clipped to [0, 1], and (scale, offset). The scale is 0 where all that was rendered, or
        recorded, is flat; see `fit_fault`.
    """
    x = torch.cat([linlog(image.double()).flatten() for image in rendered])
    y = torch.cat([linlog(image.double()).flatten() for image in recorded])
    variance = torch.mean((x - x.mean()) ** 2)
    is_flat = min(variance, torch.mean((y - y.mean()) ** 2)) <= FLAT
    covariance = torch.mean((x - x.mean()) * (y - y.mean()))
    scale = 0.0 if is_flat else (covariance / variance).item()
    offset = (y.mean() - scale * x.mean()).item()
    aligned = [
        inverse_linlog(scale * linlog(image.double()) + offset).clamp(0.0, 1.0).to(image.dtype) for image in rendered
    ]
    return aligned, (scale, offset)


def align_channels(
    rendered: Sequence[Float[Tensor, "height width channels"]],
    recorded: Sequence[Float[Tensor, "height width channels"]],
) -> tuple[list[Float[Tensor, "height width channels"]], list[tuple[float, float]]]:
    """Fit one scale and offset of log brightness for each colour channel, and apply them; see `align_brightness`.

    For colour that was learnt from colour events, which leave the log brightness of every channel open (Robust e-NeRF,
    ICCV 2023, evaluates so).

    Returns:
        The aligned pictures, clipped to [0, 1], and (scale, offset) of each channel.
    """
    aligned, fits = [], []
    for channel in range(rendered[0].shape[-1]):
        images, fit = align_brightness(
            [image[..., channel, None] for image in rendered], [image[..., channel, None] for image in recorded]
        )
        aligned.append(images)
        fits.append(fit)
    return [torch.cat(channels, dim=-1) for channels in zip(*aligned, strict=True)], fits


def fit_fault(fits: Sequence[tuple[float, float]]) -> str | None:
    """Why pictures after a fit of brightness cannot be compared with frames; None where they can.

    Args:
        fits: (scale, offset), of each channel that was fitted by itself.
    """
    scale = min(scale for scale, _ in fits)
    if scale > 0.0:
        return None
    if scale < 0.0:
        return (
            f"the render is a negative of the frame (brightness scale {scale:.3g}); check the polarity of the events, "
            "the contrast thresholds, and that the field has learnt"
        )
    return "no brightness scale fits, since what is rendered or recorded is flat; check that the field has learnt"


def image_metrics(
    rendered: Float[Tensor, "height width channels"], recorded: Float[Tensor, "height width channels"]
) -> dict[str, Score]:
    """PSNR in dB and SSIM of two pictures in [0, 1]."""
    from torchmetrics.functional.image import structural_similarity_index_measure

    if not rendered.isfinite().all():
        return {"psnr": NOT_FINITE, "ssim": NOT_FINITE}
    psnr = -10.0 * torch.log10(torch.mean((rendered - recorded) ** 2).clamp(min=1e-12))
    if min(rendered.shape[:2]) < SSIM_SIDE:
        return {"psnr": float(psnr), "ssim": f"the frame is smaller than {SSIM_SIDE} x {SSIM_SIDE} pixels"}
    pictures = [image.movedim(-1, 0)[None] for image in (rendered, recorded)]
    ssim = structural_similarity_index_measure(pictures[0], pictures[1], data_range=1.0)
    assert isinstance(ssim, Tensor)
    return {"psnr": float(psnr), "ssim": float(ssim)}


def correlation(rendered: Float[Tensor, "*shape"], recorded: Float[Tensor, "*shape"]) -> Score:
    """Linear (Pearson) correlation of two pictures, blind to scale and offset of brightness."""
    if not rendered.isfinite().all():
        return NOT_FINITE
    for what, values in (("rendered", rendered), ("recorded", recorded)):
        if values.min() == values.max():
            return f"what is {what} is flat"
    pixels = torch.stack([rendered.flatten(), recorded.flatten()]).double()
    return float(torch.corrcoef(pixels)[0, 1])


def depth_rmse(rendered: Float[Tensor, "height width 1"], recorded: Float[Tensor, "height width 1"]) -> Score:
    """Root mean squared error of depth in metres, over the pixels whose recorded depth is known."""
    known = is_known(recorded)
    if not known.any():
        return "no depth is known"
    if not rendered[known].isfinite().all():
        return "the rendered depth is not finite"
    return float(torch.sqrt(torch.mean((rendered[known] - recorded[known]) ** 2)))


def is_known(depth: Float[Tensor, "*shape"]) -> Bool[Tensor, "*shape"]:
    """Which recorded depths are known: those that are positive and finite."""
    return (depth > 0.0) & depth.isfinite()

"""Scores of rendered against recorded pictures."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from enerf_ns.sensor.response import inverse_linlog, linlog


def align_brightness(
    rendered: Sequence[Float[Tensor, "height width channels"]],
    recorded: Sequence[Float[Tensor, "height width channels"]],
) -> tuple[list[Float[Tensor, "height width channels"]], tuple[float, float]]:
    """Fit one scale and offset of log brightness over a whole set of pictures, and apply them.

    Events fix log brightness only up to an offset, and up to a factor where the threshold is unknown. The fit is
    ordinary least squares in float64 over all pixels of all pictures: log(recorded) = scale * log(rendered) + offset,
    with `linlog` as the logarithm (E-NeRF, section IV; Robust e-NeRF evaluates so too).

    Returns:
        The aligned pictures, clipped to [0, 1], and (scale, offset).
    """
    x = torch.cat([linlog(image.double()).flatten() for image in rendered])
    y = torch.cat([linlog(image.double()).flatten() for image in recorded])
    variance = torch.mean((x - x.mean()) ** 2)
    covariance = torch.mean((x - x.mean()) * (y - y.mean()))
    scale = (covariance / variance).item() if variance > 1e-12 else 0.0
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


def image_metrics(
    rendered: Float[Tensor, "height width channels"], recorded: Float[Tensor, "height width channels"]
) -> dict[str, float]:
    """PSNR in dB and SSIM of two pictures in [0, 1]."""
    from torchmetrics.functional.image import structural_similarity_index_measure

    psnr = -10.0 * torch.log10(torch.mean((rendered - recorded) ** 2).clamp(min=1e-12))
    pictures = [image.movedim(-1, 0)[None] for image in (rendered, recorded)]
    ssim = structural_similarity_index_measure(pictures[0], pictures[1], data_range=1.0)
    assert isinstance(ssim, Tensor)
    return {"psnr": float(psnr), "ssim": float(ssim)}


def correlation(rendered: Float[Tensor, "*shape"], recorded: Float[Tensor, "*shape"]) -> float:
    """Linear (Pearson) correlation of two pictures, blind to scale and offset of brightness; 0 if one is flat."""
    pixels = torch.stack([rendered.flatten(), recorded.flatten()]).double()
    return float(torch.corrcoef(pixels)[0, 1].nan_to_num())


def depth_rmse(rendered: Float[Tensor, "height width 1"], recorded: Float[Tensor, "height width 1"]) -> float:
    """Root mean squared error of depth in metres, over the pixels whose recorded depth is known (positive)."""
    known = recorded > 0.0
    return float(torch.sqrt(torch.mean((rendered[known] - recorded[known]) ** 2)))

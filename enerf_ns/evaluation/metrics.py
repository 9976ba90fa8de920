"""Scores of rendered against recorded pictures and events."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

Score = float | str
"""A score, or the reason why it is missing, as a clause about one picture."""

NOT_FINITE = "the render is not finite"

SSIM_SIDE = 11
"""Width and height of the window of SSIM, pixels."""


def psnr(rendered: Float[Tensor, "*shape"], recorded: Float[Tensor, "*shape"]) -> Score:
    """Peak signal-to-noise ratio in dB of pictures whose peak is 1."""
    if not rendered.isfinite().all():
        return NOT_FINITE
    return float(-10.0 * torch.log10(torch.mean((rendered - recorded) ** 2).clamp(min=1e-12)))


def ssim(rendered: Float[Tensor, "height width channels"], recorded: Float[Tensor, "height width channels"]) -> Score:
    """Structural similarity of two pictures in [0, 1] (Wang et al., TIP 2004)."""
    from torchmetrics.functional.image import structural_similarity_index_measure

    if not rendered.isfinite().all():
        return NOT_FINITE
    if min(rendered.shape[:2]) < SSIM_SIDE:
        return f"the frame is smaller than {SSIM_SIDE} x {SSIM_SIDE} pixels"
    pictures = [image.movedim(-1, 0)[None] for image in (rendered, recorded)]
    similarity = structural_similarity_index_measure(pictures[0], pictures[1], data_range=1.0)
    assert isinstance(similarity, Tensor)
    return float(similarity)


def correlation(rendered: Float[Tensor, "*shape"], recorded: Float[Tensor, "*shape"]) -> Score:
    """Linear (Pearson) correlation of two pictures, which does not depend on scale and offset of brightness."""
    if not rendered.isfinite().all():
        return NOT_FINITE
    for what, values in (("rendered", rendered), ("recorded", recorded)):
        if values.min() == values.max():
            return f"the {what} values are all equal"
    pixels = torch.stack([rendered.flatten(), recorded.flatten()]).double()
    return float(torch.corrcoef(pixels)[0, 1])


EVENT_SCORES = ("event_correlation", "event_rmse", "event_sign")
"""Names of the `event_scores`."""


def event_scores(
    predicted: Float[Tensor, " pairs"], measured: Float[Tensor, " pairs"], mean_threshold: float
) -> dict[str, Score]:
    """Agreement of rendered changes of log brightness with those that pairs of events measured (protocol "events").

    Args:
        predicted: Rendered change of log brightness of each pair.
        measured: Sum of the changes of the events of each pair.
        mean_threshold: Mean contrast threshold, the unit of the error.

    Returns:
        event_correlation (linear), event_rmse (root mean square error in thresholds), and event_sign. event_sign is the
        share of pairs whose rendered change has the sign of the measured one, without pairs whose events cancel.
    """
    scores: dict[str, Score] = {"event_correlation": correlation(predicted, measured)}
    if not predicted.isfinite().all():
        return dict.fromkeys(EVENT_SCORES, NOT_FINITE)
    error = (predicted - measured).double() / mean_threshold
    changed = measured != 0
    agrees = torch.sign(predicted[changed]) == torch.sign(measured[changed])
    scores["event_rmse"] = float(error.square().mean().sqrt())
    scores["event_sign"] = float(agrees.double().mean()) if changed.any() else "no pair measured a change"
    return scores


KNOWN = 0.5
"""Least confidence of rendered depth that counts as known."""


def depth_rmse(rendered: Float[Tensor, "height width 1"], recorded: Float[Tensor, "height width 1"]) -> Score:
    """Root mean square error of depth in metres, over the pixels with known recorded depth."""
    known = is_known(recorded)
    if not known.any():
        return "no depth is known"
    if not rendered[known].isfinite().all():
        return "the rendered depth is not finite"
    return float(torch.sqrt(torch.mean((rendered[known] - recorded[known]) ** 2)))


def is_known(depth: Float[Tensor, "*shape"]) -> Bool[Tensor, "*shape"]:
    """Whether recorded depths are known, that is, positive and finite."""
    return (depth > 0.0) & depth.isfinite()

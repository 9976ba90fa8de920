"""Scores of held-out views: of each, their mean, and all that is known of a run in numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from enerf_ns.evaluation.lpips import lpips
from enerf_ns.evaluation.metrics import correlation, depth_rmse, image_metrics
from enerf_ns.evaluation.views import HeldOutView


def view_scores(view: HeldOutView) -> dict[str, float]:
    """Scores of one held-out frame; none where there is no frame.

    Returns:
        psnr (dB), ssim, correlation, lpips where its weights are at hand, and depth_rmse (metres) where depth is known.
        The correlation is that of the render as it is, before brightness is aligned.
    """
    if view.recorded is None:
        return {}
    scores = image_metrics(view.rendered, view.recorded)
    scores["correlation"] = correlation(view.unaligned, view.recorded)
    perceptual = lpips(view.rendered, view.recorded)
    if perceptual is not None:
        scores["lpips"] = perceptual
    if view.recorded_depth is not None:
        scores["depth_rmse"] = depth_rmse(view.depth, view.recorded_depth)
    return scores


def mean_scores(views: Sequence[HeldOutView], with_std: bool = False) -> dict[str, float]:
    """Mean over held-out frames of each of the `view_scores`; empty where there are no frames.

    Args:
        views: At least one; all with the same scores.
        with_std: Give the standard deviation over the frames too, as NAME_std.
    """
    per_view = [view_scores(view) for view in views]
    means: dict[str, float] = {}
    for name in per_view[0]:
        values = [scores[name] for scores in per_view]
        means[name] = float(np.mean(values))
        if with_std:
            means[f"{name}_std"] = float(np.std(values))
    return means


def summary_scores(views: Sequence[HeldOutView], summary: Mapping[str, float]) -> dict[str, float | None]:
    """Mean scores and the numbers about the whole set in one table, with a place for each score that can be missing.

    Args:
        views: At least one, as `held_out_views` gives them.
        summary: Numbers about the whole set, as `held_out_views` gives them.

    Returns:
        psnr (dB), ssim, lpips (None where its weights are missing), correlation, and with known depth depth_rmse and
        mean_depth (metres); means over the held-out frames. Without frames the first three are None, and
        event_correlation stands for them.
    """
    scores: dict[str, float | None] = {"psnr": None, "ssim": None, "lpips": None}
    scores |= mean_scores(views)
    known = [view.recorded_depth[view.recorded_depth > 0] for view in views if view.recorded_depth is not None]
    if known:
        scores["mean_depth"] = float(np.mean([float(depth.mean()) for depth in known]))
    return scores | dict(summary)

"""Scores of held-out views: of each, their mean, and all that is known of a run in numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from enerf_ns.evaluation.lpips import lpips
from enerf_ns.evaluation.metrics import Score, correlation, depth_rmse, image_metrics, is_known
from enerf_ns.evaluation.views import HeldOutView

NotScored = dict[str, dict[str, list[int]]]
"""What has no value: by score and reason, the numbers of the held-out frames, from 0; none of a score of the whole
set."""


def view_scores(view: HeldOutView) -> dict[str, Score]:
    """Scores of one held-out frame, each a number or why there is none.

    Returns:
        psnr (dB), ssim, correlation, lpips, and of a recording with depth depth_rmse (metres). The correlation is that
        of the render as it is, before brightness is aligned.
    """
    if view.recorded is None:
        return dict.fromkeys(("psnr", "ssim", "correlation", "lpips"), "there is no frame")
    scores = image_metrics(view.rendered, view.recorded)
    scores["correlation"] = correlation(view.unaligned, view.recorded)
    scores["lpips"] = lpips(view.rendered, view.recorded)
    if view.not_aligned is not None:
        scores |= dict.fromkeys(("psnr", "ssim", "lpips"), view.not_aligned)
    if view.recorded_depth is not None:
        scores["depth_rmse"] = depth_rmse(view.depth, view.recorded_depth)
    return scores


def mean_scores(views: Sequence[HeldOutView], with_std: bool = False) -> tuple[dict[str, float], NotScored]:
    """Mean of each of the `view_scores` over the held-out frames that have it; no entry where none has.

    Args:
        views: At least one, of one recording.
        with_std: Give the standard deviation over these frames too, as NAME_std.

    Returns:
        The means, and which frames they leave out, and why.
    """
    per_view = [view_scores(view) for view in views]
    means: dict[str, float] = {}
    not_scored: NotScored = {}
    for name in per_view[0]:
        values = [scores[name] for scores in per_view]
        for number, value in enumerate(values):
            if isinstance(value, str):
                not_scored.setdefault(name, {}).setdefault(value, []).append(number)
        values = [value for value in values if not isinstance(value, str)]
        if values:
            means[name] = float(np.mean(values))
            if with_std:
                means[f"{name}_std"] = float(np.std(values))
    return means, not_scored


def summary_scores(
    views: Sequence[HeldOutView], summary: Mapping[str, Score], with_std: bool = False
) -> dict[str, float | NotScored | None]:
    """Mean scores and the numbers about the whole set in one table, with a place for each score that can be missing.

    Args:
        views: At least one, as `held_out_views` gives them.
        summary: Numbers about the whole set, as `held_out_views` gives them.
        with_std: As of `mean_scores`.

    Returns:
        psnr (dB), ssim, lpips, correlation, and with known depth depth_rmse and mean_depth (metres); means over the
        held-out frames that have them. The first three are None where no frame has them; without frames,
        event_correlation stands for them. not_scored, where anything is left out, says what and why.
    """
    means, not_scored = mean_scores(views, with_std)
    scores: dict[str, float | NotScored | None] = {"psnr": None, "ssim": None, "lpips": None}
    scores |= means
    depths = [view.recorded_depth[is_known(view.recorded_depth)] for view in views if view.recorded_depth is not None]
    means_of_depth = [float(depth.mean()) for depth in depths if len(depth)]
    if means_of_depth:
        scores["mean_depth"] = float(np.mean(means_of_depth))
    for name, value in summary.items():
        if isinstance(value, str):
            not_scored[name] = {value: []}
        else:
            scores[name] = value
    return scores | ({"not_scored": not_scored} if not_scored else {})

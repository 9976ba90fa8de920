"""Scores of held-out views: of each view, their means, and the summary of a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from enerf_ns.evaluation.lpips import NETWORKS, Net, lpips
from enerf_ns.evaluation.metrics import KNOWN, Score, correlation, depth_rmse, is_known, psnr, ssim
from enerf_ns.evaluation.protocols import DEFAULT_PROTOCOL, EVENTS_PROTOCOL, PROTOCOLS
from enerf_ns.evaluation.views import EXPECTED_SCALE, HeldOutView, aligned_views

NotScored = dict[str, dict[str, list[int]]]
"""Numbers of the held-out frames without a value, from 0, by score and reason. The list is empty for a score of the
whole set."""


def view_scores(
    view: HeldOutView, aligned: HeldOutView, protocol: str = DEFAULT_PROTOCOL, lpips_nets: Sequence[Net] = ("alex",)
) -> dict[str, Score]:
    """Scores of one held-out frame. Each is a number, or the reason why it is missing.

    Args:
        view: View before the correction of brightness.
        aligned: The same view in `aligned_views`.
        protocol: Name of the protocol in `PROTOCOLS` that corrected it.
        lpips_nets: Networks of LPIPS.

    Returns:
        psnr (dB), ssim, correlation, the requested ones of lpips (AlexNet) and lpips_vgg, and, if the recording has
        depth, depth_rmse (metres). If the view has a confidence of its depth, also depth_known, the share of pixels
        with known depth; depth_rmse_known over these pixels (metres); and depth_rmse_spread of the spread depth over
        all pixels (metres). The correlation is that of the render before the correction of brightness.
    """
    names = ["psnr", "ssim", *(NETWORKS[net].score for net in lpips_nets)]
    if view.recorded is None or aligned.recorded is None:
        return dict.fromkeys((*names, "correlation"), "there is no frame")
    scores: dict[str, Score] = {}
    if aligned.not_aligned is not None:
        scores |= dict.fromkeys(names, aligned.not_aligned)
    else:
        clipped = aligned.rendered.clamp(0.0, 1.0) if aligned.rendered.isfinite().all() else aligned.rendered
        scores["psnr"] = psnr(clipped if PROTOCOLS[protocol].clips else aligned.rendered, aligned.recorded)
        scores["ssim"] = ssim(clipped, aligned.recorded)
        for net in lpips_nets:
            scores[NETWORKS[net].score] = lpips(clipped, aligned.recorded, net)
    scores["correlation"] = correlation(view.rendered, view.recorded)
    if view.recorded_depth is not None and view.depth is not None:
        scores["depth_rmse"] = depth_rmse(view.depth, view.recorded_depth)
        if view.confidence is None or view.spread_depth is None:
            return scores
        known, truth = view.confidence >= KNOWN, is_known(view.recorded_depth)
        found = depth_rmse(view.depth, view.recorded_depth.where(known, 0.0))
        scores["depth_rmse_known"] = (
            "no rendered depth is known" if truth.any() and not (truth & known).any() else found
        )
        scores["depth_known"] = float(known[truth].float().mean()) if truth.any() else "no depth is known"
        scores["depth_rmse_spread"] = depth_rmse(view.spread_depth, view.recorded_depth)
    return scores


def mean_scores(
    views: Sequence[HeldOutView],
    with_std: bool = False,
    protocol: str = DEFAULT_PROTOCOL,
    lpips_nets: Sequence[Net] = ("alex",),
    crop: tuple[int, int] | None = None,
) -> tuple[dict[str, float], NotScored]:
    """Mean of each of the `view_scores` over the held-out frames that have it. A score that no frame has is left out.

    Args:
        views: At least one, of one recording, as `held_out_views` gives them.
        with_std: Whether to add the standard deviation over these frames, as NAME_std.
        protocol: Name of the protocol in `PROTOCOLS`.
        lpips_nets: Networks of LPIPS.
        crop: Height and width in pixels of the central part of each frame that is fitted and scored. None: all.

    Returns:
        The means, and the frames that they leave out, with reasons.

    Raises:
        FlagError: The crop is larger than the frames.
    """
    views = [view.cropped(*crop) for view in views] if crop else views
    return _mean_scores(views, aligned_views(views, protocol)[0], with_std, protocol, lpips_nets)


def _mean_scores(
    views: Sequence[HeldOutView],
    aligned: Sequence[HeldOutView],
    with_std: bool,
    protocol: str,
    lpips_nets: Sequence[Net],
) -> tuple[dict[str, float], NotScored]:
    per_view = [view_scores(*both, protocol, lpips_nets) for both in zip(views, aligned, strict=True)]
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
    if PROTOCOLS[protocol].pooled and "psnr" in means:
        errors = [10.0 ** (-0.1 * scores["psnr"]) for scores in per_view if not isinstance(scores["psnr"], str)]
        means["psnr"] = float(-10.0 * np.log10(np.mean(errors)))
    return means, not_scored


def summary_scores(
    views: Sequence[HeldOutView],
    summary: Mapping[str, Score],
    with_std: bool = False,
    protocol: str = DEFAULT_PROTOCOL,
    lpips_nets: Sequence[Net] = ("alex",),
    crop: tuple[int, int] | None = None,
) -> dict[str, float | str | NotScored | None]:
    """Mean scores and numbers about the whole set in one dictionary, with None for scores that are missing.

    Args:
        views: At least one, as `held_out_views` gives them.
        summary: Numbers about the whole set, as `held_out_views` gives them.
        with_std, protocol, lpips_nets, crop: The arguments of `mean_scores`.

    Returns:
        The name of the protocol; means of psnr (dB), ssim, lpips, correlation, and, if depth is known, depth_rmse,
        mean_depth (metres) and the other depth scores of `view_scores`; and the parameters of the protocol's fit over
        the whole set. brightness_scale_expected is present only with log-affine-set. psnr, ssim and the requested LPIPS
        are None if no frame has them. Without frames, event_correlation replaces them, and the protocol is "events".
        not_scored, if present, holds the missing values with their reasons.

    Raises:
        FlagError: The crop is larger than the frames.
    """
    views = [view.cropped(*crop) for view in views] if crop else views
    aligned, parameters = aligned_views(views, protocol)
    means, not_scored = _mean_scores(views, aligned, with_std, protocol, lpips_nets)
    has_frames = any(view.recorded is not None for view in views)
    scores: dict[str, float | str | NotScored | None] = {"protocol": protocol if has_frames else EVENTS_PROTOCOL}
    scores |= dict.fromkeys(("psnr", "ssim", *(NETWORKS[net].score for net in lpips_nets)))
    scores |= {**means, **parameters}
    depths = [view.recorded_depth[is_known(view.recorded_depth)] for view in views if view.recorded_depth is not None]
    means_of_depth = [float(depth.mean()) for depth in depths if len(depth)]
    if means_of_depth:
        scores["mean_depth"] = float(np.mean(means_of_depth))
    for name, value in summary.items():
        if name == EXPECTED_SCALE and not (parameters and protocol == DEFAULT_PROTOCOL):
            continue
        if isinstance(value, str):
            not_scored[name] = {value: []}
        else:
            scores[name] = value
    return scores | ({"not_scored": not_scored} if not_scored else {})

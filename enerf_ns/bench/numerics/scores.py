"""Cases of scores: flat and negative renders, NaN, small pictures, unknown depth."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from enerf_ns.bench.numerics.case import case
from enerf_ns.evaluation.protocols import DEFAULT_PROTOCOL, align
from enerf_ns.evaluation.scores import mean_scores
from enerf_ns.evaluation.views import HeldOutView
from enerf_ns.sensor.response import inverse_linlog, linlog


def _picture(height: int = 32, width: int = 40) -> Tensor:
    """A grey picture whose rows are all different."""
    rows, columns = torch.arange(height)[:, None] / height, torch.arange(width)[None] / width
    return (0.2 + 0.5 * (rows * columns + 0.3 * torch.sin(9.0 * rows)).abs())[..., None].expand(-1, -1, 3)


def _view(recorded: Tensor, rendered: Tensor, recorded_depth: Tensor | None = None) -> HeldOutView:
    depth = torch.full((*recorded.shape[:2], 1), 2.0)
    return HeldOutView(recorded, rendered, depth, recorded_depth, 0)


def _scored(views: list[HeldOutView]) -> tuple[dict[str, float], dict[str, Any]]:
    means, reasons = mean_scores(views)
    return means, dict(reasons)


@case("a render that is the negative of its frame", "no fit, and the reason", 0, "faults")
def negative() -> float:
    recorded = _picture()
    (fault,) = align([1.0 - recorded], [recorded], DEFAULT_PROTOCOL).faults
    return int("negative" not in (fault or ""))


@case("a render that is flat", "no fit and no correlation, and the reasons", 0, "faults")
def flat() -> float:
    recorded, rendered = _picture(), torch.full((32, 40, 3), 0.4)
    means, reasons = _scored([_view(recorded, rendered)])
    return sum(int(name in means) + int(name not in reasons) for name in ("psnr", "correlation"))


@case("a brightness fit of 0.02 to 50 times the contrast", "the applied scale, relative error", 1e-4)
def fitted() -> float:
    recorded = _picture()
    errors = []
    for scale in (0.02, 1.0, 50.0):
        rendered = inverse_linlog((linlog(recorded.double()) - 4.0) / scale + 4.0)
        found = align([rendered], [recorded.double()], DEFAULT_PROTOCOL).parameters["brightness_scale"]
        errors.append(abs(found / scale - 1.0))
    return max(errors)


@case("one frame of three whose render has a NaN", "means over the two others, and the reason", 0, "faults")
def nan_pixel() -> float:
    recorded = _picture()
    spoilt = recorded.clone()
    spoilt[3, 4, 0] = math.nan
    sound, spoilt_view = _view(recorded, recorded * 0.9), _view(recorded, spoilt)
    alone, _ = _scored([sound, sound])
    means, reasons = _scored([sound, spoilt_view, sound])
    return int(means != alone) + sum(
        int(list(reasons[name].values()) != [[1]]) for name in ("psnr", "ssim", "correlation")
    )


@case("one frame of two without depth", "the mean over the other, and the reason", 0, "m")
def no_depth() -> float:
    recorded = _picture()
    known = torch.full((32, 40, 1), 2.5)
    means, reasons = _scored([_view(recorded, recorded, known), _view(recorded, recorded, torch.zeros_like(known))])
    return abs(means["depth_rmse"] - 0.5) + int("depth_rmse" not in reasons)


@case("pictures of 8 x 8 and 16 x 16 pixels", "the possible scores, and reasons for the others", 0, "faults")
def small_pictures() -> float:
    amiss = 0
    for side in (8, 16):
        recorded = _picture(side, side)
        means, reasons = _scored([_view(recorded, 0.9 * recorded)])
        amiss += int("psnr" not in means) + int(not {"ssim", "lpips"} <= means.keys() | reasons.keys())
        amiss += sum(int(not math.isfinite(value)) for value in means.values())
    return amiss

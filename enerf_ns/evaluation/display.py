"""Brightness as a screen should show it: fitted to the frames of a recording, and gamma-encoded."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from enerf_ns.evaluation.protocols import DEFAULT_PROTOCOL, PROTOCOLS, Correction
from enerf_ns.evaluation.views import HeldOutView

MIDDLE_GREY = 0.5
"""Displayed value of the median brightness, as far as a gamma of at most `SCREEN_GAMMA` can reach it."""
SCREEN_GAMMA = 2.2
"""Gamma of screens, which display brightness^(1 / 2.2) as linear brightness. Frames that a camera has already encoded
need less."""
PICTURE_ROWS = 3
"""Number of held-out frames that are shown, and that a display is made for."""


def shown_numbers(number: int) -> list[int]:
    """Numbers of the held-out frames that are shown, evenly chosen."""
    return np.unique(np.linspace(0, number - 1, PICTURE_ROWS).round().astype(int)).tolist()


@dataclass(frozen=True)
class Display:
    """Display of brightness."""

    correct: Callable[[Tensor], Tensor]
    """From the field's linear brightness to the linear brightness of the frames."""
    exponent: float
    """Exponent of brightness for display."""

    @classmethod
    def of_views(cls, views: Sequence[HeldOutView]) -> Display:
        """A display that suits views, whose brightness is not aligned."""
        correct = _correction(views)
        shown = torch.cat([correct(view.rendered.double()).clamp(0, 1).flatten() for view in views])
        median = float(shown[shown.isfinite()].median().clamp(1e-6, 0.999)) if shown.isfinite().any() else MIDDLE_GREY
        exponent = min(max(math.log(MIDDLE_GREY) / math.log(median), 1 / SCREEN_GAMMA), 1.0)
        return cls(correct, exponent)

    def shown(self, rendered: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """The field's linear brightness as displayed, in [0, 1], on the device and of the kind of the argument."""
        corrected = self.correct(rendered.cpu().double()).nan_to_num().clamp(0.0, 1.0)
        return (corrected**self.exponent).to(rendered)

    @property
    def gamma(self) -> str:
        """The display of brightness, in words."""
        return f"brightness^(1/{1 / self.exponent:.1f})" if self.exponent < 1 else "brightness"


def _correction(views: Sequence[HeldOutView]) -> Callable[[Tensor], Tensor]:
    """The default protocol's fit of renders to frames. Without a fit, the 0.99 quantile of brightness becomes white."""
    framed = [view for view in views if view.recorded is not None and view.rendered.isfinite().all()]
    fit = PROTOCOLS[DEFAULT_PROTOCOL].fit
    if framed and fit is not None:
        columns = 3 if framed[0].colour_filter else 1
        x = torch.cat([view.rendered.double().reshape(-1, columns) for view in framed])
        y = torch.cat([view.recorded.double().reshape(-1, columns) for view in framed if view.recorded is not None])
        fitted = fit(x, y)
        if isinstance(fitted, Correction):
            return fitted.apply
    brightness = torch.cat([view.rendered.double().flatten() for view in views])
    finite = brightness[brightness.isfinite()].numpy()
    white = max(float(np.quantile(finite, 0.99)) if len(finite) else 1.0, 1e-9)
    return lambda rendered: rendered / white

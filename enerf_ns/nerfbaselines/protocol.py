"""The protocol of this package for nerfbaselines: one fit of log brightness over all held-out frames."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from enerf_ns.evaluation.metrics import psnr, ssim
from enerf_ns.evaluation.protocols import DEFAULT_PROTOCOL, align


class LogAffineSet:
    """Scores of renders after one scale and one offset of log brightness, fitted over all held-out frames together.

    Events do not determine these two numbers. `accumulate_metrics` scores the frames that are evaluated while it runs.
    """

    def __init__(self) -> None:
        self._pairs: list[tuple[Tensor, Tensor]] = []

    def get_name(self) -> str:
        """Name of the protocol."""
        return "log-affine-set"

    def render(self, method: Any, dataset: Any, *, options: Any = None) -> Any:
        """Renders the camera of a data set of one frame."""
        return method.render(dataset["cameras"].item(), options=options)

    def evaluate(self, predictions: Any, dataset: Any) -> dict[str, float]:
        """Keeps a render and its frame.

        Args:
            predictions: With color, linear brightness of shape (height, width, 3).
            dataset: Of one frame.

        Returns:
            psnr (dB) and ssim after a fit to this frame alone.
        """
        (frame,) = dataset["images"]
        self._pairs.append((_linear(predictions["color"]), _linear(frame)))
        return _scores(self._pairs[-1:])

    def accumulate_metrics(self, metrics: Iterable[dict[str, float]]) -> dict[str, float]:
        """Means of psnr (dB) and ssim over all frames, after one fit over all of them.

        Args:
            metrics: An iterator whose items call `evaluate`. Their values, which are of fits to single frames, do not
                count; nor do frames that were evaluated before, which nerfbaselines shows during training.
        """
        self._pairs = []
        for _ in metrics:
            pass
        pairs, self._pairs = self._pairs, []
        return _scores(pairs)


def _linear(picture: np.ndarray) -> Tensor:
    """A picture as float32, without transparency."""
    scale = 255.0 if picture.dtype == np.uint8 else 1.0
    return torch.from_numpy(np.asarray(picture, np.float32)[..., :3] / scale)


def _scores(pairs: list[tuple[Tensor, Tensor]]) -> dict[str, float]:
    rendered, recorded = ([pair[side] for pair in pairs] for side in (0, 1))
    found: dict[str, list[float]] = {"psnr": [], "ssim": []}
    for one, frame in zip(align(rendered, recorded, DEFAULT_PROTOCOL).rendered, recorded, strict=True):
        shown = one.float().clamp(0.0, 1.0)
        for name, score in {"psnr": psnr(shown, frame), "ssim": ssim(shown, frame)}.items():
            if not isinstance(score, str):
                found[name].append(score)
    return {name: float(np.mean(values)) for name, values in found.items() if values}

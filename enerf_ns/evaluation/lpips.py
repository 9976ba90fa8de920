"""LPIPS with AlexNet (Zhang et al., CVPR 2018), whose weights are loaded when first needed."""

from __future__ import annotations

import functools
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from pickle import UnpicklingError
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import torch
from jaxtyping import Float
from torch import Tensor

from enerf_ns.evaluation.metrics import NOT_FINITE, Score

if TYPE_CHECKING:
    from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

WEIGHTS_VARIABLE = "ENERF_LPIPS_WEIGHTS"
"""Environment variable that names a file with the state dict of torchvision's `alexnet().features` (ImageNet)."""

SMALLEST_SIDE = 31
"""Pixels along a side of the smallest picture of which AlexNet's poolings leave anything."""


@functools.lru_cache(maxsize=1)
def load_lpips() -> LearnedPerceptualImagePatchSimilarity | None:
    """The metric, or None with a line that says why, where its weights are neither at hand nor to be downloaded."""
    from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

    path = os.environ.get(WEIGHTS_VARIABLE)
    try:
        if path is None:
            return LearnedPerceptualImagePatchSimilarity(net_type="alex", normalize=True)
        with _alexnet_at_hand(Path(path)):
            return LearnedPerceptualImagePatchSimilarity(net_type="alex", normalize=True)
    except (OSError, EOFError, KeyError, TypeError, RuntimeError, UnpicklingError) as error:
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        print(
            f"LPIPS is left out: the AlexNet weights could not be loaded ({reason}); "
            f"set {WEIGHTS_VARIABLE} to a file with the state dict of torchvision's alexnet().features."
        )
        return None


@contextmanager
def _alexnet_at_hand(features: Path) -> Iterator[None]:
    """Lets torchvision find AlexNet in its folder of downloads: these features, with a classifier of zeros, unused."""
    from torchvision.models import AlexNet_Weights, alexnet

    weights = torch.load(features, map_location="cpu", weights_only=True)
    with torch.device("meta"):
        layers = alexnet(weights=None).state_dict()
    state = {
        name: weights[name.removeprefix("features.")]
        if name.startswith("features.")
        else torch.zeros(()).expand(layer.shape)  # of which the file holds one number
        for name, layer in layers.items()
    }
    hub = torch.hub.get_dir()
    with TemporaryDirectory() as folder:
        file = Path(folder, "checkpoints", Path(AlexNet_Weights.DEFAULT.url).name)
        file.parent.mkdir()
        torch.save(state, file)
        torch.hub.set_dir(folder)
        try:
            yield
        finally:
            torch.hub.set_dir(hub)


def lpips(rendered: Float[Tensor, "height width 3"], recorded: Float[Tensor, "height width 3"]) -> Score:
    """Perceptual distance of two pictures in [0, 1]."""
    if not rendered.isfinite().all():
        return NOT_FINITE
    if min(rendered.shape[:2]) < SMALLEST_SIDE:
        return f"the frame is smaller than {SMALLEST_SIDE} x {SMALLEST_SIDE} pixels"
    metric = load_lpips()
    if metric is None:
        return "its weights could not be loaded"
    pictures = [image.detach().cpu().float().clamp(0, 1).movedim(-1, 0)[None] for image in (rendered, recorded)]
    with torch.no_grad():
        distance = float(metric(*pictures))
    metric.reset()
    return distance

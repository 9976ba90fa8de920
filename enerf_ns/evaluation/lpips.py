"""LPIPS with AlexNet or VGG (Zhang et al., CVPR 2018). Weights are loaded on first use."""

from __future__ import annotations

import functools
import os
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from pickle import UnpicklingError
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from enerf_ns.evaluation.metrics import NOT_FINITE, Score

if TYPE_CHECKING:
    from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

Net = Literal["alex", "vgg"]
"""Network whose features are compared: AlexNet or VGG-16."""


@dataclass(frozen=True)
class Network:
    """Properties of a network for LPIPS."""

    model: str
    """Name of the function of torchvision that makes the network."""
    weights_variable: str
    """Environment variable with the path of the state dict of the network's features, trained on ImageNet."""
    smallest_side: int
    """Least width and height of a picture in pixels. The poolings of the network leave nothing of a smaller one."""
    score: str
    """Name of the score."""


NETWORKS: dict[Net, Network] = {
    "alex": Network("alexnet", "ENERF_LPIPS_WEIGHTS", 31, "lpips"),
    "vgg": Network("vgg16", "ENERF_LPIPS_VGG_WEIGHTS", 16, "lpips_vgg"),
}
"""Networks by their names in LPIPS."""


@functools.cache
def load_lpips(net: Net) -> LearnedPerceptualImagePatchSimilarity | None:
    """The metric of a network. If its weights cannot be loaded, None, and a line with the reason is printed."""
    from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

    network = NETWORKS[net]
    path = os.environ.get(network.weights_variable)
    try:
        with _at_hand(network, Path(path)) if path is not None else nullcontext():
            return LearnedPerceptualImagePatchSimilarity(net_type=net, normalize=True)
    except (OSError, EOFError, KeyError, TypeError, RuntimeError, UnpicklingError) as error:
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        print(
            f"{network.score} is left out: the weights of {network.model} could not be loaded ({reason}); set "
            f"{network.weights_variable} to a file with the state dict of torchvision's {network.model}().features."
        )
        return None


@contextmanager
def _at_hand(network: Network, features: Path) -> Iterator[None]:
    """Makes torchvision load these features instead of a download. The unused classifier is filled with zeros."""
    from torchvision.models import get_model, get_model_weights

    published: Any = get_model_weights(network.model)
    weights = torch.load(features, map_location="cpu", weights_only=True)
    with torch.device("meta"):
        layers = get_model(network.model, weights=None).state_dict()
    state = {
        name: weights[name.removeprefix("features.")]
        if name.startswith("features.")
        else torch.zeros(()).expand(layer.shape)  # stored as one number
        for name, layer in layers.items()
    }
    hub = torch.hub.get_dir()
    with TemporaryDirectory() as folder:
        file = Path(folder, "checkpoints", Path(published.DEFAULT.url).name)
        file.parent.mkdir()
        torch.save(state, file)
        torch.hub.set_dir(folder)
        try:
            yield
        finally:
            torch.hub.set_dir(hub)


def lpips(
    rendered: Float[Tensor, "height width 3"], recorded: Float[Tensor, "height width 3"], net: Net = "alex"
) -> Score:
    """Perceptual distance of two pictures in [0, 1], or the reason why there is none."""
    if not rendered.isfinite().all():
        return NOT_FINITE
    side = NETWORKS[net].smallest_side
    if min(rendered.shape[:2]) < side:
        return f"the frame is smaller than {side} x {side} pixels"
    metric = load_lpips(net)
    if metric is None:
        return "its weights could not be loaded"
    pictures = [image.detach().cpu().float().clamp(0, 1).movedim(-1, 0)[None] for image in (rendered, recorded)]
    with torch.no_grad():
        distance = float(metric(*pictures))
    metric.reset()
    return distance

"""LPIPS with AlexNet or VGG (Zhang et al., CVPR 2018). Weights are read from a file on first use."""

from __future__ import annotations

import functools
import os
from dataclasses import dataclass
from http.client import HTTPException
from pathlib import Path
from pickle import UnpicklingError
from typing import TYPE_CHECKING, Any, Literal, cast
from unittest.mock import patch

import torch
from jaxtyping import Float
from torch import Tensor

from enerf_ns.dataparsers.recording.errors import OutputError
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
def load_lpips(net: Net) -> LearnedPerceptualImagePatchSimilarity | str:
    """The metric of a network, or the reason why it cannot be made. Nothing is downloaded."""
    from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity
    from torchvision.models import get_model_weights

    network = NETWORKS[net]
    variable = network.weights_variable
    try:
        weights = _weights(network)
        with patch.object(get_model_weights(network.model), "get_state_dict", lambda *_, **__: weights):
            return LearnedPerceptualImagePatchSimilarity(net_type=net, normalize=True)
    except (OSError, EOFError, KeyError, TypeError, RuntimeError, UnpicklingError) as error:
        if variable in os.environ:
            found = "is missing" if isinstance(error, FileNotFoundError) else "does not hold its weights"
            return f"the file of {variable}, {os.environ[variable]}, {found}"
        found = "are not here" if isinstance(error, FileNotFoundError) else "cannot be read"
        return f"its weights {found}; get them by enerf fetch-lpips {net}"


def _weights(network: Network) -> dict[str, Tensor]:
    """The state dict of a network, from the file of its variable or of torchvision. The classifier of the former, which
    LPIPS does not use, is filled with zeros."""
    from torchvision.models import get_model

    path = os.environ.get(network.weights_variable)
    weights = torch.load(path or torchvision_file(network), map_location="cpu", weights_only=True)
    if path is None:
        return weights
    with torch.device("meta"):
        layers = get_model(network.model, weights=None).state_dict()
    return {
        name: weights[name.removeprefix("features.")]
        if name.startswith("features.")
        else torch.zeros(()).expand(layer.shape)  # which needs no memory
        for name, layer in layers.items()
    }


def torchvision_file(network: Network) -> Path:
    """The file in which torchvision keeps the weights of a network. It may not be there."""
    from torchvision.models import get_model_weights

    published: Any = get_model_weights(network.model)
    return Path(torch.hub.get_dir(), "checkpoints", Path(published.DEFAULT.url).name)


def fetch_weights(net: Net) -> Path:
    """Downloads the weights of a network to torchvision's file, and returns its path. Weights that are there stay.

    Raises:
        OutputError: They cannot be downloaded or written.
    """
    from torchvision.models import get_model_weights

    file, published = torchvision_file(NETWORKS[net]), cast("Any", get_model_weights(NETWORKS[net].model)).DEFAULT
    try:
        try:
            torch.load(file, map_location="cpu", weights_only=True)
        except (EOFError, RuntimeError, UnpicklingError):
            file.unlink()
        except FileNotFoundError:
            pass
        published.get_state_dict(progress=True, check_hash=True)
    except BrokenPipeError:
        raise
    except (OSError, HTTPException, RuntimeError) as error:
        raise OutputError(
            f"{published.url} could not be downloaded to {file} ({getattr(error, 'reason', error)}); download it where "
            "there is a network, and copy it there."
        ) from error
    return file


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
    if isinstance(metric, str):
        return metric
    pictures = [image.detach().cpu().float().clamp(0, 1).movedim(-1, 0)[None] for image in (rendered, recorded)]
    with torch.no_grad():
        distance = float(metric(*pictures))
    metric.reset()
    return distance

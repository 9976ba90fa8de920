"""LPIPS with AlexNet (Zhang et al., CVPR 2018), whose weights are loaded when first needed."""

from __future__ import annotations

import functools
import os
from pathlib import Path
from pickle import UnpicklingError

import torch
from jaxtyping import Float
from torch import Tensor, nn

WEIGHTS_VARIABLE = "ENERF_LPIPS_WEIGHTS"
"""Environment variable: a file with the state dict of torchvision's `alexnet().features` (ImageNet)."""


@functools.lru_cache(maxsize=1)
def load_lpips() -> nn.Module | None:
    """The network, or None with a line that says why, where its weights are neither at hand nor to be downloaded."""
    from torchmetrics.functional.image.lpips import _LPIPS

    path = os.environ.get(WEIGHTS_VARIABLE)
    try:
        if path is None:
            return _LPIPS(net="alex").eval()
        network = _LPIPS(net="alex", pnet_rand=True).eval()
        weights = torch.load(Path(path), map_location="cpu", weights_only=True)
        layers = {name: f"{name.split('.', 1)[1]}" for name in network.net.state_dict()}
        network.net.load_state_dict({name: weights[layer] for name, layer in layers.items()})
        return network
    except (OSError, EOFError, KeyError, RuntimeError, UnpicklingError) as error:
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        print(
            f"LPIPS is left out: the AlexNet weights could not be loaded ({reason}); "
            f"set {WEIGHTS_VARIABLE} to a file with the state dict of torchvision's alexnet().features."
        )
        return None


def lpips(rendered: Float[Tensor, "height width 3"], recorded: Float[Tensor, "height width 3"]) -> float | None:
    """Perceptual distance of two pictures in [0, 1]; None where the weights are missing."""
    network = load_lpips()
    if network is None:
        return None
    pictures = [image.detach().cpu().float().movedim(-1, 0)[None] for image in (rendered, recorded)]
    with torch.no_grad():
        return float(network(pictures[0], pictures[1], normalize=True))

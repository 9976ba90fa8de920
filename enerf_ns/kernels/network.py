"""Small networks, in PyTorch or compiled for the CPU."""

from __future__ import annotations

import torch
from jaxtyping import Float
from nerfstudio.field_components.mlp import MLP
from torch import Tensor, nn

from enerf_ns.kernels.hash_grid import BACKENDS


class Network(MLP):
    """Nerfstudio's network in PyTorch with ReLU between its layers: the same function of the same parameters, on the
    CPU by compiled kernels.

    Args:
        in_dim: Width of the inputs.
        num_layers: At least 1.
        layer_width: Width of the hidden layers.
        out_dim: Width of the output.
        backend: As of the `HashGrid` beside it: with "auto" and "numba" the kernels are used where they can be, which
            is in float32.
    """

    def __init__(self, in_dim: int, num_layers: int, layer_width: int, out_dim: int, backend: str = "auto"):
        super().__init__(in_dim, num_layers, layer_width, out_dim, activation=nn.ReLU(), implementation="torch")
        self.backend = backend

    def forward(self, in_tensor: Float[Tensor, "*batch in_dim"]) -> Float[Tensor, "*batch out_dim"]:
        kernels = BACKENDS["numba"]
        misfit = kernels.misfit(in_tensor.device.type, in_tensor.dtype)
        if self.backend not in ("auto", "numba") or misfit or torch.is_autocast_enabled("cpu"):
            return super().forward(in_tensor)
        from enerf_ns.kernels.network_numba import network  # here, since Numba may be missing

        layers = [layer for layer in self.layers if isinstance(layer, nn.Linear)]
        found = network(
            in_tensor.reshape(-1, in_tensor.shape[-1]),
            [layer.weight for layer in layers],
            [layer.bias for layer in layers],
        )
        return found.view(*in_tensor.shape[:-1], found.shape[-1])

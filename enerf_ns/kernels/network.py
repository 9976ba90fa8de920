"""Small networks, computed by PyTorch or by compiled kernels for the CPU."""

from __future__ import annotations

import torch
from jaxtyping import Float
from nerfstudio.field_components.mlp import MLP
from torch import Tensor, nn

from enerf_ns.kernels.hash_grid import BACKENDS


class Network(MLP):
    """Nerfstudio's multilayer perceptron with ReLU between its layers. Compiled kernels compute it on the CPU.

    The parameters and the function are those of Nerfstudio's class.

    Args:
        in_dim: Width of the inputs.
        num_layers: Number of linear layers, at least 1.
        layer_width: Width of the hidden layers.
        out_dim: Width of the output.
        backend: The backend of the hash grid beside the network. With "auto" and "numba" the kernels compute float32
            on the CPU; in all other cases PyTorch computes.
    """

    def __init__(self, in_dim: int, num_layers: int, layer_width: int, out_dim: int, backend: str = "auto"):
        super().__init__(in_dim, num_layers, layer_width, out_dim, activation=nn.ReLU(), implementation="torch")
        self.backend = backend

    def forward(self, in_tensor: Float[Tensor, "*batch in_dim"]) -> Float[Tensor, "*batch out_dim"]:
        """Returns the output of the network."""
        misfit = BACKENDS["numba"].misfit(in_tensor.device.type, in_tensor.dtype)
        if self.backend not in ("auto", "numba") or misfit or torch.is_autocast_enabled("cpu"):
            return super().forward(in_tensor)
        from enerf_ns.kernels.network_numba import network  # here, since Numba may be missing

        found = network(in_tensor.reshape(-1, in_tensor.shape[-1]), self.parameters())
        return found.view(*in_tensor.shape[:-1], found.shape[-1])

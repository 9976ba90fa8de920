"""Multiresolution hash grid (Müller et al., Instant Neural Graphics Primitives, SIGGRAPH 2022, section 3).

One layout of parameters, and backends that compute the same function: `hash_grid` below in plain PyTorch, which runs on
any device and is the test oracle, and those of `BACKENDS`, compiled on first use, for the CPU and for the GPU.
"""

from __future__ import annotations

import functools
import importlib
import itertools
from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn


def hash_grid(
    x: Float[Tensor, "*batch 3"], table: Float[Tensor, "entries features"], scalings: Float[Tensor, " levels"]
) -> Float[Tensor, "*batch encoding"]:
    """Trilinear interpolation of hashed features at every level (equations 2 to 4 of the paper), in plain PyTorch.

    Every level is hashed, also those whose lattice would fit the table, as in Nerfstudio's PyTorch HashEncoding.
    Differentiable in `x` and `table`. On a plane of a level's lattice the encoding has a kink; the derivative across
    the plane that is returned for that level is zero, as in Nerfstudio.

    Args:
        x: positions, meant for [0, 1]; the lattice goes on outside of it.
        table: levels * T rows, level after level; T is a power of two.
        scalings: lattice cells a unit length, for each level; whole numbers.

    Returns:
        levels * features numbers a position, level after level.
    """
    num_levels, features_per_level = len(scalings), table.shape[1]
    table_size = len(table) // num_levels
    scaled = x[..., None, :] * scalings[:, None]  # [..., levels, 3]
    floor, ceil = torch.floor(scaled), torch.ceil(scaled)
    weights = torch.stack([1 - (scaled - floor), scaled - floor])
    primes = torch.tensor([1, 2654435761, 805459861], device=x.device)
    hashes = torch.stack([floor, ceil]).long() * primes
    offsets = torch.arange(num_levels, device=x.device) * table_size

    encoding = torch.zeros((), device=x.device)
    for i, j, k in itertools.product((0, 1), repeat=3):
        rows = ((hashes[i, ..., 0] ^ hashes[j, ..., 1] ^ hashes[k, ..., 2]) & (table_size - 1)) + offsets
        # of PyTorch's ways to look up rows, the one with the fastest backward pass on the CPU
        features = table.gather(0, rows.reshape(-1, 1).expand(-1, features_per_level))
        weight = weights[i, ..., 0] * weights[j, ..., 1] * weights[k, ..., 2]
        encoding = encoding + weight[..., None] * features.view(*rows.shape, features_per_level)
    return encoding.flatten(start_dim=-2)


@functools.cache
def _module(name: str) -> ModuleType | None:
    try:
        return importlib.import_module(name)
    except ImportError:
        return None


@dataclass(frozen=True)
class Backend:
    """One way to compute the hash grid."""

    package: str
    """What it is compiled with, which may be missing."""
    module: str
    """Module of its function `hash_grid`, and of DEVICE, the type of the device whose tensors that takes."""
    device: str
    """Type of the device on which "auto" takes it; elsewhere its module is not even imported."""
    features: tuple[int, ...]
    """Features per level that it knows."""

    def misfit(self, device: str, dtype: torch.dtype = torch.float32, num_features: int = 2) -> str | None:
        """What it needs that positions and a table of this device, type and features per level are not; None where it
        can take them."""
        module = _module(self.module)
        if module is None:
            return f"the package {self.package}, which cannot be imported"
        if num_features not in self.features:
            return f"{', '.join(map(str, self.features))} features per level, not {num_features}"
        if device != module.DEVICE or dtype != torch.float32:
            return f"positions and table in float32 on the device {module.DEVICE}, not {dtype} on {device}"
        return None


BACKENDS: dict[str, Backend] = {
    "triton": Backend("triton", "enerf_ns.kernels.hash_grid_triton", "cuda", (1, 2, 4, 8)),
    "numba": Backend("numba", "enerf_ns.kernels.hash_grid_numba", "cpu", (2,)),
}
"""Backends by name, beside "torch", which is `hash_grid` and fits everything."""


def backend_of(name: str, x: Tensor, table: Tensor) -> str:
    """The name of the backend that computes the grid for some positions and a table.

    Args:
        name: "torch", one of `BACKENDS`, or "auto": of these the first that fits, else "torch".
        x: positions, shape `(*batch, 3)`.
        table: rows, shape (levels * T, features).

    Raises:
        ValueError: There is no backend of this name, or it does not fit.
    """
    if name not in ("auto", "torch", *BACKENDS):
        raise ValueError(f'backend is "{name}", but must be auto, torch, {" or ".join(BACKENDS)}')
    for found, backend in BACKENDS.items():
        if name != found and (name != "auto" or x.device.type != backend.device):
            continue
        misfits = {backend.misfit(tensor.device.type, tensor.dtype, table.shape[1]) for tensor in (x, table)} - {None}
        if not misfits:
            return found
        if name == found:
            raise ValueError(f'backend "{name}" needs {misfits.pop()}; use "auto"')
    return "torch"


def fitting(name: str, x: Tensor, table: Tensor) -> Callable[[Tensor, Tensor, Tensor], Tensor]:
    """The function of the backend of `backend_of`."""
    found = backend_of(name, x, table)
    return hash_grid if found == "torch" else importlib.import_module(BACKENDS[found].module).hash_grid


class HashGrid(nn.Module):
    """Encoding of positions by a multiresolution hash grid; the same function, and the same table row by row, as
    Nerfstudio 1.1.5's `HashEncoding(implementation="torch")`.

    The backend is chosen at each call, and the checkpoint holds nothing but `table`: what one backend has trained, the
    other one loads.

    Args:
        num_levels: number of levels, at least 1.
        min_res: lattice cells along each side of the unit cube at the coarsest level.
        max_res: lattice cells along each side of the unit cube at the finest level; the levels between are in
            geometric progression, rounded down.
        log2_table_size: each level has 2**log2_table_size rows.
        features_per_level: numbers in one row.
        init_scale: the table starts uniform in [-init_scale, init_scale).
        backend: as of `backend_of`; chosen at each call.
    """

    scalings: Tensor

    def __init__(
        self,
        num_levels: int = 16,
        min_res: int = 16,
        max_res: int = 1024,
        log2_table_size: int = 19,
        features_per_level: int = 2,
        init_scale: float = 1e-4,
        backend: str = "auto",
    ) -> None:
        super().__init__()
        self.backend = backend
        self.out_dim = num_levels * features_per_level
        growth = np.exp((np.log(max_res) - np.log(min_res)) / (num_levels - 1)) if num_levels > 1 else 1.0
        scalings = torch.floor(min_res * growth ** torch.arange(num_levels))  # float32, rounded as Nerfstudio does
        self.register_buffer("scalings", scalings, persistent=False)
        table = torch.rand(num_levels * 2**log2_table_size, features_per_level) * 2 - 1
        self.table = nn.Parameter(table * init_scale)

    def forward(self, x: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch out_dim"]:
        """Encodes positions in [0, 1]; slightly outside, the lattice goes on.

        Raises:
            ValueError: if the last axis of `x` is not 3, or if there is no such backend, or it does not fit.
        """
        if x.shape[-1] != 3:
            raise ValueError(f"positions have shape {tuple(x.shape)}, but the last axis must be 3")
        return fitting(self.backend, x, self.table)(x, self.table, self.scalings)

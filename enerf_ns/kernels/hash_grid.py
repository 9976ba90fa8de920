"""Multiresolution hash grid (Müller et al., Instant Neural Graphics Primitives, SIGGRAPH 2022, section 3).

All backends have one layout of parameters and compute the same function. The function `hash_grid` of this module is in
plain PyTorch. It runs on any device, and tests compare the other backends with it. Those are in `BACKENDS`, for the CPU
and for the GPU, and are compiled on first use.
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
    """Returns hashed features, interpolated trilinearly at every level (equations 2 to 4 of the paper).

    As in Nerfstudio's HashEncoding in PyTorch, every level is hashed, even a level whose lattice fits into the table.
    The result is differentiable in `x` and `table`. On a plane of a level's lattice the encoding has a kink. There the
    derivative across the plane is zero for this level, as in Nerfstudio.

    Args:
        x: Positions in [0, 1]. Outside this range the lattice continues.
        table: levels * T rows, level after level; T is a power of two.
        scalings: Lattice cells per unit length, for each level; whole numbers.

    Returns:
        levels * features numbers for each position, level after level.
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
        # gather has the fastest backward pass on the CPU of all ways to look up rows in PyTorch
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
    """The package that compiles it. It may not be installed."""
    module: str
    """The module with the function `hash_grid`, and with DEVICE, the type of device whose tensors it takes."""
    device: str
    """The type of device on which "auto" selects this backend. On other devices its module is not even imported."""
    features: tuple[int, ...]
    """Numbers of features per level that it can compute."""

    def misfit(self, device: str, dtype: torch.dtype = torch.float32, num_features: int = 2) -> str | None:
        """Returns what the backend needs and does not find, in words, or None if it can compute.

        Args:
            device: Type of the device of the positions and the table.
            dtype: Type of the positions and the table.
            num_features: Features per level.
        """
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
"""Backends by name. The backend "torch" is the function `hash_grid` of this module, which takes any tensors."""


def backend_of(name: str, x: Tensor, table: Tensor) -> str:
    """Returns the name of the backend that computes the hash grid for these positions and this table.

    Args:
        name: "torch", a name in `BACKENDS`, or "auto", which selects the first of `BACKENDS` that can compute, or else
            "torch".
        x: Positions [..., 3].
        table: Rows [levels * T, features].

    Raises:
        ValueError: No backend has this name, or the backend cannot compute for these tensors.
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
    """Returns the function `hash_grid` of the backend that `backend_of` selects, with the same arguments and errors."""
    found = backend_of(name, x, table)
    return hash_grid if found == "torch" else importlib.import_module(BACKENDS[found].module).hash_grid


class HashGrid(nn.Module):
    """The encoding of positions by a multiresolution hash grid.

    The function, and the table row by row, are those of `HashEncoding(implementation="torch")` in Nerfstudio 1.1.5. The
    backend is selected at each call. A checkpoint holds only `table`, so any backend can load it.

    Args:
        num_levels: Number of levels, at least 1.
        min_res: Lattice cells along each side of the unit cube at the coarsest level.
        max_res: Lattice cells along each side of the unit cube at the finest level. The levels between them follow a
            geometric progression, rounded down.
        log2_table_size: Each level has 2**log2_table_size rows.
        features_per_level: Numbers in one row.
        init_scale: The table starts uniform in [-init_scale, init_scale).
        backend: "auto", "torch" or a name in `BACKENDS`; see `backend_of`.
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
        scalings = torch.floor(min_res * growth ** torch.arange(num_levels))  # float32, rounded as in Nerfstudio
        self.register_buffer("scalings", scalings, persistent=False)
        self.num_differentiated = num_levels
        """Number of the coarsest levels that are differentiated; the finer ones are constants."""
        table = torch.rand(num_levels * 2**log2_table_size, features_per_level) * 2 - 1
        self.table = nn.Parameter(table * init_scale)

    def forward(self, x: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch out_dim"]:
        """Returns the encoding of positions in [0, 1]. Outside this range the lattice continues.

        Raises:
            ValueError: The last axis of `x` is not 3, no backend has this name, or the backend cannot compute.
        """
        if x.shape[-1] != 3:
            raise ValueError(f"positions have shape {tuple(x.shape)}, but the last axis must be 3")
        encoding = fitting(self.backend, x, self.table)(x, self.table, self.scalings)
        num_levels = len(self.scalings)
        if self.num_differentiated == num_levels:
            return encoding
        num_columns = self.num_differentiated * (self.out_dim // num_levels)
        is_differentiated = torch.arange(self.out_dim, device=x.device) < num_columns
        return torch.where(is_differentiated, encoding, encoding.detach())

"""The radiance field: a hash grid, a density network, a colour network."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal, cast

import torch
from jaxtyping import Float
from nerfstudio.cameras.rays import RaySamples
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.field_components.encodings import SHEncoding
from nerfstudio.field_components.field_heads import FieldHeadNames
from nerfstudio.fields.base_field import Field, get_normalized_directions
from torch import Tensor, nn
from torch.autograd import Function

from enerf_ns.kernels.hash_grid import HashGrid
from enerf_ns.kernels.network import Network
from enerf_ns.kernels.precision import full_precision, widened

Brightness = Literal["log-sigmoid", "sigmoid", "exponential"]
"""Name of the function from the colour network's output to brightness."""

DARKEST = 2.0 / 255.0
"""Lowest brightness with "log-sigmoid". A field with "log-sigmoid" or "exponential" starts in the middle, in log
brightness, between this and 1."""

LOG_SIGMOID_RANGE = 4.0
"""Largest range of log brightness for which "log-sigmoid" is meant. Its rms error, fitted to a range of log brightness
by `linlog`, is below 0.001 at a range of 4, 0.09 at 6 and 0.96 at 10, because it spans only 5.24. The rms error of
"exponential" is 0.02 at 10 (`benchmarks/dynamic_range.py`)."""

LARGEST_EXPONENT = 30.0
"""Largest exponent of `limited_exp`. Training stays far below it, and products and sums along a ray stay finite in
float32."""


class _LimitedExp(Function):
    @staticmethod
    def forward(ctx, exponent: Tensor) -> Tensor:
        ctx.save_for_backward(exponent)
        return torch.exp(exponent.clamp(max=LARGEST_EXPONENT))

    @staticmethod
    def backward(ctx, *gradients: Tensor) -> Tensor:
        (exponent,) = ctx.saved_tensors
        return gradients[0] * torch.exp(exponent.clamp(-15.0, 15.0))


def limited_exp(exponent: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Returns the exponential, which is constant above `LARGEST_EXPONENT`.

    The gradient is that of Nerfstudio's `trunc_exp`: the exponential from -15 to 15, and constant beyond. So the
    gradient still reduces a density or a brightness that is far too large.
    """
    return cast("Tensor", _LimitedExp.apply(exponent))


def brightness_of(output: Float[Tensor, "*batch"], activation: Brightness) -> Float[Tensor, "*batch"]:
    """Returns the linear brightness for an output of the colour network.

    Args:
        output: Any number; about 0 before training.
        activation: With "log-sigmoid" a sigmoid spans log brightness from `DARKEST` to 1, so that the field starts in
            the middle of the range that the sensor resolves. With "sigmoid", as in the paper, a sigmoid spans linear
            brightness from 0 to 1, so that the field starts near the upper end in log brightness. "exponential" starts
            at the value and the slope of "log-sigmoid", and has no upper end.
    """
    if activation == "exponential":
        return DARKEST**0.5 * limited_exp(-0.25 * math.log(DARKEST) * output)
    share = torch.sigmoid(output)
    return DARKEST ** (1.0 - share) if activation == "log-sigmoid" else share


class HashDensity(nn.Module):
    """Density and features of points in a box, by a hash grid and a network with one hidden layer.

    Args:
        aabb: Box in scene units, shape (2, 3). Without contraction, density outside the box is zero.
        num_levels: Levels of the hash grid.
        min_res, max_res: Lattice cells along a side of the box, or with contraction along a side of [-1, 1], at the
            coarsest and at the finest level.
        log2_table_size: Each level has 2**log2_table_size rows.
        hidden_dim: Width of the hidden layer.
        contraction: Whether space beyond [-1, 1], up to infinity, is contracted (mip-NeRF 360, Barron et al., CVPR
            2022).
        num_features: Number of features.
        init_density: Density before training, in 1 / scene unit.
        backend: Backend of the hash grid; see `enerf_ns.kernels.hash_grid.backend_of`.
    """

    def __init__(
        self,
        aabb: Float[Tensor, "2 3"],
        *,
        num_levels: int,
        min_res: int,
        max_res: int,
        log2_table_size: int,
        hidden_dim: int,
        contraction: bool = False,
        num_features: int = 0,
        init_density: float = 1.0,
        backend: str = "auto",
    ):
        super().__init__()
        self.register_buffer("aabb", aabb.clone().float())
        self.aabb: Tensor
        self.init_density = init_density
        self.contraction = None
        if contraction:
            from nerfstudio.field_components.spatial_distortions import SceneContraction

            self.contraction = SceneContraction(order=math.inf)
        # contracted space is twice as wide as [-1, 1]; so the cells within [-1, 1] keep their size
        finest = 2 * max_res if contraction else max_res
        self.grid = HashGrid(num_levels, min_res, finest, log2_table_size, backend=backend)
        self.network = Network(self.grid.out_dim, 2, hidden_dim, 1 + num_features, backend)

    def forward(self, positions: Float[Tensor, "*batch 3"]) -> tuple[Float[Tensor, "*batch 1"], Tensor]:
        """Returns density, in 1 / scene unit, and features, (*batch, num_features), at positions in scene units."""
        # one coordinate after the other in memory, as the kernels need it; so the next operations are vectorised
        rows = positions.reshape(-1, 3).t().contiguous()
        unit = self.unit(rows.t().view(positions.shape))
        density, features = self.at(unit.clamp(0.0, 1.0))
        if self.contraction is None:
            density = density * ((unit > 0.0) & (unit < 1.0)).all(dim=-1, keepdim=True)
        return density, features

    def unit(self, positions: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Returns positions relative to the box, or to contracted space. In it all three coordinates are in [0, 1]."""
        if self.contraction is not None:
            return 0.5 + 0.25 * self.contraction(positions)
        return SceneBox.get_normalized_positions(positions, self.aabb)

    def at(self, unit: Float[Tensor, "*batch 3"]) -> tuple[Float[Tensor, "*batch 1"], Tensor]:
        """Returns density, in 1 / scene unit, and features at positions from `unit` in [0, 1], also on the faces."""
        # a matrix, because PyTorch's product of tensors with more axes is slower
        output = self.network(self.grid(unit.reshape(-1, 3)))
        # split along the first axis of the kernels' memory, so that gradients are joined without a copy
        parts = output.t().split_with_sizes([1, output.shape[1] - 1])
        density, features = (part.t().view(*unit.shape[:-1], len(part)) for part in parts)
        return self.init_density * limited_exp(widened(density)), features

    @contextmanager
    def slopes_over(self, distance: float) -> Iterator[None]:
        """Context in which only levels whose cells are at least so wide are differentiated with respect to positions.

        The other levels are constants. So slopes do not show details that are smaller than `distance`.

        Args:
            distance: Smallest side of a cell, scene units.
        """
        cells = (4.0 if self.contraction else float((self.aabb[1] - self.aabb[0]).max())) / self.grid.scalings
        self.grid.num_differentiated = int((cells >= distance).sum())
        try:
            yield
        finally:
            self.grid.num_differentiated = len(self.grid.scalings)

    def density_fn(self, positions: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 1"]:
        """Returns the density, in 1 / scene unit."""
        return self(positions)[0]


class EnerfField(Field):
    """The radiance field of E-NeRF: hash grid (Müller et al., 2022), density network and colour network.

    Args:
        aabb: Box in scene units, shape (2, 3).
        num_channels: 1 for grey, 3 for colour.
        view_direction: Whether brightness depends on the viewing direction, which spherical harmonics encode.
        hidden_dim_colour: Width of the hidden layers of the colour network.
        num_features: Number of features that the density network passes to the colour network.
        brightness: Function from the colour network's output to brightness; see `brightness_of`.
        density: Other keyword arguments of `HashDensity`.
    """

    def __init__(
        self,
        aabb: Float[Tensor, "2 3"],
        *,
        num_channels: int,
        view_direction: bool,
        hidden_dim_colour: int,
        num_features: int,
        brightness: Brightness,
        **density,
    ):
        super().__init__()
        self.num_channels = num_channels
        self.brightness: Brightness = brightness
        self.geometry = HashDensity(aabb, num_features=num_features, **density)
        self.direction_encoding = SHEncoding(levels=4, implementation="torch") if view_direction else None
        directions = self.direction_encoding.get_out_dim() if self.direction_encoding else 0
        num_layers = 3 if view_direction else 2
        backend = self.geometry.grid.backend
        self.colour_network = Network(directions + num_features, num_layers, hidden_dim_colour, num_channels, backend)

    @full_precision  # bfloat16 has errors of 0.2 to 1.2 % in density, of 0.3 to 0.7 % in changes of log brightness
    def get_density(self, ray_samples: RaySamples) -> tuple[Tensor, Tensor]:
        """Returns density, in 1 / scene unit, shape (*batch, 1), and features for the colour network."""
        return self.geometry(ray_samples.frustums.get_positions())

    def get_outputs(self, ray_samples: RaySamples, density_embedding: Tensor | None = None) -> dict:
        """Returns linear brightness, shape (*batch, num_channels), from 0 to 1. "exponential" has no upper limit."""
        assert density_embedding is not None
        directions = ray_samples.frustums.directions.reshape(-1, 3)
        colour = self.colour(density_embedding.reshape(len(directions), density_embedding.shape[-1]), directions)
        return {FieldHeadNames.RGB: colour.view(*density_embedding.shape[:-1], self.num_channels)}

    @full_precision
    def colour(self, features: Float[Tensor, "points features"], directions: Float[Tensor, "points 3"]) -> Tensor:
        """Returns brightness, shape (points, num_channels), of points with these features, seen in these directions."""
        if self.direction_encoding is not None:
            features = torch.cat([self.direction_encoding(get_normalized_directions(directions)), features], dim=-1)
        return brightness_of(self.colour_network(features), self.brightness)

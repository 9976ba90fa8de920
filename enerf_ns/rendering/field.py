"""The radiance field: a hash grid, a density network, a colour network."""

from __future__ import annotations

import math
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
"""What makes brightness of the colour network's output."""

DARKEST = 2.0 / 255.0
"""Lowest brightness of a field whose sigmoid spans log brightness; the middle of that span is where all start whose
brightness is logarithmic."""

LOG_SIGMOID_RANGE = 4.0
"""Largest range of log brightness for which log-sigmoid is meant: fitted to a range of 4 its rms error is below 0.001,
of 6 it is 0.09 and of 10 0.96 by `linlog`, of which it spans 5.24; the exponential's is 0.02 at 10
(`benchmarks/dynamic_range.py`)."""

LARGEST_EXPONENT = 30.0
"""Largest exponent of `limited_exp`: far above what training arrives at, and small enough that whatever is made of its
exponential along a ray is finite in float32."""


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
    """Exponential, constant above `LARGEST_EXPONENT`.

    Its gradient is that of Nerfstudio's `trunc_exp`, which is the exponential's from -15 to 15 and constant beyond, so
    that what is far too dense or bright is still pushed back.
    """
    return cast("Tensor", _LimitedExp.apply(exponent))


def brightness_of(output: Float[Tensor, "*batch"], activation: Brightness) -> Float[Tensor, "*batch"]:
    """Brightness that the colour network's output stands for.

    Args:
        output: Any number; 0 before training.
        activation: log-sigmoid lets a sigmoid span log brightness, from `DARKEST` to 1, so that the field starts in the
            middle of what the sensor can tell apart; sigmoid brightness itself, as in the paper, which starts near its
            upper end; exponential starts where log-sigmoid does, at the same slope, and has no upper end.
    """
    if activation == "exponential":
        return DARKEST**0.5 * limited_exp(-0.25 * math.log(DARKEST) * output)
    share = torch.sigmoid(output)
    return DARKEST ** (1.0 - share) if activation == "log-sigmoid" else share


class HashDensity(nn.Module):
    """Density, and features beside it, of a point in a box: hash grid and one hidden layer.

    Args:
        aabb: Box in scene units, shape (2, 3). Outside it density is zero.
        contraction: Reach beyond the box, which lies within [-1, 1], to infinity (mip-NeRF 360, Barron et al., CVPR
            2022).
        num_features: Outputs beside the density.
        init_density: Density before training, in 1 / scene unit.
        backend: What computes the hash grid, as of `backend_of` in `enerf_ns.kernels.hash_grid`.
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
        # contracted space is twice as wide as what lies within [-1, 1], which keeps its cells
        finest = 2 * max_res if contraction else max_res
        self.grid = HashGrid(num_levels, min_res, finest, log2_table_size, backend=backend)
        self.network = Network(self.grid.out_dim, 2, hidden_dim, 1 + num_features, backend)

    def forward(self, positions: Float[Tensor, "*batch 3"]) -> tuple[Float[Tensor, "*batch 1"], Tensor]:
        """Density in 1 / scene unit, and the features."""
        # coordinate by coordinate in memory, as the kernels take them: what follows is vectorised
        rows = positions.reshape(-1, 3).t().contiguous()
        unit = self.unit(rows.t().view(positions.shape))
        density, features = self.at(unit.clamp(0.0, 1.0))
        if self.contraction is None:
            density = density * ((unit > 0.0) & (unit < 1.0)).all(dim=-1, keepdim=True)
        return density, features

    def unit(self, positions: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Positions as shares of the sides of the box, or of contracted space: in [0, 1] where density may be."""
        if self.contraction is not None:
            return 0.5 + 0.25 * self.contraction(positions)
        return SceneBox.get_normalized_positions(positions, self.aabb)

    def at(self, unit: Float[Tensor, "*batch 3"]) -> tuple[Float[Tensor, "*batch 1"], Tensor]:
        """Density in 1 / scene unit, and the features, at positions of `unit` in [0, 1], faces of the box included."""
        # rows of a matrix: where there are more axes, PyTorch multiplies in another way, which is slower
        output = self.network(self.grid(unit.reshape(-1, 3)))
        # features first, as the kernels have them, so that gradients are put together without moving them around
        parts = output.t().split_with_sizes([1, output.shape[1] - 1])
        density, features = (part.t().view(*unit.shape[:-1], len(part)) for part in parts)
        return self.init_density * limited_exp(widened(density)), features

    def density_fn(self, positions: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 1"]:
        """Density alone."""
        return self(positions)[0]


class EnerfField(Field):
    """Density and colour of E-NeRF (hash grid of Mueller et al. 2022, two networks, spherical harmonics).

    Args:
        aabb: Box in scene units, shape (2, 3).
        num_channels: 1 for grey, 3 for colour.
        view_direction: Whether colour depends on the direction from which a point is seen.
        density: Keywords of `HashDensity`.
        hidden_dim_colour: Width of the hidden layers of the colour network.
        brightness: What makes brightness of the colour network's output; see `brightness_of`.
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

    @full_precision  # in bfloat16 density is 0.2 to 1.2 % off, and a change of log brightness 0.3 to 0.7 %
    def get_density(self, ray_samples: RaySamples) -> tuple[Tensor, Tensor]:
        """Density in 1 / scene unit, shape (*batch, 1), and features for the colour network."""
        return self.geometry(ray_samples.frustums.get_positions())

    @full_precision
    def get_outputs(self, ray_samples: RaySamples, density_embedding: Tensor | None = None) -> dict:
        """Brightness, shape (*batch, num_channels): 0 or more, and at most 1 but where it is exponential."""
        assert density_embedding is not None
        directions = ray_samples.frustums.directions.reshape(-1, 3)
        colour = self.colour(density_embedding.reshape(len(directions), density_embedding.shape[-1]), directions)
        return {FieldHeadNames.RGB: colour.view(*density_embedding.shape[:-1], self.num_channels)}

    @full_precision
    def colour(self, features: Float[Tensor, "points features"], directions: Float[Tensor, "points 3"]) -> Tensor:
        """Brightness, shape (points, num_channels), of points with these features seen along these directions."""
        if self.direction_encoding is not None:
            features = torch.cat([self.direction_encoding(get_normalized_directions(directions)), features], dim=-1)
        return brightness_of(self.colour_network(features), self.brightness)

"""The radiance field: a hash grid, a density network, a colour network."""

from __future__ import annotations

import torch
from jaxtyping import Float
from nerfstudio.cameras.rays import RaySamples
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.field_components.activations import trunc_exp
from nerfstudio.field_components.encodings import SHEncoding
from nerfstudio.field_components.field_heads import FieldHeadNames
from nerfstudio.field_components.mlp import MLP
from nerfstudio.fields.base_field import Field, get_normalized_directions
from torch import Tensor, nn

from enerf_ns.encodings.hash_grid import HashGrid

DARKEST = 2.0 / 255.0
"""Lowest brightness of a field whose sigmoid spans log brightness."""


class HashDensity(nn.Module):
    """Density, and features beside it, of a point in a box: hash grid and one hidden layer.

    Args:
        aabb: Box in scene units, shape (2, 3). Outside it density is zero.
        num_features: Outputs beside the density.
        init_density: Density before training, in 1 / scene unit; small, so that training starts without fog.
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
        num_features: int = 0,
        init_density: float = 0.01,
    ):
        super().__init__()
        self.register_buffer("aabb", aabb.clone().float())
        self.aabb: Tensor
        self.init_density = init_density
        self.grid = HashGrid(num_levels, min_res, max_res, log2_table_size)
        self.network = MLP(
            in_dim=self.grid.out_dim,
            num_layers=2,
            layer_width=hidden_dim,
            out_dim=1 + num_features,
            activation=nn.ReLU(),
            implementation="torch",
        )

    def forward(self, positions: Float[Tensor, "*batch 3"]) -> tuple[Float[Tensor, "*batch 1"], Tensor]:
        """Density in 1 / scene unit, and the features."""
        unit = SceneBox.get_normalized_positions(positions, self.aabb)
        inside = ((unit > 0.0) & (unit < 1.0)).all(dim=-1, keepdim=True)
        output = self.network(self.grid(unit.clamp(0.0, 1.0)))
        density = self.init_density * trunc_exp(output[..., :1]) * inside
        return density, output[..., 1:]

    def density_fn(self, positions: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 1"]:
        """Density alone, as Nerfstudio's proposal sampler asks for it."""
        return self(positions)[0]


class EnerfField(Field):
    """Density and colour of E-NeRF (hash grid of Mueller et al. 2022, two networks, spherical harmonics).

    Args:
        aabb: Box in scene units, shape (2, 3).
        num_channels: 1 for grey, 3 for colour.
        view_direction: Whether colour depends on the direction from which a point is seen.
        density: Keywords of `HashDensity`.
        hidden_dim_colour: Width of the hidden layers of the colour network.
        log_sigmoid: Let a sigmoid span log brightness, from `DARKEST` to 1, so that the field starts in the middle of
            what the sensor can tell apart; else brightness itself, as in the paper, which starts near its upper end.
    """

    def __init__(
        self,
        aabb: Float[Tensor, "2 3"],
        *,
        num_channels: int,
        view_direction: bool,
        hidden_dim_colour: int,
        num_features: int,
        log_sigmoid: bool,
        **density,
    ):
        super().__init__()
        self.log_sigmoid = log_sigmoid
        self.geometry = HashDensity(aabb, num_features=num_features, **density)
        self.direction_encoding = SHEncoding(levels=4, implementation="torch") if view_direction else None
        directions = self.direction_encoding.get_out_dim() if self.direction_encoding else 0
        self.colour_network = MLP(
            in_dim=directions + num_features,
            num_layers=3 if view_direction else 2,
            layer_width=hidden_dim_colour,
            out_dim=num_channels,
            activation=nn.ReLU(),
            implementation="torch",
        )

    def get_density(self, ray_samples: RaySamples) -> tuple[Tensor, Tensor]:
        """Density in 1 / scene unit, shape (*batch, 1), and features for the colour network."""
        return self.geometry(ray_samples.frustums.get_positions())

    def get_outputs(self, ray_samples: RaySamples, density_embedding: Tensor | None = None) -> dict:
        """Colour in [0, 1], shape (*batch, num_channels)."""
        assert density_embedding is not None
        inputs = density_embedding
        if self.direction_encoding is not None:
            directions = get_normalized_directions(ray_samples.frustums.directions)
            encoded = self.direction_encoding(directions.reshape(-1, 3)).view(*directions.shape[:-1], -1)
            inputs = torch.cat([encoded, inputs], dim=-1)
        colour = torch.sigmoid(self.colour_network(inputs))
        return {FieldHeadNames.RGB: DARKEST ** (1.0 - colour) if self.log_sigmoid else colour}

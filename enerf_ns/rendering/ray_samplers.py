"""Samplers that give all rays of a pair, or of a chain of two pairs, the same random numbers, so that their differences
have less sampling noise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from nerfstudio.cameras.rays import RayBundle, RaySamples
from nerfstudio.model_components.ray_samplers import (
    PDFSampler,
    ProposalNetworkSampler,
    SpacedSampler,
    UniformLinDispPiecewiseSampler,
    UniformSampler,
)
from torch import Tensor


@dataclass
class PairedRayBundle(RayBundle):
    """Rays of shape (2 * num_pairs + others): the first rays of all pairs, the second rays, then single rays."""

    num_pairs: int = 0
    chains: tuple[tuple[int, int], ...] = ()
    """Parts of the pairs that are in chains, in order: number of the first pair, and number n of the chains. Pairs i
    and n + i of a part are in chain i."""


def paired_rand(rays: RayBundle, columns: int) -> Float[Tensor, "rays columns"]:
    """Returns random numbers in [0, 1), one row for each ray. All rays of a pair or of a chain have the same row.

    Args:
        rays: A `PairedRayBundle`, or any other bundle, which has no pairs.
        columns: Numbers per ray.
    """
    pairs = getattr(rays, "num_pairs", 0)
    drawn = torch.rand((len(rays) - pairs, columns), device=rays.origins.device)
    for first, number in getattr(rays, "chains", ()):
        drawn[first + number : first + 2 * number] = drawn[first : first + number]
    return torch.cat([drawn[:pairs], drawn]) if pairs else drawn


class PairedSpacedSampler(SpacedSampler):
    """A sampler of Nerfstudio that needs no weights. In training, all rays of a pair or chain have the same jitter."""

    def generate_ray_samples(self, ray_bundle: RayBundle | None = None, num_samples: int | None = None) -> RaySamples:
        """Returns samples that are evenly spaced between nears and fars. In training, jitter moves their edges.

        Args:
            ray_bundle: Rays with nears and fars.
            num_samples: Samples per ray. Default: the sampler's number.
        """
        if not self.training:
            return super().generate_ray_samples(ray_bundle, num_samples)
        num_samples = num_samples or self.num_samples
        assert ray_bundle is not None and num_samples is not None
        assert ray_bundle.nears is not None and ray_bundle.fars is not None
        near, far = self.spacing_fn(ray_bundle.nears), self.spacing_fn(ray_bundle.fars)
        edges = torch.linspace(0.0, 1.0, num_samples + 1, device=near.device)[None]
        middles = (edges[:, 1:] + edges[:, :-1]) / 2.0
        lower, upper = torch.cat([edges[:, :1], middles], -1), torch.cat([middles, edges[:, -1:]], -1)
        jitter = paired_rand(ray_bundle, 1 if self.single_jitter else num_samples + 1)
        bins = lower + (upper - lower) * jitter
        return _samples(ray_bundle, bins, lambda x: self.spacing_fn_inv(x * far + (1 - x) * near))


class PairedUniformSampler(PairedSpacedSampler, UniformSampler):
    """Samples that are even in distance."""


class PairedPiecewiseSampler(PairedSpacedSampler, UniformLinDispPiecewiseSampler):
    """Samples that are even in distance up to 1, and even in inverse distance beyond."""


class PairedPDFSampler(PDFSampler):
    """Nerfstudio's PDFSampler without the original samples. In training, all rays of a pair or chain have the same
    jitter."""

    def __init__(self, single_jitter: bool = False):
        super().__init__(include_original=False, single_jitter=single_jitter)

    def generate_ray_samples(
        self,
        ray_bundle: RayBundle | None = None,
        ray_samples: RaySamples | None = None,
        weights: Float[Tensor, "*batch num_samples 1"] | None = None,
        num_samples: int | None = None,
        eps: float = 1e-5,
    ) -> RaySamples:
        """Returns samples that are distributed as the weights of earlier samples.

        The cumulative sum of the weights is inverted at stratified heights.

        Args:
            ray_bundle: The rays.
            ray_samples: The earlier samples.
            weights: Weights of the earlier samples, 0 or more.
            num_samples: Samples per ray. Default: the sampler's number.
            eps: Smallest sum of the weights of a ray.
        """
        if not self.training:
            return super().generate_ray_samples(ray_bundle, ray_samples, weights, num_samples, eps)
        num_samples = num_samples or self.num_samples
        assert ray_bundle is not None and ray_samples is not None and weights is not None and num_samples is not None
        assert ray_samples.spacing_starts is not None and ray_samples.spacing_ends is not None
        assert ray_samples.spacing_to_euclidean_fn is not None
        weights = weights[..., 0] + self.histogram_padding
        total = weights.sum(dim=-1, keepdim=True)
        padding = torch.relu(eps - total)
        density = (weights + padding / weights.shape[-1]) / (total + padding)
        cumulative = density.cumsum(dim=-1).clamp(max=1.0)
        cumulative = torch.cat([torch.zeros_like(cumulative[..., :1]), cumulative], dim=-1)

        edges = num_samples + 1
        jitter = paired_rand(ray_bundle, 1 if self.single_jitter else edges) / edges
        heights = (torch.linspace(0.0, 1.0 - 1.0 / edges, edges, device=jitter.device) + jitter).contiguous()

        bins = torch.cat([ray_samples.spacing_starts[..., 0], ray_samples.spacing_ends[..., -1:, 0]], dim=-1)
        above = torch.searchsorted(cumulative, heights, side="right")
        below = (above - 1).clamp(0, bins.shape[-1] - 1)
        above = above.clamp(0, bins.shape[-1] - 1)
        low, high = cumulative.gather(-1, below), cumulative.gather(-1, above)
        share = torch.nan_to_num((heights - low) / (high - low), 0).clip(0, 1)
        first, second = bins.gather(-1, below), bins.gather(-1, above)
        bins = (first + share * (second - first)).detach()
        return _samples(ray_bundle, bins, ray_samples.spacing_to_euclidean_fn)


class PairedProposalSampler(ProposalNetworkSampler):
    """Samples where one proposal network expects surfaces. In training, both rays of a pair use the network's density
    along one of them.

    The rays of a pair belong to one pixel at two close instants, so they see nearly the same surfaces.

    Args:
        num_proposal_samples: Samples per ray for the proposal network.
        num_samples: Samples per ray that are returned.
        initial_sampler: Sampler that places the samples for the proposal network.
    """

    def __init__(self, num_proposal_samples: int, num_samples: int, initial_sampler: SpacedSampler):
        super().__init__(
            num_proposal_samples_per_ray=(num_proposal_samples,),
            num_nerf_samples_per_ray=num_samples,
            num_proposal_network_iterations=1,
            initial_sampler=initial_sampler,
            pdf_sampler=PairedPDFSampler(single_jitter=True),
            update_sched=lambda step: 1 if step > 500 else 0,  # then the proposal network learns in every second step
        )

    def generate_ray_samples(
        self, ray_bundle: RayBundle | None = None, density_fns: list[Callable[..., Any]] | None = None
    ) -> tuple[RaySamples, list[Tensor], list[RaySamples]]:
        """Returns samples, and lists of one element: the weights and the samples of the proposal network.

        Args:
            ray_bundle: Rays with nears and fars.
            density_fns: One function: the expected density at positions.
        """
        assert ray_bundle is not None and density_fns is not None
        (expected,) = density_fns
        if not self.training:  # Nerfstudio's own would count pictures as steps
            samples = self.initial_sampler(ray_bundle, num_samples=self.num_proposal_samples_per_ray[0])
            weights = samples.get_weights(expected(samples.frustums.get_positions()))
            found = self.pdf_sampler(ray_bundle, samples, weights, num_samples=self.num_nerf_samples_per_ray)
            return found, [weights], [samples]
        pairs = getattr(ray_bundle, "num_pairs", 0)

        def density(positions: Tensor) -> Tensor:
            found = expected(positions[pairs:])
            return torch.cat([found[:pairs], found]) if pairs else found

        return super().generate_ray_samples(ray_bundle, [density])


def _samples(rays: RayBundle, bins: Float[Tensor, "rays edges"], to_distance) -> RaySamples:
    """Returns samples between the edges of bins, which are in [0, 1]."""
    distances = to_distance(bins)
    return rays.get_ray_samples(
        bin_starts=distances[..., :-1, None],
        bin_ends=distances[..., 1:, None],
        spacing_starts=bins[..., :-1, None],
        spacing_ends=bins[..., 1:, None],
        spacing_to_euclidean_fn=to_distance,
    )

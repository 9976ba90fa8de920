"""Samplers along rays: both rays of a pair have the same samples; single rays have those of Nerfstudio."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from nerfstudio.cameras.rays import RayBundle, RaySamples
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.model_components.ray_samplers import (
    PDFSampler,
    ProposalNetworkSampler,
    UniformLinDispPiecewiseSampler,
    UniformSampler,
)
from torch import Tensor

from enerf_ns.method.model import BoxCollider
from enerf_ns.rendering.ray_samplers import (
    PairedPDFSampler,
    PairedPiecewiseSampler,
    PairedProposalSampler,
    PairedRayBundle,
    PairedUniformSampler,
    paired_rand,
)

PAIRS, FRAME_RAYS = 5, 4


def paired_rays(seed: int = 0) -> PairedRayBundle:
    """Returns rays of which both rays of each pair are equal."""
    generator = torch.Generator().manual_seed(seed)
    directions = torch.nn.functional.normalize(torch.randn(PAIRS + FRAME_RAYS, 3, generator=generator), dim=-1)
    directions = torch.cat([directions[:PAIRS], directions])
    rays = len(directions)
    return PairedRayBundle(
        origins=0.1 * directions,
        directions=directions,
        pixel_area=torch.full((rays, 1), 1e-4),
        camera_indices=torch.arange(rays)[:, None],
        metadata={"directions_norm": torch.ones(rays, 1)},
        nears=torch.full((rays, 1), 0.1),
        fars=torch.full((rays, 1), 2.0),
        num_pairs=PAIRS,
    )


CHAINS = ((0, 1), (3, 1))
"""Pairs 0 and 1 are in a chain, and pairs 3 and 4."""


def density(positions: Tensor) -> Tensor:
    """The density of a ball around the origin."""
    return torch.exp(-8.0 * positions.norm(dim=-1, keepdim=True))


def uniform_samples(rays: RayBundle, single_jitter: bool) -> RaySamples:
    return PairedUniformSampler(num_samples=16, single_jitter=single_jitter).train()(rays)


def piecewise_samples(rays: RayBundle, single_jitter: bool) -> RaySamples:
    return PairedPiecewiseSampler(num_samples=16, single_jitter=single_jitter).train()(rays)


def proposal_samples(rays: RayBundle, single_jitter: bool, training: bool = True, paired: bool = True) -> RaySamples:
    uniform, pdf = PairedUniformSampler(single_jitter=single_jitter), PairedPDFSampler(single_jitter=single_jitter)
    if not paired:
        uniform, pdf = UniformSampler(single_jitter=single_jitter), PDFSampler(None, True, single_jitter, False)
    sampler = ProposalNetworkSampler(
        num_proposal_samples_per_ray=(12,),
        num_nerf_samples_per_ray=8,
        num_proposal_network_iterations=1,
        initial_sampler=uniform,
        pdf_sampler=pdf,
    )
    return sampler.train(training)(rays, density_fns=[density])[0]


@pytest.mark.parametrize("single_jitter", [False, True])
@pytest.mark.parametrize("sample", [uniform_samples, piecewise_samples, proposal_samples])
def test_both_rays_of_a_pair_get_the_same_samples_and_other_rays_their_own(sample, single_jitter: bool):
    torch.manual_seed(0)
    starts = sample(paired_rays(), single_jitter).frustums.starts[..., 0]
    assert len(starts) == 2 * PAIRS + FRAME_RAYS
    torch.testing.assert_close(starts[:PAIRS], starts[PAIRS : 2 * PAIRS], rtol=0, atol=0)
    assert len(starts.unique(dim=0)) == PAIRS + FRAME_RAYS


@pytest.mark.parametrize("single_jitter", [False, True])
@pytest.mark.parametrize("sample", [uniform_samples, piecewise_samples, proposal_samples])
def test_all_four_rays_of_a_chain_get_the_same_samples(sample, single_jitter: bool):
    """Here, where all of them are the same ray. Else a difference of two pairs would hold the noise of both."""
    rays, place = paired_rays(), torch.arange(2 * PAIRS + FRAME_RAYS)
    for first, last in ((0, 1), (3, 4)):
        place[[last, PAIRS + last]] = first
    rays = replace(rays[place], num_pairs=PAIRS, chains=CHAINS)
    torch.manual_seed(0)
    starts = sample(rays, single_jitter).frustums.starts[..., 0]
    for first, last in ((0, 1), (3, 4)):
        torch.testing.assert_close(starts[[first] * 3], starts[[last, PAIRS + first, PAIRS + last]], rtol=0, atol=0)
    assert len(starts.unique(dim=0)) == PAIRS - len(CHAINS) + FRAME_RAYS


@pytest.mark.parametrize("sample", [uniform_samples, piecewise_samples, proposal_samples])
def test_rays_that_are_no_pairs_differ(sample):
    torch.manual_seed(0)
    starts = sample(replace(paired_rays(), num_pairs=0), True).frustums.starts[..., 0]
    assert (starts[:PAIRS] != starts[PAIRS : 2 * PAIRS]).any(dim=1).all()


@pytest.mark.parametrize("single_jitter", [False, True])
@pytest.mark.parametrize("training", [False, True])
def test_samples_of_single_rays_are_those_of_nerfstudio(training: bool, single_jitter: bool):
    """The same random numbers give the same samples."""
    rays = replace(paired_rays(), num_pairs=0)
    found, expected = [], []
    for paired, samples in ((True, found), (False, expected)):
        torch.manual_seed(1)
        samples.append(proposal_samples(rays, single_jitter, training, paired))
        uniform = (PairedUniformSampler if paired else UniformSampler)(16, True, single_jitter)
        piecewise = (PairedPiecewiseSampler if paired else UniformLinDispPiecewiseSampler)(16, True, single_jitter)
        samples += [uniform.train(training)(rays), piecewise.train(training)(rays)]
    for one, other in zip(found, expected, strict=True):
        for name in ("starts", "ends", "origins", "directions"):
            torch.testing.assert_close(getattr(one.frustums, name), getattr(other.frustums, name), rtol=0, atol=0)
        torch.testing.assert_close(one.deltas, other.deltas, rtol=0, atol=0)
        torch.testing.assert_close(one.spacing_starts, other.spacing_starts, rtol=0, atol=0)


@pytest.mark.parametrize("weights", [torch.zeros(14, 12, 1), torch.full((14, 12, 1), 1e30)])
def test_weights_of_any_size_give_samples_in_order_within_the_ray(weights: torch.Tensor):
    rays = paired_rays()
    coarse = PairedUniformSampler(12).train()(rays)
    fine = PairedPDFSampler().train()(rays, coarse, weights, num_samples=8)
    edges = torch.cat([fine.frustums.starts, fine.frustums.ends[:, -1:]], dim=1)[..., 0]
    assert (edges.diff(dim=1) >= 0).all() and (edges >= 0.1).all() and (edges <= 2.0).all()


def test_the_jitter_is_uniform_and_global_random_numbers_are_left_alone():
    rays = paired_rays()
    torch.manual_seed(0)
    drawn = paired_rand(rays, 5000)
    assert drawn.shape == (len(rays), 5000)
    assert drawn.min() >= 0 and drawn.max() < 1
    assert drawn.mean().item() == pytest.approx(0.5, abs=0.01)
    torch.manual_seed(0)
    expected = torch.rand((PAIRS + FRAME_RAYS, 5000))
    torch.testing.assert_close(drawn[PAIRS:], expected, rtol=0, atol=0)


def test_pairs_and_chains_survive_collider_slice_and_device():
    rays = replace(paired_rays(), chains=CHAINS)
    collider = BoxCollider(SceneBox(aabb=torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])), near_plane=0.5)
    for same in (collider(rays), rays[:7], rays.to("cpu"), rays.reshape((2, -1)), rays.flatten()):
        assert isinstance(same, PairedRayBundle) and (same.num_pairs, same.chains) == (PAIRS, CHAINS)
    assert len(rays[:7]) == 7


@pytest.mark.parametrize("training", [False, True])
def test_rays_start_at_the_near_plane_and_end_at_the_box(training: bool):
    """One ray starts in the middle of the box, one outside, and one misses the box."""
    rays = RayBundle(
        origins=torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, -3.0], [0.0, 5.0, 0.0]]),
        directions=torch.tensor([[0.0, 0.0, 1.0]]).repeat(3, 1),
        pixel_area=torch.ones(3, 1),
    )
    collider = BoxCollider(SceneBox(aabb=torch.tensor([[-1.0] * 3, [1.0] * 3])), near_plane=0.25).train(training)
    rays = collider(rays)
    assert rays.nears is not None and rays.fars is not None
    torch.testing.assert_close(rays.nears[:2, 0], torch.tensor([0.25, 2.0]))
    torch.testing.assert_close(rays.fars[:2, 0], torch.tensor([1.0, 4.0]))
    assert (rays.fars > rays.nears).all() and rays.fars.isfinite().all()


def test_rays_that_say_where_they_end_do_so_within_the_box():
    collider = BoxCollider(SceneBox(aabb=torch.tensor([[-1.0] * 3, [1.0] * 3])), near_plane=0.25)
    origins = torch.tensor([[0.0, 0.0, -3.0]]).repeat(4, 1)
    rays = RayBundle(origins, torch.tensor([[0.0, 0.0, 1.0]]).repeat(4, 1), torch.ones(4, 1))
    rays.nears = torch.tensor([[2.5], [0.0], [1e10], [3.0]])
    rays.fars = torch.tensor([[3.5], [9.0], [1e10], [3.0]])
    rays = collider(rays)
    assert rays.nears is not None and rays.fars is not None
    torch.testing.assert_close(rays.nears, torch.tensor([[2.5], [2.0], [4.0], [3.0]]))
    torch.testing.assert_close(rays.fars, torch.tensor([[3.5], [4.0], [4.0], [3.0]]), atol=2e-4, rtol=0)


@pytest.mark.parametrize("pairs", [0, PAIRS])
def test_the_proposal_network_is_asked_along_one_ray_of_a_pair(pairs: int):
    """Both rays of a pair use its densities. All else is as with Nerfstudio's sampler."""
    rays = replace(paired_rays(), num_pairs=pairs)
    asked = []

    def proposal(positions: Tensor) -> Tensor:
        asked.append(positions.shape[:-1])
        return density(positions)

    torch.manual_seed(1)
    sampler = PairedProposalSampler(12, 8, PairedUniformSampler(single_jitter=True)).train()
    samples, (weights,), _ = sampler(rays, density_fns=[proposal])
    assert asked == [(len(rays) - pairs, 12)]
    torch.manual_seed(1)
    expected = proposal_samples(rays, single_jitter=True)
    torch.testing.assert_close(samples.frustums.starts, expected.frustums.starts)
    assert weights.shape == (len(rays), 12, 1)


def test_pictures_are_sampled_as_by_nerfstudio_and_are_no_steps():
    rays = paired_rays()
    sampler = PairedProposalSampler(12, 8, PairedUniformSampler()).eval()
    sampler._steps_since_update = 7
    samples, (weights,), (even,) = sampler(rays, density_fns=[density])
    expected = proposal_samples(rays, single_jitter=False, training=False, paired=False)
    torch.testing.assert_close(samples.frustums.starts, expected.frustums.starts)
    torch.testing.assert_close(weights, even.get_weights(density(even.frustums.get_positions())))
    assert sampler._steps_since_update == 7

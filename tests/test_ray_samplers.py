from __future__ import annotations

import pytest
import torch
from nerfstudio.cameras.rays import RayBundle, RaySamples
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.model_components.ray_samplers import PDFSampler, ProposalNetworkSampler, UniformSampler
from torch import Tensor

from enerf_ns.enerf_model import BoxCollider
from enerf_ns.ray_samplers import PairedRayBundle, SharedJitter

PAIRS, FRAME_RAYS = 5, 4


def paired_rays(seed: int = 0) -> PairedRayBundle:
    """Both rays of each pair are equal."""
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


def density(positions: Tensor) -> Tensor:
    """A ball around the origin."""
    return torch.exp(-8.0 * positions.norm(dim=-1, keepdim=True))


def uniform_samples(rays: RayBundle, single_jitter: bool) -> RaySamples:
    return UniformSampler(num_samples=16, single_jitter=single_jitter).train()(rays)


def proposal_samples(rays: RayBundle, single_jitter: bool) -> RaySamples:
    sampler = ProposalNetworkSampler(
        num_proposal_samples_per_ray=(12,),
        num_nerf_samples_per_ray=8,
        num_proposal_network_iterations=1,
        initial_sampler=UniformSampler(single_jitter=single_jitter),
        pdf_sampler=PDFSampler(include_original=False, single_jitter=single_jitter),
    )
    return sampler.train()(rays, density_fns=[density])[0]


@pytest.mark.parametrize("single_jitter", [False, True])
@pytest.mark.parametrize("sample", [uniform_samples, proposal_samples])
def test_both_rays_of_a_pair_get_the_same_samples_and_other_rays_their_own(sample, single_jitter: bool):
    torch.manual_seed(0)
    rays = paired_rays()
    with SharedJitter(PAIRS):
        starts = sample(rays, single_jitter).frustums.starts[..., 0]
    assert len(starts) == 2 * PAIRS + FRAME_RAYS
    torch.testing.assert_close(starts[:PAIRS], starts[PAIRS : 2 * PAIRS], rtol=0, atol=0)
    assert len(starts.unique(dim=0)) == PAIRS + FRAME_RAYS


@pytest.mark.parametrize("sample", [uniform_samples, proposal_samples])
def test_without_it_the_rays_of_a_pair_differ(sample):
    torch.manual_seed(0)
    starts = sample(paired_rays(), True).frustums.starts[..., 0]
    assert (starts[:PAIRS] != starts[PAIRS : 2 * PAIRS]).any(dim=1).all()


def test_the_jitter_is_uniform_and_of_the_shape_type_and_device_asked_for():
    torch.manual_seed(0)
    with SharedJitter(1000):
        drawn = torch.rand((2500, 4), dtype=torch.float64)
        other = torch.randn(3, 4)
    assert drawn.shape == (2500, 4) and drawn.dtype == torch.float64 and other.shape == (3, 4)
    assert drawn.min() >= 0 and drawn.max() < 1
    assert drawn.mean().item() == pytest.approx(0.5, abs=0.02)


def test_without_pairs_nothing_changes():
    torch.manual_seed(0)
    expected = torch.rand((6, 2))
    torch.manual_seed(0)
    with SharedJitter(0):
        torch.testing.assert_close(torch.rand((6, 2)), expected, rtol=0, atol=0)


def test_the_number_of_pairs_survives_collider_slice_and_device():
    rays = paired_rays()
    collider = BoxCollider(SceneBox(aabb=torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])), near_plane=0.5)
    for same in (collider(rays), rays[:7], rays.to("cpu"), rays.reshape((2, -1)), rays.flatten()):
        assert isinstance(same, PairedRayBundle) and same.num_pairs == PAIRS
    assert len(rays[:7]) == 7


@pytest.mark.parametrize("training", [False, True])
def test_rays_start_at_the_near_plane_and_end_at_the_box(training: bool):
    """A ray from the middle of the box, one from outside it, and one that misses it."""
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

"""Depth spread over untextured regions against planes of known depth, and the evidence that it starts from."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import torch
from nerfstudio.models.base_model import Model
from small_runs import set_up, small_config

from enerf_ns.method.model import AROUND_DEPTH, FAR_SHARE
from enerf_ns.rendering.ray_samplers import PairedUniformSampler
from enerf_ns.rendering.spread_depth import depth_evidence, spread_depth

HEIGHT, WIDTH = 40, 60


def slanted_plane() -> torch.Tensor:
    """Returns depths of a plane, in metres; their inverses are linear in the pixel."""
    x = torch.linspace(0.0, 1.0, WIDTH).expand(HEIGHT, WIDTH)
    return (1.0 / (0.5 - 0.1 * x))[..., None]


def test_what_is_known_at_some_pixels_of_a_plane_is_spread_over_all_of_it():
    truth, generator = slanted_plane(), torch.Generator().manual_seed(0)
    known = torch.rand(HEIGHT, WIDTH, 1, generator=generator) < 0.3
    wrong = truth * (1.0 + 0.05 * torch.randn(truth.shape, generator=generator))
    depth = truth.where(known, wrong)
    found = spread_depth(depth, depth, known.float(), torch.full((HEIGHT, WIDTH, 3), 0.5))
    assert found.shape == truth.shape
    assert ((found - truth).abs() / truth).mean() < 0.2 * ((depth - truth).abs() / truth).mean()


@pytest.mark.parametrize("edge", ["brightness", "depth"])
def test_depth_is_not_spread_over_edges(edge: str):
    """A near wall of known depth stands beside a far wall of low confidence."""
    left = (torch.arange(WIDTH) < WIDTH // 2).expand(HEIGHT, WIDTH)[..., None]
    truth = torch.where(left, 2.0, 2.1 if edge == "brightness" else 3.0)
    brightness = torch.where(left, 0.1, 0.9) if edge == "brightness" else torch.full_like(truth, 0.5)
    confidence = torch.where(left, 1.0, 0.05)
    found = spread_depth(truth, truth, confidence, brightness)
    torch.testing.assert_close(found, truth, atol=0.01, rtol=0)


def test_where_depth_is_known_it_hardly_moves_and_where_it_is_not_the_far_depth_counts():
    truth = slanted_plane()
    brightness = torch.full((HEIGHT, WIDTH, 1), 0.5)
    torch.testing.assert_close(
        spread_depth(truth, 2.0 * truth, torch.ones_like(truth), brightness), truth, rtol=0.05, atol=0
    )
    unknown = spread_depth(0.5 * truth, truth, torch.zeros_like(truth), brightness)
    assert (unknown - truth).abs().median() < 0.1


def test_depth_that_is_no_number_is_left_alone():
    depth = slanted_plane()
    depth[3, 4] = torch.nan
    found = spread_depth(depth, depth, torch.ones_like(depth), torch.ones_like(depth))
    torch.testing.assert_close(found, depth, equal_nan=True)


@pytest.fixture(scope="module")
def pipeline(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    return set_up(small_config(recording, tmp_path_factory.mktemp("outputs"))).pipeline.eval()


class Everywhere:
    """A seen volume with the same evidence everywhere."""

    def __init__(self, evidence: float):
        self._evidence = evidence

    def evidence(self, points: torch.Tensor) -> torch.Tensor:
        return torch.full_like(points[..., 0], self._evidence)


@pytest.mark.parametrize("evidence", [1.0, 0.25])
def test_the_evidence_of_even_fog_is_that_of_its_closed_form(
    pipeline: Any, monkeypatch: pytest.MonkeyPatch, evidence: float
):
    """Transmittance is exp(-density t). The evidence is its difference over the range around the depth."""
    model, density = pipeline.model, 3.0
    monkeypatch.setattr(model, "_samples", lambda rays: (PairedUniformSampler(num_samples=4096).eval()(rays), [], []))
    monkeypatch.setattr(model.field.geometry, "forward", lambda x: (torch.full_like(x[..., :1], density), x))
    monkeypatch.setattr(model, "seen_volume", lambda: Everywhere(evidence))
    rays = pipeline.datamanager.eval_dataset.cameras[:1].generate_rays(camera_indices=0, keep_shape=True)[10:12, 14:18]
    bounded = model.collider(rays.flatten())
    near, far = bounded.nears.view(2, 4, 1), bounded.fars.view(2, 4, 1)
    depth = near + 0.3
    confidence, far_depth = model.depth_evidence(rays, depth)
    passed = [torch.exp(-density * (depth * (1 + side * AROUND_DEPTH) - near)) for side in (-1, 1)]
    torch.testing.assert_close(confidence, evidence * (passed[0] - passed[1]), rtol=0.02, atol=0)
    stopped = 1.0 - torch.exp(-density * (far - near))
    expected = near - torch.log1p(-FAR_SHARE * stopped) / density
    assert (far_depth < far).all() and not math.isclose(float(far_depth[0, 0]), float(depth[0, 0]))
    torch.testing.assert_close(far_depth, expected, rtol=0.01, atol=0)


def test_the_evidence_of_a_picture_is_of_metres_along_the_optical_axis(pipeline: Any, monkeypatch: pytest.MonkeyPatch):
    asked = []

    def evidence(rays: Any, depth: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        asked.append(depth)
        return torch.zeros_like(depth), 1.5 * depth

    monkeypatch.setattr(pipeline.model, "depth_evidence", evidence)
    rays = pipeline.datamanager.eval_dataset.cameras[:1].generate_rays(camera_indices=0, keep_shape=True)
    wall = torch.full((*rays.shape, 1), 2.0)
    confidence, spread = depth_evidence(pipeline.model, rays, wall, torch.ones_like(wall), scale=0.4)
    torch.testing.assert_close(asked[0], 0.8 * rays.metadata["directions_norm"])
    torch.testing.assert_close(spread, torch.full_like(wall, 3.0), rtol=1e-3, atol=0)
    assert not confidence.any()


def test_there_is_no_confidence_at_rims_whose_depth_is_spread(pipeline: Any, monkeypatch: pytest.MonkeyPatch):
    """In the evidence of a picture, and in the outputs of the model."""
    rays = pipeline.datamanager.eval_dataset.cameras[:1].generate_rays(camera_indices=0, keep_shape=True)
    height, width = rays.shape
    steps = torch.full((height, width, 1), 2.0)
    steps[:, : width // 2] = 1.0
    monkeypatch.setattr(pipeline.model, "depth_evidence", lambda rays, depth: (torch.ones_like(depth), depth))
    confidence, spread = depth_evidence(pipeline.model, rays, steps, torch.ones_like(steps), scale=0.4)
    assert not confidence[:, width // 2 - 1].any() and confidence.count_nonzero() == height * (width - 1)
    torch.testing.assert_close(spread, steps, rtol=0.01, atol=0)
    monkeypatch.setattr(Model, "get_outputs_for_camera_ray_bundle", lambda *_: {"depth": steps})
    assert torch.equal(pipeline.model.get_outputs_for_camera_ray_bundle(rays)["confidence"], confidence)


def test_a_model_renders_its_confidence_when_it_is_asked_for_and_events_lower_it(pipeline: Any):
    rays = pipeline.datamanager.eval_dataset.cameras[:1].generate_rays(camera_indices=0, keep_shape=True)
    with torch.no_grad():
        outputs = pipeline.model.get_outputs_for_camera_ray_bundle(rays)
    confidence = outputs["confidence"]
    assert confidence.shape == outputs["depth"].shape
    assert (confidence >= 0).all() and (confidence <= 1).all() and confidence.any()
    volume = pipeline.seen_volume()
    assert volume is pipeline.seen_volume()
    points = rays.origins + rays.directions * outputs["depth"]
    assert (confidence[..., 0] <= volume.evidence(points) + 1e-6).all()
    pipeline.datamanager.train_count += 1
    assert pipeline.seen_volume() is not volume

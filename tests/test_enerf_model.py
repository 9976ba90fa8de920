"""The model: what it renders in training and otherwise, its losses, its parameters."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from nerfstudio.cameras.rays import RayBundle
from small_runs import set_up, small_config

from enerf_ns.sensor.response import luma


@pytest.fixture(scope="module")
def pipeline(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    config = small_config(
        recording,
        tmp_path_factory.mktemp("outputs"),
        data__supervision="events+frames",
        data__silent_pairs=16,
        model__opacity_loss_weight=0.5,
    )
    return set_up(config).pipeline


def rays_of(pipeline: Any) -> tuple[Any, Any]:
    batch = pipeline.datamanager.next_batch(pipeline.model.sensor)
    return batch, pipeline.datamanager.rays(batch, pipeline.model.sensor)


def test_both_rays_of_a_pair_that_are_one_ray_render_the_same_in_training(pipeline: Any):
    """Samples and background are random, but the same for both."""
    _, rays = rays_of(pipeline)
    pairs = rays.num_pairs
    rays.origins[pairs : 2 * pairs], rays.directions[pairs : 2 * pairs] = rays.origins[:pairs], rays.directions[:pairs]
    pipeline.train()
    first, again = pipeline.model(rays)["rgb"], pipeline.model(rays)["rgb"]
    torch.testing.assert_close(first[:pairs], first[pairs : 2 * pairs], rtol=0, atol=0)
    assert (first[:pairs] != again[:pairs]).any()


def test_what_is_rendered_has_the_shapes_that_nerfstudio_asks_for(pipeline: Any):
    _, rays = rays_of(pipeline)
    pipeline.eval()
    with torch.no_grad():
        outputs = pipeline.model(rays)
    assert next(iter(outputs)) == "rgb"
    sizes = {"rgb": 3, "accumulation": 1, "depth": 1, "normals": 3}
    assert {name: tuple(output.shape) for name, output in outputs.items()} == {
        name: (len(rays), size) for name, size in sizes.items()
    }
    torch.testing.assert_close(outputs["normals"].mul(2).sub(1).norm(dim=-1), torch.ones(len(rays)), atol=1e-3, rtol=0)
    pipeline.train()


def test_losses_are_those_of_the_parts(pipeline: Any):
    batch, rays = rays_of(pipeline)
    model = pipeline.model
    outputs = model(rays)
    losses = model.get_loss_dict(outputs, batch)
    start, end, frames = batch.split(outputs["rgb"])
    of_events = model.supervision.losses(start, end, batch.events, model.sensor)
    for name, loss in of_events.items():
        torch.testing.assert_close(losses[name], loss, rtol=0, atol=0)
    error = (luma(frames) - luma(batch.frames.colours)) ** 2
    torch.testing.assert_close(losses["frame_loss"], model.config.frame_loss_weight * error.mean())
    torch.testing.assert_close(losses["opacity_loss"], 0.5 * (1 - outputs["accumulation"]).mean())
    psnr = model.get_metrics_dict(outputs, batch)["frame_psnr"]
    torch.testing.assert_close(psnr, -10 * torch.log10(error.mean()))


def test_every_parameter_is_in_one_group(pipeline: Any):
    groups = pipeline.model.get_param_groups()
    grouped = [id(parameter) for group in groups.values() for parameter in group]
    trained = {
        id(parameter) for name, parameter in pipeline.model.named_parameters() if name != "device_indicator_param"
    }
    assert set(groups) == {"fields"} and len(grouped) == len(set(grouped)) and set(grouped) == trained


def test_a_ray_that_misses_the_box_is_black_and_nothing(pipeline: Any):
    pipeline.eval()
    far = torch.full((3, 3), 50.0)
    rays = RayBundle(far, torch.tensor([[1.0, 0.0, 0.0]]).expand(3, 3), torch.ones(3, 1))
    with torch.no_grad():
        outputs = pipeline.model(rays)
    assert (outputs["accumulation"] == 0).all() and (outputs["rgb"] == 0).all()
    assert all(output.isfinite().all() for output in outputs.values())
    pipeline.train()

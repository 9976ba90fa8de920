"""The model: what it renders in training and otherwise, its losses, its parameters."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.field_components.field_heads import FieldHeadNames
from nerfstudio.model_components.losses import interlevel_loss, ray_samples_to_sdist
from small_runs import EVENTS, check_two_steps, set_up, small_config

from enerf_ns.choices.brightness import MEAN_BRIGHTNESS
from enerf_ns.method.held_out_views import held_out_views
from enerf_ns.method.model import FOG_GROWTH, fog_growth
from enerf_ns.rendering.ray_samplers import PairedUniformSampler
from enerf_ns.sensor.response import linlog, luma
from enerf_ns.supervision.balance import ErrorBalance
from enerf_ns.supervision.losses import distortion_loss


@pytest.fixture(scope="module")
def pipeline(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    config = small_config(
        recording,
        tmp_path_factory.mktemp("outputs"),
        data__supervision="events+frames",
        data__silent_pairs=16,
        model__frame_loss_weight=3.0,
        model__opacity_loss_weight=0.5,
        model__level_loss_weight=0.2,
        model__mean_brightness=0.2,
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
    sizes = {"rgb": 3, "accumulation": 1, "depth": 1, "normals": 3, "confidence": 1}
    assert {name: tuple(outputs[name].shape) for name in outputs} == {
        name: (len(rays), size) for name, size in sizes.items()
    }
    torch.testing.assert_close(outputs["normals"].mul(2).sub(1).norm(dim=-1), torch.ones(len(rays)), atol=1e-3, rtol=0)
    pipeline.train()


@pytest.mark.parametrize("training", [False, True])
def test_a_level_of_brightness_only_makes_pictures_brighter(recording: Path, tmp_path: Path, training: bool):
    rendered = []
    for number, level in enumerate((MEAN_BRIGHTNESS, 0.5 * MEAN_BRIGHTNESS)):
        config = small_config(
            recording, tmp_path / str(number), model__level_loss_weight=0.1, model__mean_brightness=level
        )
        pipeline: Any = set_up(config).pipeline
        pipeline.train(training)
        _, rays = rays_of(pipeline)
        torch.manual_seed(0)
        rendered.append(pipeline.model(rays))
    torch.testing.assert_close(rendered[1]["rgb"], 0.5 * rendered[0]["rgb"])
    torch.testing.assert_close(rendered[1]["accumulation"], rendered[0]["accumulation"])
    assert rendered[0]["rgb"].abs().max() > 0.01


def test_losses_are_those_of_the_parts(pipeline: Any):
    batch, rays = rays_of(pipeline)
    model = pipeline.model
    outputs = model(rays)
    losses = model.get_loss_dict(outputs, batch)
    start, end, frames = batch.split(outputs["rgb"])
    of_events = model.supervision.losses(start, end, batch.events, model.sensor)
    for name, loss in of_events.items():
        torch.testing.assert_close(losses[name], loss, rtol=0, atol=0)
    assert batch.frames.are_grey
    error = (luma(frames) - luma(batch.frames.colours)) ** 2
    torch.testing.assert_close(losses["frame_loss"], model.config.frame_loss_weight * error.mean())
    torch.testing.assert_close(losses["opacity_loss"], 0.5 * (1 - outputs["accumulation"]).mean())
    seen = luma(torch.cat([start, end]))
    level = torch.exp(torch.log(seen[seen > 0.01]).mean())
    torch.testing.assert_close(losses["level_loss"], 0.2 * torch.log(level / model.config.mean_brightness) ** 2)
    psnr = model.get_metrics_dict(outputs, batch)["frame_psnr"]
    torch.testing.assert_close(psnr, -10 * torch.log10(error.mean()))


def test_every_parameter_is_in_one_group(pipeline: Any):
    groups = pipeline.model.get_param_groups()
    grouped = [id(parameter) for group in groups.values() for parameter in group]
    trained = {
        id(parameter) for name, parameter in pipeline.model.named_parameters() if name != "device_indicator_param"
    }
    assert set(groups) == {"fields"} and len(grouped) == len(set(grouped)) and set(grouped) == trained


STRANGE_RAYS = {
    "misses": ([50.0, 50.0, 50.0], [1.0, 0.0, 0.0]),
    "starts far behind": ([0.0, 0.0, -1e6], [0.0, 0.0, 1.0]),
    "grazes a face": ([-3.0, 1.0, 0.0], [1.0, 0.0, 0.0]),
    "starts on a face, and leaves": ([1.0, 0.0, 0.0], [1.0, 0.0, 0.0]),
    "touches a corner": ([-2.0, 0.0, 1.0], [0.70710678, 0.70710678, 0.0]),
    "is as steep as what Nerfstudio adds to directions": ([1.0, 0.5, 0.0], [-1e-6, 0.0, 1.0]),
    "has no direction": ([0.0, 0.0, 0.0], [0.0, 0.0, 0.0]),
}


@pytest.mark.parametrize("logit", [-1e4, -95.0, 0.0, 88.8, 1e4])
@pytest.mark.parametrize("training", [False, True])
def test_all_is_finite_for_any_ray_and_density(pipeline: Any, training: bool, logit: float):
    """Densities of 0, subnormal ones and those above float32, in the field and in the proposal network."""
    origins, directions = (torch.tensor(column) for column in zip(*STRANGE_RAYS.values(), strict=True))
    lengths = torch.ones(len(origins), 1)
    biases = [network.network.layers[-1].bias for network in (pipeline.model.field.geometry, pipeline.model.proposal)]
    kept = [bias.detach().clone() for bias in biases]
    with torch.no_grad():
        for bias in biases:
            bias[0] = logit
    pipeline.train(training)
    pipeline.zero_grad()
    outputs = pipeline.model(RayBundle(origins, directions, lengths, metadata={"directions_norm": lengths}))
    shown = ("rgb", "accumulation") if training else ("rgb", "accumulation", "depth", "normals")
    assert all(outputs[name].isfinite().all() for name in shown)
    if training:
        losses = [
            (outputs["rgb"] ** 2).mean(),
            (1.0 - outputs["accumulation"]).mean(),
            distortion_loss(outputs["weights_list"][-1][..., 0], ray_samples_to_sdist(outputs["ray_samples_list"][-1])),
            interlevel_loss(outputs["weights_list"], outputs["ray_samples_list"]),
        ]
        assert all(loss.isfinite() for loss in losses)
        torch.stack(losses).sum().backward()
        gradients = [parameter.grad for parameter in pipeline.model.parameters() if parameter.grad is not None]
        assert gradients and all(gradient.isfinite().all() for gradient in gradients)
    with torch.no_grad():
        for bias, value in zip(biases, kept, strict=True):
            bias.copy_(value)
    pipeline.zero_grad()
    pipeline.train()


def test_frames_beside_events_are_weighed_by_the_errors_of_both(pipeline: Any):
    batch, rays = rays_of(pipeline)
    model = pipeline.model
    outputs = model(rays)
    before = model.get_loss_dict(outputs, batch)
    model.frame_balance = ErrorBalance()
    after = model.get_loss_dict(outputs, batch)
    model.frame_balance = None
    pairs, pixels = len(batch.events) - batch.events.num_silent, len(batch.frames.indices)
    torch.testing.assert_close(after["frame_loss"], before["event_loss"] / pairs * pixels)
    assert all(torch.equal(after[name], before[name]) for name in before if name != "frame_loss")


@pytest.mark.parametrize("frames_are_weighed", [False, True])
def test_pairs_of_any_instants_are_weighed_by_the_errors_of_both(pipeline: Any, frames_are_weighed: bool):
    """Each kind as its number over its mean error; both together as one loss of weight 1."""
    batch, rays = rays_of(pipeline)
    model = pipeline.model
    outputs = model(rays)
    events = batch.events
    number = events.num_of_events // 3
    some = replace(batch, events=replace(events, num_any=number))
    start, end, _ = batch.split(outputs["rgb"])
    means = model.supervision.losses(start, end, some.events, model.sensor)
    model.instant_balance = ErrorBalance()
    model.frame_balance = ErrorBalance() if frames_are_weighed else None
    losses = model.get_loss_dict(outputs, some)
    model.instant_balance, model.frame_balance = ErrorBalance(), None
    numbers = {"event_loss": events.num_of_events - number, "instant_loss": number}
    shares = {name: numbers[name] / float(means[name]) for name in numbers}
    for name in numbers:
        torch.testing.assert_close(losses[name], shares[name] / sum(shares.values()) * means[name])
    if frames_are_weighed:
        of_frame = len(batch.frames.indices) / numbers["event_loss"]
        torch.testing.assert_close(losses["frame_loss"], of_frame * losses["event_loss"])


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_under_autocast_only_the_proposal_network_is_half(pipeline: Any, dtype: torch.dtype):
    """With samples that do not hang on it, losses and gradients of a step are equal to the bit; the proposal network
    moves changes of log brightness by less than the jitter of the samples does."""
    model, manager = pipeline.model, pipeline.datamanager
    state = manager.generator.get_state()

    def step(half: bool, seed: int = 0) -> tuple[dict, dict, torch.Tensor]:
        manager.generator.set_state(state)
        torch.manual_seed(seed)
        pipeline.zero_grad()
        with torch.autocast("cpu", dtype=dtype, enabled=half):
            outputs, losses, metrics = pipeline.get_train_loss_dict(0)
        torch.stack(list(losses.values())).sum().backward()
        assert all(value.dtype == torch.float32 for value in (losses | metrics).values())
        assert all(output.dtype == torch.float32 for output in (outputs["rgb"], *outputs["weights_list"]))
        start, end = outputs["rgb"].detach()[: 2 * manager.config.event_pairs].chunk(2)
        gradients = {name: value.grad for name, value in model.named_parameters() if value.grad is not None}
        return losses | metrics, gradients, linlog(end) - linlog(start)

    sampler, proposal = model.sampler, model.proposal
    torch.nn.init.normal_(proposal.grid.table)
    torch.nn.init.normal_(model.field.geometry.grid.table)
    _, _, expected = step(False)
    error = (step(True)[2] - expected).square().mean()
    assert 0 < error < 0.1 * (step(False, seed=1)[2] - expected).square().mean()

    model.sampler, model.proposal = PairedUniformSampler(16).train(), None
    try:
        torch.testing.assert_close(step(True), step(False), rtol=0, atol=0)
    finally:
        model.sampler, model.proposal = sampler, proposal


def test_brightness_above_white_is_scored_as_it_is_and_shown_as_white(recording: Path, tmp_path: Path):
    pipeline = set_up(small_config(recording, tmp_path, model__brightness="exponential")).pipeline
    with torch.no_grad():
        pipeline.model.field.colour_network.layers[-1].bias += 10.0
        pipeline.model.field.geometry.network.layers[-1].bias[0] += 8.0
    pipeline.eval()
    camera = pipeline.datamanager.eval_dataset.cameras[:1]
    shown = pipeline.model.get_outputs_for_camera(camera)["rgb"]
    scored = held_out_views(pipeline)[0][0].rendered
    assert scored.isfinite().all() and (scored > 1).any()
    torch.testing.assert_close(shown, scored.clamp(max=1.0))


def test_with_contraction_what_lies_beyond_the_box_is_learnt(recording: Path, tmp_path: Path):
    """By all parameters, and seen by rays that miss the box."""
    config = small_config(recording, tmp_path, model__contraction=True)
    pipeline = check_two_steps(config, EVENTS).pipeline
    pipeline.eval()
    lengths = torch.ones(2, 1)
    rays = RayBundle(torch.full((2, 3), 5.0), torch.eye(3)[:2], lengths, metadata={"directions_norm": lengths})
    with torch.no_grad():
        outputs = pipeline.model(rays)
    assert (outputs["rgb"] > 0).all() and all(outputs[name].isfinite().all() for name in outputs)


PICTURES: dict[str, dict[str, Any]] = {
    "default": {},
    "colour": {"num_channels": 3, "view_direction": True},
    "contraction": {"contraction": True},
    "panorama": {"panorama": True},
    "uniform": {"sampling": "uniform", "num_samples": 21, "brightness": "sigmoid"},
    "bright": {"brightness": "exponential"},
}


@pytest.mark.sweep(8)
@pytest.mark.parametrize("backend", ["numba", "torch", "torch, 40 samples at once"])
@pytest.mark.parametrize("setting", PICTURES)
def test_a_picture_is_the_sum_over_all_samples(recording: Path, tmp_path: Path, setting: str, backend: str):
    """Though the field is not asked for what lies behind, nor for the colour of what is thin."""
    settings = {f"model__{name}": value for name, value in PICTURES[setting].items()}
    config = small_config(recording, tmp_path, **settings, model__hash_grid=backend.split(",")[0])
    pipeline = set_up(config).pipeline
    model = pipeline.model
    _, rays = rays_of(pipeline)
    pipeline.eval()
    torch.manual_seed(0)
    torch.nn.init.normal_(model.field.geometry.grid.table, std=4.0)  # free, thin and dense by turns
    rays = model.collider(rays)
    if model.proposal is None:
        samples = model.sampler(rays)
    else:
        torch.nn.init.normal_(model.proposal.grid.table, std=4.0)
        even = model.sampler.initial_sampler(rays, num_samples=model.config.num_proposal_samples)
        weights = even.get_weights(model.expected(even.frustums.get_positions()))
        samples = model.sampler.pdf_sampler(rays, even, weights, num_samples=model.config.num_samples)
    field = model.field(samples)
    weights = samples.get_weights(field[FieldHeadNames.DENSITY])
    model.samples_at_once = 40 if "40" in backend else None
    with torch.no_grad():
        outputs = model(rays)
    assert 0.01 < weights.sum(dim=1).mean() and (weights.sum(dim=1).mean() < 0.999 or setting == "panorama")
    expected = (weights * field[FieldHeadNames.RGB]).sum(dim=1).expand(-1, 3)
    torch.testing.assert_close(outputs["rgb"], expected, rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(outputs["accumulation"], weights.sum(dim=1), rtol=0, atol=1e-3)
    depth = model.renderer_depth(weights=weights, ray_samples=samples)
    assert ((outputs["depth"] - depth).abs() < 1e-3 * depth).float().mean() > 0.99  # a median may jump by a sample


def test_normals_of_a_picture_are_those_of_its_rays(pipeline: Any):
    pipeline.eval()
    rays = pipeline.datamanager.eval_dataset.cameras[:1].generate_rays(camera_indices=0, keep_shape=True)
    with torch.no_grad():
        picture = pipeline.model.get_outputs_for_camera_ray_bundle(rays)
        by_rays = pipeline.model(rays.flatten())
    torch.testing.assert_close(picture["normals"].view(-1, 3), by_rays["normals"])
    assert picture["normals"].std() > 0
    pipeline.train()


def test_depth_that_is_scaled_in_place_changes_neither_normals_nor_confidence(pipeline: Any):
    """As `ns-render dataset` scales raw-depth before it reads the outputs that are named behind it."""
    pipeline.eval()
    camera = pipeline.datamanager.eval_dataset.cameras[:1]
    picture, other = (pipeline.model.get_outputs_for_camera(camera) for _ in range(2))
    other["depth"].div_(3.0)
    for name in ("normals", "confidence"):
        assert torch.equal(other[name], picture[name]) and picture[name].std() > 0
    pipeline.train()


def test_a_picture_without_depth_is_shown(pipeline: Any):
    zeros = torch.zeros(12, 12, 1)
    outputs = {"rgb": torch.rand(12, 12, 3), "depth": zeros, "accumulation": zeros}
    _, images = pipeline.model.get_image_metrics_and_images(outputs, {"image": torch.rand(12, 12, 3), "is_frame": True})
    assert torch.equal(images["depth"], zeros)


def test_a_ray_that_misses_the_box_is_black_and_nothing(pipeline: Any):
    pipeline.eval()
    far = torch.full((3, 3), 50.0)
    rays = RayBundle(far, torch.tensor([[1.0, 0.0, 0.0]]).expand(3, 3), torch.ones(3, 1))
    with torch.no_grad():
        outputs = pipeline.model(rays)
    assert (outputs["accumulation"] == 0).all() and (outputs["rgb"] == 0).all()
    assert all(outputs[name].isfinite().all() for name in outputs)
    pipeline.train()


@pytest.mark.parametrize("num_steps", [2000, 4000])
def test_fog_is_contracted_in_the_middle_of_a_training(num_steps: int):
    """By a weight that grows by one factor a step, stays, and falls by one factor a step."""
    growth = torch.tensor([fog_growth(step, num_steps) for step in range(num_steps)])
    begins, grown, falls, fallen = (num_steps * share // 10 for share in (2, 5, 6, 8))
    assert (growth[: begins + 1] == 1.0).all() and (growth[grown : falls + 1] == FOG_GROWTH).all()
    assert (growth[fallen:] == 1.0).all()
    for part, end in ((growth[begins : grown + 1], FOG_GROWTH), (growth[falls : fallen + 1], 1.0 / FOG_GROWTH)):
        factors = part[1:] / part[:-1]
        torch.testing.assert_close(factors, torch.full_like(factors, end ** (1.0 / len(factors))))


@pytest.mark.parametrize("num_steps", [1999, math.inf])
def test_fog_is_not_contracted_in_short_trainings_nor_in_those_without_an_end(num_steps: float):
    assert {fog_growth(step, num_steps) for step in range(1999)} == {1.0}


@pytest.mark.parametrize("step", [800, 2000])
@pytest.mark.parametrize("supervision", ["events", "events+frames", "frames"])
def test_the_distortion_loss_grows_in_runs_with_events_alone(
    recording: Path, tmp_path: Path, supervision: str, step: int
):
    config = small_config(recording, tmp_path, data__supervision=supervision)
    config.max_num_iterations = 4000
    trainer = set_up(config)
    outputs, losses, _ = trainer.pipeline.get_train_loss_dict(step)
    spread = distortion_loss(outputs["weights_list"][-1][..., 0], ray_samples_to_sdist(outputs["ray_samples_list"][-1]))
    weight = 0.01 * (1.0 if supervision == "frames" or step == 800 else FOG_GROWTH)
    torch.testing.assert_close(losses["distortion_loss"], weight * spread)

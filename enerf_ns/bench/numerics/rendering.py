"""Cases of rendering: extreme densities, rays without length, half precision."""

from __future__ import annotations

from functools import cache
from typing import Any

import torch
from nerfstudio.cameras.rays import Frustums, RayBundle, RaySamples
from nerfstudio.field_components.field_heads import FieldHeadNames
from torch import Tensor

from enerf_ns.bench.numerics.case import case
from enerf_ns.bench.numerics.small_run import quiet, small_trainer
from enerf_ns.rendering.field import Brightness, brightness_of, limited_exp
from enerf_ns.sensor.response import Linlog, Logarithm, Response
from enerf_ns.supervision.event_supervision import brightness_change

DENSITIES = (0.0, 1e-42, 1e-6, 1e-2, 1.0, 1e2, 1e6, 1e20, 3e38)
"""Densities from 0, with a subnormal number, to the largest float32 number."""


def _samples(edges: Tensor) -> RaySamples:
    """Samples between edges (rays, samples + 1) along rays."""
    starts, ends = edges[..., :-1, None], edges[..., 1:, None]
    shape = (*starts.shape[:-1], 3)
    frustums = Frustums(torch.zeros(shape), torch.ones(shape), starts, ends, torch.ones_like(starts))
    return RaySamples(frustums, deltas=ends - starts)


@case("densities from 0 to 3e38 along a ray", "weights of float64", 1e-6)
def densities() -> float:
    generator = torch.Generator().manual_seed(0)
    density = torch.tensor(DENSITIES)[torch.randint(len(DENSITIES), (2000, 24, 1), generator=generator)]
    edges = torch.rand((2000, 25), generator=generator).sort(dim=-1).values
    optical = density.double() * (edges[:, 1:, None] - edges[:, :-1, None]).double()
    before = torch.cat([torch.zeros_like(optical[:, :1]), optical.cumsum(dim=1)[:, :-1]], dim=1)
    expected = torch.exp(-before) * -torch.expm1(-optical)
    return float((_samples(edges).get_weights(density).double() - expected).abs().max())


@case(
    "density logits from -1e4 to 1e4",
    "finite weights and gradients, and a gradient that lowers large densities",
    0,
    "numbers",
)
def density_logits() -> float:
    logits = torch.linspace(-1e4, 1e4, 201)[None, :, None].requires_grad_()
    weights = _samples(torch.linspace(0.0, 1.0, 202)[None]).get_weights(0.01 * limited_exp(logits))
    (gradient,) = torch.autograd.grad(weights.square().sum(), logits)
    pushed = torch.tensor(1e4, requires_grad=True)
    (push,) = torch.autograd.grad(limited_exp(pushed), pushed)
    return int((~weights.isfinite()).sum() + (~gradient.isfinite()).sum()) + int(not float(push) > 0.0)


@cache
def _pipeline() -> Any:
    """A pipeline after 40 training steps."""
    trainer: Any = small_trainer()
    with quiet():
        for step in range(40):
            trainer.train_iteration(step)
    return trainer.pipeline


@case("rays that graze, miss, start inside, stand still", "finite pictures, depths and gradients", 0, "numbers")
def odd_rays() -> float:
    model = _pipeline().model
    low, high = model.scene_box.aabb
    edge, outside = torch.stack([low[0], low[1], 0.5 * (low[2] + high[2])]), high + 50.0
    directions = torch.tensor([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0], [1e-30, 0, 1.0], [-1.0, 0, 0], [0, 0, 0]])
    origins = torch.stack([low, high, edge, outside, 0.5 * (low + high)])
    rays = RayBundle(
        origins.repeat_interleave(len(directions), 0),
        directions.repeat(len(origins), 1),
        torch.ones(len(origins) * len(directions), 1),
    )
    wrong = 0
    for train in (True, False):
        model.train(train)
        outputs = model(rays)
        wrong += sum(
            int((~outputs[name].isfinite()).sum()) for name in ("rgb", "accumulation", "depth") if name in outputs
        )
        model.zero_grad()
        outputs["rgb"].sum().backward()
        wrong += sum(
            int((~parameter.grad.isfinite()).sum()) for parameter in model.parameters() if parameter.grad is not None
        )
    model.zero_grad()
    model.train()
    return wrong


@case("a ray without length", "zero weight, finite gradients", 0)
def no_length() -> float:
    density = torch.full((1, 8, 1), 1e20, requires_grad=True)
    weights = _samples(torch.ones(1, 9)).get_weights(density)
    (gradient,) = torch.autograd.grad(weights.sum(), density)
    return float(weights.detach().abs().sum()) + int((~gradient.isfinite()).sum())


def _half_error(dtype: torch.dtype) -> float:
    """Error of the change of log brightness under autocast, relative to its root mean square, at the same samples."""
    pipeline = _pipeline()
    model, manager = pipeline.model, pipeline.datamanager
    batch = manager.next_batch(model.sensor)
    rays = model.collider(manager.rays(batch, model.sensor))
    model.train()
    with torch.no_grad():
        samples, _, _ = model.sampler(rays, density_fns=[model.proposal.density_fn])

        def change() -> Tensor:
            outputs = model.field(samples)
            weights = samples.get_weights(outputs[FieldHeadNames.DENSITY])
            start, end, _ = batch.split((weights * outputs[FieldHeadNames.RGB]).sum(dim=-2))
            return brightness_change(start, end, batch.events, model.sensor)

        exact = change()
        with torch.autocast("cpu", dtype=dtype):
            half = change()
    return float((half.double() - exact.double()).abs().max() / exact.double().square().mean().sqrt())


@case("bfloat16 (--mixed-precision True)", "changes of log brightness of float32, relative to their RMS", 1e-4)
def bfloat16() -> float:
    return _half_error(torch.bfloat16)


@case("float16 (--mixed-precision True)", "changes of log brightness of float32, relative to their RMS", 1e-4)
def float16() -> float:
    return _half_error(torch.float16)


def fit_error(
    spread: float, response: Response, activation: Brightness = "exponential", steps: int = 1500, rate: float = 0.05
) -> float:
    """Root mean square error of log brightness after Adam has fitted 1000 free numbers to evenly spread values.

    Args:
        spread: Range of log brightness; its offset is free.
        response: From brightness to log brightness.
        activation: From the free numbers, which stand for the network's output, to brightness.
        steps: Of Adam.
        rate: Learning rate of Adam.
    """
    wanted = torch.linspace(0.0, spread, 1000)
    output = torch.zeros(1000, requires_grad=True)
    optimizer = torch.optim.Adam([output], lr=rate)
    error = wanted
    for _ in range(steps):
        optimizer.zero_grad()
        found = response(brightness_of(output, activation))
        error = (found - found.mean()) - (wanted - wanted.mean())
        error.square().mean().backward()
        optimizer.step()
    return float(error.detach().square().mean().sqrt())


@case("log brightness over 10, linlog", "root mean square error of a fit", 0.1)
def dynamic_range_linlog() -> float:
    return fit_error(10.0, Linlog())


@case("log brightness over 10, logarithm", "root mean square error of a fit", 0.1)
def dynamic_range_logarithm() -> float:
    return fit_error(10.0, Logarithm(0.001))

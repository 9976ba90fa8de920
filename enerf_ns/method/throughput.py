"""The number of rays of a training step on a fast device. It is measured, since GPUs differ."""

from __future__ import annotations

from collections.abc import Callable

import torch

from enerf_ns.method.memory import forward_and_backward, rays_from_the_middle
from enerf_ns.method.model import EnerfModel
from enerf_ns.method.pipeline import EnerfPipeline, EnerfPipelineConfig
from enerf_ns.method.stopwatch import seconds_of

LARGEST_FACTOR = 32
"""Largest factor on the number of rays of the method; with it, a step has about the rays of the paper."""

LONGER = 1.5
"""Largest factor on the time of a step that more rays may cost."""

REPETITIONS = 5
"""Number of steps of each size that are timed; the fastest counts."""


def largest_factor(seconds: Callable[[int], float]) -> int:
    """The largest power of two, up to `LARGEST_FACTOR`, with which a step takes at most `LONGER` times as long.

    Args:
        seconds: Returns the time of a step by the factor on its rays. It is not called beyond the first slow one.
    """
    factor, most = 1, LONGER * seconds(1)
    while factor < LARGEST_FACTOR and seconds(2 * factor) <= most:
        factor *= 2
    return factor


def seconds_of_step(model: EnerfModel, num_rays: int) -> float:
    """Seconds of rendering rays from the middle of the scene, forward and backward.

    The parameters and the states of the random generators do not change.

    Args:
        model: Model on its device.
        num_rays: Number of rays.
    """
    device = model.scene_box.aabb.device
    with torch.random.fork_rng([device] if device.type == "cuda" else []):
        rays, was_training = rays_from_the_middle(model, num_rays), model.training
        model.train()
        forward_and_backward(model, rays)  # compiles
        fastest = min(seconds_of(lambda: forward_and_backward(model, rays), device) for _ in range(REPETITIONS))
        model.train(was_training)
    return fastest


def batch_factor(config: EnerfPipelineConfig, device: torch.device | str) -> int:
    """Factor on the number of rays of the method for a device. It is 1 on a CPU, where twice as many rays take twice as
    long.

    Args:
        config: Config without a field that is None.
        device: Device of the training.
    """
    if torch.device(device).type == "cpu":
        return 1
    with torch.random.fork_rng():
        pipeline: EnerfPipeline = config._target(config, device=str(device), test_mode="val")
    num_rays = pipeline.datamanager.get_train_rays_per_batch()
    return largest_factor(lambda factor: seconds_of_step(pipeline.model, factor * num_rays))

"""How many rays a training step has on a device that is fast enough for more: measured, since no two GPUs are alike."""

from __future__ import annotations

from collections.abc import Callable

import torch

from enerf_ns.method.memory import forward_and_backward, rays_from_the_middle
from enerf_ns.method.model import EnerfModel
from enerf_ns.method.pipeline import EnerfPipeline, EnerfPipelineConfig
from enerf_ns.method.stopwatch import seconds_of

LARGEST_FACTOR = 32
"""Times as many rays as the method has, at most: about those of the paper."""

LONGER = 1.5
"""Times as long, at most, that a step takes with more rays."""

REPETITIONS = 5
"""Steps of each size that are timed, of which the fastest counts."""


def largest_factor(seconds: Callable[[int], float]) -> int:
    """The largest power of two, up to `LARGEST_FACTOR`, with which a step takes at most `LONGER` times as long.

    Args:
        seconds: That a step takes with so many times as many rays; not asked beyond the first that is too slow.
    """
    factor, most = 1, LONGER * seconds(1)
    while factor < LARGEST_FACTOR and seconds(2 * factor) <= most:
        factor *= 2
    return factor


def seconds_of_step(model: EnerfModel, num_rays: int) -> float:
    """Seconds of rendering rays from the middle of the scene, forward and backward; nothing is learnt, and random
    numbers stay as they were.

    Args:
        model: On its device.
        num_rays: Of the step.
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
    """How many times the rays of the method a step may have on a device: 1 on a CPU, where twice as many take twice as
    long.

    Args:
        config: With everything decided.
        device: To train on.
    """
    if torch.device(device).type == "cpu":
        return 1
    with torch.random.fork_rng():
        pipeline: EnerfPipeline = config._target(config, device=str(device), test_mode="val")
    num_rays = pipeline.datamanager.get_train_rays_per_batch()
    return largest_factor(lambda factor: seconds_of_step(pipeline.model, factor * num_rays))

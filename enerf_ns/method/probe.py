"""A probe whether the viewing direction helps on a scene: short trainings with and without it, compared on pixels that
are held out from both."""

from __future__ import annotations

from functools import cache

import numpy as np
import torch
import yaml
from nerfstudio.engine.optimizers import OptimizerConfig
from nerfstudio.utils.rich_utils import CONSOLE
from rich.progress import track

from enerf_ns.events.batch import TrainBatch
from enerf_ns.method.pipeline import EnerfPipeline, EnerfPipelineConfig

SEEDS = 3
"""Number of trainings of each kind: after few steps, two that differ by their seed alone can be far apart."""

STEPS = 100
"""Steps of each training."""

PAIRS = 256
"""Largest number of pairs of events, and of pixels of frames, of a step."""

HELD_OUT_EVERY = 8
"""One of so many pixels is held out from these trainings."""

SCORED_BATCHES = 16
"""Number of batches of held-out pixels on which the trainings are compared."""

MEASURED = ("event_loss", "instant_loss", "frame_loss")
"""Losses that compare the field with what was recorded."""


def view_direction_gain(
    config: EnerfPipelineConfig, optimizer: OptimizerConfig, device: str | torch.device
) -> tuple[float, float]:
    """Relative decrease of the error at held-out pixels if brightness may depend on the viewing direction.

    The states of the random generators do not change. The result of a config is computed once in a process.

    Args:
        config: Config in which only `model.view_direction` is None.
        optimizer: Optimiser of the field.
        device: Device of the training.

    Returns:
        The decrease as a share of the error, and its standard error over the seeds.
    """
    return _gain(yaml.dump(config), yaml.dump(optimizer), str(device))


@cache
def _gain(config: str, optimizer: str, device: str) -> tuple[float, float]:
    without, with_direction = (
        np.array([_error(config, optimizer, device, kept, seed) for seed in range(SEEDS)]) for kept in (False, True)
    )
    gains = (without - with_direction) / without.mean()
    return float(gains.mean()), float(gains.std(ddof=1) / np.sqrt(SEEDS))


def _error(config: str, optimizer: str, device: str, view_direction: bool, seed: int) -> float:
    """Mean loss at held-out pixels after a short training on the other pixels."""
    short: EnerfPipelineConfig = yaml.load(config, Loader=yaml.Loader)
    short.model.view_direction = view_direction
    manager = short.datamanager
    manager.event_pairs = min(manager.event_pairs or PAIRS, PAIRS)
    manager.instant_pairs = min(manager.instant_pairs or 0, PAIRS)
    manager.silent_pairs = min(manager.silent_pairs or 0, PAIRS // 3)
    manager.train_num_rays_per_batch = min(manager.train_num_rays_per_batch or PAIRS, PAIRS)
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        pipeline: EnerfPipeline = short._target(short, device=device, test_mode="val")
        adam = yaml.load(optimizer, Loader=yaml.Loader).setup(params=pipeline.model.get_param_groups()["fields"])
        what = f"Probe {seed + 1} of {SEEDS} {'with' if view_direction else 'without'} the viewing direction"
        for _ in track(range(STEPS), what, console=CONSOLE, transient=True, disable=not CONSOLE.is_terminal):
            adam.zero_grad()
            torch.stack([*_losses(pipeline, held_out=False).values()]).sum().backward()
            adam.step()
        torch.manual_seed(1)
        pipeline.datamanager.generator.manual_seed(1)
        with torch.no_grad():
            scored = [_losses(pipeline, held_out=True) for _ in range(SCORED_BATCHES)]
    return float(np.mean([sum(float(losses[name]) for name in MEASURED if name in losses) for losses in scored]))


def _losses(pipeline: EnerfPipeline, held_out: bool) -> dict[str, torch.Tensor]:
    """The losses of the next batch, at its held-out pixels alone, or at its other pixels alone."""
    manager, model = pipeline.datamanager, pipeline.model
    batch = manager.next_batch(model.sensor)
    events, frames = batch.events, batch.frames
    if events is not None:
        events = events.subset((events.pixels % HELD_OUT_EVERY == 0) == held_out)
    if frames is not None:
        row_and_column = frames.indices[:, 1:].sum(dim=-1)
        frames = frames.subset((row_and_column % HELD_OUT_EVERY == 0) == held_out)
    batch = TrainBatch(events, frames)
    return model.get_loss_dict(model(manager.rays(batch, model.sensor)), batch)

"""Whether a part of the model helps on a scene: two short trainings, compared on pixels that neither learnt from."""

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
"""Trainings of each kind: early on, two that differ by their seed alone may be far apart."""

STEPS = 100
"""Steps of each training."""

PAIRS = 256
"""Pairs of events, and pixels of frames, of a step at most."""

HELD_OUT_EVERY = 8
"""Number of pixels of which one is kept from these trainings."""

SCORED_BATCHES = 16
"""Batches of held-out pixels by which they are compared."""


MEASURED = ("event_loss", "instant_loss", "frame_loss")
"""Losses that compare the field with what was recorded."""


def view_direction_gain(
    config: EnerfPipelineConfig, optimizer: OptimizerConfig, device: str | torch.device
) -> tuple[float, float]:
    """By which share the error at held-out pixels falls where brightness may depend on the viewing direction.

    Random numbers of the process stay as they were; of one config the answer is found once in a process.

    Args:
        config: With all but `model.view_direction` decided.
        optimizer: Of the field.
        device: To train on.

    Returns:
        Gain, and its standard error over the seeds.
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
    """Mean loss at held-out pixels, the same for either answer, after a short training on the others."""
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
        what = f"Probing gloss, {'with' if view_direction else 'without'} it ({seed + 1} of {SEEDS})"
        for _ in track(range(STEPS), what, console=CONSOLE, transient=True):
            adam.zero_grad()
            torch.stack([*_losses(pipeline, held_out=False).values()]).sum().backward()
            adam.step()
        torch.manual_seed(1)
        pipeline.datamanager.generator.manual_seed(1)
        with torch.no_grad():
            scored = [_losses(pipeline, held_out=True) for _ in range(SCORED_BATCHES)]
    return float(np.mean([sum(float(losses[name]) for name in MEASURED if name in losses) for losses in scored]))


def _losses(pipeline: EnerfPipeline, held_out: bool) -> dict[str, torch.Tensor]:
    """The losses of the next batch, of which only the held-out pixels are looked at, or only the others."""
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

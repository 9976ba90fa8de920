"""A recording of a tenth of a second, and runs of two steps on it, for tests."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import torch
from nerfstudio.scripts.train import _set_random_seed

from enerf_ns.method.config import enerf
from enerf_ns.method.trainer import EnerfTrainerConfig

WIDTH, HEIGHT = 32, 24

EVENTS = {"event_loss", "distortion_loss", "interlevel_loss"}
"""Losses of `small_config` that learns from events."""


def small_config(data: Path, output_dir: Path, method=enerf, **changes: Any) -> EnerfTrainerConfig:
    """A registered method with a small batch, a small field and few losses, and changes like `model__num_samples=8`."""
    config = copy.deepcopy(method.config)
    assert isinstance(config, EnerfTrainerConfig)
    config.data, config.output_dir = data, output_dir
    config.vis, config.timestamp = "tensorboard", "run"
    config.machine.device_type = "cpu"
    config.max_num_iterations = 2
    manager, model = config.pipeline.datamanager, config.pipeline.model
    manager.event_pairs = manager.train_num_rays_per_batch = 64
    manager.silent_pairs, manager.silence_ms = 0, 5.0
    model.opacity_loss_weight, model.level_loss_weight, model.distortion_loss_weight = 0.0, 0.0, 0.01
    model.edge_start = False
    model.log2_table_size, model.num_levels, model.sampling = 12, 4, model.sampling or "proposal"
    model.num_samples = model.num_proposal_samples = 16
    parts = {"data": manager, "model": model, "sensor": model.sensor}
    for name, value in changes.items():
        part, field = name.split("__")
        assert hasattr(parts[part], field)
        setattr(parts[part], field, value)
    return config


def set_up(config: EnerfTrainerConfig, local_rank: int = 0, world_size: int = 1) -> Any:
    """A trainer as `ns-train` makes it, set up, in place of a run that no checkpoint was stored of."""
    for file in config.output_dir.glob(f"*/{config.method_name}/{config.timestamp}/config.yml"):
        file.unlink()
    _set_random_seed(config.machine.seed)
    config.save_config()
    trainer = config.setup(local_rank=local_rank, world_size=world_size)
    trainer.setup()
    with trainer.train_lock:  # a viewer may render
        trainer.pipeline.train()
    return trainer


def check_two_steps(config: EnerfTrainerConfig, expected_losses: set[str]) -> Any:
    """Every loss is there and finite, and every parameter moves; the trainer."""
    trainer = set_up(config)
    before = {name: parameter.detach().clone() for name, parameter in trainer.pipeline.model.named_parameters()}
    for step in range(2):
        loss, losses, metrics = trainer.train_iteration(step)
        assert set(losses) == expected_losses
        assert loss.isfinite() and all(value.isfinite() for value in losses.values())
        torch.testing.assert_close(loss, sum(losses.values()))
        assert ("event_correlation" in metrics) == ("event_loss" in expected_losses)
        assert ("frame_psnr" in metrics) == ("frame_loss" in expected_losses)
    for name, parameter in trainer.pipeline.model.named_parameters():
        moved = (parameter != before[name]).any() or parameter.numel() == 0  # Nerfstudio keeps an empty one
        assert parameter.isfinite().all() and moved, name
    return trainer


SMALL: dict[str, Any] = {
    "max_num_iterations": 2,
    "timestamp": "run",
    "machine.device_type": "cpu",
    "pipeline.datamanager.event_pairs": 64,
    "pipeline.datamanager.silent_pairs": 0,
    "pipeline.model.log2_table_size": 12,
    "pipeline.model.num_levels": 4,
    "pipeline.model.sampling": "proposal",
    "pipeline.model.num_samples": 16,
    "pipeline.model.num_proposal_samples": 16,
}
"""What a run that takes seconds changes of the method, by the names of ns-train's flags."""

SMALL_BENCH: dict[str, Any] = {"budget": "2", "scale": 0.05, "rows": ("events", "uniform-samples")}
"""Settings of `enerf bench`: two rows of two steps each, on 32 x 24 pixels."""

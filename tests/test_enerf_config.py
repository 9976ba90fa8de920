"""The registered methods, and what Nerfstudio does with them."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from enerf_ns.enerf_config import DecayOverRunSchedulerConfig, FusedAdamOptimizerConfig, enerf, enerf_paper


@pytest.mark.parametrize("method", [enerf, enerf_paper])
def test_what_a_preset_may_fill_in_is_open(method: Any):
    manager, model = method.config.pipeline.datamanager, method.config.pipeline.model
    open_settings = (
        manager.event_pairs, manager.silent_pairs, manager.silence_ms, manager.train_num_rays_per_batch,
        manager.dataparser.held_out_every, manager.dataparser.time_range, manager.dataparser.box,
        manager.dataparser.depth_range, model.event_loss, model.no_event_loss_weight, model.no_event_margin,
        model.sensor.contrast_thresholds,
    )  # fmt: skip
    assert set(open_settings) == {None}
    assert not method.config.pipeline.resolution.choices


def test_the_paper_is_larger_in_every_way():
    tuned: Any = enerf.config
    paper: Any = enerf_paper.config
    assert paper.pipeline.defaults.event_pairs > tuned.pipeline.defaults.event_pairs
    assert paper.pipeline.model.num_samples > tuned.pipeline.model.num_samples
    assert paper.pipeline.model.log2_table_size > tuned.pipeline.model.log2_table_size
    assert paper.max_num_iterations > tuned.max_num_iterations


def test_the_optimizer_takes_the_steps_of_plain_adam():
    torch.manual_seed(0)
    one, other = (torch.nn.Parameter(torch.linspace(-1, 1, 50)) for _ in range(2))
    fused = FusedAdamOptimizerConfig(lr=0.01, eps=1e-15).setup([one])
    plain = torch.optim.Adam([other], lr=0.01, betas=(0.9, 0.99), eps=1e-15)
    for _ in range(5):
        for parameter, optimizer in ((one, fused), (other, plain)):
            optimizer.zero_grad()
            (parameter**4).sum().backward()
            optimizer.step()
    torch.testing.assert_close(one, other)


def test_the_learning_rate_falls_exponentially_over_the_run():
    parameter = torch.nn.Parameter(torch.zeros(1))
    optimizer = torch.optim.SGD([parameter], lr=0.1)
    scheduler = DecayOverRunSchedulerConfig(lr_final=0.001, max_steps=4).setup().get_scheduler(optimizer, 0.1)
    rates = []
    for _ in range(5):
        rates.append(float(optimizer.param_groups[0]["lr"]))
        optimizer.step()
        scheduler.step()
    assert rates == pytest.approx([0.1 * 0.01 ** (i / 4) for i in range(5)])

"""Steps that are larger than the memory."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest
import torch
from small_runs import set_up, small_config

from enerf_ns.method import memory
from enerf_ns.method.memory import StepCost, in_parts, kept_bytes, step_cost
from enerf_ns.method.trainer import EnerfTrainer


@pytest.fixture
def trainer(recording: Path, tmp_path: Path, one_thread) -> EnerfTrainer:
    return set_up(small_config(recording, tmp_path))


def gradients(trainer: EnerfTrainer, samples_at_once: int | None) -> dict[str, torch.Tensor]:
    """Losses and gradients of one step, whose batch and jitter are always the same."""
    pipeline = trainer.pipeline
    pipeline.model.samples_at_once = samples_at_once
    pipeline.datamanager.generator.manual_seed(0)
    torch.manual_seed(0)
    pipeline.train()
    losses = pipeline.get_train_loss_dict(0)[1]
    names = [name for name, _ in pipeline.model.named_parameters()]
    found = torch.autograd.grad(sum(losses.values()), [*pipeline.model.parameters()], allow_unused=True)  # type: ignore
    given = {name: gradient for name, gradient in zip(names, found, strict=True) if gradient is not None}
    return {name: loss.detach() for name, loss in losses.items()} | given


@pytest.mark.parametrize("rays_at_once", [1, 7, 10**6])
def test_parts_have_the_losses_and_gradients_of_the_whole(trainer: EnerfTrainer, rays_at_once: int):
    whole = gradients(trainer, None)
    parts = gradients(trainer, rays_at_once * trainer.pipeline.model.config.num_samples)
    assert whole.keys() == parts.keys() and any("grid.table" in name for name in whole)
    for name, value in whole.items():
        # of a young field's rays, gradients nearly cancel, so that float32 keeps four digits of their sum
        torch.testing.assert_close(parts[name], value, rtol=1e-6, atol=5e-4 * float(value.abs().max()))


def test_parts_show_the_picture_of_the_whole(trainer: EnerfTrainer):
    pipeline = trainer.pipeline
    pipeline.eval()
    pipeline.model.field.geometry.grid.backend = "torch"  # with Numba no picture needs memory
    camera = pipeline.datamanager.eval_dataset.cameras[:1]
    whole = pipeline.model.get_outputs_for_camera(camera)
    pipeline.model.samples_at_once = 5 * pipeline.model.config.num_samples
    parts = pipeline.model.get_outputs_for_camera(camera)
    assert set(parts) == set(whole)
    for name in whole:
        torch.testing.assert_close(parts[name], whole[name], rtol=1e-5, atol=1e-5)


def test_parts_keep_what_their_samples_say_and_no_more(trainer: EnerfTrainer):
    model = trainer.pipeline.model
    rays = trainer.pipeline.datamanager.rays(trainer.pipeline.datamanager.next_batch(model.sensor), model.sensor)
    samples = model.train().get_outputs(rays)["ray_samples_list"][-1]
    whole = kept_bytes(lambda: model.field(samples), model)
    parts = kept_bytes(lambda: in_parts(model.field, samples, 10 * samples.shape[1]), model)
    assert parts < whole / 2


def test_what_a_step_keeps_is_foretold(trainer: EnerfTrainer):
    pipeline = trainer.pipeline
    rays, samples = pipeline.datamanager.get_train_rays_per_batch(), pipeline.model.config.num_samples
    before = torch.get_rng_state()
    cost = step_cost(pipeline.model, rays, samples)
    assert torch.equal(before, torch.get_rng_state())
    assert all(parameter.grad is None for parameter in pipeline.model.parameters())
    kept = kept_bytes(lambda: pipeline.get_train_loss_dict(0)[1], pipeline.model)
    assert 0.6 * kept < cost.bytes < 1.4 * kept
    assert 0 < cost.field_bytes < cost.bytes and cost.num_samples == rays * samples and cost.seconds > 0


@pytest.mark.parametrize(
    "free, expected",
    [
        (300_000, None),  # twice the bytes, and a quarter
        (200_000, 1000 * (160_000 - 40_000) // 160_000),
        (50_001, 0),
        (100, 0),
    ],
)
def test_samples_that_fit(free: int, expected: int | None):
    assert StepCost(100_000, 80_000, 1.0, 1000).samples_at_once(free) == expected


def test_training_says_that_it_goes_in_parts_or_that_nothing_fits(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr("enerf_ns.method.pipeline.SMALL_STEP", 0)
    config = small_config(recording, tmp_path, model__sampling="uniform")
    set_up(config)
    assert "free" not in capsys.readouterr().out

    needed = step_cost(set_up(config).pipeline.model, config.pipeline.model.eval_num_rays_per_chunk, 16).bytes
    for free, says in ((int(1.5 * needed), "samples at a time"), (1000, "give fewer with")):
        monkeypatch.setattr(psutil, "virtual_memory", lambda free=free: SimpleNamespace(available=free, total=2**34))
        try:
            trainer = set_up(small_config(recording, tmp_path / str(free), model__sampling="uniform"))
            assert trainer.pipeline.model.samples_at_once
        except SystemExit as end:
            print(end.code)
        printed = " ".join(capsys.readouterr().out.split())
        assert says in printed and "GB are free" in printed
    assert memory.free_bytes("cpu") == 1000

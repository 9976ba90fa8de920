"""Steps that are not finite, and runs that learn nothing."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import torch
from small_runs import set_up, small_config
from torch import Tensor
from torch.amp.grad_scaler import GradScaler

from enerf_ns.method import trainer as enerf_trainer
from enerf_ns.method.guarded_steps import keep_batch
from enerf_ns.supervision.event_supervision import EVENT_LOSSES


def nan_loss(change: Tensor, measured: Tensor, threshold: Any) -> Tensor:
    return (change * torch.nan).sum()


def infinite_loss(change: Tensor, measured: Tensor, threshold: Any) -> Tensor:
    return change.sum() + torch.inf


def nan_gradient(change: Tensor, measured: Tensor, threshold: Any) -> Tensor:
    return torch.sqrt((change - change.detach()) ** 2).sum()


def infinite_gradient(change: Tensor, measured: Tensor, threshold: Any) -> Tensor:
    return (change - change.detach()).sum() * 1e30


BROKEN = {
    "NaN loss": (nan_loss, "event_loss"),
    "infinite loss": (infinite_loss, "event_loss"),
    "NaN gradient": (nan_gradient, "the gradient of "),
    "gradient whose square is infinite": (infinite_gradient, "the gradient of "),
}
"""Losses, and what is to be named of them."""


@pytest.fixture
def breaking() -> Iterator[Callable[[Any, set[int], Any], Any]]:
    """A trainer whose event loss is another at some steps."""
    sound = EVENT_LOSSES["squared"]

    def broken(config: Any, steps: set[int], loss: Any) -> Any:
        config.pipeline.model.event_loss = "squared"
        trainer = set_up(config)
        count = iter(range(1000))
        EVENT_LOSSES["squared"] = lambda *arguments: (loss if next(count) in steps else sound)(*arguments)
        return trainer

    yield broken
    EVENT_LOSSES["squared"] = sound


def learnt(trainer: Any) -> dict[str, Any]:
    """Parameters and the state of the optimisers, which begin with zeros."""
    optimizers = {}
    for name, one in trainer.optimizers.optimizers.items():
        for number, parameter in enumerate(trainer.optimizers.parameters[name]):
            zeros = {"step": torch.tensor(0.0)} | dict.fromkeys(("exp_avg", "exp_avg_sq"), torch.zeros_like(parameter))
            optimizers[f"{name} {number}"] = one.state.get(parameter, zeros)
    return copy.deepcopy({"parameters": dict(trainer.pipeline.state_dict()), **optimizers})


def tensors(state: Any) -> list[Tensor]:
    if isinstance(state, dict):
        return [tensor for value in state.values() for tensor in tensors(value)]
    return [state]


def equal(one: Any, other: Any) -> bool:
    return all(torch.equal(a, b) for a, b in zip(tensors(one), tensors(other), strict=True))


@pytest.mark.parametrize("name", BROKEN)
def test_a_step_that_is_not_finite_changes_nothing(recording: Path, tmp_path: Path, breaking, capsys, name: str):
    """Not the first, nor one later; the learning rate goes on with the number of the step; the batch is kept."""
    config = small_config(recording, tmp_path)
    config.max_num_iterations = 5
    loss, culprit = BROKEN[name]
    trainer = breaking(config, {0, 2}, loss)
    states, rates = [learnt(trainer)], []
    for step in range(5):
        rates.append(trainer.optimizers.optimizers["fields"].param_groups[0]["lr"])
        trainer.train_iteration(step)
        states.append(learnt(trainer))
    same = [equal(a, b) for a, b in pairwise(states)]
    assert same == [True, False, True, False, False]
    assert all(tensor.isfinite().all() for tensor in tensors(states[-1]))
    assert rates == pytest.approx([rates[0] * 0.1 ** (step / 5) for step in range(5)])
    assert trainer.num_skipped == 2
    (file,) = trainer.base_dir.glob("skipped-*")
    assert file.name == "skipped-step-000000000.pt"
    said = capsys.readouterr().out
    assert f"Step 0 is left out, since {culprit}" in said and str(file) in said
    kept = torch.load(file, weights_only=True)
    assert kept["step"] == 0 and set(kept["losses"]) == {"event_loss", "distortion_loss", "interlevel_loss"}
    assert kept["events"].pop("num_silent") == kept["events"].pop("num_any") == 0 and kept["events"].pop(
        "starts_at_events"
    )
    assert all(kept["events"].pop(name) is None for name in ("rates", "ahead", "slopes", "links"))
    assert {len(column) for column in kept["events"].values()} == {64}
    assert math.isfinite(kept["losses"]["event_loss"]) == ("gradient" in name)


@pytest.mark.parametrize("name", BROKEN)
def test_after_some_in_a_row_training_stops_and_the_last_checkpoint_stays(
    recording: Path, tmp_path: Path, breaking, capsys, name: str
):
    config = small_config(recording, tmp_path)
    config.max_num_iterations, config.steps_per_save = 20, 2
    loss, culprit = BROKEN[name]
    trainer = breaking(config, {3, *range(5, 30)}, loss)
    with pytest.raises(
        SystemExit, match=rf"^enerf: Training stopped at step 9, since {culprit}.* is not finite, 5 steps"
    ):
        trainer.train()
    assert "Training is done" not in capsys.readouterr().out
    assert trainer.num_skipped == 6
    assert (trainer.checkpoint_dir / "step-000000004.ckpt").exists()


def test_a_batch_that_is_kept_has_the_links_of_its_chains(recording: Path, tmp_path: Path):
    pipeline = set_up(small_config(recording, tmp_path, data__instant_pairs=8)).pipeline
    pipeline.get_train_loss_dict(0)
    keep_batch(pipeline.last_step, 0, tmp_path / "batch.pt")
    kept = torch.load(tmp_path / "batch.pt", weights_only=True)["events"]
    assert len(kept["pixels"]) == 64 + 8 and torch.equal(
        kept["links"]["pixels"], kept["pixels"][[*range(32), *range(64, 68)]]
    )


def test_steps_that_were_left_out_are_counted_at_the_end(recording: Path, tmp_path: Path, breaking, capsys):
    config = small_config(recording, tmp_path)
    config.max_num_iterations = 8
    breaking(config, {1, 2, 3, 4, 6}, nan_loss).train()
    assert "5 steps were left out, since losses or gradients were not finite." in capsys.readouterr().out


def test_a_sound_run_leaves_nothing_out(recording: Path, tmp_path: Path, capsys):
    trainer = set_up(small_config(recording, tmp_path))
    trainer.train()
    assert trainer.num_skipped == 0 and not list(trainer.base_dir.glob("skipped-*"))
    assert "left out, since" not in capsys.readouterr().out


def test_an_optimiser_that_a_checkpoint_makes_another_leaves_out_steps(recording: Path, tmp_path: Path, breaking):
    """A checkpoint of Adam in a loop states so, and its settings replace those of the config."""
    trainer = breaking(small_config(recording, tmp_path), {1}, nan_loss)
    state = trainer.optimizers.optimizers["fields"].state_dict()
    state["param_groups"][0]["fused"] = None
    trainer.optimizers.load_optimizers({"fields": state})
    states = [learnt(trainer)]
    for step in range(2):
        trainer.train_iteration(step)
        states.append(learnt(trainer))
    assert [equal(a, b) for a, b in pairwise(states)] == [False, True]


def test_gradients_that_are_gathered_over_steps_begin_again(recording: Path, tmp_path: Path, breaking):
    config = small_config(recording, tmp_path)
    config.gradient_accumulation_steps = {"fields": 2}
    trainer = breaking(config, {0}, nan_loss)
    before = learnt(trainer)["parameters"]
    trainer.train_iteration(0)
    assert all(parameter.grad is None for parameter in trainer.pipeline.parameters())
    trainer.train_iteration(1)
    after = learnt(trainer)["parameters"]
    assert not equal(before, after) and all(value.isfinite().all() for value in after.values())


def test_a_gradient_scaler_lowers_its_scale_by_itself(recording: Path, tmp_path: Path, breaking):
    """Gradients that overflow under its scale are no fault; a loss that is not finite is one."""
    config = small_config(recording, tmp_path)
    trainer = breaking(config, {0, 2}, lambda change, *_: (change - change.detach()).sum() * 1e37)
    trainer.grad_scaler = GradScaler("cpu", init_scale=2.0**16)
    states = [learnt(trainer)["parameters"]]
    for step in range(3):
        trainer.train_iteration(step)
        states.append(learnt(trainer)["parameters"])
    assert [equal(a, b) for a, b in pairwise(states)] == [True, False, True]
    assert trainer.grad_scaler.get_scale() == 2.0**14 and trainer.num_skipped == 0
    trainer = breaking(config, {1}, infinite_loss)
    trainer.grad_scaler = GradScaler("cpu", init_scale=2.0**16)
    trainer.train_iteration(0)
    before = learnt(trainer)["parameters"]
    trainer.train_iteration(1)
    assert equal(before, learnt(trainer)["parameters"]) and trainer.num_skipped == 1


@pytest.mark.parametrize(
    ("changes", "rate", "learns"),
    [
        ({}, None, True),
        ({"model__sampling": "uniform"}, None, True),
        ({"data__supervision": "frames"}, None, True),
        ({}, 1.0, False),
    ],
)
def test_a_run_that_learns_nothing_says_so_once(
    recording: Path, tmp_path: Path, capsys, monkeypatch, changes: dict, rate: float | None, learns: bool
):
    monkeypatch.setattr(enerf_trainer, "LEARNING_CHECKED_FROM", 60)
    monkeypatch.setattr(enerf_trainer, "LEARNING_CHECKED_EVERY", 20)
    config = small_config(recording, tmp_path, **changes)
    config.max_num_iterations = 110
    if rate is not None:
        config.optimizers["fields"]["optimizer"].lr = rate
    trainer = set_up(config)
    for step in range(110):
        trainer.train_iteration(step)
    said = capsys.readouterr().out
    assert ("Nothing is learnt at step 60" in said) == (not learns)
    assert said.count("rendered changes of log brightness are") == (not learns)


def test_a_field_without_density_is_told(recording: Path, tmp_path: Path, capsys):
    trainer = set_up(small_config(recording, tmp_path))
    torch.nn.init.constant_(trainer.pipeline.model.field.geometry.network.layers[-1].bias, -30.0)
    trainer.train_iteration(0)
    trainer._look_at_learning(0)
    trainer._look_at_learning(0)
    said = capsys.readouterr().out
    assert said.count("rays meet no surface, their mean accumulation is") == 1

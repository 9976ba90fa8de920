"""Two processes that train one field, as Nerfstudio's --machine.num-devices starts them; here on a CPU, with gloo."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
import torch.distributed
from small_runs import set_up, small_config
from torch.multiprocessing.spawn import spawn

from enerf_ns.supervision.balance import ErrorBalance

STEPS = 4


def two_process_config(recording: Path, folder: Path) -> Any:
    config = small_config(
        recording,
        folder,
        data__supervision="events+frames",
        data__silent_pairs=32,
        model__frame_loss_weight=10.0,  # a weight by errors would be that of both batches
        model__learn_exposure=True,
        sensor__learn_leak_rate=True,
    )
    config.max_num_iterations = STEPS
    return config


def one_of_two(rank: int, recording: Path, folder: Path) -> None:
    """The work of one process for both tests: starting two costs more than all else here."""
    torch.set_num_threads(1)
    torch.distributed.init_process_group("gloo", f"file://{folder / 'meet'}", rank=rank, world_size=2)
    weigh_one_of_two(rank, folder)
    train_one_of_two(rank, recording, folder)
    torch.distributed.destroy_process_group()


@pytest.fixture(scope="module")
def both(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder with what two processes have stored."""
    folder = tmp_path_factory.mktemp("both")
    spawn(one_of_two, (recording, folder), nprocs=2)
    return folder


def train_one_of_two(rank: int, recording: Path, folder: Path) -> None:
    """Stores its losses, and the field after each step."""
    config = two_process_config(recording, folder / f"process-{rank}")
    config.machine.seed += rank  # as Nerfstudio does
    trainer = set_up(config, rank, 2)
    found = []
    for step in range(STEPS):
        loss, _, _ = trainer.train_iteration(step)
        drawn = trainer.pipeline.last_step.batch.events.pixels
        field = {name: value.clone() for name, value in trainer.pipeline.model.state_dict().items()}
        found.append({"loss": loss.detach(), "drawn": drawn, "field": field})
    torch.save(found, folder / f"{rank}.pt")


@pytest.mark.slow
def test_two_processes_train_as_one_would_with_both_batches(recording: Path, both: Path, tmp_path: Path) -> None:
    one, other = (torch.load(both / f"{rank}.pt") for rank in (0, 1))
    trainers, states = [], []
    for rank in (0, 1):
        config = two_process_config(recording, tmp_path / f"alone-{rank}")
        config.machine.seed += rank
        trainers.append(set_up(config))
        states.append(torch.get_rng_state())
    first, second = trainers
    second.pipeline.model.load_state_dict(first.pipeline.model.state_dict())
    for step in range(STEPS):
        assert not torch.equal(one[step]["drawn"], other[step]["drawn"])
        for rank, trainer in enumerate(trainers):
            torch.set_rng_state(states[rank])
            trainer.optimizers.zero_grad_all()
            _, losses, _ = trainer.pipeline.get_train_loss_dict(step)
            loss = torch.stack([*losses.values()]).sum()
            loss.backward()
            states[rank] = torch.get_rng_state()
            torch.testing.assert_close((one, other)[rank][step]["loss"], loss.detach(), rtol=1e-5, atol=0)
        pairs = zip(first.pipeline.model.parameters(), second.pipeline.model.parameters(), strict=True)
        for mine, theirs in pairs:
            if mine.grad is not None:
                assert theirs.grad is not None
                mine.grad.add_(theirs.grad).mul_(0.5)
        first.optimizers.optimizer_scaler_step_some(first.grad_scaler, ["fields", "leak_rate"])
        first.optimizers.scheduler_step_all(step)
        field = first.pipeline.model.state_dict()
        second.pipeline.model.load_state_dict(field)
        for name, value in field.items():
            assert torch.equal(one[step]["field"][name], other[step]["field"][name]), name
            torch.testing.assert_close(one[step]["field"][name], value, rtol=1e-5, atol=1e-7)


def weigh_one_of_two(rank: int, folder: Path) -> None:
    """Stores the weight that it finds, and the errors that it remembers."""
    balance = ErrorBalance()
    weight = balance(torch.tensor(1.0 + 2.0 * rank), 100, torch.tensor(0.1 + 0.3 * rank), 50)
    if rank == 0:  # which alone evaluates, and must not wait for the other
        assert balance.eval()(torch.tensor(9.0), 1, torch.tensor(9.0), 1) == 2.0 / 0.25
    torch.save((weight, balance.errors), folder / f"weight-{rank}.pt")


@pytest.mark.slow
def test_two_processes_weigh_frames_by_the_errors_of_both(both: Path) -> None:
    one, other = (torch.load(both / f"weight-{rank}.pt") for rank in (0, 1))
    torch.testing.assert_close(one, other, rtol=0, atol=0)
    torch.testing.assert_close(one[0], torch.tensor(50 / 100 * 2.0 / 0.25))

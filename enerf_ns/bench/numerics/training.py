"""Cases of training: NaN, senseless events, steps of one pair, interrupted runs, damaged checkpoints."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import torch
from nerfstudio.engine.callbacks import TrainingCallbackLocation
from torch import Tensor

from enerf_ns.bench.numerics.case import case
from enerf_ns.bench.numerics.small_run import quiet, small_config, small_trainer
from enerf_ns.events.batch import EventBatch, TrainBatch
from enerf_ns.method.checkpoints import checkpoint_path, newest_checkpoint
from enerf_ns.method.runs import set_up, train


def _state(trainer: Any) -> dict[str, Tensor]:
    """All parameters, and the moments of the optimisers."""
    state = {name: value.detach().clone() for name, value in trainer.pipeline.model.named_parameters()}
    for group, optimizer in trainer.optimizers.optimizers.items():
        for number, values in optimizer.state_dict()["state"].items():
            state |= {f"{group} {number} {name}": torch.as_tensor(value).clone() for name, value in values.items()}
    return state


def _different(first: Mapping[str, Tensor], second: Mapping[str, Tensor]) -> float:
    """Number of values that differ between two states."""
    if first.keys() != second.keys():
        return float(len(first.keys() ^ second.keys()))
    return float(sum(int((first[name] != second[name]).sum()) for name in first))


def _changed_by(spoil: Callable[[Any], None]) -> float:
    """Number of values that a corrupted step changes, plus values that are not finite after the next, normal step."""
    trainer: Any = small_trainer()
    with quiet():
        trainer.train_iteration(0)
        before = _state(trainer)
        manager = trainer.pipeline.datamanager
        spoil(manager)
        trainer.train_iteration(1)
        changed = _different(before, _state(trainer))
        for name in ("next_batch", "rays"):
            vars(manager).pop(name, None)
        trainer.train_iteration(2)
    after = _state(trainer)
    stuck = all(torch.equal(before[name], after[name]) for name in before)
    return changed + sum(int((~value.isfinite()).sum()) for value in after.values()) + int(stuck)


@case("one NaN among the counts of a step", "a step that changes nothing, and training goes on", 0, "numbers")
def nan_count() -> float:
    def spoil(manager: Any) -> None:
        drawn = manager.next_batch

        def next_batch(sensor: Any) -> TrainBatch:
            batch = drawn(sensor)
            on = batch.events.on.float()
            on[0] = torch.nan
            return TrainBatch(replace(batch.events, on=on), batch.frames)

        manager.next_batch = next_batch

    return _changed_by(spoil)


@case("one NaN among the origins of a step", "a step that changes nothing, and training goes on", 0, "numbers")
def nan_origin() -> float:
    def spoil(manager: Any) -> None:
        made = manager.rays

        def rays(batch: TrainBatch, sensor: Any) -> Any:
            bundle = made(batch, sensor)
            bundle.origins[0, 0] = torch.nan
            return bundle

        manager.rays = rays

    return _changed_by(spoil)


def _not_finite_after(
    steps: int, changes: Mapping[str, Any], of_events: Callable[[EventBatch], EventBatch] | None = None
) -> float:
    """Number of losses that are not finite, plus skipped steps, in a short training on optionally replaced events."""
    trainer: Any = small_trainer(changes)
    manager = trainer.pipeline.datamanager
    if of_events is not None:
        drawn = manager.next_batch
        manager.next_batch = lambda sensor: TrainBatch(of_events((batch := drawn(sensor)).events), batch.frames)
    wrong = 0
    with quiet():
        for step in range(steps):
            _, losses, _ = trainer.train_iteration(step)
            wrong += sum(int(not loss.isfinite()) for loss in losses.values())
    return float(wrong + trainer.num_skipped)


def _noise(events: EventBatch) -> EventBatch:
    on, off = torch.randint(0, 9, (2, len(events)))
    on[events.silent] = off[events.silent] = 0
    return replace(events, on=on, off=off)


@case("events that are white noise", "finite losses", 0, "steps")
def white_noise() -> float:
    return _not_finite_after(60, {}, _noise)


@case("events of one polarity", "finite losses", 0, "steps")
def one_polarity() -> float:
    return _not_finite_after(60, {}, lambda events: replace(events, on=events.on + events.off, off=0 * events.off))


@case("thresholds ten times too large, and too small", "finite losses", 0, "steps")
def thresholds_off() -> float:
    name = "pipeline.model.sensor.contrast_thresholds"
    return sum(_not_finite_after(40, {name: (value, value)}) for value in (0.025, 2.5))


@case("one pair a step", "finite losses", 0, "steps")
def one_pair() -> float:
    return _not_finite_after(60, {"pipeline.datamanager.event_pairs": 1, "pipeline.datamanager.silent_pairs": 1})


@case("a learning rate of 1", "finite losses, and a warning that nothing is learnt", 0, "faults")
def collapse() -> float:
    config = small_config({"max_num_iterations": 350})
    config.optimizers["fields"]["optimizer"].lr = 1.0
    with quiet() as printed:
        run = train(config)
    finite = all(value.isfinite().all() for value in run.pipeline.parameters())
    return int(not finite) + int("Nothing is learnt" not in printed[0])


@case("a run cut in two after 30 of 60 steps", "the weights and moments of an uninterrupted run", 0, "numbers")
def resumed() -> float:
    with quiet():
        whole: Any = small_trainer()
        for step in range(60):
            _step(whole, step)
        first: Any = small_trainer()
        for step in range(30):
            _step(first, step)
        first.save_checkpoint(29)
        config = small_config({"max_num_iterations": 60})
        config.load_dir = first.checkpoint_dir
        second: Any = set_up(config)
        for step in range(30, 60):
            _step(second, step)
    return _different(_state(whole), _state(second))


@case("a newest checkpoint cut short, or with one byte changed", "the one before it is loaded", 0, "wrong answers")
def damaged_checkpoint() -> float:
    with quiet():
        trainer: Any = small_trainer({"save_only_latest_checkpoint": False})
        for step in (0, 1):
            trainer.train_iteration(step)
            trainer.save_checkpoint(step)
        before, newest = (checkpoint_path(trainer.checkpoint_dir, step) for step in (0, 1))
        content = newest.read_bytes()
        wrong = int(newest_checkpoint(trainer.checkpoint_dir) != newest)
        middle = len(content) // 2
        for damaged in (content[:middle], content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :]):
            newest.write_bytes(damaged)
            wrong += int(newest_checkpoint(trainer.checkpoint_dir) != before)
    return wrong


def _step(trainer: Any, step: int) -> None:
    trainer.train_iteration(step)
    for callback in trainer.callbacks:  # those of the end of a training would evaluate the run
        callback.run_callback_at_location(step, TrainingCallbackLocation.AFTER_TRAIN_ITERATION)

"""Batches by the time that a step takes, as a closed form and as measured."""

from __future__ import annotations

from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest
import torch
from small_runs import small_config

from enerf_ns.choices.resolver import resolve
from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.method.config import enerf, enerf_paper
from enerf_ns.method.runs import set_up
from enerf_ns.method.throughput import LARGEST_FACTOR, largest_factor, seconds_of_step


@pytest.mark.parametrize(
    ("fixed", "each", "expected"),
    [(1.0, 0.0, LARGEST_FACTOR), (0.0, 1.0, 1), (1.0, 1.0, 2), (10.0, 1.0, 4), (9.0, 1.0, 4), (15.0, 1.0, 8)],
)
def test_the_largest_batch_takes_hardly_longer_than_the_smallest(fixed: float, each: float, expected: int):
    """fixed + each * 2^n <= 1.5 (fixed + each)."""
    assert largest_factor(lambda factor: fixed + each * factor) == expected


def test_timing_a_step_changes_nothing(recording: Path, tmp_path: Path):
    model = set_up(small_config(recording, tmp_path)).pipeline.model
    before = {name: value.clone() for name, value in model.state_dict().items()}
    state = torch.get_rng_state()
    assert seconds_of_step(model, 64) > 0.0
    assert torch.equal(torch.get_rng_state(), state)
    for name, value in model.state_dict().items():
        assert torch.equal(value, before[name])


@pytest.mark.parametrize(
    ("changes", "expected"),
    [({}, (8, 8)), ({"event_pairs": 100}, (None, 1)), ({"silent_pairs": 0}, (1, 1))],
    ids=["all open", "pairs set", "silent pairs set"],
)
def test_only_what_nobody_set_is_larger(recording: Path, changes: dict[str, Any], expected: tuple):
    config: Any = deepcopy(enerf.config.pipeline)
    for name, value in changes.items():
        setattr(config.datamanager, name, value)
    config.datamanager.dataparser.data = recording
    read = read_recording(recording)
    usual, larger = resolve(config, read), resolve(config, read, batch_factor=lambda filled: 8)
    for name, factor in zip(("event_pairs", "instant_pairs"), expected, strict=True):
        name = f"datamanager.{name}"
        assert larger.values.get(name) == (None if factor is None else factor * usual.values[name])
    assert [choice.part for choice in larger.choices if choice.kept].count("larger batch") == (8 in expected)


def test_the_batch_of_the_paper_is_what_it_is(recording: Path):
    config: Any = deepcopy(enerf_paper.config.pipeline)
    config.datamanager.dataparser.data = recording
    assert (
        resolve(config, read_recording(recording), batch_factor=lambda filled: 8).values["datamanager.event_pairs"]
        == config.defaults.event_pairs
    )

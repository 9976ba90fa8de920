"""Losses and metrics of a batch against loops over its pairs."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from enerf_ns.events.batch import EventBatch
from enerf_ns.sensor.part import GREY
from enerf_ns.sensor.sensor_model import SensorModel, SensorModelConfig
from enerf_ns.supervision.event_supervision import EVENT_LOSSES, EventSupervision, brightness_change

ON, OFF, WIDTH = 0.2, 0.4, 4
RANDOM = torch.Generator().manual_seed(0)
START, END = (torch.rand(12, 3, generator=RANDOM) for _ in range(2))


def sensor(pattern: str = GREY) -> SensorModel:
    return SensorModelConfig(
        contrast_thresholds=(ON, OFF), response="linlog", refractory_period_ns=0, bayer_pattern=pattern, width=WIDTH
    ).setup()


def batch(silent: list[bool]) -> EventBatch:
    generator = torch.Generator().manual_seed(1)
    fired = ~torch.tensor(silent)
    on, off = (torch.randint(1, 4, (12,), generator=generator) * fired for _ in range(2))
    pixels = torch.randint(16, (12,), generator=generator)
    return EventBatch(pixels, torch.arange(12), torch.arange(12) + 5, on, off, num_silent=sum(silent))


SOME = [False] * 8 + [True] * 4


def level(rgb: torch.Tensor, pixel: int, pattern: str) -> float:
    """What a pixel compares, one number after the other."""
    red, green, blue = rgb.tolist()
    seen = 0.299 * red + 0.587 * green + 0.114 * blue
    if pattern != GREY:
        y, x = divmod(pixel, WIDTH)
        seen = {"R": red, "G": green, "B": blue}[pattern[2 * (y % 2) + x % 2]]
    grey = 255 * seen
    return grey * math.log(20) / 20 if grey < 20 else math.log(grey)


def changes(pairs: EventBatch, pattern: str) -> tuple[list[float], list[float]]:
    predicted = [level(END[i], p, pattern) - level(START[i], p, pattern) for i, p in enumerate(pairs.pixels.tolist())]
    return predicted, [ON * a - OFF * b for a, b in zip(pairs.on.tolist(), pairs.off.tolist(), strict=True)]


@pytest.mark.parametrize("pattern", [GREY, "RGGB"])
@pytest.mark.parametrize("silent", [[False] * 12, SOME, [False] + [True] * 11, [True] * 12])
@pytest.mark.parametrize("name", ["huber", "squared", "normalised"])
def test_losses_are_those_of_a_loop(name: str, silent: list[bool], pattern: str):
    pairs = batch(silent)
    losses = EventSupervision(name, 2.0, 0.5, 0.5).losses(START, END, pairs, sensor(pattern))
    predicted, measured = changes(pairs, pattern)
    mean = (ON + OFF) / 2
    fired = [i for i in range(12) if not silent[i]]
    quiet = [i for i in range(12) if silent[i]]
    assert ("event_loss" in losses) == bool(fired) and ("no_event_loss" in losses) == bool(quiet)
    if fired:
        errors = [(predicted[i] - measured[i]) / mean for i in fired]
        if name == "squared":
            expected = sum(error**2 for error in errors) / len(fired)
        elif name == "huber":
            expected = sum(e**2 if abs(e) <= 1 else 2 * abs(e) - 1 for e in errors) / len(fired)
        else:
            of_predicted, of_measured = (math.sqrt(sum(x[i] ** 2 for i in fired)) for x in (predicted, measured))
            expected = sum((predicted[i] / of_predicted - measured[i] / of_measured) ** 2 for i in fired)
        assert losses["event_loss"].item() == pytest.approx(2.0 * expected, rel=1e-5)
    if quiet:
        beyond = [max(predicted[i] - 0.5 * ON, 0) + max(-predicted[i] - 0.5 * OFF, 0) for i in quiet]
        assert losses["no_event_loss"].item() == pytest.approx(0.5 * sum(beyond) / len(quiet) / mean, rel=1e-5)


def test_the_correlation_is_that_of_the_pairs_with_events():
    pairs = batch(SOME)
    metrics = EventSupervision("huber", 1.0, 1.0, 0.0).metrics(START, END, pairs, sensor())
    predicted, measured = changes(pairs, GREY)
    expected = np.corrcoef(predicted[:8], measured[:8])[0, 1]
    assert metrics["event_correlation"].item() == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("channels", [1, 3])
def test_gradients_reach_both_instants(channels: int):
    start, end = (shown[:, :channels].double().requires_grad_() for shown in (START.clone(), END.clone()))
    supervision = EventSupervision("squared", 1.0, 1.0, 0.0)

    def total(start: torch.Tensor, end: torch.Tensor) -> Any:
        return sum(supervision.losses(start, end, batch(SOME), sensor()).values())

    assert torch.autograd.gradcheck(total, (start, end), eps=1e-7, atol=1e-4)


def test_a_perfect_render_costs_nothing():
    pairs = batch([False] * 12)
    sensed = sensor()
    measured = sensed.measured_change(pairs)
    start = torch.full((12, 1), 0.3)
    end = sensed.response.inverse(sensed.response(start) + measured[:, None])
    torch.testing.assert_close(brightness_change(start, end, pairs, sensed), measured, rtol=0, atol=1e-5)
    for name in EVENT_LOSSES:
        loss = EventSupervision(name, 1.0, 1.0, 0.0).losses(start, end, pairs, sensed)["event_loss"]
        assert loss.item() == pytest.approx(0.0, abs=1e-8)


@pytest.mark.parametrize("name", ["huber", "squared", "normalised"])
def test_pairs_of_any_instants_have_a_loss_of_their_own_that_is_formed_alike(name: str):
    pairs = replace(batch(SOME), num_any=5)
    supervision = EventSupervision(name, 2.0, 0.5, 0.5)
    losses = supervision.losses(START, END, pairs, sensor())
    for part, loss in ((pairs.of_events, "event_loss"), (pairs.of_any, "instant_loss")):
        alone = pairs.subset(torch.isin(torch.arange(12), torch.arange(12)[part]))
        alone = replace(alone, num_any=0)
        expected = supervision.losses(START[part], END[part], alone, sensor())["event_loss"]
        torch.testing.assert_close(losses[loss], expected)
    assert losses["no_event_loss"] > 0 and len(losses) == 3


@pytest.mark.parametrize("pattern", [GREY, "RGGB"])
@pytest.mark.parametrize("name", ["huber", "squared", "normalised"])
def test_all_six_changes_of_a_chain_count_alike(name: str, pattern: str):
    """The batch: two chains and a pair of events, then a chain of any instants and a pair, then silent pairs. Changes
    between instants of two pairs are written down one by one."""
    pairs = replace(batch([False] * 8 + [True] * 4), num_any=3)
    pixels = pairs.pixels.clone()
    pixels[2:4], pixels[6] = pixels[:2], pixels[5]
    pairs = replace(pairs, pixels=pixels)
    between = {0: (2, 3, 1), 1: (3, 0, 2), 5: (6, 1, 4)}  # of the first pair of each chain: its last, on and off events
    rows = [[int(pixels[first]), 0, 0, on, off] for first, (_, on, off) in between.items()]
    link, start, end, on, off = torch.tensor(rows).T
    links = EventBatch(link, start, end, on, off, num_any=1)
    supervision = EventSupervision(name, 2.0, 0.5, 0.5)
    losses = supervision.losses(START, END, replace(pairs, links=links), sensor(pattern))

    predicted, measured = changes(pairs, pattern)
    every: dict[str, list[tuple[float, float]]] = {"event_loss": [], "instant_loss": []}
    for i in range(8):
        every["event_loss" if i < 5 else "instant_loss"].append((predicted[i], measured[i]))
    for first, (last, on, off) in between.items():
        pixel, reported = int(pixels[first]), ON * on - OFF * off
        seen = [level(x[i], pixel, pattern) for i in (first, last) for x in (START, END)]
        told = [0.0, measured[first], measured[first] + reported, measured[first] + reported + measured[last]]
        for one, other in ((0, 2), (0, 3), (1, 2), (1, 3)):
            rendered = seen[other] - seen[one], told[other] - told[one]
            every["event_loss" if first < 5 else "instant_loss"].append(rendered)
    for part, rendered in every.items():
        one, other = torch.tensor(rendered).T
        expected = 2.0 * EVENT_LOSSES[name](one, other, (ON + OFF) / 2)
        torch.testing.assert_close(losses[part], expected, rtol=1e-4, atol=1e-5)
    without = supervision.losses(START, END, pairs, sensor(pattern))
    torch.testing.assert_close(losses["no_event_loss"], without["no_event_loss"])

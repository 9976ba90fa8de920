"""Published losses as methods of their own: what they set, what of them is said, and that they learn."""

from __future__ import annotations

import copy
import math
from dataclasses import asdict, replace
from operator import attrgetter
from pathlib import Path
from typing import Any

import pytest
import torch
from nerfstudio.configs.method_configs import all_descriptions, all_methods
from small_runs import EVENTS, check_two_steps, set_up, small_config

from enerf_ns.choices.resolution import Resolution
from enerf_ns.choices.resolver import resolve
from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.method.config import enerf
from enerf_ns.method.runs import method_config
from enerf_ns.sensor.response import Gamma, Logarithm
from enerf_ns.supervision.event_supervision import brightness_change
from enerf_ns.supervision.published_losses import PUBLISHED_LOSSES

ENERF: Any = enerf.config


def specification(name: str) -> Any:
    return replace(enerf, config=all_methods[name])


def rows(resolution: Resolution) -> dict[str, Any]:
    return {choice.part: choice for choice in resolution.choices}


@pytest.mark.parametrize("name", PUBLISHED_LOSSES)
def test_a_method_is_enerf_with_the_settings_of_its_losses(name: str, tmp_path: Path):
    """The registered method, and the settings given as changes of enerf, are one config, but for the name."""
    registered: Any = copy.deepcopy(all_methods[name])
    losses = PUBLISHED_LOSSES[name]
    assert registered.method_name == name and losses.source in all_descriptions[name]
    changed: Any = method_config("enerf", tmp_path, tmp_path, losses.settings)
    for path, value in losses.settings.items():
        assert attrgetter(path)(registered) == value != attrgetter(path)(ENERF)
        assert (path.removeprefix("pipeline."), value) in registered.pipeline.defaults.settings
    assert len(registered.pipeline.defaults.settings) == len(
        {**losses.settings, **dict(ENERF.pipeline.defaults.settings)}
    )
    assert asdict(registered.pipeline.model) == asdict(changed.pipeline.model)
    registered.pipeline.datamanager.data = tmp_path
    assert registered.pipeline.datamanager == changed.pipeline.datamanager
    assert registered.optimizers == changed.optimizers
    assert registered.max_num_iterations == changed.max_num_iterations


@pytest.mark.parametrize("name", PUBLISHED_LOSSES)
def test_every_method_renders_as_many_rays_a_step_as_enerf(name: str):
    data, defaults = all_methods[name].pipeline.datamanager, ENERF.pipeline.defaults
    assert data.event_pairs + data.silent_pairs == defaults.event_pairs + defaults.silent_pairs  # type: ignore


@pytest.mark.parametrize("name", PUBLISHED_LOSSES)
def test_what_is_said_of_a_method_is_so(name: str, recording: Path):
    """Its settings stand against what recording and preset state, and rows say who set what."""
    stated = replace(read_recording(recording), response="logarithm:0.02", refractory_period=2_000_000)
    pipeline: Any = all_methods[name].pipeline
    resolution = resolve(pipeline, stated)
    filled, said = resolution.applied_to(pipeline), rows(resolution)
    for setting, value in pipeline.defaults.settings:
        assert attrgetter(setting)(filled) == value
    assert said["response"].why == "set by the method" and said["response"].value == filled.model.sensor.response
    assert said["silent pixels"].why == "set by the method"
    blind = name in ("enerf-robust", "enerf-deblur")
    assert said["refractory period"].kept == blind == bool(filled.model.sensor.refractory_period_ns)
    assert said["refractory period"].why == ("the recording states it" if blind else "set by the method")
    assert not any(choice.why == "set by flag" for choice in resolution.choices)
    poses = [said[row] for row in ("clock of the poses", "mount", "lens", "drift of the poses")]
    assert all(not row.kept and row.why == "not part of the method" for row in poses)
    assert said["silent pixels"].kept == (name == "enerf-deblur")
    if name == "enerf-deblur":
        assert said["silent pixels"].value == "682 pairs a step, between successive events"
    if name == "enerf-eventnerf":
        duration = stated.span[1] - stated.span[0]
        assert filled.datamanager.window_ms == pytest.approx(0.05 * duration * 1e-6)
        assert f"over up to {filled.datamanager.window_ms:g} ms" in said["event loss"].value

    flagged = copy.deepcopy(pipeline)
    flagged.model.sensor.response = "logarithm:0.5"
    flagged.poses.refine_clock = True
    assert rows(resolve(flagged, stated))["response"].why == "set by flag"
    assert rows(resolve(flagged, stated))["clock of the poses"].kept


@pytest.mark.parametrize("name", PUBLISHED_LOSSES)
def test_two_steps_of_every_method(recording: Path, tmp_path: Path, name: str):
    """The batch is made smaller, nothing else of the losses."""
    silent = 32 if name == "enerf-deblur" else 0
    losses = EVENTS | {"no_event_loss"} if silent else EVENTS
    check_two_steps(small_config(recording, tmp_path, specification(name), data__silent_pairs=silent), losses)


@pytest.mark.parametrize("name", PUBLISHED_LOSSES)
def test_every_loss_falls(recording: Path, tmp_path: Path, name: str):
    """Over 60 steps; and what is rendered then changes more as was measured than at first."""
    config = small_config(recording, tmp_path, specification(name), data__event_pairs=512)
    config.max_num_iterations = 60
    trainer = set_up(config)
    losses, correlations = [], []
    for step in range(60):
        _, terms, metrics = trainer.train_iteration(step)
        losses.append(terms["event_loss"].item())
        correlations.append(metrics["event_correlation"].item())
    assert sum(losses[-10:]) < 0.9 * sum(losses[:10])
    assert sum(correlations[-10:]) > sum(correlations[:10]) + 1.0


def first_step(recording: Path, tmp_path: Path, name: str, **changes: Any) -> Any:
    trainer = set_up(small_config(recording, tmp_path, specification(name), **changes))
    pipeline = trainer.pipeline
    torch.nn.init.normal_(pipeline.model.field.geometry.grid.table)  # at first nothing changes
    batch = pipeline.datamanager.next_batch(pipeline.model.sensor)
    outputs = pipeline.model(pipeline.datamanager.rays(batch, pipeline.model.sensor))
    outputs["rgb"] = outputs["rgb"].double()  # changes between instants close by are of the size of float32's steps
    start, end, _ = batch.split(outputs["rgb"])
    return (
        pipeline,
        batch.events,
        start[:, 0].tolist(),
        end[:, 0].tolist(),
        pipeline.model.get_loss_dict(outputs, batch),
    )


def thresholds_of(pipeline: Any) -> tuple[float, float, float]:
    on, off = pipeline.model.config.sensor.contrast_thresholds
    return on, off, 0.5 * (on + off)


def test_the_loss_of_eventnerf_by_a_loop(recording: Path, tmp_path: Path):
    pipeline, events, start, end, losses = first_step(recording, tmp_path, "enerf-eventnerf")
    assert pipeline.model.sensor.response == Gamma(2.2, 1e-5)
    on, off, mean = thresholds_of(pipeline)
    total = 0.0
    for a, b, positive, negative in zip(start, end, events.on.tolist(), events.off.tolist(), strict=True):
        change = math.log(b**2.2 + 1e-5) - math.log(a**2.2 + 1e-5)
        total += ((change - (on * positive - off * negative)) / mean) ** 2
    assert losses["event_loss"].item() == pytest.approx(total / len(events), rel=1e-4)
    assert "no_event_loss" not in losses and events.num_silent == 0 and 0 < int((events.on + events.off == 0).sum()) < 7


@pytest.mark.parametrize("name", ["enerf-robust", "enerf-deblur"])
def test_the_losses_of_robust_and_deblur_e_nerf_by_a_loop(recording: Path, tmp_path: Path, name: str):
    """Deblur e-NeRF's Huber loss and total variation of weight 0.1 come out doubled, in one proportion."""
    deblur = name == "enerf-deblur"
    changes: dict[str, Any] = {"data__silent_pairs": 48 * deblur, "sensor__refractory_period_ns": 300_000}
    pipeline, events, start, end, losses = first_step(recording, tmp_path, name, **changes)
    assert pipeline.model.sensor.response == Logarithm(0.001)
    on, off, mean = thresholds_of(pipeline)
    huber, squared, variation = [], [], []
    for i, (a, b) in enumerate(zip(start, end, strict=True)):
        change = math.log(b + 0.001) - math.log(a + 0.001)
        if i < 64:
            error = (change - (on * int(events.on[i]) - off * int(events.off[i]))) / mean
            squared.append(error**2)
            huber.append(0.5 * error**2 if abs(error) <= 1 else abs(error) - 0.5)
        else:
            variation.append(abs(change) / mean)
    expected = 2 * sum(huber) / len(huber) if deblur else sum(squared) / len(squared)
    assert losses["event_loss"].item() == pytest.approx(expected, rel=1e-4)
    assert ("no_event_loss" in losses) == deblur
    if deblur:
        assert losses["no_event_loss"].item() == pytest.approx(2 * 0.1 * sum(variation) / len(variation), rel=1e-4)


def test_windows_begin_where_they_begin_whatever_the_refractory_period(recording: Path, tmp_path: Path):
    """It delays the starts of pairs, which are events, also of those held out; windows of time begin at none."""
    config = small_config(recording, tmp_path, specification("enerf-eventnerf"), data__held_out_events=0.2)
    pipeline = set_up(config).pipeline
    manager = pipeline.datamanager
    batch = manager.next_batch(pipeline.model.sensor)
    plain = manager.rays(batch, pipeline.model.sensor)
    pipeline.model.sensor.refractory_period = 2_000_000
    blind = manager.rays(batch, pipeline.model.sensor)
    torch.testing.assert_close(plain.origins, blind.origins, rtol=0, atol=0)
    torch.testing.assert_close(plain.directions, blind.directions, rtol=0, atol=0)
    held_out = manager.held_out_pair_sampler.sample(64, torch.Generator().manual_seed(0))
    begin = held_out.start + (held_out.end - 1 - held_out.start).clamp(max=2_000_000)
    expected = manager.event_camera.rays(held_out.pixels.repeat(2), torch.cat([begin, held_out.end]))
    found = manager.event_rays(held_out, pipeline.model.sensor)
    torch.testing.assert_close(found.origins, expected.origins)
    torch.testing.assert_close(found.directions, expected.directions)


def test_a_field_that_is_gamma_encoded_changes_as_a_linear_one_to_its_power(recording: Path, tmp_path: Path):
    """What a render of it means: brightness to the power of 1 / 2.2."""
    pipeline, events, *_ = first_step(recording, tmp_path, "enerf-eventnerf")
    start, end = torch.rand(2, len(events), 1, dtype=torch.float64)
    sensor = pipeline.model.sensor
    change = brightness_change(start ** (1 / 2.2), end ** (1 / 2.2), events, sensor)
    sensor.response = Logarithm(1e-5)
    torch.testing.assert_close(change, brightness_change(start, end, events, sensor))

"""The method as a whole, on the CPU, in this process: every configuration learns, checkpoints fit, runs repeat."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

import numpy as np
import pytest
import torch
import yaml
from nerfstudio.utils.eval_utils import eval_setup
from small_runs import EVENTS, HEIGHT, WIDTH, check_two_steps, set_up, small_config

from enerf_ns.method.config import enerf, enerf_paper
from enerf_ns.method.datamanager import EnerfDataManagerConfig
from enerf_ns.method.model import EnerfModelConfig
from enerf_ns.sensor.response import luma
from enerf_ns.supervision.event_supervision import EVENT_LOSSES, brightness_change

SILENT = {"data__silent_pairs": 32}

CONFIGURATIONS = {
    "events": ({}, EVENTS),
    "partner": ({"data__pair_mode": "partner", "data__max_pair_distance": 3}, EVENTS),
    "window": ({"data__pair_mode": "window", "data__window_ms": 20.0}, EVENTS),
    "accumulated": ({"data__pair_mode": "accumulated", "data__window_ms": 20.0}, EVENTS),
    "normalised": ({"model__event_loss": "normalised"}, EVENTS),
    "silent pixels": ({**SILENT, "model__no_event_margin": 1.0}, {*EVENTS, "no_event_loss"}),
    "total variation": ({**SILENT, "model__no_event_margin": 0.0}, {*EVENTS, "no_event_loss"}),
    "silent intervals": ({**SILENT, "data__silent_mode": "intervals"}, {*EVENTS, "no_event_loss"}),
    "no pixel is silent so long": ({**SILENT, "data__silence_ms": 1e4}, {*EVENTS, "no_event_loss"}),
    "frames": ({"data__supervision": "frames"}, {"frame_loss", "distortion_loss", "interlevel_loss"}),
    "events and frames": ({"data__supervision": "events+frames"}, {*EVENTS, "frame_loss"}),
    "all losses": (
        {"data__supervision": "events+frames", **SILENT, "model__opacity_loss_weight": 1.0},
        {*EVENTS, "no_event_loss", "frame_loss", "opacity_loss"},
    ),
    "uniform samples": ({"model__sampling": "uniform"}, {"event_loss", "distortion_loss"}),
    "view direction": ({"model__view_direction": True}, EVENTS),
    "level of brightness": ({"model__level_loss_weight": 0.1}, {*EVENTS, "level_loss"}),
    "a sensor that is learned": (
        {
            "data__supervision": "events+frames",
            "sensor__refractory_period_ns": 1000,
            **{
                f"sensor__learn_{part}": True
                for part in (
                    "threshold_ratio",
                    "mean_threshold",
                    "leak_rate",
                    "cutoff_frequency",
                    "response",
                    "refractory_period",
                    "threshold_map",
                )
            },
        },
        {*EVENTS, "frame_loss"},
    ),
    "colour": ({"model__num_channels": 3}, EVENTS),
    "no distortion loss": ({"model__distortion_loss_weight": 0.0}, {"event_loss", "interlevel_loss"}),
}

"""Changes, and the losses that there are then."""

CHOICES = [
    (f"{part}__{name}", value)
    for part, config in {"data": EnerfDataManagerConfig, "model": EnerfModelConfig}.items()
    for name, hint in get_type_hints(config).items()
    if get_origin(hint) is Literal and name in config.__annotations__
    for value in get_args(hint)
]

CHOICES += [("model__event_loss", name) for name in EVENT_LOSSES]

"""Every value of every choice that the method has of its own."""


@pytest.mark.sweep(8)
@pytest.mark.parametrize("name", CONFIGURATIONS)
def test_two_steps_of_every_configuration(recording: Path, tmp_path: Path, name: str):
    changes, losses = CONFIGURATIONS[name]
    check_two_steps(small_config(recording, tmp_path, **changes), losses)


@pytest.mark.sweep(5)
@pytest.mark.parametrize(("name", "value"), CHOICES)
def test_two_steps_with_every_choice(recording: Path, tmp_path: Path, name: str, value: str):
    """All losses but the frame loss where there is no frame, and but the interlevel loss without proposals."""
    config = small_config(recording, tmp_path, **{"data__supervision": "events+frames", **SILENT, name: value})
    losses = {*EVENTS, "frame_loss", "no_event_loss"}
    without = {
        "events": {"frame_loss"},
        "frames": {"event_loss", "no_event_loss"},
        "uniform": {"interlevel_loss"},
    }
    check_two_steps(config, losses - without.get(value, set()))


@pytest.mark.parametrize("method", [enerf, enerf_paper])
def test_two_steps_of_every_method_as_it_is_registered(recording: Path, tmp_path: Path, method):
    """Only batch and field are made smaller."""
    registered = method.config.pipeline
    losses = {
        "data__silent_pairs": min(registered.defaults.silent_pairs, 32),
        "model__opacity_loss_weight": registered.model.opacity_loss_weight,
        "model__distortion_loss_weight": registered.model.distortion_loss_weight,
    }
    trainer = set_up(small_config(recording, tmp_path, method, **losses))
    for step in range(2):
        assert trainer.train_iteration(step)[0].isfinite()


@pytest.mark.parametrize(("supervision", "frame_loss"), [("events", set()), ("events+frames", {"frame_loss"})])
def test_two_steps_of_the_setting_of_the_paper(recording: Path, tmp_path: Path, supervision: str, frame_loss: set[str]):
    config = small_config(recording, tmp_path, method=enerf_paper, data__supervision=supervision)
    assert config.pipeline.model.sampling == "uniform" and config.pipeline.model.view_direction
    check_two_steps(config, {"event_loss", "distortion_loss", *frame_loss})


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_an_early_field_is_no_negative_whose_brightness_is_that_of_holes(recording: Path, tmp_path: Path, seed: int):
    """As one that starts transparent is before a bright background: its correlation is -0.9 after 50 steps."""
    config = small_config(recording, tmp_path, data__held_out_events=0.0, data__event_pairs=256, data__silent_pairs=64)
    config.pipeline.model.opacity_loss_weight, config.machine.seed = 1.0, seed
    config.pipeline.model.num_levels, config.pipeline.model.log2_table_size = None, 17
    config.max_num_iterations = 2000
    trainer = set_up(config)
    for step in range(50):
        trainer.train_iteration(step)
    assert trainer.pipeline.event_scores(2048)["event_correlation"] > 0.8
    assert trainer.pipeline.last_step.accumulation.mean() > 0.9


@pytest.mark.parametrize("supervision", ["events+frames", "frames"])
def test_two_steps_with_frames_in_colour_and_grey_events(colour_recording: Path, tmp_path: Path, supervision: str):
    losses = {*EVENTS, "frame_loss"} if "events" in supervision else EVENTS - {"event_loss"} | {"frame_loss"}
    trainer = check_two_steps(small_config(colour_recording, tmp_path, data__supervision=supervision), losses)
    assert not trainer.pipeline.last_step.batch.frames.are_grey
    model, manager = trainer.pipeline.model, trainer.pipeline.datamanager
    assert model.config.num_channels == 3
    batch = manager.next_batch(model.sensor)
    rgb = model(manager.rays(batch, model.sensor))["rgb"]
    assert (rgb.std(dim=-1) > 0).any(), "the field is in colour"
    if "events" in supervision:
        start, end, _ = batch.split(rgb)
        predicted = brightness_change(start, end, batch.events, model.sensor)
        start, end = (luma(shown)[:, None].expand(-1, 3) for shown in (start, end))
        torch.testing.assert_close(brightness_change(start, end, batch.events, model.sensor), predicted)


def test_the_same_seed_gives_the_same_losses_and_another_seed_others(recording: Path, tmp_path: Path):
    def losses(seed: int) -> list[float]:
        config = small_config(recording, tmp_path, data__silent_pairs=16, data__supervision="events+frames")
        config.machine.seed = seed
        trainer = set_up(config)
        return [trainer.train_iteration(step)[0].item() for step in range(3)]

    first = losses(42)
    assert losses(42) == first
    assert losses(43)[0] != first[0]


def test_training_brings_the_loss_down(recording: Path, tmp_path: Path):
    config = small_config(recording, tmp_path, data__event_pairs=256, model__distortion_loss_weight=0.0)
    config.max_num_iterations = 4000  # of which the first 60 are taken, so that the learning rate hardly falls
    trainer = set_up(config)
    losses = [trainer.train_iteration(step)[1]["event_loss"].item() for step in range(60)]
    assert np.mean(losses[-10:]) < 0.7 * np.mean(losses[:5])


@pytest.fixture(scope="module")
def trained(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Two steps and a checkpoint."""
    trainer = set_up(small_config(recording, tmp_path_factory.mktemp("outputs")))
    trainer.train()
    return trainer


def test_a_loaded_run_renders_what_the_trained_one_does(trained: Any, monkeypatch, tmp_path: Path):
    monkeypatch.chdir(tmp_path)
    loaded: Any
    _, loaded, checkpoint, step = eval_setup(trained.base_dir / "config.yml")
    assert step == 1 and checkpoint.name == "step-000000001.ckpt"
    camera = loaded.datamanager.eval_dataset.cameras[:1]
    trained.pipeline.eval()
    outputs = loaded.model.get_outputs_for_camera(camera)
    expected = trained.pipeline.model.get_outputs_for_camera(camera)
    assert next(iter(outputs)) == "rgb"
    for name, channels in {"rgb": 3, "depth": 1, "accumulation": 1, "normals": 3}.items():
        assert outputs[name].shape == (HEIGHT, WIDTH, channels)
        torch.testing.assert_close(outputs[name], expected[name], rtol=0, atol=0)
    assert outputs["normals"].min() >= 0 and outputs["normals"].max() <= 1
    rgba = loaded.model.get_rgba_image(outputs)
    torch.testing.assert_close(rgba[..., 3:], outputs["accumulation"], rtol=0, atol=0)


def rename(state: dict) -> None:
    state["_model.field.geometry.grid.entries"] = state.pop("_model.field.geometry.grid.table")


def remove(state: dict) -> None:
    del state["_model.field.geometry.grid.table"]


def shorten(state: dict) -> None:
    state["_model.field.geometry.grid.table"] = state["_model.field.geometry.grid.table"][:-1]


def add(state: dict) -> None:
    state["_model.field.appearance"] = torch.zeros(3)


@pytest.mark.parametrize("change", [rename, remove, shorten, add])
@pytest.mark.parametrize("strict", [True, None])
def test_parameters_that_do_not_fit_are_an_error(trained: Any, change, strict: bool | None):
    """Nerfstudio asks for a strict load first, and then silently for one that is not."""
    state = trained.pipeline.state_dict()
    change(state)
    with pytest.raises(RuntimeError, match=r"field\.(geometry\.grid\.(table|entries)|appearance)"):
        trained.pipeline.load_state_dict(state, strict=strict)


def test_loading_a_checkpoint_that_does_not_fit_is_an_error(trained: Any, tmp_path: Path):
    run = tmp_path / "outputs/recording/enerf/run"
    shutil.copytree(trained.base_dir, run)
    config = yaml.load((run / "config.yml").read_text(), Loader=yaml.Loader)
    config.output_dir = tmp_path / "outputs"
    (run / "config.yml").write_text(yaml.dump(config))
    assert eval_setup(run / "config.yml")[3] == 1
    file = run / "nerfstudio_models/step-000000001.ckpt"
    checkpoint = torch.load(file)
    rename(checkpoint["pipeline"])
    torch.save(checkpoint, file)
    with pytest.raises(RuntimeError, match=r"geometry\.grid\.table"):
        eval_setup(run / "config.yml")

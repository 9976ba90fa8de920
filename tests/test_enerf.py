"""The method as a whole, on the CPU, in this process: every configuration learns, checkpoints fit, runs repeat."""

from __future__ import annotations

import copy
import json
import shutil
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

import numpy as np
import pytest
import torch
import yaml
from nerfstudio.scripts.train import _set_random_seed
from nerfstudio.utils.eval_utils import eval_setup
from PIL import Image

from enerf_ns.dataparsers.files import load_image
from enerf_ns.enerf_config import enerf, enerf_paper
from enerf_ns.enerf_datamanager import EnerfDataManagerConfig
from enerf_ns.enerf_model import EnerfModelConfig
from enerf_ns.enerf_trainer import EnerfTrainerConfig
from enerf_ns.sensor.response import luma
from enerf_ns.simulator.engine import simulate
from enerf_ns.simulator.settings import SimulationSettings

WIDTH, HEIGHT = 32, 24


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tenth of a second of a small camera, with grey frames, sharp and blurred, and depth."""
    folder = tmp_path_factory.mktemp("simulated") / "recording"
    simulate(
        SimulationSettings("shapes", width=WIDTH, height=HEIGHT, duration=0.1, num_frames=11, exposure_ms=5.0), folder
    )
    return folder


@pytest.fixture(scope="module")
def colour_recording(recording: Path) -> Path:
    """The same with frames in colour."""
    folder = recording.with_name("colour")
    shutil.copytree(recording, folder)
    for file in [*folder.glob("images/*.png"), *folder.glob("images_corrupted/*.png")]:
        Image.fromarray((load_image(file) * np.array([1.0, 0.8, 0.5])).astype(np.uint8)).save(file)
    return folder


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
    model.opacity_loss_weight, model.distortion_loss_weight = 0.0, 0.01
    model.log2_table_size, model.num_levels = 12, 4
    model.num_samples = model.num_proposal_samples = 16
    parts = {"data": manager, "model": model}
    for name, value in changes.items():
        part, field = name.split("__")
        assert hasattr(parts[part], field)
        setattr(parts[part], field, value)
    return config


def set_up(config: EnerfTrainerConfig) -> Any:
    """A trainer as `ns-train` makes it, set up."""
    _set_random_seed(config.machine.seed)
    config.save_config()
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    trainer.pipeline.train()
    return trainer


EVENTS = {"event_loss", "distortion_loss", "interlevel_loss"}
SILENT = {"data__silent_pairs": 32}

CONFIGURATIONS = {
    "events": ({}, EVENTS),
    "partner": ({"data__pair_mode": "partner", "data__max_pair_distance": 3}, EVENTS),
    "window": ({"data__pair_mode": "window", "data__window_ms": 20.0}, EVENTS),
    "normalised": ({"model__event_loss": "normalised"}, EVENTS),
    "silent pixels": ({**SILENT, "model__no_event_margin": 1.0}, {*EVENTS, "no_event_loss"}),
    "total variation": ({**SILENT, "model__no_event_margin": 0.0}, {*EVENTS, "no_event_loss"}),
    "no pixel is silent so long": ({**SILENT, "data__silence_ms": 1e4}, EVENTS),
    "frames": ({"data__supervision": "frames"}, {"frame_loss", "distortion_loss", "interlevel_loss"}),
    "events and frames": ({"data__supervision": "events+frames"}, {*EVENTS, "frame_loss"}),
    "all losses": (
        {"data__supervision": "events+frames", **SILENT, "model__opacity_loss_weight": 1.0},
        {*EVENTS, "no_event_loss", "frame_loss", "opacity_loss"},
    ),
    "uniform samples": ({"model__sampling": "uniform"}, {"event_loss", "distortion_loss"}),
    "view direction": ({"model__view_direction": True}, EVENTS),
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
"""Every value of every choice that the method has of its own."""


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


@pytest.mark.parametrize("name", CONFIGURATIONS)
def test_two_steps_of_every_configuration(recording: Path, tmp_path: Path, name: str):
    changes, losses = CONFIGURATIONS[name]
    check_two_steps(small_config(recording, tmp_path, **changes), losses)


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
        "data__silent_pairs": min(registered.datamanager.silent_pairs, 32),
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


@pytest.mark.parametrize("supervision", ["events+frames", "frames"])
def test_two_steps_with_frames_in_colour_and_grey_events(colour_recording: Path, tmp_path: Path, supervision: str):
    losses = {*EVENTS, "frame_loss"} if "events" in supervision else EVENTS - {"event_loss"} | {"frame_loss"}
    trainer = check_two_steps(small_config(colour_recording, tmp_path, data__supervision=supervision), losses)
    model, manager = trainer.pipeline.model, trainer.pipeline.datamanager
    assert model.config.num_channels == 3
    rays, batch = manager.next_train(0)
    outputs = model(rays)
    rgb = outputs["rgb"]
    assert (rgb.std(dim=-1) > 0).any(), "the field is in colour"
    if "events" in supervision:
        predicted, _, _ = model.brightness_changes(outputs, batch)
        grey = torch.stack([luma(rgb), luma(rgb), luma(rgb)], dim=-1)
        torch.testing.assert_close(model.brightness_changes({"rgb": grey}, batch)[0], predicted)


@pytest.mark.parametrize("supervision", ["events", "events+frames"])
def test_a_field_of_grey_frames_or_events_alone_has_one_channel(recording, colour_recording, tmp_path, supervision):
    data = colour_recording if supervision == "events" else recording
    config = small_config(data, tmp_path, data__supervision=supervision)
    config.prepare()
    assert config.pipeline.model.num_channels == 1


def test_a_step_holds_what_the_recording_saw(colour_recording: Path, tmp_path: Path):
    """Pairs against the raw events of the recording, frame rays against the picture files."""
    config = small_config(
        colour_recording,
        tmp_path,
        data__supervision="events+frames",
        data__silent_pairs=10,
        data__train_num_rays_per_batch=20,
    )
    manager = set_up(config).pipeline.datamanager
    rays, batch = manager.next_train(0)
    assert batch["num_pairs"] == rays.num_pairs == 64 + 10
    assert len(rays) == 2 * 74 + 20
    assert len(batch["on"]) == len(batch["off"]) == 64 and (batch["on"] + batch["off"] > 0).all()
    assert len(batch["image"]) == 20

    files = manager.train_dataset.frames.filenames
    assert all(file.parent.name == "images_corrupted" for file in files)
    for color, (frame, row, column) in zip(batch["image"], batch["indices"].tolist(), strict=True):
        np.testing.assert_allclose(color, load_image(files[frame])[row, column] / 255.0, atol=1e-6)
    frame, row, column = batch["indices"].T
    coordinates = torch.stack([row, column], dim=-1) + 0.5
    expected = manager.train_dataset.cameras.generate_rays(camera_indices=frame[:, None], coords=coordinates)
    torch.testing.assert_close(rays.origins[-20:], expected.origins)
    torch.testing.assert_close(rays.directions[-20:], expected.directions)


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


def test_config_and_choices_that_are_stored(recording: Path, tmp_path: Path, monkeypatch):
    """Open choices are filled in, paths are absolute; what was stored loads as it was."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "link").symlink_to(recording)
    config = small_config(Path("link"), Path("outputs"))
    config.save_config()
    run = tmp_path / "outputs/recording/enerf/run"
    loaded = yaml.load((run / "config.yml").read_text(), Loader=yaml.Loader)
    assert loaded == config
    manager, model = loaded.pipeline.datamanager, loaded.pipeline.model
    for path in (loaded.data, manager.data, manager.dataparser.data):
        assert path == recording.resolve()
    assert loaded.output_dir == tmp_path / "outputs"
    simulated = json.loads((recording / "simulation.json").read_text())
    assert model.contrast_thresholds == tuple(simulated["contrast_thresholds"])
    assert manager.dataparser.depth_range == pytest.approx(simulated["depth_range"])
    assert model.num_channels == 1 and model.max_res > model.base_res and 0 < model.near_plane < 1
    choices = {choice["part"]: choice for choice in json.loads((run / "choices.json").read_text())}
    assert choices["event loss"]["kept"] and not choices["no-event loss"]["kept"] and not choices["frame loss"]["kept"]
    assert all(choice["why"] for choice in choices.values())


def test_what_is_set_is_not_chosen(recording: Path, tmp_path: Path):
    forced = {"contrast_thresholds": (0.1, 0.3), "max_res": 99, "near_plane": 0.05, "num_channels": 3}
    config = small_config(recording, tmp_path, **{f"model__{name}": value for name, value in forced.items()})
    config.pipeline.datamanager.dataparser.depth_range = (1.0, 2.0)
    config.prepare()
    assert {name: getattr(config.pipeline.model, name) for name in forced} == forced
    assert config.pipeline.datamanager.dataparser.depth_range == (1.0, 2.0)


def test_the_registered_method_is_left_as_it_was(recording: Path, tmp_path: Path):
    small_config(recording, tmp_path).prepare()
    assert isinstance(enerf.config, EnerfTrainerConfig)
    assert enerf.config.data is None and enerf.config.pipeline.model.contrast_thresholds is None


def test_frames_that_are_not_there_cannot_be_learnt_from(recording: Path, tmp_path: Path):
    folder = tmp_path / "without_frames"
    shutil.copytree(recording, folder, ignore=shutil.ignore_patterns("images*", "depth"))
    config = small_config(folder, tmp_path / "outputs", data__supervision="events+frames")
    with pytest.raises(SystemExit, match=r"without_frames.*no frames.*--pipeline\.datamanager\.supervision"):
        config.save_config()
    assert not (tmp_path / "outputs").exists()
    check_two_steps(small_config(folder, tmp_path / "outputs"), EVENTS)


@pytest.mark.parametrize(
    "changes",
    [{"data__pair_mode": "window", "data__window_ms": 1e-6}, {"data__silent_pairs": 8, "data__silence_ms": 0.0}],
)
def test_pairs_that_cannot_be_drawn_are_an_error_of_one_sentence(recording: Path, tmp_path: Path, changes: dict):
    with pytest.raises(SystemExit, match=r"enerf: .*recording") as error:
        set_up(small_config(recording, tmp_path, **changes))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("changes", "held_out_every", "message"),
    [
        ({}, 0, "--held-out-every 0"),
        ({"data__supervision": "frames"}, 1, "--held-out-every 1 .*11 frames"),
        ({"data__supervision": "events+frames"}, 22, "--held-out-every 22 .*11 frames"),
        ({"model__contrast_thresholds": (0.2, 0.0)}, 4, "--contrast-thresholds"),
    ],
)
def test_flags_that_cannot_be_followed(
    recording: Path, tmp_path: Path, changes: dict, held_out_every: int, message: str
):
    config = small_config(recording, tmp_path, **changes)
    config.pipeline.datamanager.dataparser.held_out_every = held_out_every
    with pytest.raises(SystemExit, match=message):
        config.save_config()
    assert not list(tmp_path.iterdir())


def test_the_learning_rate_falls_to_a_tenth_at_the_last_step_however_long_the_run(recording: Path, tmp_path: Path):
    config = small_config(recording, tmp_path)
    config.max_num_iterations = 7
    trainer = set_up(config)
    rates = []
    for step in range(8):
        rates.append(trainer.optimizers.optimizers["fields"].param_groups[0]["lr"])
        trainer.train_iteration(step)
    ratio = np.array(rates[1:]) / np.array(rates[:-1])
    np.testing.assert_allclose(ratio, 0.1 ** (1 / 7), rtol=1e-6)

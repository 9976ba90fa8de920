"""A data set, a loss and a parameter of the sensor are added from outside the package, as a user would, and train."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from nerfstudio.utils.eval_utils import eval_setup
from small_runs import set_up, small_config
from torch import Tensor, nn

from enerf_ns.dataparsers.event_dataparser import specification
from enerf_ns.dataparsers.formats import registry
from enerf_ns.dataparsers.formats.format import Format
from enerf_ns.dataparsers.formats.registry import read_recording, register
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.recording import EventRecording, Events
from enerf_ns.dataparsers.recording.trajectory import Trajectory
from enerf_ns.sensor.sensor_model import SensorModel, SensorModelConfig
from enerf_ns.supervision.event_supervision import EVENT_LOSSES


def read_two_arrays(folder: Path) -> EventRecording:
    """A reader: events.npy has rows x y t_us p, poses.npy rows t_us px py pz qx qy qz qw."""
    events, poses = np.load(folder / "events.npy"), np.load(folder / "poses.npy")
    x, y, t, p = events.T.astype(np.int64)
    return EventRecording(
        path=folder,
        format="two_arrays",
        camera=Camera(32, 24, 27.7, 27.7, 16.0, 12.0),
        trajectory=Trajectory((1000 * poses[:, 0]).astype(np.int64), poses[:, 1:4], poses[:, 4:]),
        stream_events=lambda: iter([Events(x, y, 1000 * t, p)]),
        event_files=(folder / "events.npy",),
        depth_range=(0.5, 5.0),
    )


TWO_ARRAYS = Format("two_arrays", "two-arrays", "Two arrays.", ("events.npy", "poses.npy"), read_two_arrays)
two_arrays = specification(TWO_ARRAYS)
"""What an entry point of the group nerfstudio.dataparser_configs names, for `ns-train enerf two-arrays --data ...`."""


def cauchy_loss(predicted: Tensor, measured: Tensor, mean_threshold: float | Tensor) -> Tensor:
    """A loss that counts wrong pairs even less than Huber's."""
    return torch.log1p(((predicted - measured) / mean_threshold) ** 2).mean()


class LearnedDarkCurrent(SensorModel):
    """A sensor parameter: the brightness that a pixel sees of darkness."""

    def __init__(self, config: SensorModelConfig):
        super().__init__(config)
        self.dark_current = nn.Parameter(torch.zeros(()))

    def log_brightness(self, rgb: Tensor, pixels: Tensor) -> Tensor:
        return super().log_brightness(rgb + self.dark_current, pixels)


@dataclasses.dataclass
class LearnedDarkCurrentConfig(SensorModelConfig):
    _target: type[SensorModel] = dataclasses.field(default_factory=lambda: LearnedDarkCurrent)


@pytest.fixture(scope="module", autouse=True)
def added() -> Iterator[None]:
    """The reader and the loss, known until the tests of this module have ended."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(registry, "_FORMATS", dict(registry._FORMATS))
        register(TWO_ARRAYS)
        patch.setitem(EVENT_LOSSES, "cauchy", cauchy_loss)
        yield


@pytest.fixture(scope="module")
def two_arrays_folder(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small simulated recording in the layout of the reader above."""
    folder = tmp_path_factory.mktemp("two_arrays")
    simulated = read_recording(recording)
    events, poses = index_events(simulated).events(), simulated.trajectory
    np.save(folder / "events.npy", np.column_stack([events.x, events.y, events.t // 1000, events.p]))
    np.save(folder / "poses.npy", np.column_stack([poses.times / 1000, poses.positions, poses.quaternions]))
    return folder


def two_steps(config: Any) -> Any:
    """Trains two steps; the trainer. Every loss is finite, and every parameter moves."""
    trainer = set_up(config)
    before = {name: parameter.detach().clone() for name, parameter in trainer.pipeline.model.named_parameters()}
    trainer.train()
    for name, parameter in trainer.pipeline.model.named_parameters():
        moved = parameter.numel() == 0 or (parameter != before[name]).any()  # Nerfstudio keeps an empty one
        assert parameter.isfinite().all() and moved, name
    return trainer


def test_a_reader_of_ones_own(two_arrays_folder: Path, tmp_path: Path):
    """The folder is found to have its format, and is trained on."""
    trainer = two_steps(small_config(two_arrays_folder, tmp_path))
    assert trainer.pipeline.datamanager.recording.format == "two_arrays"
    assert vars(two_arrays.config)["format"] == "two_arrays"


def test_a_reader_of_ones_own_can_be_named(two_arrays_folder: Path, tmp_path: Path):
    config = small_config(two_arrays_folder, tmp_path)
    config.pipeline.datamanager.dataparser = dataclasses.replace(two_arrays.config)  # type: ignore[type-var]
    assert two_steps(config).pipeline.datamanager.recording.format == "two_arrays"


READER = """
from pathlib import Path
import numpy as np
from enerf_ns.dataparsers.event_dataparser import specification
from enerf_ns.dataparsers.formats.format import Format
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.recording import EventRecording, Events
from enerf_ns.dataparsers.recording.trajectory import Trajectory

def read(folder: Path) -> EventRecording:
    times, still = np.array([0, 10**9]), np.tile([0.0, 0.0, 0.0, 1.0], (2, 1))
    return EventRecording(
        path=folder,
        format="mine",
        camera=Camera(32, 24, 27.7, 27.7, 16.0, 12.0),
        trajectory=Trajectory(times, np.array([[0.0, 0, 0], [1.0, 0, 0]]), still),
        stream_events=lambda: iter([Events(*np.load(folder / "mine.npy"))]),
        event_files=(folder / "mine.npy",),
    )

FORMAT = Format("mine", "my-events", "Mine.", ("mine.npy",), read)
MINE = specification(FORMAT)
"""


def test_commands_know_a_format_that_another_package_names(tmp_path: Path):
    """The package is found as pip would have installed it. Another one, which is broken, costs a warning alone."""
    site = tmp_path / "site"
    for name, reader in (("mine", READER), ("broken", "import a_module_that_is_missing")):
        (site / f"{name}-1.0.dist-info").mkdir(parents=True)
        (site / f"{name}-1.0.dist-info/METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
        (site / f"{name}-1.0.dist-info/entry_points.txt").write_text(f"[enerf_ns.formats]\n{name} = {name}:FORMAT\n")
        (site / f"{name}.py").write_text(reader)
    rng = np.random.default_rng(0)
    columns = rng.integers(0, 32, 500), rng.integers(0, 24, 500), np.sort(rng.integers(0, 10**9, 500))
    (tmp_path / "folder").mkdir()
    np.save(tmp_path / "folder/mine.npy", np.stack([*columns, rng.integers(0, 2, 500)]))
    command = [str(Path(sys.executable).with_name("enerf")), "convert", "folder", "--output-dir", "new"]
    environment = os.environ | {"PYTHONPATH": str(site)}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    np.testing.assert_array_equal(np.load(tmp_path / "new/events/t.npy"), columns[2])
    assert "The format broken of the package broken is left out" in done.stderr and "Traceback" not in done.stderr


def test_a_loss_of_ones_own(recording: Path, tmp_path: Path):
    trainer = two_steps(small_config(recording, tmp_path, model__event_loss="cauchy"))
    pipeline = trainer.pipeline
    batch = pipeline.datamanager.next_batch(pipeline.model.sensor)
    outputs = pipeline.model(pipeline.datamanager.rays(batch, pipeline.model.sensor))
    start, end, _ = batch.split(outputs["rgb"])
    sensor, events = pipeline.model.sensor, batch.events
    change = sensor.log_brightness(end, events.pixels) - sensor.log_brightness(start, events.pixels)
    measured = sensor.measured_change(events)
    loss = pipeline.model.get_loss_dict(outputs, batch)["event_loss"]
    torch.testing.assert_close(loss, cauchy_loss(change, measured, sensor.mean_threshold))


def test_a_parameter_of_the_sensor(recording: Path, tmp_path: Path):
    """It is trained with a learning rate of its own, stored with the run, and loaded."""
    config = small_config(recording, tmp_path)
    config.pipeline.model.sensor = LearnedDarkCurrentConfig()
    trainer = two_steps(config)
    sensor = trainer.pipeline.model.sensor
    assert isinstance(sensor, LearnedDarkCurrent) and sensor.dark_current.item() != 0
    assert set(trainer.optimizers.optimizers) == {"fields", "sensor"}
    assert trainer.optimizers.config["sensor"]["optimizer"].lr != trainer.optimizers.config["fields"]["optimizer"].lr
    loaded: Any = eval_setup(trainer.base_dir / "config.yml")[1]
    torch.testing.assert_close(loaded.model.sensor.dark_current, sensor.dark_current, rtol=0, atol=0)


def test_all_three_at_once(two_arrays_folder: Path, tmp_path: Path):
    config = small_config(two_arrays_folder, tmp_path, model__event_loss="cauchy")
    config.pipeline.model.sensor = LearnedDarkCurrentConfig()
    two_steps(config)

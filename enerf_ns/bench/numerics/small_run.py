"""A recording of 0.1 s, and runs on it that take a second, for cases that need a whole run."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from functools import cache
from io import StringIO
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from nerfstudio.utils.rich_utils import CONSOLE

from enerf_ns.method.runs import method_config, set_up
from enerf_ns.simulator.engine import simulate
from enerf_ns.simulator.settings import SimulationSettings

if TYPE_CHECKING:
    from enerf_ns.method.trainer import EnerfTrainer, EnerfTrainerConfig

SMALL = {
    "max_num_iterations": 50,
    "machine.device_type": "cpu",
    "pipeline.datamanager.event_pairs": 128,
    "pipeline.datamanager.silent_pairs": 32,
    "pipeline.datamanager.silence_ms": 5.0,
    "pipeline.model.num_levels": 4,
    "pipeline.model.log2_table_size": 12,
    "pipeline.model.num_proposal_samples": 16,
    "pipeline.model.num_samples": 16,
    "pipeline.model.sampling": "proposal",
}
"""Settings of a small run, by the names of ns-train's flags."""


@cache
def _folder() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="enerf-numerics-")


@cache
def small_recording() -> Path:
    """Path of a recording of 0.1 s at 32 x 24 pixels with frames and depth. It is removed when the process ends."""
    folder = Path(_folder().name) / "recording"
    settings = SimulationSettings("shapes", width=32, height=24, duration=0.1, num_frames=11, exposure_ms=5.0)
    with quiet():
        simulate(settings, folder)
    return folder


def small_config(changes: Mapping[str, Any] = MappingProxyType({})) -> EnerfTrainerConfig:
    """The config of a small run of the method `enerf`.

    Args:
        changes: Values by the names of ns-train's flags.
    """
    output_dir = Path(tempfile.mkdtemp(dir=_folder().name))
    config = method_config("enerf", small_recording(), output_dir, {**SMALL, **changes})
    config.timestamp = "run"
    return config


def small_trainer(changes: Mapping[str, Any] = MappingProxyType({})) -> EnerfTrainer:
    """The trainer of a small run, set up as `ns-train` does."""
    with quiet():
        return set_up(small_config(changes))


@contextmanager
def quiet() -> Iterator[list[str]]:
    """Suppresses output within the block, and collects it in the list."""
    printed: list[str] = []
    with redirect_stdout(StringIO()) as plain, CONSOLE.capture() as captured:
        yield printed
    printed += [captured.get(), plain.getvalue()]

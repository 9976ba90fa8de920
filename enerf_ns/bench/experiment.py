"""The parts of an experiment of `enerf bench`: rows are ways to train, sequences are recordings to train on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from enerf_ns.bench.published import PSNR_SSIM_LPIPS, Published
from enerf_ns.dataparsers.recording.files import write_whole

if TYPE_CHECKING:
    from enerf_ns.simulator.settings import SimulationSettings


@dataclass(frozen=True)
class Row:
    """One way to train."""

    changes: Mapping[str, Any] = field(default_factory=dict)
    """Settings that differ from the method, by the names of ns-train's flags."""
    factors: Mapping[str, float] = field(default_factory=dict)
    """Factors of settings whose value is chosen from the recording, by name."""
    method: str | None = None
    """Method of ns-train. None: the method of --method."""
    reconstruction: Literal["e2vid", "filter"] | None = None
    """How the training frames are reconstructed from events. None: the recording's own frames are used."""
    known_sensor: bool = False
    """Whether the row gets the parameters of the simulated sensor."""
    budget: float = 1.0
    """Factor of the training time, or of the number of steps, of --budget."""


@dataclass(frozen=True)
class Sequence:
    """A recording to train on, simulated or given by the user."""

    scene: str | None = None
    """Scene for `enerf simulate`. None: the recording is --data, or the folder of this name in --data."""
    preset: str | None = None
    """Name of the preset with the paper's selections."""
    changes: Mapping[str, Any] = field(default_factory=dict)
    """Settings that differ from the method, by the names of ns-train's flags."""
    simulation: Mapping[str, Any] = field(default_factory=dict)
    """Further settings of the simulation."""
    sensor: Mapping[str, Any] | None = None
    """Settings of the simulated sensor, which the recording then does not state. None: an ideal sensor, which the
    recording states."""
    files: Mapping[str, str] = field(default_factory=dict)
    """Contents of the files that scene and key_frames name, by file name."""

    def simulation_settings(self, folder: Path, **changes: Any) -> SimulationSettings:
        """Settings of the simulation of this sequence, whose scene and key frames are written into a folder.

        Args:
            folder: Made if it does not exist.
            changes: Settings that take the place of those of the sequence.

        Raises:
            OSError: The folder cannot be written to.
        """
        from enerf_ns.simulator.event_sensor import SensorSettings
        from enerf_ns.simulator.settings import SimulationSettings

        for name, content in self.files.items():
            write_whole(folder / name, content)
        given = {"scene": self.scene, "sensor": SensorSettings(**(self.sensor or {})), **self.simulation, **changes}
        for name in ("scene", "key_frames"):
            if given.get(name) in self.files:
                given[name] = folder / given[name]
        return SimulationSettings(**{**given, "scene": str(given["scene"])})


@dataclass(frozen=True)
class Experiment:
    """A table with each row on each sequence."""

    sentence: str
    """Sentence about the comparison."""
    rows: tuple[str, ...]
    sequences: tuple[str, ...] = ()
    """Simulated sequences."""
    recorded: tuple[str, ...] = ()
    """Sequences in --data, which replace the simulated ones if --data is given."""
    beside: bool = False
    """Whether sequences in --data are added to the simulated ones instead of replacing them."""
    columns: tuple[str, ...] = PSNR_SSIM_LPIPS
    """Scores in the table. The first one orders the rows."""
    protocols: tuple[str, ...] = ("log-affine-set",)
    """Protocols of the scores. Published scores stand beside those of the first protocol."""
    measures: tuple[str, ...] = ()
    """Names of further `measures.MEASURES`."""
    parts: bool = False
    """Whether to add the numerical errors of the parts of each run."""
    mean: bool = False
    """Whether the table shows means over the sequences instead of each sequence."""
    published: Published = field(default_factory=dict)
    """Published scores."""
    source: str = "the paper"
    """Publication of these scores."""
    notes: tuple[str, ...] = ()
    """Sentences that a reader needs for the comparison."""

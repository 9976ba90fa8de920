"""What an experiment of `enerf bench` is made of: rows, ways to learn, and sequences, what is learnt from."""

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
    """One way to learn: what it changes of the method, by the names of ns-train's flags."""

    changes: Mapping[str, Any] = field(default_factory=dict)
    factors: Mapping[str, float] = field(default_factory=dict)
    """By how much settings are multiplied whose value is chosen from the recording."""
    method: str | None = None
    """Method of ns-train. None: that of the bench."""
    reconstruction: Literal["e2vid", "filter"] | None = None
    """What reconstructs, from events alone, the frames that are learnt from; None: they are the recording's own."""
    known_sensor: bool = False
    """Whether it is told what the sequence simulates of the sensor."""


@dataclass(frozen=True)
class Sequence:
    """What is learnt from: a recording that is simulated, or one that the user has."""

    scene: str | None = None
    """What `enerf simulate` shows. None: the recording is the folder of this sequence's name in --data, or --data."""
    preset: str | None = None
    """The paper's selections that are used."""
    changes: Mapping[str, Any] = field(default_factory=dict)
    """As of `Row`."""
    simulation: Mapping[str, Any] = field(default_factory=dict)
    """Further settings of the simulation."""
    sensor: Mapping[str, Any] | None = None
    """Settings of the simulated sensor, of which the recording then states nothing. None: ideal, and stated."""
    files: Mapping[str, str] = field(default_factory=dict)
    """Text by the names of the files that scene and key_frames name."""

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
    """A table: each row on each sequence."""

    sentence: str
    """What is compared."""
    rows: tuple[str, ...]
    sequences: tuple[str, ...] = ()
    """Sequences that are simulated."""
    recorded: tuple[str, ...] = ()
    """Sequences within --data, which take the place of the simulated ones where it is given."""
    beside: bool = False
    """Whether those within --data stand beside the simulated ones instead of in their place."""
    columns: tuple[str, ...] = PSNR_SSIM_LPIPS
    """Scores that are shown, the one that rows are ordered by first."""
    protocols: tuple[str, ...] = ("log-affine-set",)
    """How scores are measured; what is published beside them is of the first."""
    measures: tuple[str, ...] = ()
    """Names of further `measures.MEASURES` of each run."""
    parts: bool = False
    """Whether the numerical errors of the parts of each run are told, too."""
    mean: bool = False
    """Whether means over the sequences are shown instead of the sequences."""
    published: Published = field(default_factory=dict)
    source: str = "the paper"
    """Who published it."""
    notes: tuple[str, ...] = ()
    """What a reader has to know to compare, one sentence each."""

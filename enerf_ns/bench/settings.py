"""The flags of `enerf bench`; apart from what runs them, so that they are told without loading Nerfstudio."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Optional, Tuple  # noqa: UP035 - tyro reads these annotations on Python 3.10


@dataclass(frozen=True)
class BenchSettings:
    """What is run, and for how long."""

    data: Optional[Path] = None  # noqa: UP045
    """Recording, or folder of recordings, of an experiment on real ones."""
    budget: str = "120s"
    """Training of each row: seconds, as in 120s, or steps, as in 600."""
    scale: float = 0.25
    """Size of the simulated sequences, of 640 x 480."""
    seeds: int = 1
    """Trainings of each row; scores are their means, with standard deviations."""
    sequences: Tuple[str, ...] = ()  # noqa: UP006
    """Some of the experiment's sequences. None: all."""
    rows: Tuple[str, ...] = ()  # noqa: UP006
    """Some of the experiment's rows. None: all."""
    method: str = "enerf"
    """Method of ns-train: enerf, or enerf-paper at full size on a GPU."""
    reconstruction_weights: Optional[Path] = None  # noqa: UP045
    """Weights of E2VID or FireNet, by which frames are reconstructed from events; without, that row is left out."""
    threads: Optional[int] = None  # noqa: UP045
    """Threads of the processor. None: as many as it has cores."""
    against: Optional[Path] = None  # noqa: UP045
    """Result file (.json) of another version: the change of each row is shown, worst first, and the exit code is not 0
    where one lost more than 0.3 dB."""
    output_dir: Path = Path("outputs/bench")
    """Folder for the tables, recordings and runs; what is finished there is not run again."""

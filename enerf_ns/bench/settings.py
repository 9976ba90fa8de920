"""Settings of `enerf bench`, in a module of their own so that --help need not load Nerfstudio."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Optional, Tuple  # noqa: UP035 - tyro reads these annotations on Python 3.10


@dataclass(frozen=True)
class BenchSettings:
    """Rows, recordings and training time of an experiment."""

    data: Optional[Path] = None  # noqa: UP045
    """Recording, or folder of recordings, for an experiment on real recordings."""
    budget: str = "120s"
    """Training time of each row in seconds, such as 120s, or its number of steps, such as 600."""
    scale: float = 0.25
    """Size of the simulated pictures as a factor of 640 x 480 pixels."""
    seeds: int = 1
    """Number of trainings of each row. The table shows means and standard deviations of their scores."""
    sequences: Tuple[str, ...] = ()  # noqa: UP006
    """Sequences to train on. Default: all sequences of the experiment."""
    rows: Tuple[str, ...] = ()  # noqa: UP006
    """Rows to train. Default: all rows of the experiment."""
    method: str = "enerf"
    """Method of ns-train: enerf, or on a GPU enerf-paper at full size."""
    reconstruction_weights: Optional[Path] = None  # noqa: UP045
    """File with the weights of E2VID or FireNet, for the row e2vid, which learns from frames that this network
    reconstructs. Default: the row e2vid is left out."""
    threads: Optional[int] = None  # noqa: UP045
    """Number of CPU threads. Default: the number of CPU cores."""
    against: Optional[Path] = None  # noqa: UP045
    """Result file (.json) of another version, of the same experiment, budget, scale and method. The change of the PSNR
    of each row since that version is shown, largest loss first. The exit code is not 0 if a row lost more than 0.3
    dB."""
    output_dir: Path = Path("outputs/bench")
    """Folder for the tables, recordings and runs. Runs that are finished there are not run again."""

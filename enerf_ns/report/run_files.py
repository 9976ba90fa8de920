"""What the files of a run tell before anything is loaded: its configuration, its history, and how far it came."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, cast

from enerf_ns.dataparsers.recording.errors import FlagError, RecordingError
from enerf_ns.dataparsers.recording.files import absolute, expanded, reading
from enerf_ns.evaluation.history import HISTORY_FILE, HistoryRow, read_history
from enerf_ns.method.checkpoints import newest_checkpoint, read_config

if TYPE_CHECKING:
    from enerf_ns.dataparsers.recording.recording import EventRecording
    from enerf_ns.method.trainer import EnerfTrainerConfig

RECENT_SECONDS = 600.0
"""Age (s) of the newest file that training wrote, up to which a run that is not at its end counts as still going."""

WRITTEN_BY_TRAINING = ("config.yml", HISTORY_FILE, "events.out.*", "previews/*", "nerfstudio_models/*")
"""Patterns of the files that training writes into the folder of a run."""


@dataclass(frozen=True)
class RunFiles:
    """A run as its files show it."""

    config_file: Path
    config: EnerfTrainerConfig
    history: list[HistoryRow]
    """Oldest row first; empty where the run has none."""
    steps: int
    """Training steps done, as far as the files know."""
    stored: int
    """Training steps that the newest whole checkpoint holds; 0 where there is none."""
    state: str
    """done, or how far it came, and whether it is still going, was stopped, or crashed."""
    notes: tuple[str, ...] = ()
    """What is wrong with the files, a sentence each."""

    @property
    def folder(self) -> Path:
        return self.config_file.parent

    @property
    def learns_from(self) -> str:
        """What the run learns from, in words."""
        manager = self.config.pipeline.datamanager
        frames = "sharp frames" if manager.dataparser.train_frames == "sharp" else "blurred frames"
        return manager.supervision.replace("+", " and ").replace("frames", frames)


def find_runs(path: Path) -> list[Path]:
    """The folders of the runs in a folder and all folders below it, by name; the path itself where there are none, or
    where it is a file."""
    path = expanded(path)
    if (path / "config.yml").exists():
        return [path]
    return sorted(file.parent for file in path.rglob("config.yml")) or [path]


def read_run(path: Path) -> RunFiles:
    """What the files of a run tell.

    Args:
        path: Folder of the run, or its config.yml.

    Raises:
        RecordingError: It is no run, or one of a method of another package, or its files cannot be read.
    """
    from nerfstudio.configs.method_configs import all_methods

    path = absolute(path)
    config_file = path / "config.yml" if path.is_dir() else path
    if not config_file.exists():
        found = "holds no config.yml" if path.is_dir() else "does not exist"
        raise RecordingError(f"{path} {found}; give the folder of a run, of several, or a config.yml.")
    config = read_config(config_file)
    if not isinstance(config, type(all_methods["enerf"])):
        raise RecordingError(
            f"{config_file} is a run of the method {config.method_name}; give the folder of a run of enerf."
        )
    config = cast("EnerfTrainerConfig", config)
    folder, notes, checkpoint = config_file.parent, [], None
    with reading(folder / HISTORY_FILE, "the history of a run"):
        history = read_history(folder)
    try:
        checkpoint = newest_checkpoint(folder / "nerfstudio_models")
    except RecordingError as error:
        notes.append(str(error))
    stored = int(checkpoint.stem.removeprefix("step-")) + 1 if checkpoint else 0
    written = [file.stat().st_mtime for pattern in WRITTEN_BY_TRAINING for file in folder.glob(pattern)]
    state = _state(config, history, stored, time.time() - max(written))
    steps = max([stored, *(row.step for row in history)])
    return RunFiles(config_file, config, history, steps, stored, state, tuple(notes))


def _state(config: EnerfTrainerConfig, history: list[HistoryRow], stored: int, age: float) -> str:
    """How a run stands.

    Args:
        config: Of the run.
        history: Of the run.
        stored: Steps done at the newest checkpoint, 0 where there is none.
        age: Seconds since training wrote anything.
    """
    total = config.max_num_iterations
    recorded = history[-1].step if history else 0
    if stored >= total or (history and history[-1].final):
        return "done"
    on_schedule = config.steps_per_save and (stored - 1) % config.steps_per_save == 0
    if stored and stored >= recorded and not on_schedule:
        return f"stopped after {stored:,} of {total:,} steps"
    if age < RECENT_SECONDS:
        return f"still going, {max(stored, recorded):,} of {total:,} steps"
    kept = f"the first {stored:,} are stored" if stored else "none is stored"
    return f"crashed or killed after {max(stored, recorded):,} of {total:,} steps, of which {kept}"


def run_names(runs: list[RunFiles]) -> list[str]:
    """A name for each run: its experiment, with as much of method and time stamp as tells them apart."""
    for parts in (["experiment_name"], ["experiment_name", "method_name"], ["experiment_name", "timestamp"],
                  ["experiment_name", "method_name", "timestamp"]):  # fmt: skip
        names = ["/".join(str(getattr(run.config, part)) for part in parts) for run in runs]
        if len(set(names)) == len(names):
            return names
    return [str(run.folder) for run in runs]


def refined_recording(run: Path, data: Path) -> EventRecording:
    """A recording with clock, poses and lens as a run refined them; `as_read` is what they were before, and None where
    nothing was.

    Args:
        run: Folder of the run, or its config.yml.
        data: Folder of the recording.

    Raises:
        RecordingError: It is no run, or has no whole checkpoint.
        FlagError: It was trained on another recording.
    """
    from enerf_ns.method.runs import load  # here, since PyTorch and Nerfstudio take seconds

    files = read_run(run)
    if not files.stored:
        raise RecordingError(f"{files.config_file.parent} has no whole checkpoint; wait for one, or train again.")
    refined = load(files.config_file).pipeline.datamanager.recording
    if refined.path != data:
        raise FlagError(f"--run {run} was trained on {refined.path}, not on {data}; give a run of this recording.")
    return refined

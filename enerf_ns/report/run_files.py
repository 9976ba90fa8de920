"""Configuration, history and progress of a run, read from its files without loading the run."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from enerf_ns.dataparsers.recording.errors import FlagError, RecordingError
from enerf_ns.dataparsers.recording.files import absolute, expanded, reading
from enerf_ns.evaluation.history import HISTORY_FILE, HistoryRow, read_history
from enerf_ns.method.checkpoints import load_checkpoint, newest_checkpoint, read_config
from enerf_ns.method.origin import ORIGIN_FILE

if TYPE_CHECKING:
    from enerf_ns.dataparsers.recording.recording import EventRecording
    from enerf_ns.method.trainer import EnerfTrainerConfig

RECENT_SECONDS = 600.0
"""Age in seconds of the newest file of training up to which an unfinished run counts as still going."""

CHOICES_FILE = "choices.json"
"""Name of the file with the table of choices."""

WRITTEN_BY_TRAINING = (HISTORY_FILE, "events.out.*", "previews/*", "nerfstudio_models/*")
"""Patterns of the files that training writes into the folder of a run, beside its config."""


@dataclass(frozen=True)
class RunFiles:
    """The contents of the files of a run."""

    config_file: Path
    config: EnerfTrainerConfig
    history: list[HistoryRow]
    """Rows, oldest first; empty if the run has no history."""
    steps: int
    """Number of training steps done, according to the files."""
    stored: int
    """Number of training steps in the newest whole checkpoint; 0 if there is none."""
    stored_seconds: float
    """Time (s) of these steps."""
    state: str
    """In words: done, still going, stopped or crashed, with the number of steps."""
    notes: tuple[str, ...] = ()
    """Problems of the files, one sentence each."""
    choices: Sequence[dict[str, Any]] = ()
    """Rows of the table of choices, with part, kept, value, why and flag; empty if they are not stored."""
    origin: Mapping[str, str] = field(default_factory=dict)
    """Command, version, date and machine of the training; empty if they are not stored."""

    @property
    def folder(self) -> Path:
        """Folder of the run."""
        return self.config_file.parent

    def seconds_at(self, step: int) -> float:
        """Time (s) of training up to a step: in proportion between rows of the history, which must have one, and the
        newest checkpoint."""
        known = [(row.step, row.seconds) for row in self.history]
        if self.stored > known[-1][0]:
            known.append((self.stored, self.stored_seconds))
        steps, seconds = zip(*known, strict=True)
        return float(np.interp(step, steps, seconds))

    @property
    def learns_from(self) -> str:
        """Training data of the run, in words."""
        manager = self.config.pipeline.datamanager
        frames = "sharp frames" if manager.dataparser.train_frames == "sharp" else "blurred frames"
        return manager.supervision.replace("+", " and ").replace("frames", frames)


def find_runs(path: Path) -> list[Path]:
    """Folders of all runs in and below a folder, sorted by name.

    A path that is a run, a file, or a folder without runs is returned as it is.
    """
    path = expanded(path)
    if (path / "config.yml").exists():
        return [path]
    return sorted(file.parent for file in path.rglob("config.yml")) or [path]


def _newest_state(folder: Path) -> tuple[int, float]:
    """Number and time (s) of the steps in the newest whole checkpoint of a folder; 0 if there is none."""
    checkpoint = newest_checkpoint(folder)
    if checkpoint is None:
        return 0, 0.0
    try:
        state = load_checkpoint(checkpoint)
    except FileNotFoundError:  # training has stored another one, and removed this one
        return _newest_state(folder)
    return int(checkpoint.stem.removeprefix("step-")) + 1, float(state["error_against_time"]["seconds"])


def read_run(path: Path) -> RunFiles:
    """Reads the files of a run.

    Args:
        path: Folder of the run, or its config.yml.

    Raises:
        RecordingError: The path is no run, or a run of another method, or its files cannot be read.
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
    folder, notes, stored, stored_seconds = config_file.parent, [], 0, 0.0
    with reading(folder / HISTORY_FILE, "the history of a run"):
        history = read_history(folder)
    try:
        stored, stored_seconds = _newest_state(folder / "nerfstudio_models")
    except RecordingError as error:
        notes.append(str(error))
    about: dict[str, Any] = {CHOICES_FILE: [], ORIGIN_FILE: {}}
    for name in about:
        try:
            if (folder / name).exists():
                with reading(folder / name, "JSON"):
                    about[name] = json.loads((folder / name).read_text())
        except RecordingError as error:
            notes.append(str(error))
    written = [config_file.stat().st_mtime]
    for pattern in WRITTEN_BY_TRAINING:
        for file in folder.glob(pattern):
            with suppress(FileNotFoundError):  # training may have removed a checkpoint meanwhile
                written.append(file.stat().st_mtime)
    state = _state(config, history, stored, time.time() - max(written))
    steps = max([stored, *(row.step for row in history)])
    return RunFiles(
        config_file,
        config,
        history,
        steps,
        stored,
        stored_seconds,
        state,
        tuple(notes),
        about[CHOICES_FILE],
        about[ORIGIN_FILE],
    )


def _state(config: EnerfTrainerConfig, history: list[HistoryRow], stored: int, age: float) -> str:
    """The state of a run in words.

    Args:
        config: Configuration of the run.
        history: History of the run.
        stored: Number of steps in the newest checkpoint; 0 if there is none.
        age: Seconds since training last wrote a file.
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
    """A unique name for each run: its experiment, with method and timestamp only if they are needed."""
    for parts in (["experiment_name"], ["experiment_name", "method_name"], ["experiment_name", "timestamp"],
                  ["experiment_name", "method_name", "timestamp"]):  # fmt: skip
        names = ["/".join(str(getattr(run.config, part)) for part in parts) for run in runs]
        if len(set(names)) == len(names):
            return names
    return [str(run.folder) for run in runs]


def refined_recording(run: Path, data: Path) -> EventRecording:
    """A recording with the clock, poses and lens that a run refined.

    Args:
        run: Folder of the run, or its config.yml.
        data: Folder of the recording.

    Returns:
        The recording. Its `as_read` is the recording before the refinement, or None if the run refined nothing.

    Raises:
        RecordingError: The path is no run, or the run has no whole checkpoint.
        FlagError: The run was trained on another recording.
    """
    from enerf_ns.method.runs import load  # here, since PyTorch and Nerfstudio take seconds

    files = read_run(run)
    if not files.stored:
        raise RecordingError(f"{files.config_file.parent} has no whole checkpoint; wait for one, or train again.")
    refined = load(files.config_file).pipeline.datamanager.recording
    if refined.path != data:
        raise FlagError(f"--run {run} was trained on {refined.path}, not on {data}; give a run of this recording.")
    return refined

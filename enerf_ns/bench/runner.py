"""Runs the experiments of `enerf bench`. Trainings that are already finished are not repeated."""

from __future__ import annotations

import contextlib
import copy
import hashlib
import json
import re
import shlex
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from operator import attrgetter
from pathlib import Path
from statistics import median
from typing import Any

import numba
import torch
from nerfstudio.engine.callbacks import TrainingCallbackLocation

from enerf_ns.bench.diagram import diagram
from enerf_ns.bench.experiments import EXPERIMENTS, ROWS, SEQUENCES, Experiment, known_sensor
from enerf_ns.bench.inputs import (
    ALL_READERS,
    NUMERICAL_ERRORS,
    RECONSTRUCTION,
    SIMULATION,
    TRAINED_RUNS,
    TRAINING,
    code_digest,
    recording_digest,
)
from enerf_ns.bench.measures import TRUTH, evaluate
from enerf_ns.bench.numerics.parts import error_of_parts
from enerf_ns.bench.settings import BenchSettings
from enerf_ns.bench.tables import csv_table, lines, markdown
from enerf_ns.dataparsers.formats.registry import check_outside_recordings
from enerf_ns.dataparsers.recording.errors import FlagError, OutputError
from enerf_ns.dataparsers.recording.files import absolute, expanded, partial_of, read_json, write_whole
from enerf_ns.evaluation.lpips import NETWORKS, Net
from enerf_ns.method.origin import code_version, device_name
from enerf_ns.method.runs import method_config, set_up, train
from enerf_ns.method.stopwatch import seconds_of
from enerf_ns.method.trainer import EnerfTrainerConfig
from enerf_ns.simulator.engine import simulate
from enerf_ns.simulator.event_sensor import SensorSettings

FULL_SIZE = (640, 480)
"""Width and height in pixels of simulated sequences at scale 1."""

WARM_UP, TIMED = 5, 20
"""Number of warm-up steps and of timed steps, to find how many steps fit into a budget of seconds."""

LATE = 1001
"""Number of the first of these steps. Late in a run, the proposal network learns only at some steps."""

STATED_OF_SENSOR = ("contrast_thresholds", "refractory_period_ns", "response", "sensor")
"""Keys of the sensor in recording.json and simulation.json, except the colour filter."""

RESULT, LOG = "result.json", "log.txt"
"""Names of the files of the result and of the output in the folder of a run."""


@dataclass(frozen=True)
class Cell:
    """One training: a row on a sequence with a seed."""

    row: str
    sequence: str
    seed: int


class Bench:
    """One experiment with its settings.

    Args:
        name: Name of the experiment.
        settings: Settings of the bench.

    Raises:
        FlagError: The experiment, row or sequence does not exist, or a setting is out of its range.
    """

    def __init__(self, name: str, settings: BenchSettings):
        if name not in EXPERIMENTS:
            raise FlagError(f"There is no experiment {name}; choose one of {', '.join(EXPERIMENTS)}.")
        self.name, self.settings, self.experiment = name, settings, EXPERIMENTS[name]
        experiment: Experiment = self.experiment
        of_data = settings.data is not None and bool(experiment.recorded)
        if settings.data is not None and not experiment.recorded:
            raise FlagError(f"--data changes nothing for {name}, whose sequences are simulated; leave it out.")
        if settings.data is None and not experiment.sequences:
            raise FlagError(f"enerf bench {name} needs --data: the folder of {', '.join(experiment.recorded)}.")
        there = experiment.recorded if of_data else experiment.sequences
        if experiment.beside and of_data:
            there = (*experiment.sequences, *experiment.recorded)
        self.all_sequences = there
        """Sequences that the experiment could have with these recordings."""
        self.sequences = _some("sequences", settings.sequences, there)
        rows = _some("rows", settings.rows, experiment.rows)
        self.left_out = {
            row: "--reconstruction-weights names no file with the weights of a network"
            for row in rows
            if ROWS[row].reconstruction == "e2vid" and settings.reconstruction_weights is None
        }
        self.rows = tuple(row for row in rows if row not in self.left_out)
        weights = settings.reconstruction_weights
        if weights is not None and not expanded(weights).is_file():
            raise FlagError(f"--reconstruction-weights {weights} does not exist; give a file of E2VID's or FireNet's.")
        parse_budget(settings.budget)
        self.output_dir = absolute(settings.output_dir)
        check_outside_recordings("--output-dir", self.output_dir)
        own = self.output_dir / f"{name}.json"
        if settings.against is not None and absolute(settings.against) == own:
            raise FlagError(f"--against {own} is the file that this bench writes; give another --output-dir.")
        conditions = {"experiment": name, "budget": settings.budget, "scale": self.scale, "method": settings.method}
        self.before = _results_of(settings.against, conditions)
        """Results in the file of --against; None if not given."""
        if not 0.0 < settings.scale <= 4.0:
            raise FlagError(f"--scale is {settings.scale:g}, but must be above 0 and at most 4.")
        if settings.seeds < 1:
            raise FlagError(f"--seeds is {settings.seeds}, but must be at least 1.")
        if settings.threads is not None:
            most = numba.config.NUMBA_NUM_THREADS  # type: ignore[attr-defined]
            if not 1 <= settings.threads <= most:
                raise FlagError(f"--threads is {settings.threads}, but must be from 1 to {most}.")
            numba.set_num_threads(settings.threads)  # starts OpenMP, with a number of threads of its own for torch, too
            torch.set_num_threads(settings.threads)
        self._stored = _stored_runs(own)

    @property
    def cells(self) -> list[Cell]:
        """All trainings, ordered by sequence."""
        return [
            Cell(row, sequence, seed)
            for sequence in self.sequences
            for seed in range(self.settings.seeds)
            for row in self.rows
        ]

    def run(self) -> Iterator[tuple[Cell, dict[str, Any] | None]]:
        """Runs and scores all trainings that are not finished, and writes the tables after each training.

        Yields:
            Each training with None when it begins, and each training with its result when it is finished.

        Raises:
            OutputError: The output folder cannot be written to.
            KeyboardInterrupt: Training was interrupted.
        """
        found = {cell: self._finished(cell) for cell in self.cells}
        for cell in self.cells:
            result = found[cell]
            if result is None:
                yield cell, None
                result = found[cell] = self._attempt(cell)
            runs = [run for run in found.values() if run is not None]
            results = self.results(runs)
            for suffix, content in {
                "json": json.dumps(results, indent=1) + "\n",
                "md": markdown(results),
                "csv": csv_table(results),
            }.items():
                self._write(self.output_dir / f"{self.name}.{suffix}", content)
            yield cell, result
        picture = diagram(self.results([run for run in found.values() if run is not None]))
        if picture is not None:
            self._write(self.output_dir / f"{self.name}.png", picture)

    def results(self, runs: list[dict[str, Any]]) -> dict[str, Any]:
        """Contents of the result file, from which the tables are made."""
        experiment, settings = self.experiment, self.settings
        weights = settings.reconstruction_weights
        not_asked = {*experiment.rows} - {*self.rows, *self.left_out}
        return {
            "experiment": self.name,
            "sentence": experiment.sentence,
            "command": self.command(),
            "method": settings.method,
            "budget": settings.budget,
            "scale": self.scale,
            "columns": experiment.columns,
            "protocols": experiment.protocols,
            "mean": experiment.mean,
            "sequences": self.all_sequences,
            "published": {
                sequence: {row: scores for row, scores in rows.items() if row not in not_asked}
                for sequence, rows in experiment.published.items()
            },
            "source": experiment.source,
            "notes": experiment.notes,
            "reconstruction_weights": weights and weights.name,
            "left_out": self.left_out,
            "runs": [{name: value for name, value in run.items() if name != "settings"} for run in runs],
        }

    @property
    def scale(self) -> float | None:
        """Size of the simulated pictures as a factor; None for recordings of the user."""
        return self.settings.scale if self.sequences[0] in self.experiment.sequences else None

    def command(self, of_machine: bool = False) -> str:
        """The command that makes these results, but for its output folder.

        Args:
            of_machine: Whether it has the user's own paths, so that it runs as it is.
        """
        words, default = ["enerf", "bench", self.name], BenchSettings()
        for name, value in vars(self.settings).items():
            if name in ("output_dir", "threads", "against") or (
                value == getattr(default, name) and name not in ("budget", "scale")
            ):
                continue
            values = value if isinstance(value, tuple) else [value]
            words.append(f"--{name.replace('_', '-')}")
            if isinstance(value, Path) and not of_machine:
                values = [f"path/to/{value.name}"]
            words += map(str, values)
        return shlex.join(words)

    def _method(self, cell: Cell) -> str:
        return ROWS[cell.row].method or self.settings.method

    def _simulation(self, cell: Cell) -> dict[str, Any] | None:
        """Settings of the simulation of the recording; None if the recording is the user's."""
        sequence = SEQUENCES[cell.sequence]
        if sequence.scene is None:
            return None
        width, height = (max(1, round(self.settings.scale * side)) for side in FULL_SIZE)
        sensor = {} if sequence.sensor is None else {"sensor": dict(sequence.sensor)}
        return {"scene": sequence.scene, "width": width, "height": height, **sequence.simulation, **sensor}

    def _changes(self, cell: Cell) -> dict[str, Any]:
        """Settings of a cell that differ from the method."""
        row, sequence = ROWS[cell.row], SEQUENCES[cell.sequence]
        known = known_sensor(SensorSettings(**(sequence.sensor or {}))) if row.known_sensor else {}
        return {**sequence.changes, **row.changes, **known, "machine.seed": cell.seed}

    def _about(self, cell: Cell) -> dict[str, Any]:
        """Everything that a result depends on."""
        row, sequence, settings = ROWS[cell.row], SEQUENCES[cell.sequence], self.settings
        simulation = self._simulation(cell)
        weights = settings.reconstruction_weights if row.reconstruction == "e2vid" else None
        if simulation is None:
            recording = recording_digest(self._recorded(cell))
        else:
            recording = [simulation, sequence.files, code_digest(*SIMULATION, left_out=TRAINED_RUNS)]
        code = [*TRAINING, *([ALL_READERS] * (simulation is None)), *([NUMERICAL_ERRORS] * self.experiment.parts)]
        about = {
            "method": self._method(cell),
            "changes": self._changes(cell),
            "factors": row.factors,
            "preset": sequence.preset,
            "code": code_digest(*code),
            "recording": recording,
            "reconstruction": row.reconstruction,
            "weights": weights and hashlib.sha256(expanded(weights).read_bytes()).hexdigest(),
            "budget": self._budget(cell),
            "protocols": self.experiment.protocols,
            "vgg": "lpips_vgg" in self.experiment.columns,
            "parts": self.experiment.parts,
            "measures": self.experiment.measures,
            "threads": torch.get_num_threads(),
            "device": device_name(),
        }
        return json.loads(json.dumps(about))

    def _budget(self, cell: Cell) -> str:
        """The budget of a row, in the unit of --budget."""
        budget, factor = self.settings.budget, ROWS[cell.row].budget
        amount, in_seconds = parse_budget(budget)
        if factor == 1:
            return budget
        return f"{factor * amount:.3f}s" if in_seconds else str(max(1, round(factor * amount)))

    def folder(self, cell: Cell) -> Path:
        """Folder of the run of a cell, in the layout of Nerfstudio."""
        name = f"{cell.row.replace('/', '-over-')}-seed-{cell.seed}-{_digest(self._about(cell))}"
        return self.output_dir / "runs" / cell.sequence / self._method(cell) / name

    def _finished(self, cell: Cell) -> dict[str, Any] | None:
        """The stored result of a cell with the same inputs: of its run, or in the result file, which may come from
        another machine. None if there is none or the training failed."""
        found = [self._stored.get(_digest(self._about(cell)))]
        with contextlib.suppress(OSError, ValueError):
            found.insert(0, json.loads((self.folder(cell) / RESULT).read_text()))
        finished = (result for result in found if result is not None and "failure" not in result)
        return next(({**result, **asdict(cell)} for result in finished), None)

    def _attempt(self, cell: Cell) -> dict[str, Any]:
        """Trains and scores a cell, and stores its result or its failure."""
        folder, about = self.folder(cell), self._about(cell)
        result = {**asdict(cell), "settings": about, "inputs": _digest(about), "version": code_version()}
        result |= {"device": about["device"], "threads": about["threads"]}
        shutil.rmtree(folder, ignore_errors=True)
        self._write(folder / LOG, "")
        try:
            with (folder / LOG).open("a") as log, contextlib.redirect_stdout(log), contextlib.redirect_stderr(log):
                result |= self._trained(cell, folder)
        except SystemExit as end:
            if end.code == 130:
                raise KeyboardInterrupt from end
            result["failure"] = str(end.code).removeprefix("enerf: ")
        except Exception as error:  # the other rows are run after any failure
            result["failure"] = " ".join(str(error).split()) or type(error).__name__
        self._write(folder / RESULT, json.dumps(result, indent=1) + "\n")
        return result

    def _trained(self, cell: Cell, folder: Path) -> dict[str, Any]:
        """Trains a cell in a folder, and returns its seconds, steps and scores."""
        config = self._config(cell, folder)
        config.max_num_iterations = steps_of(self._budget(cell), config)
        run = train(config)
        assert run.train_seconds is not None and run.processor_seconds is not None
        columns = self.experiment.columns
        nets: list[Net] = [net for net, network in NETWORKS.items() if net == "alex" or network.score in columns]
        scores, not_scored = evaluate(run, self.experiment.protocols, self.experiment.measures, nets)
        result: dict[str, Any] = {
            "steps": config.max_num_iterations,
            "seconds": round(run.train_seconds, 2),
            "processor_seconds": round(run.processor_seconds, 2),
            "scores": scores,
        }
        if self.experiment.parts:
            result["parts"] = [asdict(part) for part in error_of_parts(run)]
        return result | ({"not_scored": not_scored} if any(not_scored.values()) else {})

    def _config(self, cell: Cell, folder: Path) -> EnerfTrainerConfig:
        row, sequence = ROWS[cell.row], SEQUENCES[cell.sequence]
        changes = {**self._changes(cell), "preset": sequence.preset}
        config = method_config(self._method(cell), self._recording(cell), self.output_dir / "runs", changes)
        config.experiment_name, config.timestamp = cell.sequence, folder.name
        config.evaluation_share = 0.0  # a trained run is scored once, by `evaluate`
        if sequence.scene is not None and config.pipeline.model.view_direction is None:
            config.pipeline.model.view_direction = False  # simulated surfaces are matt; so all rows have the same field
        if row.factors:
            resolved = config.resolved().pipeline
            chosen = resolved.resolution.applied_to(resolved)
            for path, factor in row.factors.items():
                section, _, name = path.removeprefix("pipeline.").rpartition(".")
                setattr(
                    attrgetter(f"pipeline.{section}")(config),
                    name,
                    round(factor * attrgetter(f"{section}.{name}")(chosen)),
                )
        return config

    def _recorded(self, cell: Cell) -> Path:
        """Path of the user's recording."""
        assert self.settings.data is not None
        data = absolute(self.settings.data)
        return data / cell.sequence if (data / cell.sequence).is_dir() or len(self.experiment.recorded) > 1 else data

    def _recording(self, cell: Cell) -> Path:
        """Path of the recording of a cell, which is made first if necessary."""
        row, sequence, simulation = ROWS[cell.row], SEQUENCES[cell.sequence], self._simulation(cell)
        if simulation is None:
            recording = self._recorded(cell)
        else:
            stem = f"{Path(simulation['scene']).stem}-{simulation['width']}x{simulation['height']}"
            made_of = _digest(self._about(cell)["recording"])
            recording = self.output_dir / "recordings" / f"{stem}-{made_of}"
            with made_whole(recording) as folder:
                if folder is not None:
                    size = {name: simulation[name] for name in ("width", "height")}
                    with self._writing_to(recording.parent):
                        settings = sequence.simulation_settings(recording.parent, **size)
                    simulate(settings, folder)
                    if sequence.sensor is not None:
                        hide_sensor(folder)
        if row.reconstruction is None:
            return recording
        from enerf_ns.reconstruction.reconstruction import reconstruct

        weights = self.settings.reconstruction_weights if row.reconstruction == "e2vid" else None
        about = self._about(cell)
        made_of = _digest([about["recording"], row.reconstruction, about["weights"], code_digest(RECONSTRUCTION)])
        frames = self.output_dir / "recordings" / f"{cell.sequence}-{row.reconstruction}-{made_of}"
        with made_whole(frames) as folder:
            if folder is not None:
                reconstruct(recording, folder, weights and expanded(weights))
        return frames

    def _write(self, path: Path, content: str | bytes) -> None:
        with self._writing_to(path):
            write_whole(path, content)

    @contextlib.contextmanager
    def _writing_to(self, path: Path) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise OutputError(
                f"{path} could not be written ({error.strerror}); make room, or give another --output-dir."
            ) from error


def _results_of(against: Path | None, conditions: dict[str, Any]) -> dict[str, Any] | None:
    """The results in a result file; None if no file is given.

    Raises:
        FlagError: The file has no results, or has results of other conditions.
    """
    if against is None:
        return None
    try:
        found = json.loads(expanded(against).read_text())
        table = lines(found)
    except OSError as error:
        raise FlagError(
            f"--against {against} cannot be read ({error.strerror}); give a result file (.json)."
        ) from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise FlagError(f"--against {against} holds no results of enerf bench; give a result file (.json).") from error
    if not table:
        raise FlagError(f"--against {against} holds no runs; give a result file (.json) that has some.")
    for what, value in conditions.items():
        if what == "scale" and None in (value, found.get(what)):
            continue  # on recordings of the user, which have one size
        if found.get(what) != value:
            raise FlagError(
                f"--against {against} has results of {what} {found.get(what)}, but this bench has {what} {value}; "
                f"give a result file of the same {what}."
            )
    return found


def _stored_runs(file: Path) -> dict[str, dict[str, Any]]:
    """The runs in a result file by their inputs; none if there is no such file."""
    try:
        return {run["inputs"]: run for run in json.loads(file.read_text())["runs"] if "inputs" in run}
    except (OSError, ValueError, KeyError, TypeError):
        return {}


def parse_budget(budget: str) -> tuple[float, bool]:
    """Amount of a budget, and whether its unit is seconds instead of steps.

    Raises:
        FlagError: The budget is no such amount.
    """
    found = re.fullmatch(r"(\d+(?:\.\d+)?)(s?)", budget)
    amount, in_seconds = (float(found[1]), found[2] == "s") if found else (0.0, False)
    if amount <= 0.0 or not (in_seconds or amount.is_integer()):
        raise FlagError(f"--budget is {budget}, but must be seconds, such as 120s, or steps, such as 600.")
    return amount, in_seconds


def steps_of(budget: str, config: EnerfTrainerConfig) -> int:
    """Number of steps for a budget. For a budget in seconds, a short trial run measures the time of a step."""
    amount, in_seconds = parse_budget(budget)
    if not in_seconds:
        return int(amount)
    with tempfile.TemporaryDirectory() as folder:
        trial = copy.deepcopy(config)
        trial.output_dir, trial.max_num_iterations = Path(folder), LATE + WARM_UP + TIMED
        trainer = set_up(trial)
        trainer.pipeline.train()
        device, times = trainer.pipeline.device, []
        for step in range(LATE, LATE + WARM_UP + TIMED):
            times.append(seconds_of(lambda step=step: trainer.train_iteration(step), device))
            for callback in trainer.callbacks:
                callback.run_callback_at_location(step, TrainingCallbackLocation.AFTER_TRAIN_ITERATION)
        # pairs, because the proposal network learns at every second step; median, to ignore interruptions
        pairs = [sum(pair) for pair in zip(times[WARM_UP::2], times[WARM_UP + 1 :: 2], strict=True)]
        return max(1, round(amount / (0.5 * median(pairs))))


def hide_sensor(recording: Path) -> None:
    """Removes the sensor, except its colour filter, from the files of a simulated recording.

    The settings of the simulation are copied to `TRUTH`, which no reader of recordings knows.
    """
    write_whole(recording / TRUTH, (recording / "simulation.json").read_bytes())
    for name in ("simulation.json", "recording.json"):
        if (recording / name).exists():
            stated = read_json(recording / name)
            kept = {name: value for name, value in stated.items() if name not in STATED_OF_SENSOR}
            write_whole(recording / name, json.dumps(kept, indent=2) + "\n")


def _some(flag: str, chosen: tuple[str, ...], known: tuple[str, ...]) -> tuple[str, ...]:
    """The known names that a flag chooses, in their order; all if it chooses none.

    Raises:
        FlagError: A chosen name is not known.
    """
    unknown = [name for name in chosen if name not in known]
    if unknown:
        raise FlagError(f"--{flag} {' '.join(unknown)} is not part of this experiment; choose from {', '.join(known)}.")
    return tuple(name for name in known if not chosen or name in chosen)


def _digest(about: Any) -> str:
    """A short name for settings."""
    return hashlib.sha256(json.dumps(about, sort_keys=True, default=str).encode()).hexdigest()[:10]


@contextlib.contextmanager
def made_whole(folder: Path) -> Iterator[Path | None]:
    """A new folder beside one that is to be made, which it becomes at the end; None where that one is there."""
    if folder.exists():
        yield None
        return
    partial = partial_of(folder)
    try:
        yield partial
        partial.rename(folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)

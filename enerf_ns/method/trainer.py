"""The trainer: it resolves the config, prints the start and the end of training, and keeps a run through interruptions,
full disks and steps that are not finite."""

from __future__ import annotations

import json
import signal
import sys
import time
from contextlib import suppress
from copy import deepcopy
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryFile
from types import FrameType
from typing import Any, Literal, Optional, Type  # noqa: UP035 - tyro reads these annotations on Python 3.10

import numpy as np
import torch
import yaml
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.engine.trainer import Trainer, TrainerConfig
from nerfstudio.utils import writer
from nerfstudio.utils.comms import get_rank, is_main_process
from nerfstudio.utils.decorators import check_main_thread
from nerfstudio.utils.rich_utils import CONSOLE
from nerfstudio.viewer.viewer import Viewer
from rich.rule import Rule
from rich.text import Text
from torch import Tensor
from tyro.conf import Fixed

from enerf_ns.choices.ranges import check_ranges
from enerf_ns.choices.resolver import resolve
from enerf_ns.choices.table import choices_text, findings_table, recording_table
from enerf_ns.dataparsers.formats.registry import check_outside_recordings
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.recording.errors import (
    FlagError,
    OutputError,
    RecordingError,
    exit_with_a_sentence,
    quoted,
)
from enerf_ns.dataparsers.recording.files import absolute, write_together, write_whole
from enerf_ns.dataparsers.recording.recording import EventRecording
from enerf_ns.evaluation.history import HISTORY_FILE
from enerf_ns.kernels.hash_grid import fitting
from enerf_ns.kernels.threads import kernels_alone
from enerf_ns.method.checkpoints import (
    checkpoint_path,
    is_whole,
    load_checkpoint,
    newest_checkpoint,
    random_state,
    read_config,
    set_random_seed,
    set_random_state,
    write_checkpoint,
)
from enerf_ns.method.error_against_time import ErrorAgainstTime
from enerf_ns.method.guarded_steps import (
    LEARNING_CHECKED_EVERY,
    LEARNING_CHECKED_FROM,
    MOST_SKIPPED,
    GuardedOptimizers,
    Later,
    keep_batch,
    what_is_not_finite,
    why_nothing_is_learnt,
)
from enerf_ns.method.model import EnerfModel
from enerf_ns.method.nerfstudio_seams import flush_tensorboard, sampler_counters, set_sampler_counters
from enerf_ns.method.origin import ORIGIN_FILE, origin
from enerf_ns.method.pipeline import EnerfPipeline, EnerfPipelineConfig, TrainStep
from enerf_ns.method.probe import view_direction_gain
from enerf_ns.method.throughput import batch_factor
from enerf_ns.poses.findings import findings
from enerf_ns.quiet import silence_known_warnings
from enerf_ns.terminal import clear_line, columns, duration, say, say_plainly, say_table, say_where, without_chatter

POSES_FILE = "poses.json"
"""Name of the file in a run's folder that states the errors found in clock, poses and lens."""

CHOICES_FILE, CHOICES_COLUMNS = "choices.txt", 100
"""Name of the file in a run's folder that states what was chosen and why, and the width of its lines."""

LONG = 3600.0
"""Seconds of training from which the time that it takes is printed at the start."""

START_SECONDS = 60.0
"""Seconds within which a run may have written its config and no scores yet."""


@dataclass
class EnerfTrainerConfig(TrainerConfig):
    """The config of a run. It reads and checks the recording before anything is written."""

    _target: Type = field(default_factory=lambda: EnerfTrainer)  # noqa: UP006
    pipeline: EnerfPipelineConfig = field(default_factory=EnerfPipelineConfig)
    prompt: Fixed[Optional[str]] = None  # noqa: UP045
    data: Optional[Path] = None  # noqa: UP045
    """Folder of the recording."""
    load_config: Optional[Path] = None  # noqa: UP045
    """config.yml of a run to continue."""
    max_num_iterations: int = 4000
    """Number of steps."""
    verbose: bool = False
    """Print all choices for the recording, with their reasons and flags, as choices.txt in the run's folder states
    them."""
    preset: Optional[str] = None  # noqa: UP045
    """Settings of the E-NeRF paper for one of its sequences: eds00, eds11, mocap-1d-trans, mocap-desk2,
    mocap-desk2-6views, shake-carpet1, shake-moon1, shake-moon2, spiral1, spiral1-sparse, spiral1-more-sparse or
    spiral2. Flags that you set take precedence. Default: no preset."""

    evaluation_share: float = 0.03
    """Largest share of the training time that evaluation takes during training: it scores a few held-out frames and the
    held-out events at moments evenly spaced in log time (history.jsonl), and stores previews. All held-out frames are
    scored once at the end, in extra time. With 0 nothing is evaluated, not even at the end."""

    def __post_init__(self) -> None:
        """Checks the config.yml of --load-config, since Nerfstudio would end with a traceback, or train a run that was
        moved from its start. Hands --data on, since Nerfstudio would print that it does."""
        if self.load_config is not None:
            with exit_with_a_sentence():
                self.load_config = absolute(self.load_config)
                config = read_config(self.load_config)
                if isinstance(config, EnerfTrainerConfig):
                    config._check_place(self.load_config.parent)
        elif self.data is not None and self.pipeline.datamanager.data != self.data:
            self.pipeline = replace(self.pipeline, datamanager=replace(self.pipeline.datamanager, data=self.data))
            self.data = None

    def resolved(self) -> EnerfTrainerConfig:
        """A copy in which everything is decided: absolute paths, the length of the decay of learning rates, and the
        choices for the recording (`pipeline.resolution`). The events of the recording are read and checked.

        The choices are kept with this config and its copies until a setting changes. Nerfstudio stores config.yml, and
        then sets up one process for each device, where a second measurement could give another batch.

        Raises:
            RecordingError: The recording, or the checkpoint to continue from, cannot be used.
            FlagError: A flag cannot be followed.
            OutputError: The run's folder holds another run.
        """
        check_ranges(self)
        self._check_device()
        config = deepcopy(self)
        asked = yaml.dump([self.data, self.preset, self.machine, self.optimizers, self.pipeline])
        known = config.__dict__.pop("_resolution", None)
        pipeline, parser = config.pipeline, config.pipeline.datamanager.dataparser
        data = self.data or pipeline.datamanager.data or (parser.data if parser.data != Path() else None)
        if data is None:
            raise FlagError("--data is missing; give the folder of a recording")
        config.data = pipeline.datamanager.data = parser.data = absolute(data)
        config.output_dir = absolute(self.output_dir)
        config._check_output_dir()
        config.load_dir = self.load_dir and absolute(self.load_dir)
        config.load_checkpoint = self.load_checkpoint and absolute(self.load_checkpoint)
        checkpoint = config.checkpoint()
        decays = load_checkpoint(checkpoint)["max_steps"] if checkpoint else {}
        for name, group in config.optimizers.items():
            scheduler = group["scheduler"]
            scheduler.max_steps = scheduler.max_steps or decays.get(name) or self.max_num_iterations
        if known is not None and known[0] == asked:
            pipeline.resolution = known[1]
        elif not pipeline.resolution.choices:
            recording = parser.setup().recording()
            optimizer, device = config.optimizers["fields"]["optimizer"], config.machine.device_type
            pipeline.resolution = resolve(
                pipeline,
                recording,
                self.preset,
                lambda filled: view_direction_gain(filled, optimizer, device),
                lambda filled: batch_factor(filled, device),
            )
            self._resolution = asked, deepcopy(pipeline.resolution)
        if checkpoint:
            config._check_fits(checkpoint)
        index_events(config.recording())
        return config

    def _check_place(self, folder: Path) -> None:
        """Checks that checkpoints beside config.yml are those of the folder that it states, where training continues.

        Args:
            folder: Folder of config.yml.

        Raises:
            FlagError: The run was moved or copied to that folder.
        """
        stated, beside = absolute(self.get_base_dir()), folder / self.relative_model_dir
        is_there = stated.exists() and stated.samefile(folder)
        if beside.is_dir() and not is_there:
            raise FlagError(
                f"--load-config continues the run in {stated}, but its checkpoints were moved or copied to {folder}; "
                "move the run back, or train on in a new folder with the flags of the run and --load-dir "
                f"{quoted(beside)}."
            )

    def _check_output_dir(self) -> None:
        """Checks that the run's folder can be made, before anything that takes time.

        Raises:
            OutputError: It cannot.
        """
        check_outside_recordings("--output-dir", self.get_base_dir())
        there = next(folder for folder in (self.output_dir, *self.output_dir.parents) if folder.exists())
        try:
            with TemporaryFile(dir=there):
                pass
        except OSError as error:
            raise _unwritable(self.output_dir, error) from error

    def _check_device(self) -> None:
        """Checks that the machine has the device, and that the backend of the hash grid runs on it.

        Raises:
            FlagError: It has not, or it does not.
        """
        if self.machine.device_type == "cuda" and not torch.cuda.is_available():
            raise FlagError("--machine.device-type is cuda, but PyTorch finds no GPU; check its driver, or give cpu.")
        name = self.pipeline.model.hash_grid
        if name not in ("auto", "torch"):
            positions = torch.empty(0, 3, device=self.machine.device_type)
            try:
                fitting(name, positions, positions[:, :2])
            except ValueError as error:
                raise FlagError(f"--pipeline.model.hash-grid: {error}.") from error

    def _check_fits(self, checkpoint: Path) -> None:
        """Checks that a checkpoint has the field, the sensor and the scene box of this config, which is resolved.

        Raises:
            FlagError: It has others.
        """
        filled = self.pipeline.resolution.applied_to(self.pipeline)
        parser = filled.datamanager.dataparser.setup()
        outputs = parser.outputs(parser.recording(), "train")
        num_frames = len(outputs.image_filenames)
        with torch.random.fork_rng():
            model: EnerfModel = filled.model.setup(scene_box=outputs.scene_box, num_train_data=num_frames)
        state = load_checkpoint(checkpoint)
        stored = {
            name.replace("_model.module.", "_model."): value
            for name, value in state["pipeline"].items()
            if name.startswith("_model.")
        }
        here = model.state_dict(prefix="_model.")
        shapes = [
            [name, *(tuple(side[name].shape) if name in side else "missing" for side in (stored, here))]
            for name in (*here, *stored)
        ]
        other = [f"{name.removeprefix('_model.')} is {there}, but {mine} here" for name, there, mine in shapes
                 if there != mine]  # fmt: skip
        other += [f"{name} is learned" for name in state["optimizers"].keys() - model.get_param_groups().keys()]
        if not other and not torch.allclose(*(side["_model.field.geometry.aabb"] for side in (stored, here))):
            other = ["its scene has another box"]
        if other:
            raise FlagError(
                f"The checkpoint {checkpoint} is of another configuration ({other[0]}); give the flags of its run, "
                "which its config.yml states, or continue that run with --load-config."
            )

    def recording(self) -> EventRecording:
        """The recording of a config that is resolved."""
        return self.pipeline.resolution.applied_to(self.pipeline).datamanager.dataparser.setup().recording()

    def checkpoint(self) -> Path | None:
        """The checkpoint that training continues from; None for a new run.

        For a config that was loaded from config.yml, it is the newest whole checkpoint of the run. Else it is the
        checkpoint that the flags name.

        Raises:
            RecordingError: The run has checkpoints, but none is whole.
            FlagError: The checkpoint that a flag names is missing or damaged, or the run would end before its step.
            OutputError: The run's folder holds a run that neither config.yml nor a flag names.
        """
        folder = super().get_checkpoint_dir()
        own = newest_checkpoint(folder)
        if own and self.pipeline.resolution.choices:
            return own
        if own and self.load_dir != folder:
            raise _taken(folder.parent)
        if self.load_dir and self.load_step is None:
            try:
                path = newest_checkpoint(self.load_dir)
                found = "is no folder" if self.load_dir.exists() else "does not exist"
            except RecordingError:
                path, found = None, "holds no whole checkpoint"
            if path is None:
                raise FlagError(f"--load-dir {self.load_dir} {found}; give nerfstudio_models of a trained run.")
        elif self.load_dir or self.load_checkpoint:
            path = checkpoint_path(self.load_dir, self.load_step or 0) if self.load_dir else self.load_checkpoint
            assert path is not None
            if not is_whole(path):
                found = "is cut short or damaged, or is no checkpoint" if path.exists() else "does not exist"
                raise FlagError(f"The checkpoint {path} {found}; give another with --load-step or --load-checkpoint.")
        else:
            return None
        step = load_checkpoint(path)["step"]
        if step + 1 >= self.max_num_iterations:
            raise FlagError(
                f"--max-num-iterations {self.max_num_iterations} counts the {step + 1} steps of {path}, too; give a "
                "larger number to continue."
            )
        return path

    def get_checkpoint_dir(self) -> Path:
        """The folder of the run's checkpoints. Sets `load_step` to the step of the newest whole checkpoint in it.

        Nerfstudio's commands, from ns-eval to ns-viewer, ask a config for this folder, and then load the checkpoint of
        `load_step`, or the newest by name where that is None, whether it is whole or not. They call nothing else of the
        config before they load, so that the step must be set here.

        Raises:
            SystemExit: The folder exists, but holds no whole checkpoint; with one sentence.
        """
        folder = super().get_checkpoint_dir()
        with exit_with_a_sentence():
            newest = newest_checkpoint(folder)
        if newest is not None:
            self.load_step = int(newest.stem.removeprefix("step-"))
        return folder

    def print_to_terminal(self) -> None:
        """Prints nothing: `save_config` prints the choices as a table, and config.yml holds all settings."""

    def save_config(self) -> None:
        """Prints the recording and the choices for it, and stores config, choices and origin of the run.

        A run that is continued keeps its origin.

        Raises:
            SystemExit: The run cannot be trained, or its folder holds another run; with one sentence.
        """
        with exit_with_a_sentence():
            config = self.resolved()
            resolution = config.pipeline.resolution
            say_table(recording_table(resolution.applied_to(config.pipeline).datamanager.dataparser))
            for line in resolution.selection:
                say_plainly(f"* {line}")
            say_plainly(" ".join(resolution.summary))
            for flag in resolution.flags_to_state:
                say_where("better with", flag)
            if self.verbose:
                CONSOLE.print(Text(choices_text(resolution.choices, columns())), soft_wrap=True)
            if resolution.cause:
                say(f"Training may fail to explain the events, because {resolution.cause}.")
            folder = config.get_base_dir()
            files = {
                "config.yml": yaml.dump(config),
                "choices.json": json.dumps([asdict(choice) for choice in resolution.choices], indent=2),
                ORIGIN_FILE: json.dumps(origin(), indent=2),
                CHOICES_FILE: choices_text(resolution.choices, CHOICES_COLUMNS),
            }
            is_loaded = bool(self.pipeline.resolution.choices)
            if is_loaded and (folder / ORIGIN_FILE).exists():
                del files[ORIGIN_FILE]
            is_alone = self.machine.num_machines == 1  # the machines of one run may share its folder
            is_new = is_alone and not is_loaded and config.load_dir != folder / config.relative_model_dir
            if is_new and _holds_run(folder):
                raise _taken(folder)
            try:
                write_together(folder, {name: text.encode() for name, text in files.items()})
            except OSError as error:
                raise _unwritable(folder, error) from error
            say_where("all choices, their reasons and flags", quoted(folder / CHOICES_FILE))
            say_where("configuration", quoted(folder / "config.yml"))

    def setup(self, **kwargs: Any) -> EnerfTrainer:
        """The trainer of this config, resolved for its recording."""
        with exit_with_a_sentence():
            silence_known_warnings()
            config = self.resolved()
            config.load_checkpoint, config.load_dir = config.checkpoint(), None
            config.data = None  # so that the viewer keeps camera paths with the run
            with without_chatter():
                return self._target(config, **kwargs)


def _taken(folder: Path) -> OutputError:
    return OutputError(
        f"{folder} holds a run already; continue it with --load-config {quoted(folder / 'config.yml')}, give the new "
        "one another --timestamp, or remove the folder."
    )


def _holds_run(folder: Path) -> bool:
    """Whether a folder has scores of a run, or a run that may have been started in the same second."""
    if not (folder / "config.yml").exists():
        return False
    age = time.time() - (folder / "config.yml").stat().st_mtime
    return (folder / HISTORY_FILE).exists() or age < START_SECONDS


def _unwritable(folder: Path, error: OSError) -> OutputError:
    return OutputError(f"{folder} could not be written to ({error.strerror}); make room, or give another --output-dir.")


class EnerfTrainer(Trainer):
    """Nerfstudio's trainer, which survives an interruption, a full disk, and a step that is not finite.

    A step whose losses or gradients are not finite changes neither the parameters nor the state of the optimisers. The
    learning rate follows the number of the step all the same.
    """

    config: EnerfTrainerConfig
    pipeline: EnerfPipeline
    optimizers: GuardedOptimizers

    def __init__(self, config: EnerfTrainerConfig, local_rank: int = 0, world_size: int = 1):
        super().__init__(config, local_rank, world_size)
        if config.machine.device_type == "cuda":
            torch.cuda.set_device(self.device)  # else kernels and events of each process would be on the first GPU
        self.num_skipped = 0
        """Steps that were left out because they were not finite."""
        self._skipped_in_a_row = 0
        self._unseen: Later[tuple[int, TrainStep]] | None = None  # the last step
        self._trained = -1  # the last step that was taken
        self._interrupted = False
        self._recorded: dict[str, Any] | None = None  # state of ErrorAgainstTime at the checkpoint
        self._unsaved = ""  # why the last checkpoint could not be stored
        self._found_wrong: set[str] = set()
        self._handlers: dict[int, Any] = {}

    @exit_with_a_sentence()
    def setup(self, test_mode: Literal["test", "val", "inference"] = "val") -> None:
        config = self.config
        with without_chatter(), self.train_lock:  # a browser may be there before the checkpoint
            super().setup(test_mode)
        self.pipeline.num_steps = config.max_num_iterations
        self.error_against_time = ErrorAgainstTime(
            self.pipeline, self.base_dir, config.max_num_iterations, config.evaluation_share
        )
        if config.load_checkpoint is not None:
            self._resume(load_checkpoint(config.load_checkpoint))
        if is_main_process():
            self._say_how_long()
            self.callbacks.append(TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN], self._finish))
        if isinstance(self.viewer_state, Viewer):
            CONSOLE.print(*self.viewer_state.viewer_info, sep="\n", soft_wrap=True, highlight=False, style="green")
        elif self.viewer_state is not None:
            CONSOLE.print(f"Legacy viewer: {self.viewer_state.viewer_url}", soft_wrap=True, style="green")

    def _say_how_long(self) -> None:
        """Prints how long training will take, if that is more than `LONG`."""
        steps = self.config.max_num_iterations - self._start_step
        seconds = steps * (self.pipeline.seconds_a_step or 0.0)
        if seconds > LONG:
            say(
                f"{steps} steps of {self.pipeline.datamanager.get_train_rays_per_batch()} rays will take about "
                f"{duration(seconds)} on the {self.device}. Use a GPU, or the method enerf, which takes minutes."
            )

    def setup_optimizers(self) -> GuardedOptimizers:
        return GuardedOptimizers(self.config.optimizers.copy(), self.pipeline.get_param_groups(), self._is_finite)

    def _resume(self, state: dict[str, Any]) -> None:
        """Restores the state that only this class stores in a checkpoint. Nerfstudio has restored the rest before.

        The states of generators are those of the first process. The others are seeded anew, or all would draw the same.
        """
        generator = self.pipeline.datamanager.generator
        if not is_main_process():
            seeds = np.random.SeedSequence([self.config.machine.seed + get_rank(), self._start_step])
            seed = int(seeds.generate_state(1)[0])
            set_random_seed(seed)
            generator.manual_seed(seed)
        elif state["device"] == self.pipeline.device.type:
            set_random_state(state["generators"], self.pipeline.device)
            generator.set_state(state["generators"]["batches"])
        set_sampler_counters(self.pipeline.model.sampler, state["sampler"])
        self._recorded = state["error_against_time"]

    @check_main_thread
    def save_checkpoint(self, step: int) -> None:
        """Stores a checkpoint of a step, whole or not at all.

        Where the disk is full, the earlier checkpoints stay, a line says so, and training continues.
        """
        pipeline = self.pipeline
        state = {
            "step": step,
            "pipeline": pipeline.state_dict(),
            "optimizers": {name: optimizer.state_dict() for name, optimizer in self.optimizers.optimizers.items()},
            "schedulers": {name: scheduler.state_dict() for name, scheduler in self.optimizers.schedulers.items()},
            "scalers": self.grad_scaler.state_dict(),
            "max_steps": {name: group["scheduler"].max_steps for name, group in self.config.optimizers.items()},
            "device": pipeline.device.type,
            "generators": {
                **random_state(pipeline.device),
                "batches": pipeline.datamanager.generator.get_state(),
            },
            "sampler": sampler_counters(pipeline.model.sampler),
            "error_against_time": self.error_against_time.state(),
        }
        path = checkpoint_path(self.checkpoint_dir, step)
        try:
            write_checkpoint(path, state)
        except OSError as error:
            self._unsaved = f"Step {step} could not be stored in {self.checkpoint_dir} ({error.strerror or error})"
            say(f"{self._unsaved}; the checkpoints before it stay. Make room; training continues.")
            return
        self._unsaved = ""
        if self.config.save_only_latest_checkpoint and not self._skipped_in_a_row:
            for other in self.checkpoint_dir.glob("*.ckpt"):
                if other != path:
                    other.unlink()

    @exit_with_a_sentence()
    def train(self) -> None:
        """Trains up to step `max_num_iterations`, with the steps of earlier sessions. SIGINT and SIGTERM store a
        checkpoint and end it.

        Raises:
            SystemExit: With code 130, training was interrupted. With a sentence, training failed: several steps in a
                row were not finite, the last checkpoint could not be stored, or something else that the user can mend.
        """
        config, total = self.config, self.config.max_num_iterations
        self._trained = self._start_step - 1
        if self._start_step >= total:
            say(f"The run in {self.base_dir} is at its end, at step {total} of {total}. Nothing is left to train.")
            return
        self._handle_signals()
        config.max_num_iterations = total - self._start_step  # Nerfstudio counts from the step of the checkpoint
        try:
            if is_main_process():
                with self.train_lock:  # else a picture that is rendered meanwhile would be one of training
                    self.error_against_time.begin(self._start_step, self._recorded)
            super().train()
        except OSError as error:  # from files that Nerfstudio writes beside checkpoints, such as TensorBoard's
            raise SystemExit(
                f"enerf: Training ended at step {self._trained}, since {self.base_dir} could not be written to "
                f"({error.strerror or error}); the checkpoints there stay. Make room, and continue with ns-train "
                f"{config.method_name} --load-config {quoted(self.base_dir / 'config.yml')}."
            ) from error
        finally:
            config.max_num_iterations = total
            self._restore_signals()

    def train_iteration(self, step: int) -> tuple[Tensor, dict[str, Tensor], dict[str, Tensor]]:
        with self.error_against_time.step(step), kernels_alone():
            results = super().train_iteration(step)
        self._metrics = results[2]
        self._trained = step
        self._look_at_finite(step)
        if step >= LEARNING_CHECKED_FROM and step % LEARNING_CHECKED_EVERY == 0:
            self._look_at_learning(step)
        if self._interrupted:
            self.stop_training = True
        return results

    def eval_iteration(self, step: int) -> None:
        if not self.stop_training and is_main_process():
            self.error_against_time.after_step(step, self._metrics)
        super().eval_iteration(step)

    def _look_at_finite(self, step: int) -> None:
        """Counts a step that was left out. On a GPU it looks at the step before, whose result has arrived by now."""
        assert self.optimizers.finite is not None
        latest = Later((step, self.pipeline.last_step), self.optimizers.finite)
        known = self._unseen if self.optimizers.finite.is_cuda else latest
        self._unseen = latest
        if known is not None and not known:
            self._look_at_skipped(*known.seen)
        elif known is not None:
            self._skipped_in_a_row = 0

    def _finish(self, step: int) -> None:
        """Scores the run at its end, after its last checkpoint. An interruption stops the scoring at once."""
        self._restore_signals()
        with self.train_lock:
            self.error_against_time.finish()
        flush_tensorboard()

    def _is_finite(self) -> Tensor:
        """Whether the losses of this step, and the squares of its gradients, of which Adam keeps means, are finite.

        With a scaled loss (mixed precision), GradScaler itself leaves out steps whose gradients overflow.
        """
        self.pipeline.stopwatch.lap("backward")
        numbers = list(self.pipeline.last_step.losses.values())
        if not self.grad_scaler.is_enabled() or self.grad_scaler.get_scale() <= 1:
            numbers += [
                torch.linalg.vector_norm(parameter.grad)
                for parameter in self.pipeline.parameters()
                if parameter.grad is not None
            ]
        return torch.stack([number.float() for number in numbers]).isfinite().all()

    def _look_at_skipped(self, step: int, seen: TrainStep) -> None:
        """Counts a step that was left out. Stores the batch of the first one, and ends training after `MOST_SKIPPED` in
        a row.

        Raises:
            SystemExit: So many steps in a row were not finite; with one sentence.
        """
        term = what_is_not_finite(seen, self.pipeline.model)
        self.optimizers.zero_grad_all()  # since some groups accumulate gradients over several steps
        self.num_skipped += 1
        self._skipped_in_a_row += 1
        if self.num_skipped == 1 and is_main_process():
            file = self.base_dir / f"skipped-step-{step:09d}.pt"
            try:
                keep_batch(seen, step, file)
                kept = f"Its batch is stored in {file}"
            except OSError as error:
                kept = f"Its batch could not be stored ({error.strerror})"
            say(f"Step {step} is left out, since {term} is not finite. {kept}.")
        if self._skipped_in_a_row == MOST_SKIPPED:
            raise SystemExit(
                f"enerf: Training stopped at step {step}, since {term} is not finite, {MOST_SKIPPED} steps in a row; "
                f"the checkpoints in {self.checkpoint_dir} stay. Try a lower learning rate "
                "(--optimizers.fields.optimizer.lr), and check the recording with `enerf inspect`."
            )

    def _look_at_learning(self, step: int) -> None:
        """Warns, once for each reason, that the field renders nothing."""
        found = why_nothing_is_learnt(self.pipeline.last_step, self.pipeline.model.sensor)
        for reason in found.keys() - self._found_wrong:
            self._found_wrong.add(reason)
            say(
                f"Nothing is learnt at step {step}: {found[reason]}. Try a lower learning rate "
                "(--optimizers.fields.optimizer.lr), check --contrast-thresholds and --depth-range, and check poses "
                "and clock with `enerf inspect`."
            )

    def _handle_signals(self) -> None:
        try:
            for number in (signal.SIGINT, signal.SIGTERM):
                if signal.getsignal(number) != signal.SIG_IGN:  # a shell sets that for runs in the background
                    self._handlers[number] = signal.signal(number, self._interrupt) or signal.SIG_DFL
        except ValueError:  # outside the main thread, which alone receives signals
            pass

    def _restore_signals(self) -> None:
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        self._handlers.clear()

    def _interrupt(self, number: int, frame: FrameType | None) -> None:
        if self._interrupted:
            raise SystemExit(130)
        self._interrupted = self.stop_training = True
        say("Training is interrupted. It finishes this step and stores a checkpoint; a second signal stops it at once.")

    def _update_viewer_state(self, step: int) -> None:
        if isinstance(self.viewer_state, Viewer):
            self.pipeline.viewer.after_step(step)
        else:
            super()._update_viewer_state(step)

    def _train_complete_viewer(self) -> None:
        """Does nothing: Nerfstudio would wait here, before the last lines; `_end_viewer` waits after them."""

    def _end_viewer(self, how: str) -> None:
        """Says in the browser how training ended. After the last step, the viewer stays until Ctrl-C if the flag says
        so, or if a browser shows it and the command runs on a terminal."""
        viewer = self.viewer_state
        if not isinstance(viewer, Viewer):
            return
        looked_at = bool(viewer.viser_server.get_clients())
        at_terminal = looked_at and CONSOLE.is_terminal and sys.stdin.isatty()
        stays = not self._interrupted and (at_terminal or not self.config.viewer.quit_on_train_completion)
        config = quoted(self.base_dir / "config.yml")
        show = "" if stays else f" `ns-viewer --load-config {config}` shows the run again."
        self.pipeline.viewer.end(self._trained, f"**Training {how} at step {self._trained}.**{show}")
        if stays:
            say("The viewer stays until Ctrl-C.")
            with suppress(KeyboardInterrupt):
                while True:
                    time.sleep(1.0)
        elif looked_at:
            time.sleep(0.5)  # in which viser sends the sentence

    def _after_train(self) -> None:
        self.step = self._trained  # Nerfstudio has counted one step more where training was stopped
        config = quoted(self.base_dir / "config.yml")
        if self._trained + 1 < self._start_step + self.config.max_num_iterations:
            if self._trained >= self._start_step:
                self.save_checkpoint(self._trained)
            writer.write_out_storage()
            clear_line()
            self._say_skipped()
            say_where("continue", f"ns-train {self.config.method_name} --load-config {config}")
            self._end_viewer("was interrupted")
            raise SystemExit(130)
        with without_chatter():
            super()._after_train()
        if self._unsaved:
            raise SystemExit(f"enerf: {self._unsaved}; the checkpoints before it stay. Make room, and continue.")
        self._say_verdict()
        self._say_skipped()
        learned = self.pipeline.model.sensor.learned()
        if learned:
            numbers = ", ".join(f"{name.replace('_', ' ')} {value:.3g}" for name, value in learned.items())
            say(f"Parameters of the sensor that were learned: {numbers}.")
        self._say_poses()
        say_where("checkpoint", quoted(self.checkpoint_dir))
        say_where("scores, picture and video", f"enerf report {config}")
        say_where("scores alone", f"ns-eval --load-config {config} --output-path scores.json")
        manager = self.pipeline.datamanager
        for dataset, flag in ((manager.eval_dataset, ""), (manager.train_dataset, " --pose-source train")):
            if len(dataset) > 1:
                say_where(
                    "video along the cameras",
                    f"ns-render interpolate --load-config {config} --output-path video.mp4 "
                    f"--rendered-output-names display{flag}",
                )
                break
        say_where("viewer", f"ns-viewer --load-config {config}")
        self._end_viewer("has ended")

    def _say_verdict(self) -> None:
        """Prints the end of the training, and whether its field explains the events."""
        found = self.error_against_time.verdict
        say_table(Rule("Training is done" + (f": {found.short}" if found else "")))
        if found is not None and found.explained == "yes":
            say_plainly(found.sentence)
        elif found is not None:
            say(found.sentence)

    def _say_poses(self) -> None:
        """Prints the errors that were found in clock, poses and lens, and stores them with the run."""
        refiner, manager = self.pipeline.poses, self.pipeline.datamanager
        if not refiner.looks:
            return
        found = findings(refiner, manager.distance)
        say_table(findings_table(found))
        try:
            write_whole(self.base_dir / POSES_FILE, json.dumps([row.as_dict() for row in found], indent=2) + "\n")
        except OSError as error:
            say(f"{self.base_dir / POSES_FILE} could not be written ({error.strerror}); make room.")
        if refiner.corrected:
            say_where("refined poses", f"enerf export poses {quoted(self.base_dir / 'config.yml')}")

    def _say_skipped(self) -> None:
        if self.num_skipped:
            steps = "1 step was" if self.num_skipped == 1 else f"{self.num_skipped} steps were"
            say(f"{steps} left out, since losses or gradients were not finite.")

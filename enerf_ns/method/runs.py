"""Runs from Python: configure a method, train it as `ns-train` does, and load the run again."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal, cast

from enerf_ns.dataparsers.recording.errors import FlagError, RecordingError
from enerf_ns.dataparsers.recording.files import absolute
from enerf_ns.dataparsers.recording.safe_globals import allow_numpy_scalars_in_checkpoints

if TYPE_CHECKING:
    from nerfstudio.engine.trainer import TrainerConfig
    from nerfstudio.pipelines.base_pipeline import Pipeline

    from enerf_ns.dataparsers.formats.format import Format, FormatOptions
    from enerf_ns.method.pipeline import EnerfPipeline
    from enerf_ns.method.trainer import EnerfTrainer, EnerfTrainerConfig


@dataclass(frozen=True)
class Run:
    """A trained run, loaded from its folder."""

    config_file: Path
    """config.yml of the run."""
    config: EnerfTrainerConfig
    """The config that config.yml holds."""
    pipeline: EnerfPipeline
    """The pipeline, with the parameters of the last checkpoint."""
    train_seconds: float | None = None
    """Time (s) of all training steps; None for a run that was loaded."""
    processor_seconds: float | None = None
    """Time (s) of the processor in these steps, summed over its cores; None for a run that was loaded."""


def method_config(
    name: str, data: Path, output_dir: Path, changes: Mapping[str, Any] = MappingProxyType({})
) -> EnerfTrainerConfig:
    """The configuration of a method, to train without a viewer.

    Args:
        name: Name of the method, such as `enerf`.
        data: Folder of a recording.
        output_dir: Folder of all runs; each run has a folder of its own in it.
        changes: Values by the names of ns-train's flags, such as {"pipeline.datamanager.event_pairs": 512}. Options of
            a format follow its name: {"pipeline.datamanager.dataparser.format": "llff_events",
            "pipeline.datamanager.dataparser.options": {"pose_set": "uslam"}}.

    Raises:
        FlagError: There is no method, setting, format or option of such a name.
    """
    from nerfstudio.configs.method_configs import all_methods

    from enerf_ns.dataparsers.event_dataparser import EventDataParserConfig
    from enerf_ns.dataparsers.formats.registry import format_named

    own = [method for method, known in all_methods.items() if isinstance(known, type(all_methods["enerf"]))]
    if name not in own:
        raise FlagError(f"There is no method {name} in this package; choose one of {', '.join(own)}.")
    config = cast("EnerfTrainerConfig", copy.deepcopy(all_methods[name]))
    config.data = config.pipeline.datamanager.data = data
    config.output_dir, config.vis = output_dir, "tensorboard"
    for path, value in changes.items():
        *parents, attribute = path.split(".")
        owner: Any = config
        for parent in parents:
            owner = getattr(owner, parent, None)
        if not hasattr(owner, attribute):
            raise FlagError(f"The method {name} has no setting {path}; ns-train {name} --help lists all that it has.")
        if attribute == "options" and isinstance(owner, EventDataParserConfig):
            value = _options(format_named(owner.format), value)
        setattr(owner, attribute, value)
    return config


def _options(format: Format, values: Mapping[str, Any]) -> FormatOptions:
    try:
        return format.options(**values)
    except TypeError as error:
        known = ", ".join(option.name for option in fields(format.options)) or "none"
        raise FlagError(
            f"Recordings of {format.name} lack one of the options {', '.join(values)}; known: {known}."
        ) from error


def set_up(config: EnerfTrainerConfig) -> EnerfTrainer:
    """A trainer that is set up as `ns-train` does it, with random generators seeded by `config.machine.seed`.

    Nerfstudio's logs go to this run from now on, and no longer to earlier runs of this process.
    """
    from enerf_ns.method.checkpoints import set_random_seed
    from enerf_ns.method.nerfstudio_seams import start_new_logs

    set_random_seed(config.machine.seed)
    start_new_logs()
    trainer: EnerfTrainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    return trainer


def train(config: EnerfTrainerConfig) -> Run:
    """Trains in this process as `ns-train` does, and loads the run.

    Args:
        config: Configuration of the run. Its time stamp, which names the run's folder, is set if it is not set yet.

    Raises:
        RecordingError: The recording cannot be used; nothing is written then.
        FlagError: A setting cannot be followed; nothing is written then.
    """
    from nerfstudio.utils import profiler

    config.resolved()
    config.set_timestamp()
    config.save_config()
    trainer = set_up(config)
    try:
        trainer.train()
    finally:
        profiler.flush_profiler(config.logging)
    run = load(config.get_base_dir() / "config.yml")
    time = trainer.error_against_time
    return replace(run, train_seconds=time.seconds, processor_seconds=time.processor_seconds)


def load(config_file: Path) -> Run:
    """A trained run of a method of this package, to evaluate it.

    Args:
        config_file: config.yml of the run.

    Raises:
        RecordingError: The file is missing, cannot be loaded, or is of a method of another package.
    """
    from nerfstudio.configs.method_configs import all_methods

    config, pipeline = load_any_method(config_file, "test")
    if not isinstance(config, type(all_methods["enerf"])):
        raise RecordingError(
            f"{config_file} is a run of the method {config.method_name}; give the config.yml of a run of enerf."
        )
    return Run(config_file, cast("EnerfTrainerConfig", config), cast("EnerfPipeline", pipeline))


def load_any_method(
    config_file: Path, test_mode: Literal["test", "val", "inference"]
) -> tuple[TrainerConfig, Pipeline]:
    """Config and pipeline of a trained run of any of Nerfstudio's methods, with the checkpoint beside its config.yml.

    Without a folder of checkpoints there, it is in the folder in which the run was trained.

    Args:
        config_file: config.yml of the run.
        test_mode: Split of the data that is loaded, as in Nerfstudio's `eval_setup`.

    Raises:
        RecordingError: The file is missing or cannot be loaded.
    """
    if not config_file.is_file():
        found = "is a folder" if config_file.is_dir() else "does not exist"
        raise RecordingError(f"{config_file} {found}; give the config.yml of a trained run.")
    from nerfstudio.utils.eval_utils import eval_setup

    from enerf_ns.terminal import without_chatter

    def stored_here(config: TrainerConfig) -> TrainerConfig:
        beside = absolute(config_file).parent / config.relative_model_dir.name
        if beside.is_dir():
            config.relative_model_dir = beside  # an absolute path, which is used in place of the folder of the run
        return config

    def set_up_pipeline() -> tuple[TrainerConfig, Pipeline]:
        return eval_setup(config_file, test_mode=test_mode, update_config_callback=stored_here)[:2]

    allow_numpy_scalars_in_checkpoints()  # of runs on the data of another parser, too
    try:
        with without_chatter():
            try:
                return set_up_pipeline()
            except (AssertionError, FileNotFoundError):  # a run that trains may have replaced its checkpoint meanwhile
                return set_up_pipeline()
    except (Exception, SystemExit) as error:  # the kind depends on what is missing, or of another version
        reason = " ".join(str(error).split()).removeprefix("enerf: ").rstrip(".") or type(error).__name__
        if isinstance(error, IndexError) or (isinstance(error, SystemExit) and isinstance(error.code, int)):
            reason = "its checkpoints are not found"  # the folder is empty or missing, which Nerfstudio only prints
        raise RecordingError(
            f"{config_file} cannot be loaded as a trained run ({reason}); give the config.yml that training wrote, in "
            "the folder in which training was started."
        ) from error

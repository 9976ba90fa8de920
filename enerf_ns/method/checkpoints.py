"""The files of a run: its config.yml, and checkpoints, which are stored whole or not at all.

A checkpoint holds all that a run needs to continue as if it had not stopped.
"""

from __future__ import annotations

import io
import os
import random
import zipfile
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from nerfstudio.engine.trainer import TrainerConfig

from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.files import partial_of, reading
from enerf_ns.dataparsers.recording.safe_globals import allow_numpy_scalars_in_checkpoints
from enerf_ns.terminal import say


def read_config(path: Path) -> TrainerConfig:
    """The configuration of a run of any method.

    Args:
        path: config.yml of the run.

    Raises:
        RecordingError: The file is missing, cannot be read, is not the config of a run, or names classes that are not
            installed.
    """
    with reading(path, "the config.yml of a run"):
        text = path.read_text()
        try:
            config = yaml.load(text, Loader=yaml.Loader)  # as Nerfstudio reads it
        except yaml.constructor.ConstructorError as error:
            raise RecordingError(
                f"{path} names what is not installed ({error.problem}); install the package of its method, in the "
                "version that wrote it."
            ) from error
    if not isinstance(config, TrainerConfig):
        raise RecordingError(f"{path} is not the config.yml of a run; give the folder of a run.")
    return config


def checkpoint_path(folder: Path, step: int) -> Path:
    """The path of the checkpoint of a step, as Nerfstudio names it."""
    return folder / f"step-{step:09d}.ckpt"


def newest_checkpoint(folder: Path) -> Path | None:
    """The newest whole checkpoint of a folder. A checkpoint that is not whole is skipped, with one line in yellow.

    Args:
        folder: nerfstudio_models of a run; other files in it are ignored.

    Returns:
        None if the folder does not exist.

    Raises:
        RecordingError: The folder holds no checkpoint, or none that is whole.
    """
    if not folder.is_dir():
        return None
    for path in sorted(folder.glob("step-" + "[0-9]" * 9 + ".ckpt"), reverse=True):
        if is_whole(path):
            return path
        if not os.path.lexists(path):
            return newest_checkpoint(folder)  # training stored another one, and removed this one
        _say_passed_over(path)
    raise RecordingError(
        f"{folder} holds no whole checkpoint; give another run, or remove this folder to train its run from the start."
    )


def is_whole(path: Path) -> bool:
    """Whether a file is a checkpoint that torch can read, and its checksums are right."""
    try:
        with zipfile.ZipFile(path) as archive:
            sound = archive.testzip() is None
        state = load_checkpoint(path)
        return sound and {"step", "pipeline", "optimizers"} <= state.keys()
    except Exception:  # the kind depends on where the damage lies
        return False


def load_checkpoint(path: Path) -> dict[str, Any]:
    """The content of a checkpoint. Its tensors are read from the file when they are used."""
    allow_numpy_scalars_in_checkpoints()
    return torch.load(path, map_location="cpu", mmap=True)


@cache
def _say_passed_over(path: Path) -> None:
    say(f"{path} is cut short or damaged; the checkpoint before it is used.")


def write_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Stores a checkpoint whole or not at all, even where the power fails.

    The unfinished file lies above the folder of the checkpoint, since Nerfstudio reads a step from every name in it.

    Args:
        path: File of the checkpoint; its folder is made if it does not exist.
        state: Tensors and plain Python values.

    Raises:
        OSError: The disk is full, or the folder cannot be written to; no file is left then.
    """
    content = io.BytesIO()
    torch.save(state, content)
    partial = partial_of(path.parent.with_name(path.name))
    try:
        with open(partial, "wb") as file:
            file.write(content.getbuffer())
            file.flush()
            os.fsync(file.fileno())
        path.parent.mkdir(parents=True, exist_ok=True)
        partial.replace(path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise


def set_random_seed(seed: int) -> None:
    """Seeds the global random generators of the process, with a seed from 0 to 2^32 - 1."""
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002 - libraries draw from it
    torch.manual_seed(seed)


def random_state(device: torch.device) -> dict[str, Any]:
    """The states of the global random generators of the process, as tensors and plain Python values.

    Args:
        device: Device of the training; the state of its generator is stored too if it is a CUDA device.
    """
    name, keys, *rest = np.random.get_state()  # noqa: NPY002 - libraries draw from it
    return {
        "torch": torch.get_rng_state(),
        "cuda": torch.cuda.get_rng_state(device) if device.type == "cuda" else None,
        "numpy": (name, np.asarray(keys).tolist(), *rest),
        "python": random.getstate(),
    }


def set_random_state(state: dict[str, Any], device: torch.device) -> None:
    """Sets the global random generators of the process to the states that `random_state` gave."""
    torch.set_rng_state(state["torch"])
    if state["cuda"] is not None and device.type == "cuda":
        torch.cuda.set_rng_state(state["cuda"], device)
    np.random.set_state(state["numpy"])  # noqa: NPY002 - libraries draw from it
    random.setstate(state["python"])

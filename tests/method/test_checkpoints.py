"""Checkpoints that are whole, and those that are not."""

from __future__ import annotations

import errno
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import nerfstudio.engine.trainer  # noqa: F401 - before its writer, which would import it in a circle
import numpy as np
import pytest
import torch
import yaml
from nerfstudio.utils import writer
from nerfstudio.utils.eval_utils import eval_setup
from small_runs import set_up, small_config

from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.files import partial_of
from enerf_ns.method import checkpoints
from enerf_ns.method.checkpoints import is_whole, newest_checkpoint, random_state, set_random_state, write_checkpoint

SAVE = "import numpy as np, torch; torch.save({'lr': np.float64(0.01), 'other': np.float32(2.0)}, %r)"
LOAD = "import torch; %s; print(float(torch.load(%r, weights_only=True)['lr']))"


@pytest.mark.parametrize("allowed", [False, True])
def test_learning_rates_that_are_numpy_scalars_can_be_loaded(tmp_path: Path, allowed: bool):
    """In a process of its own, since what torch may load is a global of its."""
    file = str(tmp_path / "checkpoint.pt")
    subprocess.run([sys.executable, "-c", SAVE % file], check=True)
    first = (
        "from enerf_ns.dataparsers.recording.safe_globals import allow_numpy_scalars_in_checkpoints as allow; allow()"
        if allowed
        else "1"
    )
    run = subprocess.run([sys.executable, "-c", LOAD % (first, file)], capture_output=True, text=True)
    assert run.stdout == ("0.01\n" if allowed else "")
    assert allowed or "Unsupported" in run.stderr


@pytest.fixture(scope="module")
def run(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run with a checkpoint after each of its three steps."""
    config = small_config(recording, tmp_path_factory.mktemp("outputs"))
    config.max_num_iterations, config.steps_per_save, config.save_only_latest_checkpoint = 3, 1, False
    trainer = set_up(config)
    trainer.save_checkpoint(0)
    trainer.train()
    return trainer.base_dir


@pytest.fixture
def copy(run: Path, tmp_path: Path) -> Path:
    """A copy of the run, to be damaged."""
    folder = tmp_path / "recording/enerf/run"
    shutil.copytree(run, folder)
    config = yaml.load((folder / "config.yml").read_text(), Loader=yaml.Loader)
    config.output_dir = tmp_path
    (folder / "config.yml").write_text(yaml.dump(config))
    return folder


def cut_short(file: Path) -> None:
    os.truncate(file, file.stat().st_size // 2)


def cut_by_a_byte(file: Path) -> None:
    os.truncate(file, file.stat().st_size - 1)


def empty(file: Path) -> None:
    file.write_bytes(b"")


def flip(file: Path) -> None:
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)


def leave_a_partial(file: Path) -> None:
    file.rename(file.with_suffix(".ckpt.tmp"))


def leave_notes(file: Path) -> None:
    file.rename(file.with_name("notes.txt"))


@pytest.mark.parametrize("damage", [cut_short, cut_by_a_byte, empty, flip, leave_a_partial, leave_notes])
def test_the_newest_whole_checkpoint_is_used(copy: Path, capsys, damage: Callable[[Path], None]):
    """By training and by Nerfstudio's tools, which all load by `eval_setup`; one that is passed over is named."""
    config = yaml.load((copy / "config.yml").read_text(), Loader=yaml.Loader)
    config.max_num_iterations = 4
    newest = copy / "nerfstudio_models/step-000000002.ckpt"
    damage(newest)
    _, pipeline, path, step = eval_setup(copy / "config.yml")
    assert (path.name, step) == ("step-000000001.ckpt", 1)
    assert (f"{newest} is cut short or damaged" in capsys.readouterr().out) == newest.exists()
    weights = torch.load(path)["pipeline"]
    assert all(torch.equal(value, weights[name]) for name, value in pipeline.state_dict().items())
    trainer = set_up(config)
    assert trainer._start_step == 2
    trainer.train()
    assert [file.name for file in (copy / "nerfstudio_models").glob("*3.ckpt")] == ["step-000000003.ckpt"]
    assert eval_setup(copy / "config.yml")[3] == 3


def test_a_checkpoint_that_training_replaces_while_it_is_read_is_not_damaged(copy: Path, capsys, monkeypatch):
    def while_training(path: Path) -> bool:
        if path.name == "step-000000002.ckpt":
            for file in sorted(path.parent.iterdir()):
                file.replace(file.with_name("step-000000003.ckpt"))
        return is_whole(path)

    monkeypatch.setattr(checkpoints, "is_whole", while_training)
    assert newest_checkpoint(copy / "nerfstudio_models") == copy / "nerfstudio_models/step-000000003.ckpt"
    assert not capsys.readouterr().out


def test_where_none_is_whole_it_is_one_sentence(copy: Path):
    files = list((copy / "nerfstudio_models").iterdir())
    for file in files:
        cut_short(file)
    config = yaml.load((copy / "config.yml").read_text(), Loader=yaml.Loader)
    for load in (lambda: eval_setup(copy / "config.yml"), config.save_config, config.setup):
        with pytest.raises(SystemExit, match=r"^enerf: .*nerfstudio_models holds no whole checkpoint; give [^\n]*$"):
            load()
    for file in files:
        file.unlink()
    with pytest.raises(SystemExit, match=r"^enerf: .*nerfstudio_models holds no whole checkpoint; give [^\n]*$"):
        eval_setup(copy / "config.yml")


def test_what_counts_as_whole_loads_as_it_was(tmp_path: Path):
    """Of a file with a byte changed anywhere, or an end missing: either that is seen, or it does not matter."""
    state = {"step": 3, "weights": torch.arange(50.0), "random": random_state(torch.device("cpu"))}
    file = tmp_path / "models/step-000000003.ckpt"
    write_checkpoint(file, state)
    content, generator, seen = file.read_bytes(), np.random.default_rng(0), 0
    for _ in range(400):
        damaged = bytearray(content)
        if generator.random() < 0.2:
            damaged = damaged[: generator.integers(len(content))]
        else:
            damaged[generator.integers(len(content))] ^= 1 << generator.integers(8)
        file.write_bytes(damaged)
        if not is_whole(file):
            seen += 1
            continue
        loaded = torch.load(file)
        assert loaded["step"] == 3 and torch.equal(loaded["weights"], state["weights"])
        assert torch.equal(loaded["random"]["torch"], state["random"]["torch"])
        assert loaded["random"]["python"] == state["random"]["python"]
    assert seen > 200


def test_random_state_is_that_of_all_generators():
    state = random_state(torch.device("cpu"))

    def drawn() -> list:
        return [torch.rand(3).tolist(), np.random.rand(3).tolist(), np.random.normal(), random.random()]  # noqa: NPY002

    first = drawn()
    assert drawn() != first
    set_random_state(state, torch.device("cpu"))
    assert drawn() == first


def test_no_folder_is_no_checkpoint_and_no_error(tmp_path: Path):
    assert newest_checkpoint(tmp_path / "nowhere") is None
    with pytest.raises(RecordingError):
        newest_checkpoint(tmp_path)


@contextmanager
def full_disk(largest: int) -> Iterator[None]:
    """No file of this process can become larger than so many bytes, which is refused as where a disk is full."""
    assert signal.getsignal(signal.SIGXFSZ) is signal.SIG_IGN, "Python ignores it, so that writing fails instead"
    before, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (largest, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (before, hard))


def test_a_full_disk_keeps_the_last_checkpoint(copy: Path, capsys, monkeypatch):
    """Training goes on to its end, and ends with an error, since its last checkpoint is missing."""
    config = yaml.load((copy / "config.yml").read_text(), Loader=yaml.Loader)
    config.max_num_iterations, config.save_only_latest_checkpoint = 6, True
    models = copy / "nerfstudio_models"
    before = {file: file.read_bytes() for file in models.iterdir()}
    assert min(map(len, before.values())) > 200_000
    trainer = set_up(config)
    with full_disk(100_000), pytest.raises(SystemExit, match=r"^enerf: Step 5 could not be stored .* Make room, and "):
        trainer.train()
    said = capsys.readouterr().out
    for step in (3, 4, 5):
        assert f"Step {step} could not be stored in {models} (File too large); the checkpoints before it stay." in said
    assert {file: file.read_bytes() for file in models.iterdir()} == before
    assert not list(copy.glob(".*"))
    gone = subprocess.run([sys.executable, "-c", "import os; print(os.getpid())"], capture_output=True, text=True)
    left = partial_of(copy / "step-000000003.ckpt").name.replace(str(os.getpid()), gone.stdout.strip())
    (copy / left).write_bytes(b"of a process that was killed")
    set_up(config).train()
    assert not list(copy.glob(".*"))
    assert [file.name for file in models.iterdir()] == ["step-000000005.ckpt"]


def test_a_disk_that_is_full_at_the_start_is_one_sentence(recording: Path, tmp_path: Path, capsys):
    config = small_config(recording, tmp_path)  # and capsys keeps what is printed in memory
    message = r"could not be written to \(File too large\); make room, or give another --output-dir\.$"
    with full_disk(1000), pytest.raises(SystemExit, match=message):
        config.save_config()
    assert not [file for file in tmp_path.rglob("*") if file.is_file()]


def test_a_disk_that_is_full_for_other_files_ends_training_with_the_command_that_continues(copy: Path, monkeypatch):
    def no_room() -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    config = yaml.load((copy / "config.yml").read_text(), Loader=yaml.Loader)
    config.max_num_iterations = 6
    trainer, handler = set_up(config), signal.getsignal(signal.SIGINT)
    monkeypatch.setattr(writer, "write_out_storage", no_room)
    with pytest.raises(SystemExit, match=r"could not be written to \(No space left on device\); .* continue") as ended:
        trainer.train()
    assert "\n" not in str(ended.value) and f"--load-config {copy / 'config.yml'}" in str(ended.value)
    assert signal.getsignal(signal.SIGINT) is handler

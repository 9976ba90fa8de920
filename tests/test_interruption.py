"""Runs that are stopped and go on."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import signal
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from nerfstudio.engine.trainer import Trainer
from nerfstudio.scripts.train import main
from nerfstudio.utils import writer
from small_runs import set_up, small_config

from enerf_ns.method import trainer as trainer_module
from enerf_ns.method.error_against_time import ErrorAgainstTime
from enerf_ns.method.trainer import EnerfTrainerConfig

pytestmark = pytest.mark.usefixtures("one_thread")

STEPS = 6


pytestmark = pytest.mark.usefixtures("python_interrupts")


def trained(config: EnerfTrainerConfig, first: int = 0, stop_after: int | None = None, by=signal.SIGTERM) -> Any:
    """A trainer that trained from a step to the end, or until a signal came in the middle of a step."""
    trainer = set_up(config)
    if first:
        trainer._start_step = first
    draw = trainer.pipeline.datamanager.next_batch
    steps = iter(range(trainer._start_step, config.max_num_iterations))

    def interrupted_draw(sensor: Any) -> Any:
        if trainer.pipeline.training and next(steps) == stop_after:
            os.kill(os.getpid(), by)
        return draw(sensor)

    trainer.pipeline.datamanager.next_batch = interrupted_draw
    if stop_after is None:
        trainer.train()
        return trainer
    with pytest.raises(SystemExit) as stopped:
        trainer.train()
    assert stopped.value.code == 130
    return trainer


def stored(trainer: Any) -> EnerfTrainerConfig:
    return yaml.load((trainer.base_dir / "config.yml").read_text(), Loader=yaml.Loader)


def checkpoints(trainer: Any) -> list[str]:
    return sorted(file.name for file in trainer.checkpoint_dir.iterdir())


def same(one: Any, other: Any, where: str = "") -> None:
    """All of two checkpoints is equal, to the bit."""
    assert type(one) is type(other), where
    if isinstance(one, torch.Tensor):
        assert torch.equal(one, other), where
    elif isinstance(one, dict):
        assert one.keys() == other.keys(), where
        for key in one:
            same(one[key], other[key], f"{where}.{key}")
    elif isinstance(one, list | tuple):
        assert len(one) == len(other), where
        for place, values in enumerate(zip(one, other, strict=True)):
            same(*values, f"{where}.{place}")
    else:
        assert one == other, where


LEARNED = ("mean_threshold", "threshold_ratio", "threshold_map", "leak_rate", "cutoff_frequency", "response")
ALL_LEARNED = {f"sensor__learn_{part}": True for part in LEARNED}


@pytest.mark.sweep(4)
@pytest.mark.parametrize("by", ["signal", "kill"])
@pytest.mark.parametrize(
    ("changes", "first"),
    [
        ({}, 0),
        ({"data__supervision": "events+frames", "data__silent_pairs": 32}, 0),
        ({"data__supervision": "events+frames", "model__learn_exposure": True, **ALL_LEARNED}, 0),
        ({"data__supervision": "frames"}, 0),
        ({"model__sampling": "uniform"}, 0),
        ({}, 498),  # from step 501 on, the proposal network learns at every other step
    ],
)
def test_a_run_that_was_stopped_ends_as_one_that_was_not(
    recording: Path, tmp_path: Path, changes: dict, first: int, by: str
):
    """Weights, Adam's means, learning rates and the states of all generators, with evaluation between that draws, too;
    stopped by a signal, or killed some steps after a checkpoint."""

    def config(output_dir: str) -> EnerfTrainerConfig:
        config = small_config(recording, tmp_path / output_dir, **changes)
        config.max_num_iterations = first + STEPS
        config.steps_per_eval_batch = config.steps_per_eval_image = 2
        config.steps_per_save = 3
        config.save_only_latest_checkpoint = False
        config.evaluation_share = 1.0
        return config

    straight = trained(config("straight"), first)
    last = f"step-{first + STEPS - 1:09d}.ckpt"
    stopped = trained(config("stopped"), first, first + 2 if by == "signal" else first + 4)
    if by == "kill":
        (stopped.checkpoint_dir / checkpoints(stopped)[-1]).unlink()
    assert checkpoints(stopped)[-1] == f"step-{first + (2 if by == 'signal' else 3):09d}.ckpt"
    resumed = trained(stored(stopped))
    assert resumed.base_dir == stopped.base_dir and checkpoints(resumed)[-1] == checkpoints(straight)[-1] == last
    one, other = (torch.load(run.checkpoint_dir / last) for run in (straight, resumed))
    assert all(state.pop("error_against_time")["seconds"] > 0 for state in (one, other))
    same(one, other)
    assert one["sampler"].get("_step", first + STEPS - 1) == first + STEPS - 1
    assert one["schedulers"]["fields"]["last_epoch"] == STEPS


@pytest.mark.parametrize("by", [signal.SIGINT, signal.SIGTERM])
def test_what_an_interrupted_run_prints_continues_it(recording: Path, tmp_path: Path, capsys, by: signal.Signals):
    """The command is quoted for a shell; the last step that was trained names the checkpoint; handlers are put back."""
    config = small_config(recording, tmp_path / "it's a folder")
    config.max_num_iterations = 5
    before = signal.getsignal(by)
    trainer = trained(config, stop_after=1, by=by)
    assert signal.getsignal(by) is before
    assert checkpoints(trainer) == ["step-000000001.ckpt"]
    (line,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("continue: ")]
    command = shlex.split(line.removeprefix("continue: "))
    assert command[:3] == ["ns-train", "enerf", "--load-config"]
    config.load_config = Path(command[3])
    written = (trainer.base_dir / "config.yml").read_text()
    main(config)
    assert checkpoints(trainer) == ["step-000000004.ckpt"]
    assert (trainer.base_dir / "config.yml").read_text() == written
    assert "is at its end, at step 5 of 5" not in capsys.readouterr().out
    main(config)
    assert f"{trainer.base_dir} is at its end, at step 5 of 5." in capsys.readouterr().out
    assert checkpoints(trainer) == ["step-000000004.ckpt"]


def test_a_second_signal_stops_at_once(recording: Path, tmp_path: Path):
    """In the same step, before a checkpoint is stored."""
    trainer = set_up(small_config(recording, tmp_path))
    draw = trainer.pipeline.datamanager.next_batch

    def twice(sensor: Any) -> Any:
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGTERM)
        return draw(sensor)

    trainer.pipeline.datamanager.next_batch = twice
    with pytest.raises(SystemExit) as stopped:
        trainer.train()
    assert stopped.value.code == 130 and not trainer.checkpoint_dir.exists()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_signal_in_the_last_step_leaves_a_run_that_is_done(recording: Path, tmp_path: Path, capsys):
    trainer = set_up(small_config(recording, tmp_path))
    trainer.pipeline.datamanager.next_batch, draw = (
        lambda sensor: (os.kill(os.getpid(), signal.SIGINT) if trainer.step == 1 else None, draw(sensor))[1],
        trainer.pipeline.datamanager.next_batch,
    )
    trainer.train()
    assert "Training is done" in capsys.readouterr().out and checkpoints(trainer) == ["step-000000001.ckpt"]


def test_a_longer_run_goes_on_from_the_checkpoints_of_another(recording: Path, tmp_path: Path):
    """In a folder of its own, up to as many steps in total, with the learning rate that the first ended with."""
    first = trained(small_config(recording, tmp_path))
    config = small_config(recording, tmp_path)
    config.timestamp, config.max_num_iterations = "longer", 5
    config.load_dir = first.checkpoint_dir
    longer = trained(config)
    assert checkpoints(first) == ["step-000000001.ckpt"] and checkpoints(longer) == ["step-000000004.ckpt"]
    one, other = (torch.load(trainer.checkpoint_dir / checkpoints(trainer)[0]) for trainer in (first, longer))
    assert one["max_steps"] == other["max_steps"] and set(one["max_steps"].values()) == {2}
    rates = [state["optimizers"]["fields"]["param_groups"][0]["lr"] for state in (one, other)]
    assert rates[0] == rates[1] == pytest.approx(0.1 * config.optimizers["fields"]["optimizer"].lr)
    assert {int(state["step"]) for state in other["optimizers"]["fields"]["state"].values()} == {5}
    config.max_num_iterations, config.timestamp = 2, "shorter"
    with pytest.raises(SystemExit, match=r"--max-num-iterations 2 counts the 2 steps of .*step-000000001\.ckpt"):
        config.save_config()
    assert not first.base_dir.with_name("shorter").exists()


def test_a_run_goes_on_in_place_after_it_was_extended_from_a_step(recording: Path, tmp_path: Path):
    """What was loaded first stands in config.yml, and counts until the run has a checkpoint of its own."""
    config = small_config(recording, tmp_path)
    config.max_num_iterations, config.steps_per_save, config.save_only_latest_checkpoint = 4, 1, False
    first = trained(config)
    config.timestamp, config.max_num_iterations = "second", 6
    config.load_dir, config.load_step = first.checkpoint_dir, 1
    second = trained(config, stop_after=3)
    assert checkpoints(second) == ["step-000000002.ckpt", "step-000000003.ckpt"]
    again = trained(stored(second))
    assert checkpoints(again) == [f"step-{step:09d}.ckpt" for step in (2, 3, 4, 5)]
    for file in again.checkpoint_dir.iterdir():
        file.unlink()
    again.checkpoint_dir.rmdir()
    assert set_up(stored(second))._start_step == 2


def test_a_run_that_is_there_is_not_written_over(recording: Path, tmp_path: Path):
    first = trained(small_config(recording, tmp_path))
    before = {file: file.read_bytes() for file in first.base_dir.rglob("*") if file.is_file()}
    config = small_config(recording, tmp_path, data__event_pairs=32)
    for start in (config.save_config, config.setup):
        with pytest.raises(SystemExit, match=r"run holds a run already; continue it with --load-config .*config\.yml,"):
            start()
    assert {file: file.read_bytes() for file in first.base_dir.rglob("*") if file.is_file()} == before


def test_a_run_that_has_no_checkpoint_yet_is_not_written_over_but_starts_again(
    recording: Path, tmp_path: Path, monkeypatch
):
    """As of two commands that start in the same second. What starts it again leaves the origin as it was."""
    monkeypatch.setattr(sys, "argv", ["ns-train", "enerf", "--machine.seed", "7"])
    small_config(recording, tmp_path).save_config()
    folder = tmp_path / "recording/enerf/run"
    before = {file: file.read_bytes() for file in folder.iterdir()}
    with pytest.raises(SystemExit, match=r"run holds a run already; continue it with --load-config .*config\.yml,"):
        small_config(recording, tmp_path, data__event_pairs=32).save_config()
    assert {file: file.read_bytes() for file in folder.iterdir()} == before
    monkeypatch.setattr(sys, "argv", ["ns-train", "enerf", "--load-config", "config.yml"])
    loaded = yaml.load((folder / "config.yml").read_text(), Loader=yaml.Loader)
    loaded.save_config()
    assert json.loads((folder / "origin.json").read_text())["command"] == "ns-train enerf --machine.seed 7"
    an_hour_ago = time.time() - 3600.0
    os.utime(folder / "config.yml", (an_hour_ago, an_hour_ago))  # of a start that failed
    small_config(recording, tmp_path, data__event_pairs=32).save_config()
    assert (folder / "config.yml").read_bytes() != before[folder / "config.yml"]


def test_processes_of_a_run_that_goes_on_draw_batches_of_their_own(recording: Path, tmp_path: Path, monkeypatch):
    """The first one those that it would have drawn; the others neither these nor those of the start again."""
    config = small_config(recording, tmp_path)
    config.max_num_iterations, config.machine.seed = 5, 3
    stopped = trained(config, stop_after=1)
    drawn = []

    def draw(trainer: Any) -> None:
        drawn.append(trainer.pipeline.datamanager.next_batch(trainer.pipeline.model.sensor).events.pixels)
        drawn.append(torch.randint(2**40, (8,)))

    draw(stopped)
    for rank in range(3):
        monkeypatch.setattr(trainer_module, "get_rank", lambda rank=rank: rank)
        monkeypatch.setattr(trainer_module, "is_main_process", lambda rank=rank: rank == 0)
        loaded = stored(stopped)
        loaded.machine.seed += rank
        draw(set_up(loaded))
        new = small_config(recording, tmp_path / f"new-{rank}")
        new.machine.seed = config.machine.seed + rank
        draw(set_up(new))
    assert all(torch.equal(*pair) for pair in zip(drawn[:2], drawn[2:4], strict=True))
    assert len({tuple(numbers.tolist()) for numbers in drawn[2:]}) == len(drawn[2:])


def test_what_is_left_is_told_of_the_run_as_a_whole(recording: Path, tmp_path: Path):
    config = small_config(recording, tmp_path)
    config.max_num_iterations = 20
    trainer = trained(config, stop_after=9)
    trainer = set_up(stored(trainer))
    shares = []
    put_time = writer.put_time

    def noted(*args: Any, **kwargs: Any) -> None:
        put_time(*args, **kwargs)
        if kwargs.get("update_eta"):
            shares.append((kwargs["step"] / writer.GLOBAL_BUFFER["max_iter"], writer.GLOBAL_BUFFER["events"][ETA]))

    ETA = writer.EventName.ETA.value
    writer.put_time = noted
    try:
        trainer.train()
    finally:
        writer.put_time = put_time
    assert [share for share, _ in shares] == pytest.approx([step / 20 for step in range(10, 20)])
    assert not any("h" in left for _, left in shares)


@pytest.mark.parametrize(
    ("flag", "content", "sentence"),
    [
        ("load_dir", None, "does not exist; give nerfstudio_models of a trained run"),
        ("load_dir", b"a file", "is no folder; give nerfstudio_models of a trained run"),
        ("load_dir", {"notes.txt": b"stray", "step-000000001.ckpt": b"stray"}, "holds no whole checkpoint; give nerf"),
        ("load_checkpoint", None, "does not exist; give another"),
        ("load_checkpoint", b"stray", "is cut short or damaged, or is no checkpoint; give another"),
    ],
)
def test_a_checkpoint_that_is_none_is_one_sentence(
    recording: Path, tmp_path: Path, flag: str, content: Any, sentence: str
):
    named = tmp_path / "named"
    if isinstance(content, bytes):
        named.write_bytes(content)
    for name, inside in content.items() if isinstance(content, dict) else ():
        named.mkdir(exist_ok=True)
        (named / name).write_bytes(inside)
    config = small_config(recording, tmp_path / "outputs")
    setattr(config, flag, named)
    with pytest.raises(SystemExit, match=rf"^enerf: [^\n]*{named} {sentence}[^\n]*\.$"):
        config.save_config()
    assert not (tmp_path / "outputs").exists()


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"model__num_levels": 5}, r"field\.geometry\.grid\.table is \(\d+, 2\), but \(\d+, 2\) here"),
        ({"model__sampling": "uniform"}, r"proposal\.\S+ is \([\d, ]+\), but missing here"),
        ({"sensor__learn_threshold_ratio": True}, r"sensor\.log_ratio is missing, but \(\) here"),
        ({"box": (0.0, 0.0, 1.0, 3.0)}, "its scene has another box"),
    ],
)
def test_a_checkpoint_of_another_configuration_is_one_sentence(
    recording: Path, first: Any, tmp_path: Path, changes: dict, what: str
):
    config = small_config(recording, tmp_path, **{name: value for name, value in changes.items() if name != "box"})
    config.pipeline.datamanager.dataparser.box = changes.get("box")
    config.max_num_iterations, config.load_dir = 5, first.checkpoint_dir
    with pytest.raises(
        SystemExit, match=rf"^enerf: The checkpoint [^\n]* is of another configuration \({what}\); give"
    ):
        config.save_config()
    assert not list(tmp_path.iterdir())


@pytest.fixture(scope="module")
def first(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A trained run of two steps."""
    trainer = set_up(small_config(recording, tmp_path_factory.mktemp("first")))
    trainer.train()
    return trainer


@pytest.mark.parametrize("content", [None, b"", b"\x7fELF\xd0", b"a: 1", b"!!python/object:no.Such {}"])
def test_a_config_that_is_none_is_one_sentence_as_soon_as_the_flag_is_read(tmp_path: Path, content: bytes | None):
    """Before Nerfstudio reads it itself."""
    file = tmp_path / "config.yml"
    if content is not None:
        file.write_bytes(content)
    with pytest.raises(SystemExit, match=rf"^enerf: {file} [^\n]*\.$"):
        EnerfTrainerConfig(method_name="enerf", load_config=file)


def test_a_run_that_was_moved_is_one_sentence_with_the_command_that_trains_on(first: Any, tmp_path: Path, monkeypatch):
    """Not trained from its start where it was before. A config.yml alone, or a link to the run, continues the run."""
    folder = tmp_path / "new place"
    shutil.copytree(first.base_dir, folder)
    with pytest.raises(SystemExit, match=rf"^enerf: [^\n]*{first.base_dir}, [^\n]* {folder};[^\n]*\.$") as refused:
        EnerfTrainerConfig(method_name="enerf", load_config=folder / "config.yml")
    assert str(refused.value).endswith(f" --load-dir '{folder / 'nerfstudio_models'}'.")
    shutil.rmtree(folder / "nerfstudio_models")
    (tmp_path / "link").symlink_to(first.base_dir)
    monkeypatch.setenv("HOME", str(folder))
    for given, file in (
        (tmp_path / "link/config.yml", first.base_dir / "config.yml"),
        (Path("~/config.yml"), folder / "config.yml"),
    ):
        assert EnerfTrainerConfig(method_name="enerf", load_config=given).load_config == file


@pytest.mark.parametrize(("of", "name"), [(Trainer, "setup"), (ErrorAgainstTime, "finish")])
def test_an_interruption_outside_of_steps_is_one_line(
    recording: Path, tmp_path: Path, monkeypatch, capfd, of: type, name: str
):
    """Nerfstudio would print a traceback, and exit with 0."""

    def interrupted(*_: Any, **__: Any) -> None:
        os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(of, name, interrupted)
    with pytest.raises(SystemExit) as stopped:
        main(small_config(recording, tmp_path))
    shown = capfd.readouterr()
    assert stopped.value.code == 130 and "enerf: Stopped." in shown.err
    assert "Traceback" not in shown.out + shown.err


def test_a_run_in_the_background_goes_on(recording: Path, tmp_path: Path):
    """It ignores SIGINT, which a terminal sends to what runs in the foreground."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    config = small_config(recording, tmp_path)
    config.max_num_iterations = 3
    trainer = set_up(config)
    draw = trainer.pipeline.datamanager.next_batch
    trainer.pipeline.datamanager.next_batch = lambda sensor: (os.kill(os.getpid(), signal.SIGINT), draw(sensor))[1]
    trainer.train()
    assert checkpoints(trainer) == ["step-000000002.ckpt"]
    assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN

"""Commands and places as they are printed: pasted into a shell, they are the paths that they stand for."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from enerf_ns.dataparsers.recording.errors import quoted
from enerf_ns.scripts.cli import entrypoint

NAMES = (
    "a b; touch PWN [red]",
    "[/red] [abc]*?",
    "run:x:1:cat:d",
    "$HOME `touch PWN` $(touch PWN)",
    'it\'s "quoted" \\',
    "-dash --help",
    "two\nlines\tand\x1b[31m",
    "%d%%{x}#!&|<>",
    "ünï 🐈",
)
"""Names of folders, each of which may stand in a shell, in rich or in a format for something else."""

SMALL = ("--width", "16", "--height", "12", "--duration", "0.05", "--num-frames", "11", "--exposure-ms", "1")


def words(command: str) -> list[str]:
    """What bash makes of a command's words."""
    told = subprocess.run(["bash", "-c", rf"printf '%s\0' {command}"], capture_output=True, check=True, text=True)
    return told.stdout.split("\0")[:-1]


def commands(printed: str) -> list[list[str]]:
    """The words of each command that is printed on a line of its own, such as "train: ns-train enerf ..."."""
    lines = (line.partition(": ")[2] for line in printed.splitlines())
    return [words(line) for line in lines if line.startswith(("enerf ", "ns-"))]


@pytest.fixture
def call(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Calls a command in this process, in an empty folder; what it prints."""
    monkeypatch.chdir(tmp_path)

    def called(*arguments: str, main: Callable[[], object] = entrypoint) -> str:
        monkeypatch.setattr(sys, "argv", ["command", *arguments])
        capsys.readouterr()
        main()
        return capsys.readouterr().out

    return called


@pytest.mark.parametrize("name", NAMES)
def test_a_quoted_path_is_one_word_on_one_line(name: str, tmp_path: Path):
    path = tmp_path / name
    assert words(f"command {quoted(path)}") == ["command", str(path)]
    assert quoted(path).isprintable()


@pytest.mark.parametrize("name", NAMES)
def test_the_commands_of_each_command_can_be_pasted(name: str, call, tmp_path: Path):
    made, again, frames = (tmp_path / kind / name for kind in ("made", "again", "frames"))
    printed = call("simulate", "shapes", "--output-dir", str(made), *SMALL)
    assert commands(printed) == [
        ["enerf", "inspect", str(made)],
        ["ns-train", "enerf", "--data", str(made)],
    ]
    assert commands(call("inspect", str(made))) == [["ns-train", "enerf", "--data", str(made)]]
    printed = call("convert", str(made), "--output-dir", str(again))
    assert commands(printed) == [["enerf", "inspect", str(again)], ["ns-train", "enerf", "--data", str(again)]]
    printed = call("convert", str(again), "--output-dir", str(bare := tmp_path / "bare" / name), "--without-poses")
    assert commands(printed) == [["enerf", "inspect", str(bare)]]
    assert commands(call("inspect", str(bare))) == []
    printed = call("reconstruct", str(made), "--output-dir", str(frames))
    (command,) = commands(printed)
    assert command[:4] == ["ns-train", "enerf", "--data", str(frames)]
    pages = [file for file in os.listdir(tmp_path) if file.startswith("inspect-")]
    assert sorted(os.listdir(tmp_path)) == sorted(["again", "bare", "frames", "made", *pages]), "nothing is executed"


@pytest.mark.slow
def test_the_commands_of_a_run_can_be_pasted(recording: Path, call, tmp_path: Path, monkeypatch):
    name = "a b; touch PWN [red] [/red] :x: two\nlines $HOME `touch PWN` it's"
    from nerfstudio.scripts.train import entrypoint as train

    monkeypatch.setenv("ENERF_LPIPS_WEIGHTS", str(tmp_path / "no-weights"))
    data = tmp_path / name.replace("/", "")
    data.symlink_to(recording)
    small = ("--vis", "tensorboard", "--machine.device-type", "cpu", "--pipeline.datamanager.event-pairs", "64")
    more = (
        "--pipeline.model.log2-table-size",
        "12",
        "--experiment-name",
        name.replace("/", ""),
        "--evaluation-share",
        "0",
    )
    run = ("enerf", "--data", str(data), "--output-dir", str(tmp_path / "runs" / name), *small, *more)
    printed = call(*run, "--max-num-iterations", "2", main=train)
    (config,) = (tmp_path / "runs").rglob("config.yml")
    told = commands(printed)
    assert [command[0] for command in told] == ["enerf", "ns-eval", "ns-render", "ns-viewer"]
    assert all(str(config) in command for command in told)
    models = str(config.parent / "nerfstudio_models")
    call(*run, "--max-num-iterations", "4", "--load-dir", models, main=train)
    page = tmp_path / "page" / name
    call("report", str(config.parent), "--output-dir", str(page), "--no-video")
    assert (page / "report.html").exists() and not list(tmp_path.rglob("PWN"))

"""The command `enerf` itself: its help, and how a mistake ends it."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from enerf_ns.scripts import cli


@pytest.mark.parametrize(
    "command", [[], *([name] for name in ("bench", "convert", "demo", "inspect", "reconstruct", "report", "simulate"))]
)
def test_every_command_has_a_help(command: list[str], monkeypatch, capsys: pytest.CaptureFixture[str]):
    monkeypatch.setattr(sys, "argv", ["enerf", *command, "--help"])
    with pytest.raises(SystemExit) as end:
        cli.entrypoint()
    assert end.value.code == 0
    shown = capsys.readouterr().out
    assert "usage: enerf" in shown and (command or all(name in shown for name in ("convert", "inspect", "simulate")))


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["inspect", "nowhere"], "nowhere does not exist"),
        (["convert", "nowhere", "--output-dir", "new"], "nowhere does not exist"),
        (["bench", "nothing"], "There is no experiment nothing; choose one of"),
        (["reconstruct", "nowhere", "--output-dir", "new"], "nowhere is not a folder"),
        (["report", "config.yml"], "config.yml does not exist"),
        (["simulate", "shapes", "--output-dir", "new", "--duration", "0"], "--duration is 0.0, but must be"),
        (["simulate", "nothing", "--output-dir", "new"], "nothing is neither a preset"),
    ],
)
def test_a_mistake_ends_it_with_one_sentence(
    arguments: list[str], sentence: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["enerf", *arguments])
    with pytest.raises(SystemExit) as end:
        cli.entrypoint()
    message = str(end.value.code)
    assert message.startswith("enerf: ") and sentence in message and "\n" not in message
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (KeyboardInterrupt(), 130),
        (MemoryError(), "enerf: There is not enough memory for this; ask for less at a time."),
    ],
)
def test_what_stops_it_from_outside_is_told(error: BaseException, code: object, monkeypatch: pytest.MonkeyPatch):
    def stopped(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(cli.tyro, "cli", stopped)
    with pytest.raises(SystemExit) as end:
        cli.entrypoint()
    assert end.value.code == code

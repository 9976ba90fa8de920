"""The command `enerf` itself: its help, and how a mistake ends it."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from importlib.metadata import version
from pathlib import Path

import pytest

from enerf_ns.scripts import cli


@pytest.mark.parametrize("command", cli.COMMANDS)
def test_every_command_has_a_help(command: str, monkeypatch, capsys: pytest.CaptureFixture[str]):
    monkeypatch.setattr(sys, "argv", ["enerf", command, "--help"])
    with pytest.raises(SystemExit) as end:
        cli.entrypoint()
    assert end.value.code == 0
    assert f"usage: enerf {command}" in capsys.readouterr().out


@pytest.mark.parametrize("command", cli.COMMANDS)
def test_help_breaks_lines_by_the_width_of_the_terminal_alone(command: str, monkeypatch, capsys):
    """On a terminal that is wide enough, the text of each flag is one line, beside the flag or below it."""
    monkeypatch.setattr(sys, "argv", ["enerf", command, "--help"])
    monkeypatch.setenv("COLUMNS", "2000")
    with pytest.raises(SystemExit):
        cli.entrypoint()
    lines = [line.strip("│|").rstrip() for line in capsys.readouterr().out.splitlines()]
    continued = [bool(re.match(r" {10,}", line)) for line in lines]
    assert len(lines) > 5 and not [lines[n] for n in range(1, len(lines)) if continued[n - 1] and continued[n]]


@pytest.mark.parametrize("command", cli.COMMANDS)
def test_help_tells_a_default_once_and_in_words(command: str, monkeypatch, capsys: pytest.CaptureFixture[str]):
    monkeypatch.setattr(sys, "argv", ["enerf", command, "--help"])
    monkeypatch.setenv("COLUMNS", "2000")
    with pytest.raises(SystemExit):
        cli.entrypoint()
    told = re.findall(r"(?i)default: ?[^.)]*|none: ", capsys.readouterr().out)
    assert [text for text in told if text.lower() in ("default: none", "default: ", "none: ")] == []


@pytest.mark.parametrize("arguments", [[], ["-h"], ["--help"]])
def test_alone_it_says_what_there_is(arguments: list[str], monkeypatch, capsys: pytest.CaptureFixture[str]):
    monkeypatch.setattr(sys, "argv", ["enerf", *arguments])
    cli.entrypoint()
    shown = capsys.readouterr().out
    commands = {file.stem.replace("_", "-") for file in Path(cli.__file__).parent.glob("*.py") if _has_a_command(file)}
    assert commands == set(cli.COMMANDS)
    assert all(f"\n  {name} " in shown for name in commands)


def _has_a_command(file: Path) -> bool:
    return "def main(self)" in file.read_text()


def test_the_list_and_help_that_needs_no_format_load_neither_torch_nor_nerfstudio():
    for arguments in ([], ["demo", "--help"], ["bench", "--help"], ["--version"], ["nonsense"]):
        code = (
            f"import sys; sys.argv = ['enerf', *{arguments}]\nfrom enerf_ns.scripts.cli import entrypoint\n"
            "try: entrypoint()\nexcept SystemExit: pass\n"
            "print([name for name in ('torch', 'nerfstudio', 'scipy') if name in sys.modules])"
        )
        run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        assert run.stdout.splitlines()[-1] == "[]", arguments


def test_the_version_is_that_of_the_package(monkeypatch, capsys: pytest.CaptureFixture[str]):
    monkeypatch.setattr(sys, "argv", ["enerf", "--version"])
    cli.entrypoint()
    assert capsys.readouterr().out == f"enerf-ns {version('enerf-ns')}\n"


@pytest.mark.parametrize("name", ["nonsense", "--nonsense"])
def test_what_is_no_command_is_one_sentence(name: str, monkeypatch, capsys: pytest.CaptureFixture[str]):
    monkeypatch.setattr(sys, "argv", ["enerf", name, "more"])
    with pytest.raises(SystemExit) as end:
        cli.entrypoint()
    assert end.value.code == 2
    out, error = capsys.readouterr()
    assert (out, error.count("\n")) == ("", 1)
    assert error.startswith(f"enerf: There is no command {name}; choose one of bench, ")


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["Report"], "There is no command Report; the nearest is report."),
        (["inspec"], "There is no command inspec; the nearest is inspect."),
        (["simulate", "--widht", "3"], "There is no flag --widht; the nearest is --width. enerf simulate --help lists"),
        (["simulate", "shapes", "--output_dri=x"], "There is no flag --output_dri; the nearest is --output-dir."),
        (["inspect", "--outptu", "x"], "There is no flag --outptu; the nearest is --output."),
    ],
)
def test_a_word_that_is_misspelt_is_told_in_a_sentence(
    arguments: list[str], sentence: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr(sys, "argv", ["enerf", *arguments])
    with pytest.raises(SystemExit) as end:
        cli.entrypoint()
    out, error = capsys.readouterr()
    assert (end.value.code, out, error.count("\n")) == (2, "", 1)
    assert error.startswith("enerf: ") and sentence in error


def test_what_else_is_wrong_with_flags_is_told_by_tyro(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr(sys, "argv", ["enerf", "simulate", "shapes"])
    with pytest.raises(SystemExit) as end:
        cli.entrypoint()
    assert end.value.code == 2 and "--output-dir PATH" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["inspect", "nowhere"], "nowhere does not exist"),
        (["convert", "nowhere", "--output-dir", "new"], "nowhere does not exist"),
        (["bench", "nothing"], "There is no experiment nothing; choose one of"),
        (["reconstruct", "nowhere", "--output-dir", "new"], "nowhere is not a folder"),
        (["export", "mesh", "nowhere"], "nowhere does not exist"),
        (["report", "config.yml"], "config.yml does not exist"),
        (["report", "."], "holds no config.yml; give the folder of a run, of several"),
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
        (MemoryError(), "enerf: There is not enough memory for enerf demo; ask for less at a time."),
    ],
)
def test_what_stops_it_from_outside_is_told(error: BaseException, code: object, monkeypatch: pytest.MonkeyPatch):
    def stopped(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr("tyro.cli", stopped)
    monkeypatch.setattr(sys, "argv", ["enerf", "demo"])
    with pytest.raises(SystemExit) as end:
        cli.entrypoint()
    assert end.value.code == code


@pytest.mark.parametrize("command", ["", "bench", "bench --help", "simulate shapes --output-dir new --width 16"])
def test_it_ends_in_silence_when_the_reader_of_its_output_has_gone(command: str, tmp_path: Path):
    """As with `enerf ... | head`, but before the first line. Printed by print, rich, tyro, and a bar of progress."""
    read, write = os.pipe()
    os.close(read)
    words = [Path(sys.executable).with_name("enerf"), *command.split()]
    if "simulate" in words:
        words += ["--height", "12", "--duration", "0.05", "--num-frames", "11"]
    ended = subprocess.run(words, stdout=write, stderr=subprocess.PIPE, text=True, cwd=tmp_path, timeout=100)
    os.close(write)
    assert ended.returncode != 0 and ended.stderr == ""


@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="what a process has loaded is told by Linux")
@pytest.mark.timeout(60)
@pytest.mark.parametrize("loaded", ["_multiarray_umath", "cv2.abi3"])
def test_a_signal_while_it_is_imported_is_told_in_a_line(loaded: str, tmp_path: Path):
    """Sent when this library has just been loaded."""
    program = Path(sys.executable).with_name("enerf")
    process = subprocess.Popen(
        [program, "demo", "--output-dir", tmp_path / "new"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # tests may run where it is ignored
    )
    maps = Path(f"/proc/{process.pid}/maps")
    while loaded not in maps.read_text() and process.poll() is None:
        time.sleep(0.005)
    process.send_signal(signal.SIGINT)
    told, errors = process.communicate(timeout=100)
    assert (process.returncode, told, errors) == (130, "", "enerf: Stopped.\n")
    assert not list(tmp_path.iterdir())

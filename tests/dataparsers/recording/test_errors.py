from __future__ import annotations

from pathlib import Path

import pytest

from enerf_ns.dataparsers.recording.errors import (
    FlagError,
    OutputError,
    RecordingError,
    exit_with_a_sentence,
    printable,
)


@pytest.mark.parametrize("kind", [RecordingError, FlagError, OutputError])
def test_what_a_user_can_mend_ends_the_program_with_its_sentence(kind: type[Exception]):
    with pytest.raises(SystemExit) as end, exit_with_a_sentence():
        raise kind("file.txt holds nothing; give some.")
    assert end.value.code == "enerf: file.txt holds nothing; give some."


@pytest.mark.parametrize("kind", [ValueError, KeyError, OSError])
def test_what_he_cannot_mend_is_not_hidden(kind: type[Exception]):
    with pytest.raises(kind), exit_with_a_sentence():
        raise kind("a fault of the program")


def test_the_three_are_told_apart():
    assert not issubclass(FlagError, RecordingError) and not issubclass(RecordingError, FlagError)
    assert not issubclass(OutputError, (RecordingError, FlagError))


def test_what_the_system_refuses_is_told_with_its_path(tmp_path: Path):
    with pytest.raises(SystemExit) as end, exit_with_a_sentence():
        (tmp_path / "two\nlines").read_bytes()
    told = f"enerf: {tmp_path}/two\\nlines could not be read or written (No such file or directory); check the path, "
    assert str(end.value.code).startswith(told)


@pytest.mark.parametrize("name", ["two\nlines", "tab\t", "red\x1b[31m", "no UTF-8 \udcff", "right to left \u202e"])
def test_sentences_are_on_one_line_and_text(name: str):
    shown = printable(f"{name} is ünusual")
    assert shown.isprintable() and shown.endswith(" is ünusual") and shown.encode()

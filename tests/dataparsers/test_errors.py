from __future__ import annotations

import pytest

from enerf_ns.dataparsers.errors import FlagError, OutputError, RecordingError, exit_with_a_sentence


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

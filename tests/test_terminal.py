"""The line that training shows, on a terminal and elsewhere."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from enerf_ns import terminal
from enerf_ns.terminal import StatusLine, duration, say

ERASED = "\x1b[2K"


def shown(monkeypatch: pytest.MonkeyPatch, is_terminal: bool) -> str:
    output = io.StringIO()
    monkeypatch.setattr(terminal, "CONSOLE", Console(file=output, width=120, force_terminal=is_terminal))
    monkeypatch.setenv("COLUMNS", "20")
    line = StatusLine()
    assert line.is_due
    line.show("step 1 of 3, [loss] is 0.5")
    assert not line.is_due
    line.show("step 2")
    say("A warning.")
    return output.getvalue()


def test_on_a_terminal_the_line_is_rewritten_in_place(monkeypatch: pytest.MonkeyPatch):
    """Never wider than the terminal; a warning takes its place, and stays."""
    text = shown(monkeypatch, True)
    first, second, warning = text.split(ERASED)[1:]
    assert (first, second) == ("step 1 of 3, [loss]\r", "step 2\r")
    assert "A warning." in warning and text.count("\n") == 1 and text.endswith("\n")


def test_elsewhere_each_state_is_a_line(monkeypatch: pytest.MonkeyPatch):
    assert shown(monkeypatch, False) == "step 1 of 3, [loss] is 0.5\nstep 2\nA warning.\n"


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.2, "0 s"), (59.7, "1 min 0 s"), (200, "3 min 20 s"), (3599, "59 min 59 s"), (7260, "2 h 1 min")],
)
def test_durations(seconds: float, text: str):
    assert duration(seconds) == text

"""`enerf simulate`: flags and words."""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from enerf_ns.scripts.cli import entrypoint

SHORT = ("--duration", "0.1", "--num-frames", "11", "--exposure-ms", "2", "--width", "16", "--height", "12")


@pytest.fixture
def call(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> Callable[..., list[str]]:
    """Calls `enerf simulate` for a short recording in an empty working directory; returns the lines it prints."""
    monkeypatch.chdir(tmp_path)

    def call_simulate(*arguments: str) -> list[str]:
        monkeypatch.setattr(sys, "argv", ["enerf", "simulate", *arguments, *SHORT])
        entrypoint()
        return [line for line in capsys.readouterr().out.splitlines() if line]  # of a progress bar, an empty one

    return call_simulate


def test_commands_that_are_printed_can_be_pasted(call, tmp_path: Path):
    folder = tmp_path / "my [bold]rooms"
    note, made, *commands = call("carpet", "--output-dir", folder.name, "--color")
    assert note == "note: --colour changes nothing, since carpet is grey."
    assert made.endswith(f" events and 11 frames of 0.1 s are in {folder}")
    assert [shlex.split(command.split(": ")[1]) for command in commands] == [
        ["enerf", "inspect", str(folder)],
        ["ns-train", "enerf", "--data", str(folder)],
    ]


def test_an_offset_of_the_logarithm_is_short_for_a_response(call):
    call("carpet", "--output-dir", "short", "--log-eps", "0.01")
    call("carpet", "--output-dir", "long", "--response", "logarithm:0.01")
    call("carpet", "--output-dir", "linlog", "--response", "linlog")
    for name, response in (("short", "logarithm:0.01"), ("long", "logarithm:0.01"), ("linlog", "linlog")):
        stated = json.loads(Path(name, "simulation.json").read_text())
        assert stated["response"] == stated["sensor"]["response"] == response
    events = {
        name: np.concatenate([np.load(file) for file in sorted(Path(name, "events").iterdir())])
        for name in ("short", "long", "linlog")
    }
    np.testing.assert_array_equal(events["short"], events["long"])
    assert len(events["linlog"]) != len(events["short"])


@pytest.mark.parametrize(
    ("flags", "sentence"),
    [
        (("--response", "linear"), "enerf: --response names the response 'linear', but linlog, or"),
        (("--log-eps", "0"), "enerf: --response names the response 'logarithm:0.0', but linlog, or"),
        (("--log-eps", "0.01", "--response", "linlog"), "enerf: --log-eps 0.01 contradicts --response linlog; leave"),
        (("--leak-rate", "-1"), "enerf: --leak-rate is -1.0, but must be at least 0"),
    ],
)
def test_flags_that_cannot_be_are_told_in_a_sentence(call, flags: tuple[str, ...], sentence: str):
    with pytest.raises(SystemExit, match=f"^{sentence}"):
        call("carpet", "--output-dir", "new", *flags)
    assert not list(Path().iterdir())

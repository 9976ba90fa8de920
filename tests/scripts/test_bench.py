"""`enerf bench`: the list, what it prints of an experiment, and what it refuses."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path

import pytest
from rich.console import Console

from enerf_ns.bench.experiments import EXPERIMENTS, ROWS, Row
from enerf_ns.scripts import bench
from enerf_ns.scripts.cli import entrypoint


@pytest.fixture
def call(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    """Calls `enerf bench`; returns what it prints."""

    def call_bench(*arguments: str) -> str:
        monkeypatch.setattr(bench, "CONSOLE", Console(width=300))
        monkeypatch.setattr(sys, "argv", ["enerf", "bench", *arguments])
        entrypoint()
        return capsys.readouterr().out

    return call_bench


def test_without_an_experiment_all_are_listed_with_a_sentence(call):
    shown = call()
    for name, experiment in EXPERIMENTS.items():
        (line,) = [line for line in shown.splitlines() if line.startswith(f"│ {name} ")]
        assert experiment.sentence in line
        assert f" {len(experiment.rows) * len(experiment.sequences or experiment.recorded)} " in line


def test_each_training_the_table_and_where_it_lies_are_printed(
    call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setitem(ROWS, "events", Row({"pipeline.model.nothing": 1}))  # fails at once
    data = str(tmp_path / "nowhere")
    arguments = ["left-out", "--data", data, "--rows", "events", "--output-dir", str(tmp_path), "--seeds", "2"]
    with pytest.raises(SystemExit, match=r"^enerf: 2 of 2 trainings failed, for the reasons above\.$"):
        call(*arguments)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "[1/2] recording, events, seed 0 …"
    assert lines[1].startswith(
        "[1/2] recording, events, seed 0: The method enerf has no setting pipeline.model.nothing"
    )
    assert any(line.startswith("│ recording │ events │") for line in lines)
    assert f"The table is in {tmp_path / 'left-out'}.md, .json and .csv" == lines[-2]
    same = shlex.join([word for word in arguments if word not in ("--output-dir", str(tmp_path))])
    command = lines[-1].removeprefix("compare later results with it: ")
    assert command.endswith(f" --output-dir NEW --against {tmp_path / 'left-out.json'}")
    assert {*shlex.split(same)} < {*shlex.split(command)}
    assert {file.name for file in tmp_path.glob("left-out.*")} == {"left-out.md", "left-out.json", "left-out.csv"}


def test_a_mistake_is_told_in_one_sentence(call, tmp_path: Path):
    with pytest.raises(SystemExit, match=r"^enerf: --budget is 2m, but must be seconds, such as 120s, or steps"):
        call("design", "--budget", "2m", "--output-dir", str(tmp_path))
    assert not list(tmp_path.iterdir())

"""What a person sees of `ns-train enerf` on a terminal, from the first line to the last."""

from __future__ import annotations

import json
import os
import pty
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from warm_commands import WarmCommands

from enerf_ns.simulator.engine import simulate
from enerf_ns.simulator.settings import SimulationSettings

pytestmark = pytest.mark.slow

CONTROLS = re.compile(r"\x1b\][^\x1b]*\x1b\\|\x1b\[[0-9;?]*[A-Za-z]")
SMALL = [
    *("--max-num-iterations", "3", "--machine.device-type", "cpu", "--timestamp", "run"),
    *("--pipeline.datamanager.event-pairs", "64", "--pipeline.model.log2-table-size", "12"),
    *("--viewer.websocket-port-default", "7100"),
]


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("simulated") / "recording"
    simulate(SimulationSettings("shapes", width=32, height=24, duration=0.1, num_frames=11), folder)
    return folder


def environment(folder: Path) -> dict[str, str]:
    return {**os.environ, "COLUMNS": "120", "ENERF_LPIPS_WEIGHTS": str(folder / "none"), "TERM": "xterm"}


def on_a_terminal(command: list[str], folder: Path, columns: int) -> tuple[int, str]:
    """The exit code, and what a terminal is sent, without colours and movements."""
    ours, theirs = pty.openpty()
    variables = environment(folder) | {"COLUMNS": str(columns)}
    with subprocess.Popen(command, cwd=folder, env=variables, stdout=theirs, stderr=theirs) as process:
        os.close(theirs)
        sent = b""
        try:
            while part := os.read(ours, 65536):
                sent += part
        except OSError:  # as Linux ends a terminal that nobody writes to any more
            pass
        os.close(ours)
    return process.returncode, CONTROLS.sub("", sent.decode()).replace("\r\n", "\n")


def ns(tool: str) -> str:
    return str(Path(sys.executable).with_name(tool))


@pytest.mark.parametrize("columns", [80, 120])
def test_a_terminal_shows_the_recording_a_paragraph_and_one_line(columns: int, recording: Path, tmp_path: Path):
    code, shown = on_a_terminal([ns("ns-train"), "enerf", "--data", str(recording), *SMALL], tmp_path, columns)
    assert code == 0, shown
    assert "Warning" not in shown and "deprecated" not in shown
    assert re.match(r"(Measuring the depth[^\n]*\s+)*Recording", shown.replace("\r", "\n").lstrip())
    parts = ("Recording", "The field learns from", "configuration: ", "Viewer running", "step 1 of 3, loss")
    order = [shown.index(part) for part in (*parts, "step 3 of 3", "Training is done", "checkpoint: ")]
    assert order == sorted(order)
    assert shown.count("localhost:") == 1 and "viser" not in shown
    for line in shown.replace("\r", "\n").splitlines():
        assert len(line) <= columns or re.match(r"[a-z, ]+: \S", line), "only what is to be copied is longer"
    for configured in ("EnerfTrainerConfig(", "EnerfModelConfig(", "log2_table_size", "steps_per_eval_image"):
        assert configured not in shown
    for chatter in ("Mixed precision", "Disabled comet", "disabled local writer", "Training Finished", "Saving check"):
        assert chatter not in shown
    run = tmp_path / "outputs" / "recording" / "enerf" / "run"
    config = yaml.load((run / "config.yml").read_text(), Loader=yaml.Loader)
    assert config.pipeline.model.log2_table_size == 12 and config.max_num_iterations == 3
    assert f"configuration: {run / 'config.yml'}\n" in shown and json.loads((run / "choices.json").read_text())
    assert re.search(r"step 3 of 3, loss [\d.]+, event correlation -?[\d.]+", shown)


@pytest.mark.parametrize(
    ("flags", "sentence"),
    [
        (["--output-dir", "file/runs"], "file/runs could not be written to"),
        (["--preset", "nonsense"], "--preset nonsense is not known"),
        (["--pipeline.model.event-loss", "no"], "--pipeline.model.event-loss is 'no', but"),
    ],
)
def test_an_error_comes_alone(
    flags: list[str], sentence: str, recording: Path, tmp_path: Path, warm_commands: WarmCommands
):
    """Neither the configuration nor a table is before it, and nothing is written."""
    (tmp_path / "file").touch()
    command = ["ns-train", "enerf", "--data", recording, *SMALL, *flags]
    code, printed = warm_commands.run(*command, cwd=tmp_path, environment=environment(tmp_path))
    assert code == 1
    lines = printed.strip().splitlines()
    assert len([line for line in lines if line.startswith("enerf: ")]) == 1 and sentence in lines[-1]
    for unwanted in ("TrainerConfig(", "The field learns", "Warning"):
        assert unwanted not in printed
    assert [file.name for file in tmp_path.iterdir()] == ["file"]


@pytest.mark.sweep(1)
@pytest.mark.parametrize("tool", ["ns-train", "ns-eval", "ns-render", "ns-viewer", "ns-export", "enerf"])
def test_no_tool_begins_with_a_warning(tool: str, tmp_path: Path):
    run = subprocess.run([ns(tool), "--help"], cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert (run.returncode, run.stderr) == (0, "")

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from small_runs import SMALL

from enerf_ns.method.runs import Run, method_config, train
from enerf_ns.simulator.engine import simulate
from enerf_ns.simulator.settings import SimulationSettings


@pytest.fixture(autouse=True)
def no_lpips(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """No test downloads weights."""
    for variable in ("ENERF_LPIPS_WEIGHTS", "ENERF_LPIPS_VGG_WEIGHTS"):
        monkeypatch.setenv(variable, str(tmp_path / "no-weights"))


@pytest.fixture(scope="session")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tenth of a second of a small camera, with frames and depth."""
    folder = tmp_path_factory.mktemp("simulated") / "recording"
    simulate(SimulationSettings("shapes", width=32, height=24, duration=0.1, num_frames=11), folder)
    return folder


@pytest.fixture(scope="session")
def run(recording: Path) -> Run:
    """Of two steps."""
    return train(method_config("enerf", recording, recording.parent / "runs", SMALL))


@pytest.fixture(scope="session")
def run_without_frames(recording: Path) -> Run:
    """The same of events alone."""
    folder = recording.with_name("without_frames")
    shutil.copytree(recording, folder, ignore=shutil.ignore_patterns("images*", "depth"))
    changes = {**SMALL, "pipeline.datamanager.dataparser.held_out_every": 16}
    changes["pipeline.datamanager.held_out_events"] = 0.2  # of so few events
    return train(method_config("enerf", folder, recording.parent / "runs", changes))

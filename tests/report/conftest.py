from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from small_runs import SMALL

from enerf_ns.method.runs import Run, method_config, train
from enerf_ns.report import film, pictures
from enerf_ns.simulator.engine import simulate
from enerf_ns.simulator.settings import SimulationSettings


@pytest.fixture(autouse=True)
def no_lpips(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """No test downloads weights."""
    monkeypatch.setenv("ENERF_LPIPS_WEIGHTS", str(tmp_path / "no-weights"))


@pytest.fixture
def short_films(monkeypatch: pytest.MonkeyPatch) -> None:
    """Films of two pictures."""
    monkeypatch.setattr(film, "MOVING_FRAMES", 2)
    monkeypatch.setattr(pictures, "VIDEO_SECONDS", 0.1)


@pytest.fixture(scope="session")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tenth of a second of a small camera, with frames and depth."""
    folder = tmp_path_factory.mktemp("simulated") / "recording"
    simulate(SimulationSettings("shapes", width=32, height=24, duration=0.1, num_frames=11), folder)
    return folder


@pytest.fixture(scope="session")
def run(recording: Path) -> Run:
    """Of two steps, without a history."""
    return train(method_config("enerf", recording, recording.parent / "runs", {**SMALL, "evaluation_share": 0.0}))


@pytest.fixture(scope="session")
def run_without_frames(recording: Path) -> Run:
    """The same of events alone, of a sensor with unknown thresholds."""
    folder = recording.with_name("events_alone")
    shutil.copytree(recording, folder, ignore=shutil.ignore_patterns("images*", "depth", "simulation.json"))
    held_out = {"pipeline.datamanager.dataparser.held_out_every": 16, "pipeline.datamanager.held_out_events": 0.2}
    changes = {**SMALL, **held_out, "evaluation_share": 0.0}
    return train(method_config("enerf", folder, recording.parent / "runs", changes))

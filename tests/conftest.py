from __future__ import annotations

import os
import random
import shutil
import signal
import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
import torch
from warm_commands import WarmCommands

if TYPE_CHECKING:
    from enerf_ns.method.runs import Run

# without a GPU, kernels of Triton run as NumPy; Triton reads this when it is imported
os.environ.setdefault("TRITON_INTERPRET", "0" if torch.cuda.is_available() else "1")

torch.set_warn_always(True)  # else a warning of PyTorch is raised at its first place alone, and filters miss the others

SWEEP_SEED = "ENERF_SWEEP_SEED"


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--slow", action="store_true", help="also run the tests marked slow")
    parser.addoption("--exhaustive", action="store_true", help="run all tests, sweeps in full too")
    parser.addoption("--sweep-seed", type=int, help="draw the parts of sweeps as the run did that printed this seed")


def pytest_configure(config: pytest.Config) -> None:
    """The seed is in the environment, so that all workers of a run draw the same parts."""
    if (seed := config.getoption("--sweep-seed")) is not None:
        os.environ[SWEEP_SEED] = str(seed)
    os.environ.setdefault(SWEEP_SEED, str(random.randrange(10**6)))


def pytest_report_header(config: pytest.Config) -> str:
    if config.getoption("--exhaustive"):
        return "sweeps: in full"
    return f"sweeps: a part of each, drawn with --sweep-seed {os.environ[SWEEP_SEED]}; in full with --exhaustive"


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    exhaustive = config.getoption("--exhaustive")
    for item in items:
        if "exhaustive" in item.keywords and not exhaustive:
            item.add_marker(pytest.mark.skip(reason="a sweep in full: run with --exhaustive"))
        elif "slow" in item.keywords and not (exhaustive or config.getoption("--slow")):
            item.add_marker(pytest.mark.skip(reason="slow: run with --slow"))
    if not exhaustive:
        left_out = not_drawn(items, int(os.environ[SWEEP_SEED]))
        config.hook.pytest_deselected(items=[item for item in items if item in left_out])
        items[:] = [item for item in items if item not in left_out]


def not_drawn(items: list[pytest.Item], seed: int) -> set[pytest.Item]:
    """Returns the cases of sweeps that are not run: all but as many as the marker of each test says, besides those that
    are marked exhaustive. Tests whose marker has the same name are one sweep."""
    sweeps: dict[tuple[str, int], list[pytest.Item]] = defaultdict(list)
    for item in items:
        if (marker := item.get_closest_marker("sweep")) and "exhaustive" not in item.keywords:
            number, name = marker.args[0], (*marker.args, item.nodeid.partition("[")[0])[1]
            sweeps[name, number].append(item)
    return {
        item
        for (name, number), cases in sweeps.items()
        for item in random.Random(f"{seed} {name}").sample(cases, max(len(cases) - number, 0))
    }


@pytest.fixture(scope="session", autouse=True)
def cache_of_its_own(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Indices of events go to a folder of this test run, also those of the commands that tests call."""
    os.environ["ENERF_CACHE"] = str(tmp_path_factory.mktemp("cache"))


@pytest.fixture(autouse=True)
def logs_of_its_own() -> Iterator[None]:
    """Trainings of this test write to no log of a test before, whose folder may be gone."""
    yield
    if "nerfstudio.utils.writer" in sys.modules:
        from enerf_ns.method.nerfstudio_seams import start_new_logs

        start_new_logs()


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of the real recordings: ENERF_DATA, or ../shared/data beside the project."""
    folder = Path(os.environ.get("ENERF_DATA", Path(__file__).parents[2] / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no real recordings at {folder}; set ENERF_DATA")
    return folder


@pytest.fixture(scope="session")
def warm_commands(tmp_path_factory: pytest.TempPathFactory) -> Iterator[WarmCommands]:
    if not hasattr(os, "fork"):
        pytest.skip("processes cannot be forked here")
    commands = WarmCommands(tmp_path_factory.mktemp("printed"))
    yield commands
    commands.close()


@pytest.fixture
def python_interrupts() -> Iterator[None]:
    """SIGINT interrupts, also where tests run in the background, whose processes ignore it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture
def one_thread() -> Iterator[None]:
    """PyTorch adds up numbers in the same order."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(params=["cpu", "cuda"])
def device(request: pytest.FixtureRequest) -> str:
    """Each device that the machine may have."""
    if request.param == "cuda" and not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    return request.param


@pytest.fixture(scope="session")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tenth of a second of a small camera, with grey frames, sharp and blurred, and depth."""
    from enerf_ns.simulator.engine import simulate
    from enerf_ns.simulator.settings import SimulationSettings

    folder = tmp_path_factory.mktemp("simulated") / "recording"
    simulate(SimulationSettings("shapes", width=32, height=24, duration=0.1, num_frames=11, exposure_ms=5.0), folder)
    return folder


@pytest.fixture(scope="session")
def colour_recording(recording: Path) -> Path:
    """The same with frames in colour."""
    import numpy as np
    from PIL import Image

    from enerf_ns.dataparsers.recording.files import load_image

    folder = recording.with_name("colour")
    shutil.copytree(recording, folder)
    for file in [*folder.glob("images/*.png"), *folder.glob("images_corrupted/*.png")]:
        Image.fromarray((load_image(file) * np.array([1.0, 0.8, 0.5])).astype(np.uint8)).save(file)
    return folder


@pytest.fixture(scope="session")
def run(recording: Path) -> Run:
    """Of two steps on that recording."""
    from small_runs import SMALL

    from enerf_ns.method.runs import method_config, train

    return train(method_config("enerf", recording, recording.parent / "runs", SMALL))


@pytest.fixture(scope="session")
def run_without_frames(recording: Path) -> Run:
    """The same of events alone."""
    from small_runs import SMALL

    from enerf_ns.method.runs import method_config, train

    folder = recording.with_name("without_frames")
    shutil.copytree(recording, folder, ignore=shutil.ignore_patterns("images*", "depth"))
    changes = {**SMALL, "pipeline.datamanager.dataparser.held_out_every": 16}
    changes["pipeline.datamanager.held_out_events"] = 0.2  # of so few events
    return train(method_config("enerf", folder, recording.parent / "runs", changes))

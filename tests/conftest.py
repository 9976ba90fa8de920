from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

# without a GPU, kernels of Triton run as NumPy; Triton reads this when it is imported
os.environ.setdefault("TRITON_INTERPRET", "0" if torch.cuda.is_available() else "1")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--slow", action="store_true", help="also run the tests marked slow")
    parser.addoption("--exhaustive", action="store_true", help="run all tests, sweeps in full too")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    exhaustive = config.getoption("--exhaustive")
    for item in items:
        if "exhaustive" in item.keywords and not exhaustive:
            item.add_marker(pytest.mark.skip(reason="a sweep in full: run with --exhaustive"))
        elif "slow" in item.keywords and not (exhaustive or config.getoption("--slow")):
            item.add_marker(pytest.mark.skip(reason="slow: run with --slow"))


@pytest.fixture(scope="session", autouse=True)
def cache_of_its_own(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Indices of events go to a folder of this test run, also those of the commands that tests call."""
    os.environ["ENERF_CACHE"] = str(tmp_path_factory.mktemp("cache"))


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of the real recordings: ENERF_DATA, or ../shared/data beside the project."""
    folder = Path(os.environ.get("ENERF_DATA", Path(__file__).parents[2] / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no real recordings at {folder}; set ENERF_DATA")
    return folder


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

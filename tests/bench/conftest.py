from __future__ import annotations

from pathlib import Path

import pytest
import torch
from small_runs import SMALL_BENCH

from enerf_ns.bench.runner import Bench
from enerf_ns.bench.settings import BenchSettings


@pytest.fixture(scope="session")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Output folder of a small bench of the experiment design that ran to its end, with one thread."""
    folder = tmp_path_factory.mktemp("bench")
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    for _ in Bench("design", BenchSettings(**SMALL_BENCH, output_dir=folder)).run():
        pass
    torch.set_num_threads(threads)
    return folder

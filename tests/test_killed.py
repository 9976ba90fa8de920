"""What processes leave that are killed."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_nothing_is_lost_or_half_written_where_processes_are_killed(recording: Path, tmp_path: Path):
    """50 times at random moments of training, with its checkpoints, of indexing and of scoring."""
    here = Path(__file__).parent
    threads = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    (tmp_path / "cache").mkdir()
    run = subprocess.run(
        [sys.executable, here / "killed.py", recording, tmp_path / "outputs", "50"],
        env={**os.environ, **threads, "ENERF_CACHE": str(tmp_path / "cache"), "PYTHONPATH": str(here)},
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stderr[-4000:]
    killed = json.loads(run.stdout.splitlines()[-1])
    assert sum(killed.values()) >= 50 and all(killed.values())

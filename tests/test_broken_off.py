"""What commands leave that are killed, or whose disk is full."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not hasattr(os, "memfd_create"), reason="needs fork and memfd_create, as of Linux"),
]

KINDS = {"index", "train", "checkpoint", "report", "convert", "simulate"}


def broken_off(recording: Path, folder: Path, kills: int, *ways: str) -> dict[str, dict[str, int]]:
    """How often each kind of command was broken off in each way, after all was as it should be each time."""
    here = Path(__file__).parent
    environment = {
        "OMP_NUM_THREADS": "1",
        "NUMBA_NUM_THREADS": "1",
        "NUMBA_THREADING_LAYER": "workqueue",  # the one whose processes may be forked
        "ENERF_LPIPS_WEIGHTS": str(folder / "none"),
        "PYTHONPATH": str(here),
    }
    run = subprocess.run(
        [sys.executable, here / "broken_off.py", recording, folder, str(kills), *ways],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stderr[-4000:]
    return json.loads(run.stdout.splitlines()[-1])


@pytest.fixture(scope="module")
def numbers(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, int]]:
    return broken_off(recording, tmp_path_factory.mktemp("broken-off"), 3, "kill", "small-files")


def test_nothing_is_lost_or_half_written_where_processes_are_killed(numbers: dict[str, dict[str, int]]):
    """Each at random moments, spread over the whole time that it takes. The next start works, what was left is gone
    then, and a run that goes on ends with the weights of one that was never killed."""
    assert numbers["kill"] == dict.fromkeys(KINDS, 3)


def test_files_that_cannot_grow_leave_nothing_half_written(numbers: dict[str, dict[str, int]]):
    """As on a full disk, on which each write may take a part of what it is given; one sentence, and no traceback."""
    number = numbers["small-files"]
    assert number.keys() == KINDS and min(number.values()) >= 3


@pytest.mark.timeout(2400)
@pytest.mark.exhaustive
def test_nor_where_they_are_killed_fifty_times(recording: Path, tmp_path: Path):
    assert broken_off(recording, tmp_path, 50, "kill") == {"kill": dict.fromkeys(KINDS, 50)}


@pytest.mark.exhaustive
def test_full_disks_leave_nothing_half_written(recording: Path, tmp_path: Path):
    disk = tmp_path / "tried"
    disk.mkdir()
    if shutil.which("mount") is None:
        pytest.skip("there is no command to mount a disk")
    mount = subprocess.run(["mount", "-t", "tmpfs", "tmpfs", disk], capture_output=True, text=True)
    if mount.returncode:
        pytest.skip(f"no disk can be mounted here: {mount.stderr.strip()}")
    subprocess.run(["umount", disk], check=True)
    number = broken_off(recording, tmp_path, 0, "small-disk")["small-disk"]
    assert number.keys() == KINDS and min(number.values()) >= 2

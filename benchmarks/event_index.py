"""Speed on one core, memory, and time of the second start, for the index of the events in an HDF5 file.

    python benchmarks/event_index.py --events 1_000_000 10_000_000 100_000_000

Each size is measured in a separate process. Peak memory is the growth of the process while the index is made.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from enerf_ns.dataparsers.index.indexing import index_events

WIDTH, HEIGHT = 1280, 720
RATE = 30e6
"""Events per second, as in mocap-desk2 of TUM-VIE."""


def write_events(path: Path, num_events: int) -> None:
    """Random events in the layout of TUM-VIE, Blosc with Zstandard included."""
    import h5py
    import hdf5plugin

    rng = np.random.default_rng(0)
    piece, start = 10**6, 0
    types = {"x": np.uint16, "y": np.uint16, "t": np.int64, "p": np.uint8}
    with h5py.File(path, "w") as file:
        columns = {
            name: file.create_dataset(
                f"events/{name}", num_events, dtype, chunks=(100_000,), **hdf5plugin.Blosc("zstd")
            )
            for name, dtype in types.items()
        }
        for first in range(0, num_events, piece):
            size = min(piece, num_events - first)
            t = start + np.cumsum(rng.random(size) * 2e6 / RATE)
            values = rng.integers(0, WIDTH, size), rng.integers(0, HEIGHT, size), t, rng.integers(0, 2, size)
            for name, value in zip(types, values, strict=True):
                columns[name][first : first + size] = value
            start = t[-1]


def memory(kind: str) -> int:
    """Bytes of this process, as Linux counts them."""
    (line,) = (line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith(kind))
    return 1024 * int(line.split()[1])


def measure(path: Path) -> dict[str, float]:
    """Index a file on one core."""
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    import torch

    from enerf_ns.dataparsers.formats.hdf5_events import Hdf5Events
    from enerf_ns.dataparsers.recording.camera import Camera
    from enerf_ns.dataparsers.recording.recording import EventRecording
    from enerf_ns.dataparsers.recording.trajectory import Trajectory
    from enerf_ns.events.samplers import EventPairSampler, SilentPixelSampler

    def recording(path: Path) -> EventRecording:
        file = Hdf5Events(path)
        times = np.array([0, file.last_time])
        trajectory = Trajectory(times, np.zeros((2, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (2, 1)))
        camera = Camera(WIDTH, HEIGHT, 1000.0, 1000.0, 640.0, 360.0)
        return EventRecording(path, "tum_vie", camera, trajectory, lambda: file.stream(0), (path,))

    few = path.with_name("few.h5")
    write_events(few, 100_000)
    index_events(recording(few))

    before = memory("VmRSS")
    begin = time.perf_counter()
    index = index_events(recording(path))
    built = time.perf_counter() - begin
    peak = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    del index
    begin = time.perf_counter()
    index = index_events(recording(path))
    again = time.perf_counter() - begin

    before = memory("RssAnon")
    samplers = EventPairSampler(index, "partner"), SilentPixelSampler(index, *index.span, 20_000_000, 20_000_000)
    in_use = memory("RssAnon") - before + index.times.nbytes + index.positives.nbytes
    generator = torch.Generator().manual_seed(0)
    assert len(samplers[0].sample(1000, generator)) == len(samplers[1].sample(1000, generator)) == 1000
    return {
        "million events/s": len(index) / built / 1e6,
        "s": built,
        "bytes/event, peak": peak / len(index),
        "bytes/event, in use": in_use / len(index),
        "second start, s": again,
    }


def main(events: tuple[int, ...] = (10**6, 10**7, 10**8), folder: Path | None = None) -> None:
    """Measure indices of these sizes.

    Args:
        events: Numbers of events.
        folder: For the files, 10 and 12 bytes an event. Without it, the system's folder for temporary files.
    """
    table = Table("events")
    for num_events in events:
        with tempfile.TemporaryDirectory(dir=folder) as scratch:
            path = Path(scratch) / "events.h5"
            write_events(path, num_events)
            environment = {**os.environ, "ENERF_CACHE": f"{scratch}/cache", "OMP_NUM_THREADS": "1"}
            command = [sys.executable, __file__, "measure", str(path)]
            found = json.loads(subprocess.run(command, env=environment, check=True, capture_output=True).stdout)
        if len(table.columns) == 1:
            for name in found:
                table.add_column(name)
        table.add_row(f"{num_events:,}", *(f"{value:.1f}" for value in found.values()))
    Console().print(table)


if __name__ == "__main__":
    if sys.argv[1:2] == ["measure"]:
        print(json.dumps(measure(Path(sys.argv[2]))))
    else:
        tyro.cli(main)

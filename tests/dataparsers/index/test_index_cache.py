from __future__ import annotations

import json
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from enerf_ns.dataparsers.index import index_cache
from enerf_ns.dataparsers.index.event_index import EventIndex
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.recording.cache import DAYS_KEPT
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.recording import EventRecording, Events
from enerf_ns.dataparsers.recording.trajectory import Trajectory

WIDTH, HEIGHT = 32, 24
NUM_EVENTS = 20_000


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache, which takes recordings of any size."""
    folder = tmp_path / "cache"
    monkeypatch.setenv("ENERF_CACHE", str(folder))
    monkeypatch.setattr(index_cache, "CACHED_FROM", 1)
    return folder


@pytest.fixture
def source(tmp_path: Path) -> Path:
    rng = np.random.default_rng(0)
    t = np.sort(rng.integers(0, 10**9, NUM_EVENTS))
    columns = [rng.integers(0, WIDTH, NUM_EVENTS), rng.integers(0, HEIGHT, NUM_EVENTS), t, np.arange(NUM_EVENTS) % 2]
    path = tmp_path / "events.npy"
    np.save(path, np.stack(columns))
    return path


def recording(source: Path, end: int = 10**9) -> EventRecording:
    """Of the events in a file, which are streamed in pieces; `passes` counts how often they were read to the end."""
    identity = np.tile([0.0, 0.0, 0.0, 1.0], (2, 1))
    trajectory = Trajectory(np.array([0, end]), np.array([[0.0, 0, 0], [1.0, 0, 0]]), identity)

    def stream():
        columns = np.load(source)
        for start in range(0, columns.shape[1], 3000):
            yield Events(*columns[:, start : start + 3000])
        passes.append(len(columns))

    passes: list[int] = []
    made = EventRecording(source, "test", Camera(WIDTH, HEIGHT, 20, 20, 16, 12), trajectory, stream, (source,))
    object.__setattr__(made, "passes", passes)
    return made


def entries(cache: Path) -> list[str]:
    return sorted(path.name for path in cache.iterdir())


def assert_equal(one: EventIndex, other: EventIndex) -> None:
    for column in ("times", "positives", "offsets", "hot_pixels"):
        assert torch.equal(getattr(one, column), getattr(other, column)), column
    assert one.width == other.width


def test_the_second_start_reads_the_index_and_not_the_events(source: Path, cache: Path):
    first, second = recording(source, 900_000_000), recording(source, 900_000_000)
    assert_equal(index_events(first), index_events(second))
    assert len(first.passes) == 2 and not second.passes  # type: ignore[attr-defined]
    notes = index_events(first).notes
    assert notes == index_events(second).notes and "lie outside the poses" in notes[0]
    assert len(entries(cache)) == 1
    assert_equal(index_events(second), EventIndex.from_events(index_events(first).events(), WIDTH, HEIGHT))


def test_what_changes_the_index_changes_the_entry(source: Path, cache: Path):
    index_events(recording(source)).span  # noqa: B018
    assert index_events(recording(source, end=500_000_000)).span[1] <= 500_000_000
    chosen = recording(source).selected((0.25, 0.5), keep_hot_pixels=False)
    assert index_events(chosen).span[0] >= 250_000_000 and index_events(chosen).span[1] <= 500_000_000
    assert len(entries(cache)) == 3

    columns = np.load(source)
    columns[2] += 1000
    np.save(source, columns)
    assert index_events(recording(source, end=2 * 10**9)).span == (columns[2, 0], columns[2, -1])
    assert len(entries(cache)) == 4


def test_what_was_not_used_for_long_is_removed(source: Path, cache: Path):
    """An entry that is used stays however old it is, and so do files of somebody else."""
    made = [recording(source, end) for end in (10**9, 500_000_000, 400_000_000)]
    for one in made[:2]:
        index_events(one).span  # noqa: B018
    others = [f"{kind}-{'0123456789abcdef' * 2}" for kind in ("frames", "pictures")]
    for name in (*others, "mine", "frames-mine"):
        (cache / name).mkdir()
    known, too_old = set(entries(cache)), time.time() - (DAYS_KEPT + 1) * 24 * 3600
    for name in known:
        os.utime(cache / name, (too_old, too_old))
    index_events(recording(source)).span  # noqa: B018
    (kept,) = set(entries(cache)) - {"mine", "frames-mine"}
    again = recording(source)
    assert index_events(again).span and not again.passes and kept in known  # type: ignore[attr-defined]
    recent = time.time() - (DAYS_KEPT - 1) * 24 * 3600
    os.utime(cache / kept, (recent, recent))
    index_events(made[2]).span  # noqa: B018
    assert kept in entries(cache) and len(entries(cache)) == 4


@pytest.mark.parametrize("column", ["times", "positives", "counts", "index.json"])
@pytest.mark.parametrize("damage", ["shorter", "other bytes", "gone"])
def test_a_damaged_entry_is_noticed_and_made_again(source: Path, cache: Path, column: str, damage: str):
    good = index_events(recording(source))
    times = good.times.clone()
    file = cache / entries(cache)[0] / column
    content = file.read_bytes()
    file.unlink()
    if damage == "shorter":
        file.write_bytes(content[: len(content) // 2])
    elif damage == "other bytes":
        file.write_bytes(bytes(len(content)))
    again = recording(source)
    assert torch.equal(index_events(again).times, times)
    assert len(again.passes) == 2 and len(entries(cache)) == 1  # type: ignore[attr-defined]
    restored = recording(source)
    assert torch.equal(index_events(restored).times, times) and not restored.passes  # type: ignore[attr-defined]


@pytest.mark.parametrize("column", ["times", "positives", "counts"])
def test_one_flipped_byte_anywhere_is_noticed(source: Path, cache: Path, column: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(index_cache, "BLOCK", 1000)
    index_events(recording(source)).span  # noqa: B018
    (entry,) = entries(cache)
    file = cache / entry / column
    content = file.read_bytes()
    for place in np.random.default_rng(4).integers(0, len(content), 20).tolist():
        flipped = bytearray(content)
        flipped[place] ^= 1 << place % 8
        file.write_bytes(flipped)
        assert index_cache.load_index(entry) is None
        index_events(recording(source)).span  # noqa: B018
        assert file.read_bytes() == content


def test_a_recording_changed_in_place_is_read_anew_whatever_its_time_of_modification(source: Path, cache: Path):
    before, state = index_events(recording(source)).times.clone(), source.stat()
    columns = np.load(source, mmap_mode="r+")
    columns[2] = np.sort(columns[2] // 2)
    columns.flush()
    os.utime(source, ns=(state.st_atime_ns, state.st_mtime_ns))
    assert (source.stat().st_size, source.stat().st_mtime_ns) == (state.st_size, state.st_mtime_ns)
    assert not torch.equal(index_events(recording(source)).times, before)


def test_a_killed_process_leaves_no_entry_and_its_remains_are_removed_later(source: Path, cache: Path):
    program = """
import os, sys
from pathlib import Path
from enerf_ns.dataparsers.index import index_cache
from enerf_ns.dataparsers.index.indexing import index_events
sys.path.insert(0, sys.argv[2])
from test_index_cache import recording
index_cache.CACHED_FROM = 1
real = index_cache.os.fsync
index_cache.os.fsync = lambda number: (print("writing", flush=True), sys.stdin.read())
index_events(recording(Path(sys.argv[1])))
"""
    arguments = [sys.executable, "-c", program, str(source), str(Path(__file__).parent)]
    process = subprocess.Popen(arguments, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None and process.stdout.readline() == "writing\n"
    process.send_signal(signal.SIGKILL)
    process.wait()
    (left_behind,) = entries(cache)
    assert ".partial-" in left_behind
    index_events(recording(source)).span  # noqa: B018
    (entry,) = entries(cache)
    assert entry != left_behind


def _build(source: Path, cache: Path, barrier, results) -> None:
    os.environ["ENERF_CACHE"] = str(cache)
    index_cache.CACHED_FROM = 1
    barrier.wait()
    index = index_events(recording(source))
    results.put((len(index), int(index.times.sum() % 10**9)))


def test_two_processes_at_once_do_no_harm(source: Path, cache: Path):
    context = multiprocessing.get_context("spawn")
    barrier, results = context.Barrier(3), context.Queue()
    processes = [context.Process(target=_build, args=(source, cache, barrier, results)) for _ in range(3)]
    for process in processes:
        process.start()
    found = {results.get(timeout=120) for _ in processes}
    for process in processes:
        process.join()
    assert found == {(NUM_EVENTS, int(np.load(source)[2].sum() % 10**9))}
    assert len(entries(cache)) == 1


def test_a_folder_that_cannot_be_written_costs_the_cache_and_nothing_else(source: Path, cache: Path):
    cache.write_text("a file, where a folder was expected")
    made = recording(source)
    assert len(index_events(made)) == NUM_EVENTS
    (note,) = index_events(made).notes
    assert "could not be stored in" in note and "ENERF_CACHE" in note


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_costs_the_cache_and_nothing_else(source: Path, cache: Path, monkeypatch: pytest.MonkeyPatch):
    opened = open

    def open_on_a_full_disk(path, *mode, **options):
        return opened("/dev/full" if str(path).endswith("/times") else path, *mode, **options)

    monkeypatch.setattr("builtins.open", open_on_a_full_disk)
    made = recording(source)
    assert len(index_events(made)) == NUM_EVENTS
    assert "No space left on device" in index_events(made).notes[0]
    assert entries(cache) == []


@pytest.mark.parametrize("bands", [1, 2, 7])
def test_bands_of_pixels_make_the_same_index(source: Path, cache: Path, bands: int, monkeypatch: pytest.MonkeyPatch):
    whole = index_events(recording(source))
    shutil.rmtree(cache)
    memory = SimpleNamespace(total=4 * 12 * (NUM_EVENTS // bands + 100))
    monkeypatch.setattr(index_cache.psutil, "virtual_memory", lambda: memory)
    banded = recording(source)
    assert_equal(index_events(banded), whole)
    assert len(banded.passes) >= 1 + bands  # type: ignore[attr-defined]


def test_a_file_that_changes_between_the_passes_is_an_error(source: Path):
    columns = np.load(source)
    moved = columns.copy()
    moved[0] = (moved[0] + 1) % WIDTH
    contents = iter([columns, columns, moved])
    made = replace(recording(source), stream_events=lambda: iter([Events(*next(contents))]))
    with pytest.raises(ValueError, match=r"events\.npy changed while it was read"):
        index_events(made)


def test_the_entry_is_plain_data(source: Path, cache: Path):
    index = index_events(recording(source))
    folder = cache / entries(cache)[0]
    assert np.array_equal(np.fromfile(folder / "times", np.int64), index.times)
    assert json.loads((folder / "index.json").read_text())["survey"]["num_events"] == NUM_EVENTS

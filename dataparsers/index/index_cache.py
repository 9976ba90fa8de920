"""A cache of event indices on disk, so that a large recording is sorted once.

An entry is a folder. Its name is a hash of everything that determines the index. It is written under another name and
then renamed, so that an entry is always whole, however many processes write it at once and whenever they are stopped.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import zlib
from dataclasses import asdict
from pathlib import Path

import numpy as np
import psutil
import torch

from enerf_ns.dataparsers.index.event_index import EventIndex
from enerf_ns.dataparsers.index.event_survey import EventStream, Survey, sorted_bands
from enerf_ns.dataparsers.recording.cache import cache_entry, cache_folder
from enerf_ns.dataparsers.recording.files import partial_of

LAYOUT = 4
"""Version of an entry's content. It grows when the content changes."""

CACHED_FROM = 2_000_000
"""Fewest events of an index that is stored. Fewer events are sorted again each time, in less than a second."""

COLUMNS = {"times": np.int64, "positives": np.int32, "counts": np.int32}
"""Files of an entry, with the type of their numbers."""

BLOCK = 2**22
"""Bytes that are read at once for a checksum."""


def entry_name(**made_from: object) -> str:
    """Name of the entry of an index that these values (JSON types) determine."""
    text = json.dumps({"layout": LAYOUT, **made_from}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def load_index(name: str) -> tuple[EventIndex, Survey] | None:
    """An index from the cache, mapped into memory, and its survey. None if there is none. Removes a damaged entry."""
    try:
        folder = cache_entry(name)
    except OSError:
        return None
    if not os.path.lexists(folder):
        return None
    try:
        stored = json.loads((folder / "index.json").read_text())
        for column in COLUMNS:
            if _checksum(folder / column) != stored["checksums"][column]:
                raise ValueError(f"{column} is damaged")
        times, positives, counts = (np.memmap(folder / column, kind, "c") for column, kind in COLUMNS.items())
        survey = Survey(counts=np.array(counts), **stored["survey"])
        if len(times) != len(positives) or len(times) != survey.counts.sum():
            raise ValueError("the columns do not fit together")
        survey.hot_pixels = np.array(survey.hot_pixels, np.int64)
    except (OSError, ValueError, KeyError, TypeError):
        shutil.rmtree(folder, ignore_errors=True)
        return None
    return _index(times, positives, survey), survey


def build_index(stream: EventStream, survey: Survey, name: str, notes: list[str]) -> EventIndex:
    """Sorts the events, and stores the index in the cache if there are at least `CACHED_FROM` events.

    If the events need more than a quarter of the memory, one band of pixels after the other is sorted and written.

    Args:
        stream: The events that were surveyed.
        survey: Without faults.
        name: Of the entry.
        notes: A sentence is added if the index could not be stored.

    Raises:
        OSError: The events need more than a quarter of the memory, and the index cannot be stored.
        ValueError: The events changed after the survey.
    """
    num_events, in_memory = int(survey.counts.sum()), psutil.virtual_memory().total // 4 // 12
    bands = sorted_bands(stream, survey, in_memory)
    if num_events < CACHED_FROM:
        return _index(*next(bands), survey)
    if num_events > in_memory:
        _store(name, survey, bands)
    else:
        times, positives = next(bands)
        try:
            _store(name, survey, iter([(times, positives)]))
        except OSError as error:
            notes.append(
                f"The index of {num_events:,} events could not be stored in the cache "
                f"({error.strerror or error}), so that the next start takes as long; make room, or set ENERF_CACHE to "
                "another folder."
            )
            return _index(times, positives, survey)
        del times, positives
    loaded = load_index(name)
    if loaded is None:
        raise OSError(f"the index could not be read back from {cache_folder() / name}")
    return loaded[0]


def _store(name: str, survey: Survey, bands) -> None:
    cache_folder().mkdir(parents=True, exist_ok=True)
    partial = partial_of(cache_folder() / name)
    partial.mkdir()
    try:
        with open(partial / "times", "wb") as times_file, open(partial / "positives", "wb") as positives_file:
            for times, positives in bands:
                times_file.write(times.data)
                positives_file.write(positives.data)
        survey.counts.tofile(partial / "counts")
        facts = {key: value for key, value in asdict(survey).items() if key != "counts"}
        facts["hot_pixels"] = survey.hot_pixels.tolist()
        checksums = {}
        for column in COLUMNS:
            with open(partial / column, "rb+") as file:
                os.fsync(file.fileno())
            checksums[column] = _checksum(partial / column)
        (partial / "index.json").write_text(json.dumps({"survey": facts, "checksums": checksums}))
        try:
            partial.rename(cache_folder() / name)
        except OSError:
            if load_index(name) is None:  # otherwise another process was faster
                raise
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _index(times: np.ndarray, positives: np.ndarray, survey: Survey) -> EventIndex:
    return EventIndex(
        torch.from_numpy(times),
        torch.from_numpy(positives),
        survey.offsets,
        survey.width,
        torch.from_numpy(survey.hot_pixels),
    )


def _checksum(path: Path) -> list[int]:
    """Size and checksum of a file."""
    checksum = 0
    with open(path, "rb") as file:
        while block := file.read(BLOCK):
            checksum = zlib.crc32(block, checksum)
    return [path.stat().st_size, checksum]

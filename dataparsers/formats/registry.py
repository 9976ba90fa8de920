"""Which formats there are, and which one a folder has.

A format is a module with `FILES`, the glob patterns that its folders are recognised by, and `read(folder)`; adding one
means writing that module and naming it in `FORMATS`.
"""

from __future__ import annotations

from functools import cache
from importlib import import_module
from pathlib import Path

from enerf_ns.dataparsers.errors import RecordingError
from enerf_ns.dataparsers.files import of_file
from enerf_ns.dataparsers.recording import EventRecording


def read_recording(
    path: Path | str,
    format: str = "auto",
    time_range: tuple[float, float] | None = None,
    keep_hot_pixels: bool = False,
    **options: object,
) -> EventRecording:
    """Reads a recording; its events are read when first asked for. A folder is read once per process.

    Args:
        path: Folder of the recording; never written to.
        format: A name of `FORMATS`, or "auto" to find out.
        time_range: As of `EventRecording.selected`.
        keep_hot_pixels: As of `EventRecording.selected`.
        options: Of the format's reader.

    Raises:
        RecordingError: The folder is of no known format, or anything in it cannot be used.
    """
    return _read_recording(Path(path).resolve(), format, time_range, keep_hot_pixels, **options)


FORMATS = ("esim", "esim_npz", "esim_bag", "davis", "eds", "tum_vie", "event_recording")
"""Names of the formats, which are those of their readers' modules."""


@cache
def _read_recording(path: Path, format: str, time_range, keep_hot_pixels: bool, **options: object) -> EventRecording:
    if not path.exists():
        raise RecordingError(f"{path} does not exist; give the folder of a recording.")
    if not path.is_dir():
        raise RecordingError(f"{path} is a file, but a recording is a folder; give the folder that it lies in.")
    reader = import_module(f"enerf_ns.dataparsers.formats.{_find_format(path) if format == 'auto' else format}")
    with of_file(path):
        recording = reader.read(path, **options)
    return recording.selected(time_range, keep_hot_pixels)


def _find_format(path: Path) -> str:
    """Of the formats, the one most of whose files lie in a folder."""
    readers = {name: import_module(f"enerf_ns.dataparsers.formats.{name}") for name in FORMATS}
    found = {name: sum(any(path.glob(pattern)) for pattern in reader.FILES) for name, reader in readers.items()}
    best = [name for name, count in found.items() if count == max(found.values())]
    if len(best) == 1:
        return best[0]
    looked_for = "; ".join(f"for {name}: {', '.join(reader.FILES)}" for name, reader in readers.items())
    names = sorted(entry.name + "/" * entry.is_dir() for entry in path.iterdir())
    listed = ", ".join(names[:8]) + (f" and {len(names) - 8} more" if len(names) > 8 else "")
    raise RecordingError(
        f"{path} is a folder of no known format, since it must hold exactly one format's files ({looked_for}) but "
        f"holds {listed or 'nothing'}."
    )

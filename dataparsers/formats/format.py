"""What the registry knows of a layout of recordings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from enerf_ns.dataparsers.formats.writer import Writer
from enerf_ns.dataparsers.recording.recording import EventRecording


@dataclass(frozen=True)
class FormatOptions:
    """What may be chosen of a recording of a format: none, unless a subclass has fields.

    A subclass is a frozen dataclass whose fields have defaults, and below each a string that becomes the help of its
    flag; `Format.read` takes them by name.
    """


@dataclass(frozen=True)
class Format:
    """A layout of recordings in folders."""

    name: str
    """Name of the format, such as tum_vie."""
    command: str
    """Sub-command of the data parser, such as tumvie-events."""
    description: str
    """One sentence about the format, for the help of its sub-command."""
    files: tuple[str, ...]
    """Patterns (glob) of files that tell a folder of this format from those of others."""
    read: Callable[..., EventRecording]
    """Reads all but the events from a folder (Path), with the options by name; raises RecordingError."""
    options: type[FormatOptions] = FormatOptions
    """Class of the options that `read` takes."""
    writer: type[Writer] | None = None
    """Class that writes such a folder; None where it can only be read."""

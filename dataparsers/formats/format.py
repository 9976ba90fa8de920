"""The description of a layout of recordings, which the registry holds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from enerf_ns.dataparsers.formats.writer import Writer
from enerf_ns.dataparsers.recording.recording import EventRecording


@dataclass(frozen=True)
class FormatOptions:
    """The options of a format; this base class has none.

    A subclass is a frozen dataclass. Each field has a default, and below it a string that becomes the help of its flag.
    `Format.read` takes the options by name.
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
    """Patterns (glob) of files that distinguish this format from others."""
    read: Callable[..., EventRecording]
    """Function that reads a folder (Path) without its events, with the options by name; raises RecordingError."""
    options: type[FormatOptions] = FormatOptions
    """Class of the options that `read` takes."""
    writer: type[Writer] | None = None
    """Class that writes such a folder; None if the format can only be read."""
    takes_poses: bool = False
    """Whether `read` takes poses (`GivenPoses`, or None) in place of those in the folder, which may then be missing."""

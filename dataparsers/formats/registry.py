"""The registry of all formats, which finds the format of a folder and reads it.

A format is a module that defines a `Format`. To add one, write the module and name it in the loop over modules below.
In another package, name it by an entry point in the group enerf_ns.formats, or call `register`. A sub-command of
`ns-train` also needs an entry point in nerfstudio.dataparser_configs.
"""

from __future__ import annotations

import os
import warnings
from contextlib import suppress
from dataclasses import asdict, fields, replace
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import Literal, get_args, get_origin, get_type_hints

from enerf_ns.dataparsers.formats import (
    davis,
    dsec,
    e2nerf,
    eds,
    esim,
    esim_bag,
    esim_npz,
    event_recording,
    eventnerf,
    evimo2,
    llff_events,
    m3ed,
    mvsec,
    ros_bag,
    tum_vie,
    vector,
)
from enerf_ns.dataparsers.formats.format import Format
from enerf_ns.dataparsers.formats.json_values import in_words
from enerf_ns.dataparsers.formats.pose_files import GivenPoses, RestPoses
from enerf_ns.dataparsers.formats.writer import Setup, Writer
from enerf_ns.dataparsers.recording.cache import cache_folder
from enerf_ns.dataparsers.recording.errors import FlagError, OutputError, RecordingError
from enerf_ns.dataparsers.recording.files import absolute, files_in, name_links_out, of_file
from enerf_ns.dataparsers.recording.ranges import RANGES, check_range
from enerf_ns.dataparsers.recording.recording import EventRecording

_FORMATS: dict[str, Format] = {}

FILES_OF_A_RECORDING = 2
"""Least number of files of a format that mark a folder as a recording, which is never written to."""


NAME_SHOWN = 60
"""Most letters that an error shows of a name in a file, from its end."""


def register(format: Format) -> None:
    """Adds a format to the registry.

    Args:
        format: The format; its name and command must be new, and its name must not be auto.

    Raises:
        ValueError: The name or command is taken, or the name is auto.
    """
    taken = {name for known in _FORMATS.values() for name in (known.name, known.command)}
    if format.name == "auto":
        raise ValueError("A format cannot be named auto, which stands for automatic detection; give it another name.")
    if format.name in taken or format.command in taken:
        raise ValueError(f"There is a format {format.name} or {format.command} already; give this one other names.")
    _FORMATS[format.name] = format


def formats() -> tuple[Format, ...]:
    """Returns all formats in the order of their registration, with those that other packages name by entry points."""
    _load_entry_points()
    return tuple(_FORMATS.values())


def format_named(name: str) -> Format:
    """Returns the format of this name.

    Raises:
        FlagError: There is none.
    """
    known = {format.name: format for format in formats()}
    if name not in known:
        raise FlagError(f"The format {name!r} is not known; give one of {', '.join(known)}, or auto to find out.")
    return known[name]


def read_recording(
    path: Path | str,
    format: str = "auto",
    time_range: tuple[float, float] | None = None,
    keep_hot_pixels: bool = False,
    keep_pose_gaps: bool = False,
    undistort: bool = True,
    smooth_poses: bool = False,
    poses: GivenPoses | None = None,
    **options: object,
) -> EventRecording:
    """Reads a recording without its events, which are read when they are needed. A process reads each folder once.

    Args:
        path: Folder of the recording; never written to.
        format: Name of a registered format, or "auto" to detect it.
        time_range: Argument of `EventRecording.selected`.
        keep_hot_pixels, keep_pose_gaps, undistort, smooth_poses: Arguments of `EventRecording.selected`.
        poses: Poses in place of those in the folder, which may then be missing. Default: those in the folder.
        options: Options of the format, by name.

    Raises:
        RecordingError: The folder has no known format, or its content cannot be used.
        FlagError: There is no such format, it lacks an option or takes no poses, or the time range cannot be used.
    """
    if time_range is not None:
        check_range("--time-range", time_range, RANGES["time_range"])
    found = _read_folder(absolute(path), format, poses, **options)
    return found.selected(time_range, keep_hot_pixels, keep_pose_gaps, undistort, smooth_poses)


def layouts() -> tuple[str, ...]:
    """Returns the names of the formats that can be written."""
    return tuple(format.name for format in formats() if format.writer is not None)


def writer_of(layout: str) -> type[Writer]:
    """Returns the class that writes a layout.

    Raises:
        FlagError: There is none.
    """
    writer = format_named(layout).writer
    if writer is None:
        raise FlagError(f"The layout {layout} can only be read; give one of {', '.join(layouts())}.")
    return writer


def open_writer(layout: str, folder: Path, setup: Setup) -> Writer:
    """Returns the writer of a new recording, for a `with` statement, whose end finishes the recording.

    Args:
        layout: One of `layouts`.
        folder: An empty folder.
        setup: The properties of the recording.

    Raises:
        FlagError: The layout cannot hold these cameras or so few frames, or the extrinsics are not a rigid motion.
        OutputError: The disk is full.
    """
    return writer_of(layout)(folder, setup)


for _module in (
    *(esim, esim_npz, esim_bag, davis, eds, tum_vie, eventnerf, llff_events, evimo2, mvsec, vector),
    *(ros_bag, m3ed, dsec, e2nerf, event_recording),
):
    register(_module.FORMAT)


@cache
def _load_entry_points() -> None:
    """Registers the formats of other packages, when formats are asked for, so that their modules can import this one.

    One that cannot be loaded is left out with a warning, since it would otherwise break every command.
    """
    for entry in entry_points(group="enerf_ns.formats"):
        try:
            register(entry.load())
        except Exception as error:
            of = f" of the package {entry.dist.name}" if entry.dist else ""
            warnings.warn(
                f"The format {entry.name}{of} is left out, since {entry.value} cannot be used ({error}).", stacklevel=2
            )


@cache
def _read_folder(path: Path, format: str, poses: GivenPoses | None = None, **options: object) -> EventRecording:
    if not path.exists():
        raise RecordingError(f"{path} does not exist; give the folder of a recording.")
    if not path.is_dir():
        raise RecordingError(f"{path} is a file, but a recording is a folder; give the folder that it lies in.")
    found = _find_format(path) if format == "auto" else format_named(format)
    _check_options(path, found, options)
    read_with = asdict(found.options(**options))
    if poses is not None:
        if not found.takes_poses:
            whose = ", ".join(format.name for format in formats() if format.takes_poses)
            if isinstance(poses, RestPoses):
                raise FlagError(
                    f"--without-poses is for recordings of {whose}, but {path} is read as {found.name}, with its own "
                    "poses; leave it out."
                )
            raise FlagError(
                f"--poses is for event files and recordings of {whose}, but {path} is read as {found.name}, with its "
                "own poses; convert it without --poses, and give --poses with the new recording."
            )
        options["poses"] = poses
    if "ENERF_CACHE" in os.environ:
        check_outside_recordings("ENERF_CACHE", cache_folder())
    name_links_out(path)
    try:
        with of_file(path):
            has_poses = not isinstance(poses, RestPoses)
            return replace(found.read(path, **options), read_with=read_with, has_poses=has_poses)
    except OSError as error:  # as of a name that is longer than names can be
        raise RecordingError(
            f"{path} names ...{os.fsdecode(error.filename or path)[-NAME_SHOWN:]}, which cannot be opened "
            f"({error.strerror}); check the names in its files, and who may read them."
        ) from error


def _check_options(path: Path, found: Format, options: dict[str, object]) -> None:
    for option, value in options.items():
        flag = f"--{option.replace('_', '-')}"
        having = [format.name for format in formats() if option in (field.name for field in fields(format.options))]
        if found.name not in having:
            whose = f"is for recordings of {in_words(having)}" if having else "is no option of any format"
            raise FlagError(f"{flag} {whose}, but {path} is read as {found.name}; leave it out.")
        hint = get_type_hints(found.options)[option]
        kinds = [part for part in (hint, *get_args(hint)) if get_origin(part) is Literal]
        choices = [choice for kind in kinds for choice in get_args(kind)]
        if choices and value is not None and value not in choices:
            raise FlagError(
                f"{flag} {value} is no choice for recordings of {found.name}, as which {path} is read; give one of "
                f"{', '.join(map(str, choices))}, or leave it out."
            )


def check_outside_recordings(flag: str, output: Path, *read: Path | None) -> None:
    """Checks that results do not go into a recording or replace an input.

    Args:
        flag: The flag that states the place of the results.
        output: The file or folder of the results, which may be missing.
        read: Files and folders of the input. Any other folder with `FILES_OF_A_RECORDING` files of a format counts as a
            recording too, where files of any name (*.bag, */*.db3) count as one.

    Raises:
        OutputError: The place lies in an input or a recording, or is one.
    """
    output = absolute(output)
    sources = {absolute(path) for path in read if path is not None}
    for place in (output, *output.parents):
        if place in sources or _is_recording(place):
            where = "lies within the recording" if place.is_dir() else "would replace the file"
            raise OutputError(f"{flag} {output} {where} {place}, which is never written to; give a place elsewhere.")


def _is_recording(path: Path) -> bool:
    most = 0
    for format in formats():
        found = [pattern for pattern in format.files if _is_there(path, pattern)]
        of_any_name = sum(pattern.removeprefix("*/").startswith("*.") for pattern in found)
        most = max(most, len(found) - max(of_any_name - 1, 0))
    return most >= FILES_OF_A_RECORDING


def _files_found(path: Path) -> dict[Format, int]:
    """Returns the number of files of each format in a folder."""
    return {format: sum(_is_there(path, pattern) for pattern in format.files) for format in formats()}


def _is_there(path: Path, pattern: str) -> bool:
    """Returns whether a folder has a file of a pattern, while other processes may remove folders in it."""
    with suppress(FileNotFoundError):
        return bool(files_in(path, pattern))
    return path.is_dir() and _is_there(path, pattern)


def _find_format(path: Path) -> Format:
    """Returns the format with the most files in a folder.

    A format does not count beside one that names all its files exactly: esim.bag is no bag of any driver.
    """
    found = _files_found(path)
    best = [format for format, count in found.items() if count == max(found.values())]
    if len(best) > 1 and found[best[0]]:
        files = {format: set(files_in(path, *format.files)) for format in best}
        named = {format: {path / name for name in format.files if (path / name).exists()} for format in best}
        best = [one for one in best if not any(files[one] <= named[other] for other in best if other is not one)]
    if len(best) == 1:
        return best[0]
    looked_for = "; ".join(f"for {format.name}: {', '.join(format.files)}" for format in formats())
    names = sorted(entry.name + "/" * entry.is_dir() for entry in path.iterdir())
    listed = ", ".join(names[:8]) + (f" and {len(names) - 8} more" if len(names) > 8 else "")
    raise RecordingError(
        f"{path} is a folder of no known format, since it must hold exactly one format's files ({looked_for}) but "
        f"holds {listed or 'nothing'}."
    )

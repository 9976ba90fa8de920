"""A trained run with its recording in one file, which another machine can view."""

from __future__ import annotations

import copy
import os
import zipfile
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import yaml

from enerf_ns.dataparsers.recording.errors import OutputError, RecordingError, quoted
from enerf_ns.dataparsers.recording.files import partial_of
from enerf_ns.method.checkpoints import newest_checkpoint

if TYPE_CHECKING:
    from enerf_ns.dataparsers.event_dataparser import EventDataParserConfig
    from enerf_ns.method.trainer import EnerfTrainerConfig

RECORDING, RUNS = Path("recording"), Path("outputs")
"""Folders of the recording and of the runs within a packed run."""


def pack_run(config: EnerfTrainerConfig, run: Path, output: Path) -> Path:
    """Writes a run and its recording as a ZIP file. All its paths start in the folder in which it is unpacked.

    Of the checkpoints, the newest is packed.

    Args:
        config: Of the run.
        run: Its folder, with a whole checkpoint.
        output: The .zip file. If it cannot be written, the previous file stays.

    Returns:
        config.yml of the run within the file.

    Raises:
        RecordingError: The recording is not there, or is not whole without the folders around it.
        OutputError: The file cannot be written.
    """
    config, checkpoint = copy.deepcopy(config), newest_checkpoint(run / "nerfstudio_models")
    recording = config.data
    assert recording is not None and checkpoint is not None
    if not recording.is_dir():
        raise RecordingError(
            f"The recording {recording} of the run is not there any more; put it back, or a link to it."
        )
    manager = config.pipeline.datamanager
    _check_is_whole(manager.dataparser)
    config.data = manager.data = manager.dataparser.data = RECORDING
    config.output_dir, config.load_dir, config.load_config, config.load_checkpoint = RUNS, None, None, None
    folder = config.get_base_dir()
    contents = {RECORDING / file.relative_to(recording): file for file in _files(recording)}
    for file in run.iterdir():
        if file.is_file() and file.suffix in (".json", ".jsonl", ".txt"):
            contents[folder / file.name] = file
    contents[folder / "nerfstudio_models" / checkpoint.name] = checkpoint
    partial = partial_of(output)
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        with zipfile.ZipFile(partial, "w", zipfile.ZIP_DEFLATED, strict_timestamps=False) as packed:
            packed.writestr((folder / "config.yml").as_posix(), yaml.dump(config))
            for name, file in sorted(contents.items()):
                packed.write(file, name.as_posix())
        partial.replace(output)
    except OSError as error:
        raise OutputError(f"{output} cannot be written ({error.strerror}); give another --output.") from error
    finally:
        with suppress(OSError):  # as of a folder that cannot be written to
            partial.unlink(missing_ok=True)
    return folder / "config.yml"


def _files(recording: Path) -> Iterator[Path]:
    """Yields the files of a recording, also those in folders that are links."""
    seen = {os.path.realpath(recording)}
    for folder, inner, names in os.walk(recording, followlinks=True):
        reached = {name: os.path.realpath(os.path.join(folder, name)) for name in inner}
        inner[:] = [name for name, place in reached.items() if place not in seen]  # links may lead in a circle
        seen.update(reached.values())
        yield from (file for name in names if (file := Path(folder, name)).is_file())


def _check_is_whole(parser: EventDataParserConfig) -> None:
    """Checks that a recording reads the same without the folders that it lies in.

    Raises:
        RecordingError: It does not, as where a name of a folder states the camera, or a calibration lies beside it.
    """
    with TemporaryDirectory() as place:
        alone = Path(place) / RECORDING
        try:
            alone.symlink_to(parser.data, target_is_directory=True)
        except OSError:  # Windows may refuse links
            return
        try:
            if replace(parser, data=alone).setup().recording().camera == parser.setup().recording().camera:
                return
            why = "its calibration lies beside it"
        except RecordingError as error:
            why = str(error).replace(str(alone), "it").rstrip(".")
    raise RecordingError(
        f"{parser.data} cannot be packed, since it is not whole without the folders around it ({why}); write it as a "
        f"recording of its own by enerf convert {quoted(parser.data)} --output-dir NEW, and train on that."
    )

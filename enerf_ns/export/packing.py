"""A trained run with its recording in one file, which another machine can view."""

from __future__ import annotations

import copy
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING

import yaml

from enerf_ns.dataparsers.recording.errors import OutputError, RecordingError
from enerf_ns.dataparsers.recording.files import partial_of
from enerf_ns.method.checkpoints import newest_checkpoint

if TYPE_CHECKING:
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
        RecordingError: The recording is not there.
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
    config.data = manager.data = manager.dataparser.data = RECORDING
    config.output_dir, config.load_dir, config.load_config, config.load_checkpoint = RUNS, None, None, None
    folder = config.get_base_dir()
    contents = {RECORDING / file.relative_to(recording): file for file in recording.rglob("*") if file.is_file()}
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
        partial.unlink(missing_ok=True)
    return folder / "config.yml"

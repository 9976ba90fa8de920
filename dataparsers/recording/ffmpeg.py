"""ffmpeg for `ns-render` on machines that have none: the binary inside the imageio-ffmpeg wheel."""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path

from platformdirs import user_cache_path

from enerf_ns.dataparsers.recording.files import partial_of


def make_ffmpeg_available() -> None:
    """Makes a program named `ffmpeg` available to this process and its children.

    If the `PATH` has none, this function puts a link (on Windows a copy) to the binary of imageio-ffmpeg into the
    user's cache folder, and appends this folder to the `PATH`. If that is impossible, nothing changes.
    """
    if shutil.which("ffmpeg") is not None:
        return
    try:
        folder = user_cache_path("enerf-ns", appauthor=False) / "bin"
        if not folder.is_absolute():  # if the home folder is not known
            return
        if shutil.which("ffmpeg", path=str(folder)) is None:
            _link_ffmpeg_into(folder)
    except (ImportError, OSError, RuntimeError):  # RuntimeError: no home folder, or no binary for this platform
        return
    os.environ["PATH"] = os.pathsep.join([os.environ.get("PATH", os.defpath), str(folder)])


def _link_ffmpeg_into(folder: Path) -> None:
    from imageio_ffmpeg import get_ffmpeg_exe

    folder.mkdir(parents=True, exist_ok=True)
    program = folder / ("ffmpeg.exe" if sys.platform == "win32" else "ffmpeg")
    partial = partial_of(program)
    try:
        if sys.platform == "win32":
            shutil.copyfile(get_ffmpeg_exe(), partial)
        else:
            partial.symlink_to(get_ffmpeg_exe())
        partial.replace(program)  # atomic: another process sees the old program or the new one
    finally:
        partial.unlink(missing_ok=True)

"""ffmpeg for `ns-render` on machines that have none: the binary inside the imageio-ffmpeg wheel."""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
from pathlib import Path

from platformdirs import user_cache_path


def make_ffmpeg_available() -> None:
    """Lets this process, and those it starts, find a program named `ffmpeg`.

    Where there is none on the `PATH`, a link (on Windows a copy) to the binary of imageio-ffmpeg is put into the cache
    folder of the user, and that folder is appended to the `PATH`. Where that is impossible, nothing changes.
    """
    if shutil.which("ffmpeg") is not None:
        return
    try:
        folder = user_cache_path("enerf-ns", appauthor=False) / "bin"
        if shutil.which("ffmpeg", path=str(folder)) is None:
            _link_ffmpeg_into(folder)
    except (ImportError, OSError, RuntimeError):  # RuntimeError: no home folder, or no binary for this platform
        return
    os.environ["PATH"] = os.pathsep.join([os.environ.get("PATH", os.defpath), str(folder)])


def _link_ffmpeg_into(folder: Path) -> None:
    from imageio_ffmpeg import get_ffmpeg_exe

    folder.mkdir(parents=True, exist_ok=True)
    name = "ffmpeg.exe" if sys.platform == "win32" else "ffmpeg"
    with tempfile.TemporaryDirectory(dir=folder) as temporary:
        link = Path(temporary) / name
        if sys.platform == "win32":
            shutil.copyfile(get_ffmpeg_exe(), link)
        else:
            link.symlink_to(get_ffmpeg_exe())
        os.replace(link, folder / name)  # atomic: another process sees the old program or the new one

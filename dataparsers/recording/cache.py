"""The folder of the cache: indices of events, pictures, and frames that recordings hold within larger files."""

from __future__ import annotations

import errno
import os
from pathlib import Path

from platformdirs import user_cache_path

from enerf_ns.dataparsers.recording.files import expanded


def cache_folder() -> Path:
    """Folder of the cache: $ENERF_CACHE, else `enerf-ns/indices` in the user's cache folder.

    `enerf_ns.dataparsers.formats.registry` refuses a folder within a recording before it reads one.

    Raises:
        OSError: The user has no home folder.
    """
    if "ENERF_CACHE" in os.environ:
        return expanded(os.environ["ENERF_CACHE"])
    unknown = FileNotFoundError(errno.ENOENT, "no home folder is known", "~")
    try:
        folder = user_cache_path("enerf-ns", appauthor=False) / "indices"
    except RuntimeError as error:  # platformdirs from 4.9 on raises it; earlier ones return a folder named ~
        raise unknown from error
    if not folder.is_absolute():
        raise unknown
    return folder

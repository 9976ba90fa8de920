"""The folder of the cache: indices of events, pictures, and frames that recordings hold within larger files."""

from __future__ import annotations

import errno
import os
import re
import shutil
import time
from contextlib import suppress
from pathlib import Path

from platformdirs import user_cache_path

from enerf_ns.dataparsers.recording.files import expanded

ENTRY = re.compile(r"((frames|pictures)-)?[0-9a-f]{32}")
"""Name of an entry, a folder: kind and hash."""

DAYS_KEPT = 30
"""Days after which an entry that nobody used is removed, so that the cache does not grow for ever."""


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


def cache_entry(name: str) -> Path:
    """Folder of an entry, which may be missing. It counts as used now, and entries that have not been used for
    `DAYS_KEPT` days are removed.

    Raises:
        OSError: The user has no home folder.
    """
    folder = cache_folder()
    with suppress(OSError):  # it is missing, or another user's
        os.utime(folder / name)
    oldest = time.time() - DAYS_KEPT * 24 * 3600
    with suppress(OSError):
        for entry in list(os.scandir(folder)):
            if ENTRY.fullmatch(entry.name) and entry.stat().st_mtime < oldest:
                shutil.rmtree(entry.path, ignore_errors=True)
    return folder / name

"""Where things lie that can be made again."""

from __future__ import annotations

import os
import sys
from pathlib import Path


def user_cache_folder() -> Path:
    """Folder of this package in the user's cache folder: $XDG_CACHE_HOME, or what the platform has for it.

    Raises:
        RuntimeError: The user has no home folder.
    """
    if "XDG_CACHE_HOME" in os.environ:
        return Path(os.environ["XDG_CACHE_HOME"]) / "enerf-ns"
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local") / "enerf-ns"
    return Path.home() / ("Library/Caches" if sys.platform == "darwin" else ".cache") / "enerf-ns"

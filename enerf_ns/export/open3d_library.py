"""Open3D, which is imported when a mesh asks for it: it takes a second, and needs libraries of the system."""

from __future__ import annotations

from typing import Any

from enerf_ns.dataparsers.recording.errors import UserError


def open3d() -> Any:
    """The library.

    Raises:
        UserError: It cannot be loaded.
    """
    try:
        import open3d
    except (ImportError, OSError) as error:
        why = " ".join(str(error).split()).rstrip(".")
        raise UserError(
            f"Open3D, which makes meshes, cannot be loaded ({why}); install it, or the library that it lacks: on "
            "Debian and Ubuntu, apt-get install libusb-1.0-0 libgl1 libx11-6 libgomp1 libegl1."
        ) from error
    return open3d

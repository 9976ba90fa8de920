"""Limits to what a program that reaches the viewer's port can do: it can send any message, not only those of a browser.

viser 0.2.7 answers a request for a path such as /../../etc/passwd with that file, and lets a message set any attribute
of an input to any value. Nerfstudio's panel writes camera paths to a file whose name is the value of a text input.
"""

from __future__ import annotations

import logging
import re
from functools import cache, wraps
from pathlib import Path
from typing import Any

import numpy as np
from viser import GuiApi
from viser._messages import GuiAddTextMessage, GuiUpdateMessage, ViewerCameraMessage
from viser.infra import WebsockServer
from viser.infra._infra import WebsockMessageHandler

MOST_LETTERS = 100
"""Number of characters of a text input that are kept."""

WIDEST = 100.0
"""Largest ratio of the sides of a browser's window."""


class ServedFolder(type(Path())):
    """A folder from which only files within it are served."""

    def __truediv__(self, name: Any) -> Path:
        """The path of a name; a missing file if it is that of a folder or leads out of this one."""
        folder = Path(self)
        found = folder / name
        return found if found.is_file() and found.resolve().is_relative_to(folder.resolve()) else folder / "missing"


@cache
def guard_viser() -> None:
    """Limits the servers that this process starts from now on to their own files, values of inputs, and possible
    cameras. Text keeps the letters of a file name. Further calls change nothing."""
    start, receive = WebsockServer.start, WebsockMessageHandler._handle_incoming_message
    update = GuiApi._handle_gui_updates

    @wraps(start)
    def guarded_start(server: WebsockServer) -> None:
        if server._http_server_root is not None:
            server._http_server_root = ServedFolder(server._http_server_root)
        logging.getLogger("websockets.server").setLevel(logging.CRITICAL)  # else bad requests print tracebacks
        start(server)

    @wraps(receive)
    def guarded_receive(handler: WebsockMessageHandler, client_id: Any, message: Any) -> None:
        if not isinstance(message, ViewerCameraMessage) or is_possible(message):
            receive(handler, client_id, message)

    @wraps(update)
    def guarded_update(gui: GuiApi, client_id: Any, message: GuiUpdateMessage) -> None:
        handle = gui._gui_input_handle_from_id.get(message.id)
        value = message.updates.get("value")
        if handle is None or message.updates.keys() != {"value"} or value not in getattr(handle, "options", (value,)):
            return
        if handle._impl.message_type is GuiAddTextMessage:
            message.updates["value"] = re.sub(r"[^\w.-]", "_", str(value))[:MOST_LETTERS]
        update(gui, client_id, message)

    setattr(WebsockServer, "start", guarded_start)  # noqa: B010 - a type checker would refuse other names
    setattr(WebsockMessageHandler, receive.__name__, guarded_receive)
    setattr(GuiApi, update.__name__, guarded_update)
    setattr(GuiApi, GuiApi._handle_file_transfer_start.__name__, lambda *_: None)  # there is no input for files


def is_possible(camera: ViewerCameraMessage) -> bool:
    """Whether a camera has finite numbers, a rotation, an angle of view below 180 degrees and a window of some size."""
    vectors = (camera.wxyz, camera.position, camera.look_at, camera.up_direction)
    numbers = np.array([*(number for vector in vectors for number in vector), camera.fov, camera.aspect], float)
    return bool(
        [*map(len, vectors)] == [4, 3, 3, 3]
        and np.isfinite(numbers).all()
        and np.any(numbers[:4])
        and 0 < camera.fov < np.pi
        and 1 / WIDEST < camera.aspect < WIDEST
    )

"""Something that looks at a viewer: a client that speaks its protocol and keeps what it is sent, and a real browser."""

from __future__ import annotations

import base64
import io
import json
import re
import shutil
import subprocess
import threading
import time
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import viser.transforms as vtf
from PIL import Image
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
"""A browser that draws pages without a screen."""


def told_by(page: Path, script: str, width: int, profile: Path) -> Any:
    """What a script on a page tells of it, once it is loaded, in a window of this width.

    Args:
        page: The HTML file; the script is added to it.
        script: JavaScript that ends with an object `seen`.
        width: Pixels.
        profile: A folder for the browser.
    """
    ends = 'const told = document.createElement("output"); told.id = "seen"; told.textContent = JSON.stringify(seen);'
    whole = (
        f'<script>addEventListener("load", () => {{ {script} {ends} document.body.append(told); }});</script></body>'
    )
    measured = page.with_name("measured.html")
    measured.write_text(page.read_text().replace("</body>", whole))
    dom = subprocess.run(
        [str(BROWSER), "--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={profile}",
         f"--window-size={width},1000", "--virtual-time-budget=10000", "--dump-dom", measured.as_uri()],
        capture_output=True, text=True, check=True, timeout=120,
    ).stdout  # fmt: skip
    told = re.search(r'<output id="seen">(.*?)</output>', dom)
    assert told, dom[-500:]
    return json.loads(told[1])


def wait_for(condition: Callable[[], Any], seconds: float = 120.0) -> Any:
    """What the condition says once it is true.

    Raises:
        TimeoutError: It is not within some time.
    """
    end = time.monotonic() + seconds
    while not (found := condition()):
        if time.monotonic() > end:
            raise TimeoutError
        time.sleep(0.02)
    return found


class Client:
    """A browser's part of viser's protocol, without a browser: it opens at a place of its own, goes where it is sent,
    and says where it is.

    Args:
        port: Of the server.
        aspect: Width over height of its window.
    """

    def __init__(self, port: int, aspect: float = 4 / 3):
        self.camera: dict[str, Any] = {
            "wxyz": (1.0, 0.0, 0.0, 0.0), "position": (3.0, 3.0, 3.0), "fov": 1.3, "aspect": aspect,
            "look_at": (0.0, 0.0, 0.0), "up_direction": (0.0, 0.0, 1.0),
        }  # fmt: skip
        self.messages: list[dict[str, Any]] = []
        self.pictures: list[np.ndarray] = []
        self._socket = connect(f"ws://127.0.0.1:{port}", max_size=None, compression=None)
        self._told()
        threading.Thread(target=self._listen, daemon=True).start()

    def _told(self, type: str = "ViewerCameraMessage", **values: Any) -> None:
        self._socket.send(msgspec.msgpack.encode({"type": type, **(values or self.camera)}))

    def go(self, **changes: Any) -> None:
        """Changes the camera, turns it towards where it looks, and says so."""
        self.camera |= changes
        z = np.subtract(self.camera["look_at"], self.camera["position"])
        x = np.cross(z, self.camera["up_direction"])
        axes = [x, np.cross(z, x), z]
        matrix = np.stack([axis / np.linalg.norm(axis) for axis in axes], axis=1)
        self.camera["wxyz"] = tuple(vtf.SO3.from_matrix(matrix).wxyz.tolist())
        self._told()

    def _listen(self) -> None:
        places = {
            "SetCameraPositionMessage": ("position", "position"), "SetCameraLookAtMessage": ("look_at", "look_at"),
            "SetCameraUpDirectionMessage": ("up_direction", "position"), "SetCameraFovMessage": ("fov", "fov"),
        }  # fmt: skip
        try:
            for raw in self._socket:
                messages = msgspec.msgpack.decode(bytes(raw))  # type: ignore
                sent = [message for message in messages if message["type"] in places]
                for message in messages:
                    if message["type"] == "BackgroundImageMessage":
                        self.pictures.append(np.asarray(Image.open(io.BytesIO(message["rgb_bytes"]))))
                if sent:  # together, since the server hears out of order what is said in quick succession
                    names = [places[message["type"]] for message in sent]
                    self.go(**{own: message[its] for (own, its), message in zip(names, sent, strict=True)})
                self.messages += messages
        except ConnectionClosed:
            pass

    def told(self, type: str) -> list[dict[str, Any]]:
        """Messages of a type so far."""
        return [message for message in self.messages if message["type"] == type]

    def control(self, label: str) -> str:
        """The id of the input with a label in the folder of the recording."""
        added = [message for message in self.messages if message.get("label") == label and "container_id" in message]
        (folder,) = (message["id"] for message in self.told("GuiAddFolderMessage") if message["label"] == "Recording")
        (found,) = {message["id"] for message in added if message["container_id"] == folder}
        return found

    def set(self, label: str, value: Any) -> None:
        """Sets an input of the folder of the recording."""
        self._told("GuiUpdateMessage", id=self.control(label), updates={"value": value})

    def close(self) -> None:
        self._socket.close()


class Browser:
    """Chromium at a page, driven by its DevTools protocol.

    Args:
        url: Of the page.
        folder: For its profile.
        width, height: Of its window.
    """

    def __init__(self, url: str, folder: Path, width: int = 640, height: int = 480):
        flags = ["--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        self._process = subprocess.Popen(
            [str(BROWSER), *flags, f"--user-data-dir={folder}", "--remote-debugging-port=0",
             "--remote-allow-origins=*", "about:blank"],
            stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        assert self._process.stderr is not None
        port = next(found[1] for line in self._process.stderr if (found := re.search(r"ws://[^:]*:(\d+)/", line)))
        threading.Thread(target=self._process.stderr.read, daemon=True).start()
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json") as answer:
            (page, *_) = (target for target in json.load(answer) if target["type"] == "page")
        self._socket, self._number = connect(page["webSocketDebuggerUrl"], max_size=None), 0
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self.call("Emulation.setDeviceMetricsOverride", **size)
        self.call("Page.navigate", url=url)

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Calls a method of the DevTools protocol."""
        self._number += 1
        self._socket.send(json.dumps({"id": self._number, "method": method, "params": parameters}))
        while (answer := json.loads(self._socket.recv(timeout=120.0))).get("id") != self._number:
            pass
        assert "result" in answer, answer
        return answer["result"]

    def text(self) -> str:
        """What the page says."""
        result = self.call("Runtime.evaluate", expression="document.body.innerText", returnByValue=True)
        return result["result"].get("value", "")

    def screenshot(self) -> np.ndarray:
        """The window, uint8, shape (height, width, 3)."""
        data = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))

    def close(self) -> None:
        self._socket.close()
        self._process.terminate()
        self._process.wait()

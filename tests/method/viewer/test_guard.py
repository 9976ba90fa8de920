"""What a program on the network can do to the viewer beside what a browser does."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest
import viser
from browsers import wait_for
from nerfstudio.viewer.render_panel import populate_render_tab
from viser._messages import ViewerCameraMessage
from websockets.sync.client import connect

from enerf_ns.method.viewer.guard import MOST_LETTERS, guard_viser, is_possible
from enerf_ns.method.viewer.view_renderer import LARGEST_SIDE, ViewRenderer

CAMERA: dict[str, Any] = {
    "wxyz": (1.0, 0.0, 0.0, 0.0),
    "position": (3.0, 3.0, 3.0),
    "fov": 1.3,
    "aspect": 1.5,
    "look_at": (0.0, 0.0, 0.0),
    "up_direction": (0.0, 0.0, 1.0),
}


@pytest.fixture(scope="module")
def server() -> Iterator[viser.ViserServer]:
    guard_viser()
    server = viser.ViserServer(host="127.0.0.1", port=9300, verbose=False)
    yield server
    server.stop()


@pytest.fixture
def say(server: viser.ViserServer) -> Iterator[Any]:
    """Sends a message as a browser would."""
    with connect(f"ws://127.0.0.1:{server.get_port()}", max_size=None, compression=None) as browser:

        def said(type: str, **values: Any) -> None:
            browser.send(msgspec.msgpack.encode({"type": type, **values}))

        said("ViewerCameraMessage", **CAMERA)
        wait_for(server.get_clients)
        yield said
    wait_for(lambda: not server.get_clients())


def answer(server: viser.ViserServer, path: str) -> bytes:
    """To a request for a path as it is, which a browser would shorten."""
    with socket.create_connection(("127.0.0.1", server.get_port()), timeout=10) as asked:
        asked.sendall(f"GET {path} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
        return b"".join(iter(lambda: asked.recv(65536), b""))


def test_the_page_alone_is_served(server: viser.ViserServer, tmp_path: Path, capfd: pytest.CaptureFixture[str]):
    secret = tmp_path / "secret"
    secret.write_text("a private key")
    assert answer(server, "/").startswith(b"HTTP/1.1 200") and b"<html" in answer(server, "/index.html")
    up = "/.." * 30
    for path in (f"{up}{secret}", f"/assets{up}{secret}", f"/{secret}", "/assets", "/..", "/no\x00thing"):
        told = answer(server, path)
        assert b" 404 " in told or b" 500 " in told or not told
        assert b"private" not in told
    assert "Traceback" not in "".join(capfd.readouterr())


@pytest.mark.parametrize("name", ["../../../outside", "/tmp/outside", "; rm -rf ~", "x" * 5000, "a\nb\x00"])
def test_a_camera_path_is_written_into_its_folder(server: viser.ViserServer, say: Any, tmp_path: Path, name: str):
    """By the panel of Nerfstudio, whatever name a browser sends for it."""
    server.gui.reset()
    inputs = server.gui._gui_input_handle_from_id
    inputs.clear()
    populate_render_tab(server, tmp_path / "config.yml", tmp_path / "run", None)
    (text,) = (handle for handle in inputs.values() if handle._impl.label == "Render name")
    buttons = {handle._impl.label: handle for handle in inputs.values()}
    say("GuiUpdateMessage", id=text._impl.id, updates={"value": name})
    wait_for(lambda: text.value == "".join(c if c.isalnum() or c in "._-" else "_" for c in name)[:MOST_LETTERS])

    def has_path() -> bool:
        say("GuiUpdateMessage", id=buttons["Add Keyframe"]._impl.id, updates={"value": True})
        time.sleep(0.2)  # viser hears messages in several threads
        return buttons["Duration (sec)"].value > 0.0

    wait_for(has_path, 20.0)
    say("GuiUpdateMessage", id=buttons["Generate Command"]._impl.id, updates={"value": True})
    (file,) = wait_for(lambda: list(tmp_path.rglob("*.json")), 20.0)
    assert file == tmp_path / "run/camera_paths" / f"{text.value}.json"
    assert not Path("/tmp/outside.json").exists()


def test_messages_change_values_alone_and_to_options_alone(server: viser.ViserServer, say: Any):
    choice, number = server.gui.add_dropdown("One", ["a", "b"]), server.gui.add_number("Number", 1)
    say("GuiUpdateMessage", id=choice._impl.id, updates={"value": "../../c"})
    say("GuiUpdateMessage", id=choice._impl.id, updates={"update_cb": [1]})
    say("GuiUpdateMessage", id=number._impl.id, updates={"disabled": True, "value": 2})
    say("FileTransferStart", source_component_id=number._impl.id, transfer_uuid="1", filename="f", mime_type="m",
        part_count=1, size_bytes=10**12)  # fmt: skip
    say("GuiUpdateMessage", id=number._impl.id, updates={"value": 3})
    say("GuiUpdateMessage", id=choice._impl.id, updates={"value": "b"})
    wait_for(lambda: number.value == 3 and choice.value == "b")
    assert choice._impl.update_cb == [] and not number._impl.disabled
    assert not server.gui._current_file_upload_states


@pytest.mark.parametrize(
    "wrong",
    [
        {"aspect": 0.0}, {"aspect": 1e-9}, {"aspect": float("inf")}, {"fov": float("nan")}, {"fov": 0.0}, {"fov": 4.0},
        {"wxyz": (0.0,) * 4}, {"position": (1.0, 2.0)}, {"position": (float("nan"), 0.0, 0.0)},
    ],
)  # fmt: skip
def test_impossible_cameras_are_left_out(server: viser.ViserServer, say: Any, wrong: dict[str, Any]):
    assert is_possible(ViewerCameraMessage(**CAMERA)) and not is_possible(ViewerCameraMessage(**{**CAMERA, **wrong}))
    (client,) = server.get_clients().values()
    say("ViewerCameraMessage", **{**CAMERA, **wrong})
    say("ViewerCameraMessage", **{**CAMERA, "fov": 1.0})
    wait_for(lambda: client.camera.fov == 1.0)
    assert client.camera.aspect == CAMERA["aspect"] and tuple(client.camera.position) == CAMERA["position"]


@pytest.mark.parametrize("asked", [10**9, 0, -5])
def test_pictures_have_a_largest_size(asked: int):
    renderer: Any = SimpleNamespace(viewer=SimpleNamespace(control_panel=SimpleNamespace(max_res=asked)))
    whole = ViewRenderer._whole.fget(renderer)  # type: ignore[attr-defined]
    assert 1 <= whole <= LARGEST_SIDE

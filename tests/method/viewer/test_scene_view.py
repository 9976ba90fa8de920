"""The viewer as a browser meets it, through viser's protocol; and with a browser, where there is one."""

from __future__ import annotations

import os
import pty
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from threading import Event, Lock
from typing import Any

import cv2
import numpy as np
import pytest
import torch
import viser.transforms as vtf
import yaml
from browsers import BROWSER, Browser, Client, wait_for
from nerfstudio.cameras.cameras import CameraType
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.viewer.utils import CameraState, get_camera
from nerfstudio.viewer.viewer import Viewer
from PIL import Image
from small_runs import set_up, small_config

from enerf_ns.dataparsers.event_dataparser import OPENGL_FROM_OPENCV
from enerf_ns.method.pipeline import EnerfPipeline
from enerf_ns.method.viewer.view_renderer import SMALLEST_SIDE, ViewRenderer
from enerf_ns.simulator.engine import simulate
from enerf_ns.simulator.settings import SimulationSettings

WHOLE = 320
"""Longer side of pictures of views at rest in most tests."""

VISER_SCALE = 10.0
"""Units of the browser in one of the scene."""


def free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return found.getsockname()[1]


@pytest.fixture(scope="module")
def pipeline(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> EnerfPipeline:
    """Of a run of no steps, whose field is a random solid; it has not heard of viewers."""
    trainer = set_up(small_config(recording, tmp_path_factory.mktemp("runs"), model__init_density=20.0))
    with torch.no_grad():
        torch.manual_seed(0)
        trainer.pipeline.model.field.geometry.grid.table.normal_(0.0, 0.3)
        for parameter in trainer.pipeline.model.field.colour_network.parameters():
            parameter *= 5.0
    assert trainer.pipeline._viewer is None and "enerf_ns.method.viewer.scene_view" not in sys.modules
    return trainer.pipeline


@pytest.fixture(scope="module")
def viewer(pipeline: EnerfPipeline, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Viewer]:
    """As of ns-viewer, on that run; the port that it is to have is taken."""
    folder = tmp_path_factory.mktemp("viewed")
    config = small_config(Path(), Path()).viewer
    config.websocket_port = free_port()
    with socket.create_server(("127.0.0.1", config.websocket_port)):
        viewer = Viewer(config, folder / "log.txt", folder, pipeline, train_lock=Lock())
    viewer.init_scene(pipeline.datamanager.train_dataset, "completed")
    viewer.update_scene(step=7)
    yield viewer
    viewer.viser_server.stop()


@pytest.fixture(scope="module")
def client(viewer: Viewer) -> Iterator[Client]:
    """One for all tests, after it was shown a picture of a view at rest. Later pictures are smaller, and so cheaper."""
    client = Client(viewer.viser_server.get_port())
    wait_for(lambda: any(picture.shape == (480, 640, 3) for picture in client.pictures))
    panel: Any = viewer.control_panel
    panel._max_res.value = WHOLE
    yield client
    renderers = list(viewer.render_statemachines.values())
    client.close()
    for renderer in renderers:  # Python may not end while one renders
        renderer.join(timeout=60.0)


def rendered(pipeline: EnerfPipeline, client: Client) -> torch.Tensor:
    """What the model shows of the view of a client, shape (240, 320, 3)."""
    pose = np.column_stack(
        [vtf.SO3(np.array(client.camera["wxyz"])).as_matrix() @ OPENGL_FROM_OPENCV,
         np.array(client.camera["position"]) / VISER_SCALE]
    )  # fmt: skip
    state = CameraState(client.camera["fov"], 4 / 3, torch.from_numpy(pose), CameraType.PERSPECTIVE)
    pipeline.eval()
    return pipeline.model.get_outputs_for_camera(get_camera(state, 240, 320))["rgb"]


def sensor_pose(pipeline: EnerfPipeline, seconds: float) -> np.ndarray:
    """Of a moment, in the scene, in OpenCV's axes: the rays of the event camera start there and look there."""
    camera = pipeline.datamanager.event_camera
    middle = torch.tensor([camera.camera.height // 2 * camera.camera.width + camera.camera.width // 2])
    rays = camera.rays(middle, torch.tensor([round(seconds * 1e9)]))
    return np.stack([rays.origins[0].numpy(), rays.directions[0].numpy()])


@pytest.fixture(scope="module")
def opened(client: Client) -> dict[str, Any]:
    """The camera of the first view."""
    return dict(client.camera)


def at_rest(client: Client) -> np.ndarray:
    """The whole picture of the view of a client, once it comes, after a move that nobody sees."""
    client.pictures.clear()
    client.go(position=np.add(client.camera["position"], 1e-4).tolist())
    wait_for(lambda: client.pictures and client.pictures[-1].shape[1] == WHOLE)
    return client.pictures[-1]


def go_back(client: Client, opened: dict[str, Any]) -> None:
    client.set("First view", True)
    wait_for(lambda: all(np.allclose(client.camera[name], value, atol=1e-5) for name, value in opened.items()))


def test_a_port_that_is_taken_is_told_with_the_one_that_is_used(viewer: Viewer):
    asked, used = viewer.config.websocket_port, viewer.viser_server.get_port()
    assert asked != used and reachable(used)
    taken, where = viewer.viewer_info
    assert taken == f"The port {asked} is taken, so that another one is used." and f"://localhost:{used} " in where


def test_it_opens_behind_the_middle_camera_and_upright(pipeline: EnerfPipeline, client: Client, opened: dict[str, Any]):
    """A button goes back there."""
    client.go(position=(9.0, 1.0, 2.0), look_at=(1.0, 1.0, 1.0), up_direction=(0.0, 1.0, 0.0))
    go_back(client, opened)
    cameras = pipeline.datamanager.train_dataset.cameras.camera_to_worlds.double().numpy()
    middle = cameras[len(cameras) // 2]
    eye, target = (np.array(client.camera[name]) / VISER_SCALE for name in ("position", "look_at"))
    back = eye - middle[:, 3]
    depth = np.linalg.norm(target - middle[:, 3])
    np.testing.assert_allclose(back / np.linalg.norm(back), middle[:, 2], atol=1e-4)
    np.testing.assert_allclose((eye - target) / np.linalg.norm(eye - target), middle[:, 2], atol=1e-4)
    assert 0.05 * depth < np.linalg.norm(back) < 0.5 * depth
    up = cameras[:, :, 1].mean(0)
    np.testing.assert_allclose(np.array(client.camera["up_direction"]), up, atol=1e-4)
    frame = pipeline.datamanager.train_dataset.cameras[len(cameras) // 2]
    assert np.tan(client.camera["fov"] / 2) == pytest.approx(float(frame.height / frame.fy) / 2, rel=1e-3)


def test_a_narrow_view_shows_all_that_the_sensor_sees(pipeline: EnerfPipeline, client: Client):
    before = client.camera["fov"]
    client.go(aspect=0.5)
    camera = pipeline.datamanager.event_camera.camera.undistorted()
    wait_for(lambda: abs(0.5 * np.tan(client.camera["fov"] / 2) - 0.5 * camera.width / camera.fx) < 0.01)
    client.go(aspect=4 / 3)
    wait_for(lambda: client.camera["fov"] == pytest.approx(before))


def test_frustums_are_few_and_small(pipeline: EnerfPipeline, client: Client):
    """None reaches as far as from the eye to the camera that it looks over the shoulder of."""
    depth = np.linalg.norm(np.subtract(client.camera["look_at"], client.camera["position"]))
    drawn = client.told("CameraFrustumMessage")
    assert 1 < len({message["name"] for message in drawn}) <= 25
    assert all(0.003 * depth < message["scale"] < 0.03 * depth for message in drawn)


def test_pictures_are_of_the_view_small_at_once_and_whole_at_rest(
    viewer: Viewer, pipeline: EnerfPipeline, client: Client, opened: dict[str, Any]
):
    """In three sizes, the middle one between the others."""
    go_back(client, opened)
    at_rest(client)
    (renderer,) = viewer.render_statemachines.values()
    assert isinstance(renderer, ViewRenderer)
    renderer.rays_per_second = 0.0  # as of a slow machine; each picture measures it again
    at_rest(client)
    small, middle, whole = (picture.shape[1] for picture in client.pictures)
    assert SMALLEST_SIDE == small < middle <= whole == WHOLE
    assert all(abs(picture.shape[1] / picture.shape[0] - 4 / 3) < 0.02 for picture in client.pictures)
    shown = client.pictures[-1].astype(float) / 255
    inner = np.s_[80:160, 107:213]
    assert correlation(shown[inner], rendered(pipeline, client).numpy()[inner]) > 0.8


def test_edges_are_points_of_the_scene_until_they_are_hidden(pipeline: EnerfPipeline, client: Client):
    edges = torch.tensor([[0.1, 0.2, -0.3], [0.0, -0.5, 0.25]])
    pipeline.viewer.draw_edges(edges)
    wait_for(lambda: client.told("PointCloudMessage"))
    points = client.told("PointCloudMessage")[-1]["points"]
    found = np.frombuffer(points["data"] if isinstance(points, dict) else points, np.float32).reshape(-1, 3)
    np.testing.assert_allclose(found, VISER_SCALE * edges.numpy(), rtol=1e-6)
    client.set("Edges", False)
    hidden = {"name": "/edges", "visible": False}
    wait_for(lambda: any(hidden.items() <= told.items() for told in client.told("SetSceneNodeVisibilityMessage")))


def test_what_was_never_seen_is_squares_of_two_greys(client: Client, opened: dict[str, Any]):
    client.go(position=(300.0, 300.0, 300.0), look_at=(600.0, 600.0, 600.0))
    picture = at_rest(client).astype(float)
    light, dark = (np.abs(picture - grey).max(-1) < 8 for grey in (100, 80))
    assert 0.35 < light.mean() < 0.6 and 0.35 < dark.mean() < 0.6
    go_back(client, opened)


def test_the_step_is_that_of_the_checkpoint(client: Client):
    def said() -> list[str]:
        texts = [m["updates"].get("markdown", "") for m in client.told("GuiUpdateMessage")]
        return [text for text in texts if text.startswith("Step: ")]

    wait_for(lambda: said() and said()[-1].startswith("Step: 7 "))


def test_runs_of_events_alone_open_neither_dark_nor_white(
    pipeline: EnerfPipeline, client: Client, opened: dict[str, Any]
):
    """Whatever the level of brightness at which the field ended."""
    assert pipeline.datamanager.config.supervision == "events"
    go_back(client, opened)
    assert 0.2 < np.median(at_rest(client)) / 255 < 0.6


def test_who_is_there_before_the_scene_sees_training_to_its_end(
    recording: Path, tmp_path: Path, pipeline: EnerfPipeline, python_interrupts: None
):
    """Pictures come, and the step advances, also where no view moves. Whoever ends the viewer of a run that is done has
    a run that is done. Camera paths are not kept with the recording."""
    config = small_config(recording, tmp_path)
    port = free_port()
    config.vis, config.viewer.websocket_port, config.max_num_iterations = "viewer", port, 200
    config.viewer.quit_on_train_completion = False
    clients: list[Client] = []

    def said() -> list[str]:
        return [message["updates"].get("markdown", "") for message in clients[0].told("GuiUpdateMessage")]

    def come() -> None:
        wait_for(lambda: reachable(port))
        clients.append(Client(port))
        try:
            wait_for(lambda: any("has ended at step 199" in text for text in said()))
            wait_for(lambda: any("Step: 199 " in text for text in said()))
        finally:
            os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=come, daemon=True).start()
    trainer = set_up(config)
    viewer = trainer.viewer_state
    assert isinstance(viewer, Viewer) and viewer.datapath == trainer.base_dir
    assert not pipeline.datamanager.get_datapath().is_relative_to(recording)
    wait_for(lambda: viewer.render_statemachines)
    trainer.train()
    (client,) = clients
    steps = {int(found[1]) for text in said() if (found := re.match(r"Step: (\d+)", text))}
    assert client.pictures and len(steps - {0, 199}) > 1
    (renderer,) = viewer.render_statemachines.values()
    client.close()
    renderer.join(timeout=60.0)
    viewer.viser_server.stop()


def test_a_browser_that_goes_while_it_moves_leaves_the_viewer_at_work(viewer: Viewer):
    others = set(viewer.render_statemachines)
    client = Client(viewer.viser_server.get_port())
    wait_for(lambda: set(viewer.render_statemachines) - others and client.pictures)
    (number,) = set(viewer.render_statemachines) - others
    handle, renderer = viewer.viser_server.get_clients()[number], viewer.render_statemachines[number]
    client.close()
    renderer.join(timeout=60.0)
    for callback in list(handle.camera._state.camera_cb):  # a message that is heard late
        callback(handle.camera)
    wait_for(lambda: not viewer.viser_server._websock_server._atomic_lock.locked(), 10.0)


def test_what_changes_nothing_is_not_shown(client: Client):
    hidden = {
        message["id"]: not message["updates"]["visible"]
        for message in client.told("GuiUpdateMessage") if "visible" in message["updates"]
    }  # fmt: skip
    for label in ("Train Speed", "Train Util", "Pause Training", "Resume Training"):
        added = next(m for m in client.messages if m.get("label") == label)
        assert hidden.get(added["id"], not added["visible"]), label


def test_the_view_follows_the_recording(pipeline: EnerfPipeline, client: Client):
    for seconds in (0.02, 0.09):
        client.set("Time (s)", seconds)
        origin, direction = sensor_pose(pipeline, seconds)

        def is_there(place: Any = origin, direction: Any = direction) -> bool:
            """Position and direction, which come one after the other; the middle pixel is half a pixel off the axis."""
            position, target = (np.array(client.camera[name]) for name in ("position", "look_at"))
            look = target - position
            follows = look @ direction / np.linalg.norm(look) > 0.995
            return bool(follows and np.allclose(position / VISER_SCALE, place, atol=1e-4))

        wait_for(is_there)
    view: Any = pipeline.viewer
    client.set("Follow", False)
    wait_for(lambda: not view._follows.value)
    before = client.camera["position"]
    client.set("Time (s)", 0.05)
    origin, _ = sensor_pose(pipeline, 0.05)
    moved = lambda: [m["position"] for m in client.told("SetPositionMessage") if m["name"] == "/recording/sensor"]  # noqa: E731
    wait_for(lambda: moved() and np.allclose(np.array(moved()[-1]) / VISER_SCALE, origin, atol=1e-4))
    assert client.camera["position"] == before
    client.set("Follow", True)
    wait_for(lambda: client.camera["position"] != before)


def test_of_moves_in_quick_succession_the_last_stays(
    pipeline: EnerfPipeline, client: Client, monkeypatch: pytest.MonkeyPatch
):
    """Also where an earlier one takes longer, as on a machine with other work."""
    view: Any = pipeline.viewer
    waits, pose = iter([0.5]), view._pose
    began = Event()

    def slow_at_first(time_ns: int) -> np.ndarray:
        found = pose(time_ns)
        began.set()
        time.sleep(next(waits, 0.0))
        return found

    monkeypatch.setattr(view, "_pose", slow_at_first)
    client.set("Time (s)", 0.03)
    assert began.wait(60.0)
    client.set("Time (s)", 0.07)
    wait_for(lambda: view._time.value == 0.07)
    time.sleep(1.0)
    origin, _ = sensor_pose(pipeline, 0.07)
    np.testing.assert_allclose(view._sensor.position / VISER_SCALE, origin, atol=1e-4)


def test_it_plays_until_it_is_told_to_stop(pipeline: EnerfPipeline, client: Client):
    view: Any = pipeline.viewer
    client.set("Time (s)", 0.0)
    wait_for(lambda: view._time.value == 0.0)
    time_id = client.control("Time (s)")

    def times() -> list[float]:
        updates = [m["updates"] for m in client.told("GuiUpdateMessage") if m["id"] == time_id]
        return [update["value"] for update in updates if "value" in update]

    number = len(times())
    client.set("Play", True)
    wait_for(lambda: len(times()) > number + 3)
    client.set("Play", False)
    wait_for(lambda: not view._plays.value)
    played = times()[number:]
    assert (np.diff(played) > 0).all() and 0 < played[0] < 0.1


def test_events_brightness_and_gamma_change_the_picture(pipeline: EnerfPipeline, client: Client):
    def change(label: str, value: Any) -> np.ndarray:
        number = len(client.pictures)
        client.set(label, value)
        wait_for(lambda: len(client.pictures) > number and client.pictures[-1].shape[1] == WHOLE)
        return client.pictures[-1].astype(float)

    change("Time (s)", 0.03)
    plain = change("Time (s)", 0.06)
    darker = change("Brightness", -0.4)
    middle = np.s_[80:160, 107:213]
    assert np.median(darker[middle] / plain[middle].clip(1)) == pytest.approx(2**-0.4, rel=0.05)
    change("Brightness", 0.0)
    with_events = change("Events", True)
    redder = with_events[..., 0] - with_events[..., 2]
    assert (redder > 60).mean() > 0.005 and (redder < -60).mean() > 0.005
    assert np.abs(plain[..., 0] - plain[..., 2]).max() < 60
    change("Events", False)


def test_depth_is_told_in_metres(pipeline: EnerfPipeline, client: Client):
    def said() -> list[float]:
        texts = [m["updates"].get("markdown", "") for m in client.told("GuiUpdateMessage")]
        found = [re.search(r"In the middle: ([\d.]+) m", text) for text in texts]
        return [float(match[1]) for match in found if match]

    client.set("Time (s)", 0.07)
    wait_for(said)
    origin, direction = sensor_pose(pipeline, 0.07)
    client.set("Time (s)", 0.071)
    at_rest(client)
    ray = RayBundle(torch.tensor(origin)[None], torch.tensor(direction)[None], torch.ones(1, 1))
    pipeline.eval()
    with torch.no_grad():
        depth = pipeline.model(ray)["depth"]
    scale = pipeline.datamanager.train_dataparser_outputs.dataparser_scale
    assert said()[-1] == pytest.approx(float(depth) / scale, rel=0.2)


def correlation(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.corrcoef(one.flatten(), other.flatten())[0, 1])


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="no chromium is installed")
def test_a_browser_sees_training_from_before_its_first_step_and_the_run_afterwards(tmp_path: Path):
    """Pictures and steps come while it trains on a terminal, whose viewer stays. ns-viewer says at once that it loads,
    and shows the same view: the middle training view, about as much smaller as it is seen from farther away."""
    data, port = tmp_path / "recording", free_port()
    simulate(SimulationSettings("shapes", width=64, height=48, duration=0.5, num_frames=21), data)
    browser = Browser("about:blank", tmp_path / "browser", 1000, 620)
    page, number = f"http://127.0.0.1:{port}", re.compile(r"Step: (\d+)")

    def shown() -> np.ndarray:
        """The page, once its picture is whole."""
        whole = re.compile(r"Resolution: (\d+)x(\d+)px")
        wait_for(lambda: (found := whole.search(browser.text())) and max(map(int, found.groups())) == 640, 240.0)
        return browser.screenshot()

    ours, theirs = pty.openpty()
    process = subprocess.Popen(
        [tool("ns-train"), "enerf", "--data", data, "--output-dir", tmp_path / "runs", "--timestamp", "run",
         "--max-num-iterations", "200", "--evaluation-share", "0", "--machine.device-type", "cpu",
         "--viewer.websocket-port", str(port)],
        stdin=theirs, stdout=theirs, stderr=theirs,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # tests may run where it is ignored
    )  # fmt: skip
    printed: list[bytes] = []
    threading.Thread(target=keep, args=(ours, printed), daemon=True).start()
    try:
        wait_for(lambda: process.poll() is not None or reachable(port))
        assert process.poll() is None, b"".join(printed)[-2000:]
        browser.call("Page.navigate", url=page)
        wait_for(lambda: re.search(r"Step: [1-9]\d*\s+Resolution: [1-9]", browser.text()), 240.0)
        wait_for(lambda: "Training has ended at step 199" in browser.text(), 240.0)
        wait_for(lambda: number.findall(browser.text()) == ["199"])
        after_training = shown()
        wait_for(lambda: b"stays until Ctrl-C" in b"".join(printed))
        process.send_signal(signal.SIGINT)
        assert process.wait(60.0) == 0, b"".join(printed)[-2000:]

        config = tmp_path / "runs" / "recording" / "enerf" / "run" / "config.yml"
        with (tmp_path / "log.txt").open("w") as log:
            process = subprocess.Popen(
                [tool("ns-viewer"), "--load-config", config, "--viewer.websocket-port", str(port)],
                stdout=log, stderr=log,
            )  # fmt: skip
        wait_for(lambda: process.poll() is not None or reachable(port))
        browser.call("Page.navigate", url=page)
        wait_for(lambda: number.findall(browser.text()) == ["199"])
        after_loading = shown()
    finally:
        browser.close()
        process.kill()
        process.wait()
    dataset = run_dataset(config)
    frame = dataset[len(dataset) // 2]["image"].numpy().mean(-1)
    for name, picture in {"trained": after_training, "loaded": after_loading}.items():
        Image.fromarray(picture).save(tmp_path / f"{name}.png")
        grey = cv2.resize(picture.mean(-1), None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        found = likeness(grey, frame)
        assert found > 0.4, "cameras and trajectory are drawn over it"
    assert max(likeness(grey, frame[::-1]), likeness(grey, frame[:, ::-1])) < found - 0.1


def tool(name: str) -> str:
    return str(Path(sys.executable).with_name(name))


def keep(terminal: int, printed: list[bytes]) -> None:
    """Keeps what is printed on a terminal."""
    with suppress(OSError):  # the other end is closed
        while part := os.read(terminal, 4096):
            printed.append(part)


def run_dataset(config: Path) -> Any:
    """The training dataset of a run."""
    pipeline = yaml.load(config.read_text(), Loader=yaml.Loader).pipeline
    return pipeline.setup(device="cpu", test_mode="test").datamanager.train_dataset


def reachable(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


def likeness(shown: np.ndarray, frame: np.ndarray) -> float:
    """The highest correlation of a frame, at any size that fits, with any part of what is shown."""
    best = 0.0
    for height in range(60, min(shown.shape[0], 230), 5):
        width = round(height * frame.shape[1] / frame.shape[0])
        if width <= shown.shape[1]:
            small = cv2.resize(frame.astype(np.float32), (width, height))
            found = cv2.matchTemplate(shown.astype(np.float32), small, cv2.TM_CCOEFF_NORMED)
            best = max(best, float(found.max()))
    return best


ENDS_BESIDE_A_RENDER = """
import threading
from types import SimpleNamespace
import numpy as np, torch
from nerfstudio.viewer_legacy.server.viewer_utils import IOChangeException
from enerf_ns.method.viewer.view_renderer import ViewRenderer

begun = threading.Event()

class Renderer(ViewRenderer):
    def _draw(self, size):
        begun.set()
        while self._asked == self._drawn:
            torch.randn(300, 300) @ torch.randn(300, 300)
        print("left its picture", flush=True)
        raise IOChangeException

client = SimpleNamespace(client_id=0, camera=SimpleNamespace(position=np.zeros(3)))
panel = SimpleNamespace(content="")
viewer = SimpleNamespace(ready=True, step=0, make_stats_markdown=lambda *_: "", stats_markdown=panel)
renderer = Renderer(viewer, client, threading.Lock(), 1.0, None, None)
client.camera.position = np.ones(3)
renderer.start()
begun.wait()
"""


def test_a_command_that_ends_while_a_picture_is_rendered_waits_for_the_thread():
    done = subprocess.run([sys.executable, "-c", ENDS_BESIDE_A_RENDER], capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout) == (0, "left its picture\n"), done.stderr

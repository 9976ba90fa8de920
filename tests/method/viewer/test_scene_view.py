"""The viewer as a browser meets it, through viser's protocol; and with a browser, where there is one."""

from __future__ import annotations

import re
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
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
from enerf_ns.method.runs import method_config, train
from enerf_ns.simulator.engine import simulate
from enerf_ns.simulator.settings import SimulationSettings

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
    """As of ns-viewer, on that run."""
    folder = tmp_path_factory.mktemp("viewed")
    config = small_config(Path(), Path()).viewer
    config.websocket_port = free_port()
    viewer = Viewer(config, folder / "log.txt", folder, pipeline, train_lock=Lock())
    viewer.init_scene(pipeline.datamanager.train_dataset, "completed")
    viewer.update_scene(step=0)
    yield viewer
    viewer.viser_server.stop()


@pytest.fixture
def client(viewer: Viewer) -> Iterator[Client]:
    """After it was shown a picture of a view at rest."""
    client = Client(viewer.viser_server.get_port())
    wait_for(lambda: any(picture.shape == (480, 640, 3) for picture in client.pictures))
    yield client
    renderers = list(viewer.render_statemachines.values())
    client.close()
    for renderer in renderers:  # Python may not end while one renders
        renderer.join(timeout=60.0)


def rendered(pipeline: EnerfPipeline, client: Client) -> torch.Tensor:
    """What the model shows of the view of a client, shape (480, 640, 3)."""
    pose = np.column_stack(
        [vtf.SO3(np.array(client.camera["wxyz"])).as_matrix() @ OPENGL_FROM_OPENCV,
         np.array(client.camera["position"]) / VISER_SCALE]
    )  # fmt: skip
    state = CameraState(client.camera["fov"], 4 / 3, torch.from_numpy(pose), CameraType.PERSPECTIVE)
    pipeline.eval()
    return pipeline.model.get_outputs_for_camera(get_camera(state, 480, 640))["rgb"]


def sensor_pose(pipeline: EnerfPipeline, seconds: float) -> np.ndarray:
    """Of a moment, in the scene, in OpenCV's axes: the rays of the event camera start there and look there."""
    camera = pipeline.datamanager.event_camera
    middle = torch.tensor([camera.camera.height // 2 * camera.camera.width + camera.camera.width // 2])
    rays = camera.rays(middle, torch.tensor([round(seconds * 1e9)]))
    return np.stack([rays.origins[0].numpy(), rays.directions[0].numpy()])


def test_it_opens_behind_the_middle_camera_and_upright(pipeline: EnerfPipeline, client: Client):
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
    client.go(aspect=0.5)
    camera = pipeline.datamanager.event_camera.camera.undistorted()
    wait_for(lambda: abs(0.5 * np.tan(client.camera["fov"] / 2) - 0.5 * camera.width / camera.fx) < 0.01)


def test_frustums_are_few_and_small(pipeline: EnerfPipeline, client: Client):
    """None reaches as far as from the eye to the camera that it looks over the shoulder of."""
    depth = np.linalg.norm(np.subtract(client.camera["look_at"], client.camera["position"]))
    drawn = client.told("CameraFrustumMessage")
    assert 1 < len({message["name"] for message in drawn}) <= 25
    assert all(0.003 * depth < message["scale"] < 0.03 * depth for message in drawn)


def test_pictures_are_of_the_view_small_at_once_and_whole_at_rest(pipeline: EnerfPipeline, client: Client):
    widths = [picture.shape[1] for picture in client.pictures]
    assert widths[-1] == 640 and min(widths) >= 160
    assert all(abs(picture.shape[1] / picture.shape[0] - 4 / 3) < 0.02 for picture in client.pictures)
    shown = client.pictures[-1].astype(float) / 255
    middle = np.s_[160:320, 214:426]
    assert correlation(shown[middle], rendered(pipeline, client).numpy()[middle]) > 0.8

    number = len(client.pictures)
    client.go(position=np.add(client.camera["position"], [0.3, 0.0, 0.0]).tolist())
    wait_for(lambda: any(160 <= picture.shape[1] < 640 for picture in client.pictures[number:]))
    wait_for(lambda: client.pictures[-1].shape[1] == 640)


def test_runs_of_events_alone_open_neither_dark_nor_white(pipeline: EnerfPipeline, client: Client):
    """Whatever the level of brightness at which the field ended; the first picture at rest is of the first view."""
    assert pipeline.datamanager.config.supervision == "events"
    first = next(picture for picture in client.pictures if picture.shape[1] == 640)
    assert 0.2 < np.median(first) / 255 < 0.6


def test_camera_paths_are_not_kept_with_the_recording(recording: Path, tmp_path: Path, pipeline: EnerfPipeline):
    config = small_config(recording, tmp_path)
    config.vis, config.viewer.websocket_port = "viewer", free_port()
    trainer = set_up(config)
    assert isinstance(trainer.viewer_state, Viewer)
    trainer.viewer_state.viser_server.stop()
    assert trainer.viewer_state.datapath == trainer.base_dir
    assert not pipeline.datamanager.get_datapath().is_relative_to(recording)


def test_a_browser_that_goes_while_it_moves_leaves_the_viewer_at_work(viewer: Viewer, client: Client):
    (handle,) = viewer.viser_server.get_clients().values()
    client.close()
    wait_for(lambda: not viewer.render_statemachines)
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
        wait_for(lambda place=origin: np.allclose(np.array(client.camera["position"]) / VISER_SCALE, place, atol=1e-4))
        look = np.subtract(client.camera["look_at"], client.camera["position"])
        assert look @ direction / np.linalg.norm(look) > 0.995, "the middle pixel is half a pixel off the axis"
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
        wait_for(lambda: len(client.pictures) > number and client.pictures[-1].shape[1] == 640)
        return client.pictures[-1].astype(float)

    change("Time (s)", 0.03)
    plain = change("Time (s)", 0.06)
    darker = change("Brightness", -0.4)
    middle = np.s_[160:320, 214:426]
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
    wait_for(lambda: client.pictures[-1].shape[1] == 640)
    ray = RayBundle(torch.tensor(origin)[None], torch.tensor(direction)[None], torch.ones(1, 1))
    pipeline.eval()
    with torch.no_grad():
        depth = pipeline.model(ray)["depth"]
    scale = pipeline.datamanager.train_dataparser_outputs.dataparser_scale
    assert said()[-1] == pytest.approx(float(depth) / scale, rel=0.2)


def correlation(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.corrcoef(one.flatten(), other.flatten())[0, 1])


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """config.yml of a run that shows its recording."""
    folder = tmp_path_factory.mktemp("trained")
    simulate(SimulationSettings("shapes", width=64, height=48, duration=0.5, num_frames=21), folder / "recording")
    settings = {"max_num_iterations": 400, "evaluation_share": 0.0, "machine.device_type": "cpu"}
    run = train(method_config("enerf", folder / "recording", folder / "runs", settings))
    return run.config_file


def commands(config: Path, output_dir: Path) -> dict[str, list[str]]:
    """That show a viewer of a trained run, by name; ns-train goes on with it."""

    def tool(name: str) -> str:
        return str(Path(sys.executable).with_name(name))

    return {
        "ns-viewer": [tool("ns-viewer"), "--load-config", str(config), "--viewer.websocket-port"],
        "ns-train": [
            tool("ns-train"), "enerf", "--data", str(config.parents[4] / "recording"), "--output-dir", str(output_dir),
            "--load-dir", str(config.parent / "nerfstudio_models"), "--max-num-iterations", "100000",
            "--evaluation-share", "0", "--machine.device-type", "cpu", "--viewer.websocket-port",
        ],
    }  # fmt: skip


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="no chromium is installed")
@pytest.mark.sweep(1)
@pytest.mark.parametrize("command", ["ns-viewer", "ns-train"])
def test_a_browser_opens_before_the_scene(trained: Path, command: str, tmp_path: Path):
    """What it shows first is the middle training view, about as much smaller as it is seen from farther away."""
    port = free_port()
    with (tmp_path / "log.txt").open("w") as log:
        process = subprocess.Popen([*commands(trained, tmp_path)[command], str(port)], stdout=log, stderr=log)
    browser = None
    try:
        wait_for(lambda: process.poll() is not None or reachable(port))
        assert process.poll() is None, (tmp_path / "log.txt").read_text()[-2000:]
        browser = Browser(f"http://127.0.0.1:{port}", tmp_path / "browser", 1000, 620)
        whole = re.compile(r"Resolution: (\d+)x(\d+)px")
        wait_for(lambda: (found := whole.search(browser.text())) and max(map(int, found.groups())) == 640, 240.0)
        shown = browser.screenshot()
    finally:
        if browser:
            browser.close()
        process.terminate()
        process.wait()
    Image.fromarray(shown).save(tmp_path / "shown.png")
    config = yaml.load(trained.read_text(), Loader=yaml.Loader)
    dataset = config.pipeline.setup(device="cpu", test_mode="test").datamanager.train_dataset
    frame = dataset[len(dataset) // 2]["image"].numpy().mean(-1)
    found = likeness(shown.mean(-1), frame)
    assert found > 0.4, "cameras and trajectory are drawn over it"
    assert max(likeness(shown.mean(-1), frame[::-1]), likeness(shown.mean(-1), frame[:, ::-1])) < found - 0.1


def reachable(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


def likeness(shown: np.ndarray, frame: np.ndarray) -> float:
    """The highest correlation of a frame, at any size that fits, with any part of what is shown."""
    best = 0.0
    for height in range(120, min(shown.shape[0], 460), 10):
        width = round(height * frame.shape[1] / frame.shape[0])
        if width <= shown.shape[1]:
            small = cv2.resize(frame.astype(np.float32), (width, height))
            found = cv2.matchTemplate(shown.astype(np.float32), small, cv2.TM_CCOEFF_NORMED)
            best = max(best, float(found.max()))
    return best

"""Every ns-* tool on a tiny run that `ns-train` made, called from another working directory.

The tools that only differ in what they do with a loaded run are called in this process, by their own entry points and
with command lines as a person types them: starting each anew would cost ten seconds of imports. So are those that are
called in a process of their own, but for the first `ns-train` and `ns-viewer`, forked from one that has imported all.
"""

from __future__ import annotations

import base64
import gzip
import hashlib
import importlib
import json
import os
import shutil
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import numpy as np
import pytest
import test_eds
import test_esim_npz
import test_event_recording
import test_eventnerf
import test_fuzz
import test_llff_events
import test_tum_vie
import torch
import yaml
from nerfstudio.utils.eval_utils import eval_setup
from PIL import Image
from warm_commands import WarmCommands

from enerf_ns.dataparsers.formats.registry import format_named, formats
from enerf_ns.dataparsers.recording.safe_globals import allow_numpy_scalars_in_checkpoints
from enerf_ns.simulator.engine import simulate
from enerf_ns.simulator.settings import SimulationSettings

pytestmark = pytest.mark.slow

WIDTH, HEIGHT, NUM_FRAMES, NUM_HELD_OUT = 32, 24, 11, 3
VIDEO_FRAMES = 100
SMALL = [
    *("--vis", "tensorboard", "--max-num-iterations", "5", "--machine.device-type", "cpu"),
    *("--pipeline.datamanager.event-pairs", "64", "--pipeline.model.log2-table-size", "12"),
]
ENTRY_POINTS = {
    "ns-train": "nerfstudio.scripts.train",
    "ns-eval": "nerfstudio.scripts.eval",
    "ns-render": "nerfstudio.scripts.render",
    "ns-export": "nerfstudio.scripts.exporter",
    "enerf": "enerf_ns.scripts.cli",
}


def environment_of(cwd: Path) -> dict[str, str]:
    return {**os.environ, "COLUMNS": "200", "ENERF_LPIPS_WEIGHTS": str(cwd / "no-weights")}


@pytest.fixture(scope="module")
def start(warm_commands: WarmCommands) -> Callable[..., tuple[int, str]]:
    """Calls a tool in a process of its own; its exit code, and what it printed."""
    return lambda tool, *arguments, cwd: warm_commands.run(
        tool, *arguments, cwd=cwd, environment=environment_of(cwd), limit=300
    )


@pytest.fixture
def call(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Calls a tool in this process, in an empty working directory."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("ENERF_LPIPS_WEIGHTS", str(tmp_path / "no-weights"))

    def call_tool(tool: str, *arguments: object) -> None:
        monkeypatch.setattr(sys, "argv", [tool, *map(str, arguments)])
        importlib.import_module(ENTRY_POINTS[tool]).entrypoint()

    return call_tool


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the recordings and the runs lie: `recording`, and the same `without_frames`."""
    home = tmp_path_factory.mktemp("home")
    simulate(
        SimulationSettings("shapes", width=WIDTH, height=HEIGHT, duration=0.1, exposure_ms=5.0, num_frames=NUM_FRAMES),
        home / "recording",
    )
    without = shutil.ignore_patterns("images*", "depth")
    shutil.copytree(home / "recording", home / "without_frames", ignore=without)
    return home


def eds_raw(folder: Path) -> Path:
    scene = test_eds.plain_scene()
    test_eds.write_camchain(test_eds.write_raw(folder, scene) / "camchain.yaml", scene.camchain)
    return folder


def eds_prepared(folder: Path) -> Path:
    return test_eds.prepare(eds_raw(folder), test_eds.plain_scene())


def tum_vie(folder: Path, side: str, write: Callable) -> Path:
    scene = test_tum_vie.make_scene(*test_tum_vie.plain_calibration(), test_tum_vie.plain_poses(), side, False)
    scene.events[150:, :2] = scene.events[:150, :2]  # a second event for each pixel
    return write(folder / "mocap-desk2", scene)


def esim_npz(folder: Path) -> Path:
    test_esim_npz.write_views(test_esim_npz.write_npz(folder) / "views")
    return folder


RECORDINGS: dict[str, Callable[[Path], Path]] = {
    "eds-events": eds_raw,
    "eds-events, prepared": eds_prepared,
    "tumvie-events": lambda folder: tum_vie(folder, "left", test_tum_vie.write_raw),
    "tumvie-events, prepared": lambda folder: tum_vie(folder, "left", test_tum_vie.write_prepared),
    "tumvie-events --event-camera right": lambda folder: tum_vie(folder, "right", test_tum_vie.write_raw),
    "esim-npz": esim_npz,
    "eventnerf-events --split train": lambda folder: test_eventnerf.write_eventnerf(folder, split="train"),
    "llff-events": test_llff_events.write_llff_events,
    "event-recording": lambda folder: test_event_recording.write_recording(folder, ("frames",)),
}

LAYOUTS = (
    *("esim", "esim_bag", "davis", "evimo2_left_camera", "mvsec", "vector", "ros_bag_1", "ros_bag_2"),
    *("m3ed", "dsec", "e2nerf"),
)
"""Other layouts, in folders of these names."""


def layout(name: str) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        folder = folder.with_name(name)
        test_fuzz.LAYOUTS[name].write(folder)
        return folder

    return write


RECORDINGS |= {f"{format_named(test_fuzz.LAYOUTS[name].format).command}, {name}": layout(name) for name in LAYOUTS}


def make_opaque(config: Path) -> Path:
    """Raises the density of a run: a few steps make no surface, and `ns-export pointcloud` waits for one."""
    (file,) = (config.parent / "nerfstudio_models").glob("step-*.ckpt")
    allow_numpy_scalars_in_checkpoints()
    checkpoint = torch.load(file)
    checkpoint["pipeline"]["_model.field.geometry.network.layers.1.bias"][0] += 8.0
    torch.save(checkpoint, file)
    return config


@pytest.fixture(scope="module")
def run(home: Path) -> Path:
    """config.yml of a run that `ns-train enerf --data DIR` made, DIR a relative path."""
    before = contents(home / "recording")
    command = [Path(sys.executable).with_name("ns-train"), "enerf", "--data", "recording", *SMALL]
    trained = subprocess.run(command, cwd=home, env=environment_of(home), capture_output=True, text=True, timeout=300)
    assert trained.returncode == 0, trained.stdout + trained.stderr
    for line in ("Recording", "The field learns from", "Training is done"):
        assert line in trained.stdout
    (config,) = (home / "outputs/recording/enerf").glob("*/config.yml")
    assert contents(home / "recording") == before
    return make_opaque(config)


@pytest.fixture(scope="module")
def run_without_frames(home: Path, start) -> Path:
    """The same of a recording without frames, through the subcommand of its format."""
    data = home / "without_frames"
    held_out = ["--pipeline.datamanager.held-out-events", "0.2"]
    recording = ["esim-events", "--data", data, "--held-out-every", 16]
    code, printed = start("ns-train", "enerf", *SMALL, *held_out, *recording, cwd=home)
    assert code == 0, printed
    (config,) = (home / "outputs/without_frames/enerf").glob("*/config.yml")
    return make_opaque(config)


def contents(folder: Path) -> dict[Path, str]:
    """Hashes of all files of a folder."""
    return {file: hashlib.sha256(file.read_bytes()).hexdigest() for file in folder.rglob("*") if file.is_file()}


def test_a_recording_of_every_format_trains_below():
    assert {name.split(",")[0].split()[0] for name in RECORDINGS} == {format.command for format in formats()}


@pytest.mark.sweep(1)
@pytest.mark.parametrize("name", RECORDINGS)
def test_every_format_trains_as_it_is_unpacked(call, name: str, capsys: pytest.CaptureFixture[str]):
    data = RECORDINGS[name](Path("recording"))
    before = contents(data)
    format, *flags = name.split(",")[0].split()
    settings = ["--steps-per-eval-image", 100, "--pipeline.datamanager.silence-ms", 1]
    chosen = [format, "--data", data, *flags] if flags else ["event-data", "--data", data]
    call("ns-train", "enerf", *SMALL, *settings, *chosen, "--depth-range", 0.3, 4)
    (config,) = Path("outputs").glob("*/enerf/*/config.yml")
    assert list((config.parent / "nerfstudio_models").glob("step-*.ckpt"))
    parser = yaml.load(config.read_text(), Loader=yaml.Loader).pipeline.datamanager.dataparser
    for flag, value in zip(flags[::2], flags[1::2], strict=True):
        assert getattr(parser.options, flag.removeprefix("--").replace("-", "_")) == value
    (read,) = (known.name for known in formats() if known.command == format)
    assert f"({read})" in capsys.readouterr().out
    assert contents(data) == before


def test_convert_and_inspect(call, home: Path):
    call("enerf", "convert", home / "recording", "--output-dir", "own")
    call("enerf", "inspect", "own")
    page = Path("inspect-own.html").read_text()
    assert "data:image/png;base64," in page


def test_a_preset_is_told_and_kept(call, tmp_path: Path, home: Path, capsys: pytest.CaptureFixture[str]):
    """Of a sequence with as many frames as the preset selects."""
    simulate(
        SimulationSettings("carpet", width=16, height=12, duration=0.5, exposure_ms=5.0, num_frames=42), Path("carpet")
    )
    call("ns-train", "enerf", "--preset", "shakeCarpet1", "--data", "carpet", *SMALL)
    shown = " ".join(capsys.readouterr().out.split())
    assert "21 train and 20 held-out frames" in shown
    (file,) = Path("outputs").glob("carpet/enerf/*/config.yml")
    config = yaml.load(file.read_text(), Loader=yaml.Loader)
    used = config.pipeline.resolution.applied_to(config.pipeline)
    assert used.model.sensor.contrast_thresholds == (0.2, 0.2)
    assert used.datamanager.dataparser.held_out_frame_indices == tuple(range(1, 40, 2))
    call("ns-eval", "--load-config", file, "--output-path", "scores.json", "--render-output-path", "pictures")
    assert len(list(Path("pictures").iterdir())) == 20
    call("ns-render", "dataset", "--load-config", file, "--output-path", "renders", "--split", "train+test",
         "--rendered-output-names", "gt-rgb")  # fmt: skip
    assert [len(list(Path("renders", split).rglob("*.jpg"))) for split in ("train", "test")] == [21, 20]


def test_a_preset_of_another_sequence_is_refused(home: Path, start):
    sentence = check_refused(*start("ns-train", "enerf", "--preset", "eds00", "--data", "recording", *SMALL, cwd=home))
    assert "--preset eds00 selects from the frames 425 to 970" in sentence


def check_rendered(path: Path, frames: int, columns: int = 1) -> np.ndarray:
    """A video of pictures side by side as Nerfstudio makes it; its first frame, uint8 [height, width, 3].

    Its size is the sensor's within a pixel: Nerfstudio doubles the principal point of a path to get it.
    """
    frame = check_video(path, frames)
    assert abs(frame.shape[1] - columns * WIDTH) <= columns and abs(frame.shape[0] - HEIGHT) <= 1
    return frame


def check_video(path: Path, frames: int) -> np.ndarray:
    """A video that can be decoded; its first frame, uint8 [height, width, 3]."""
    assert imageio_ffmpeg.count_frames_and_secs(str(path))[0] == frames
    reader = imageio_ffmpeg.read_frames(str(path))
    width, height = next(reader)["source_size"]  # type: ignore[index]
    frame = np.frombuffer(next(reader), np.uint8).reshape(height, width, 3)
    reader.close()
    return frame


def test_eval(run: Path, tmp_path: Path, start):
    code, printed = start("ns-eval", "--load-config", run, "--output-path", "scores.json",
                          "--render-output-path", "pictures", cwd=tmp_path)  # fmt: skip
    assert code == 0, printed
    scores = json.loads((tmp_path / "scores.json").read_text())["results"]
    assert scores["psnr"] > 5 and -1 <= scores["ssim"] <= 1 and 0 < scores["depth_rmse"] < 10
    assert "lpips" not in scores
    assert f"No lpips of {NUM_HELD_OUT} of {NUM_HELD_OUT} frames (0, 1, 2): the frame is smaller" in printed
    pictures = sorted((tmp_path / "pictures").iterdir())
    assert len(pictures) == NUM_HELD_OUT and Image.open(pictures[0]).size == (2 * WIDTH, HEIGHT)


def test_render_interpolate_finds_ffmpeg(run: Path, tmp_path: Path, start):
    code, printed = start("ns-render", "interpolate", "--load-config", run, "--output-path", "video.mp4",
                          "--interpolation-steps", 3, "--rendered-output-names", "rgb", "depth", "accumulation",
                          "normals", cwd=tmp_path)  # fmt: skip
    assert code == 0, printed
    check_rendered(tmp_path / "video.mp4", frames=3 * (NUM_HELD_OUT - 1), columns=4)


def test_render_spiral(call, run: Path):
    call("ns-render", "spiral", "--load-config", run, "--output-path", "video.mp4", "--seconds", 0.5)
    check_rendered(Path("video.mp4"), frames=12)


def test_render_camera_path(call, run: Path):
    """The file that the viewer writes."""
    pipeline: Any = eval_setup(run)[1]
    camera = pipeline.datamanager.eval_dataset.cameras[:1]
    pose = camera.camera_to_worlds[0]
    path = []
    for shift in np.linspace(0.0, 0.2, 5):
        matrix = np.vstack([pose, [0, 0, 0, 1]])
        matrix[0, 3] += shift
        path.append({"camera_to_world": matrix.ravel().tolist(), "fov": 60.0, "aspect": WIDTH / HEIGHT})
    camera_path = {
        "camera_type": "perspective",
        "render_height": HEIGHT,
        "render_width": WIDTH,
        "fps": 10,
        "seconds": 0.5,
        "smoothness_value": 0.5,
        "is_cycle": False,
        "crop": None,
        "camera_path": path,
    }
    Path("path.json").write_text(json.dumps(camera_path))
    call("ns-render", "camera-path", "--load-config", run, "--camera-path-filename", "path.json",
         "--output-path", "video.mp4")  # fmt: skip
    shown = check_rendered(Path("video.mp4"), frames=5) / 255.0
    rendered = pipeline.model.get_outputs_for_camera(camera)["rgb"].numpy()
    assert abs(shown.mean() - rendered.mean()) < 0.02, "the first picture is what the field shows there"


def test_render_dataset(call, run: Path):
    call("ns-render", "dataset", "--load-config", run, "--output-path", "renders", "--split", "train+test",
         "--image-format", "png", "--rendered-output-names", "rgb", "gt-rgb", "depth", "raw-depth")  # fmt: skip
    for split, count in {"train": NUM_FRAMES - NUM_HELD_OUT, "test": NUM_HELD_OUT}.items():
        for output, suffix in {"rgb": ".png", "gt-rgb": ".png", "depth": ".png", "raw-depth": ".npy.gz"}.items():
            assert len(list(Path("renders", split, output).glob(f"*{suffix}"))) == count
    frame = np.asarray(Image.open("renders/test/gt-rgb/00002.png"))
    recording = yaml.load(run.read_text(), Loader=yaml.Loader).data
    np.testing.assert_array_equal(frame, np.asarray(Image.open(recording / "images/00002.png")))
    with gzip.open("renders/test/raw-depth/00002.npy.gz") as file:
        assert (np.load(file) > 0).all()


def test_render_dataset_downscaled(call, run: Path):
    call("ns-render", "dataset", "--load-config", run, "--output-path", "renders", "--image-format", "png",
         "--downscale-factor", 2, "--rendered-output-names", "rgb", "display", "gt-rgb", "raw-gt-depth")  # fmt: skip
    recording, size = yaml.load(run.read_text(), Loader=yaml.Loader).data, (WIDTH // 2, HEIGHT // 2)
    assert {Image.open(f"renders/test/{name}/00002.png").size for name in ("rgb", "display")} == {size}
    frame = Image.open(recording / "images/00002.png").convert("RGB").resize(size, Image.Resampling.HAMMING)
    np.testing.assert_array_equal(np.asarray(Image.open("renders/test/gt-rgb/00002.png")), np.asarray(frame))
    with gzip.open("renders/test/raw-gt-depth/00002.npy.gz") as file:
        np.testing.assert_array_equal(np.load(file)[..., 0], np.load(recording / "depth/00002.npy")[1::2, 1::2])


def test_export_point_cloud(call, run: Path):
    open3d = pytest.importorskip("open3d", reason="open3d lacks system libraries", exc_type=ImportError)
    call("ns-export", "pointcloud", "--load-config", run, "--output-dir", "cloud", "--num-points", 500,
         "--num-rays-per-batch", 512, "--remove-outliers", "False", "--save-world-frame", "True")  # fmt: skip
    cloud = open3d.io.read_point_cloud("cloud/point_cloud.ply")
    assert len(cloud.points) == 512
    np.testing.assert_allclose(np.linalg.norm(cloud.normals, axis=1), 1.0, atol=1e-3)
    pipeline: Any = eval_setup(run)[1]
    recording = pipeline.datamanager.train_dataset.recording
    distances = np.linalg.norm(np.asarray(cloud.points) - recording.trajectory.positions.mean(axis=0), axis=1)
    near, far = pipeline.config.datamanager.dataparser.depth_range
    assert 0.8 * near < distances.min() and distances.max() < 1.5 * far, "the points lie in the scene, in metres"


def test_export_tsdf(call, run: Path):
    pytest.importorskip("open3d", reason="open3d lacks system libraries", exc_type=ImportError)
    call("ns-export", "tsdf", "--load-config", run, "--output-dir", "mesh", "--resolution", 32, "--downscale-factor", 1,
         "--num-pixels-per-side", 256, "--target-num-faces", 500)  # fmt: skip
    assert Path("mesh/mesh.obj").read_text().count("\nf ") > 10
    assert Image.open("mesh/material_0.png").size == (256, 256)


def test_export_cameras(call, run: Path):
    pytest.importorskip("open3d", reason="open3d lacks system libraries", exc_type=ImportError)
    call("ns-export", "cameras", "--load-config", run, "--output-dir", "cameras")
    cameras = [json.loads(Path(f"cameras/transforms_{split}.json").read_text()) for split in ("train", "eval")]
    assert [len(split) for split in cameras] == [NUM_FRAMES - NUM_HELD_OUT, NUM_HELD_OUT]
    assert all(Path(camera["file_path"]).is_file() for split in cameras for camera in split)


def test_report(call, run: Path):
    """Without a fit of brightness: what five steps show may be a negative, to which none fits."""
    call("enerf", "report", run, "--output-dir", "report", "--protocol", "raw")
    (scores,) = json.loads(Path("report/scores.json").read_text()).values()
    assert scores["lpips"] is None and scores["psnr"] > 5 and 0 < scores["depth_rmse"] and 1 < scores["mean_depth"] < 4
    assert Image.open("report/side-by-side.png").size[0] > 1000
    frame = check_video(Path("report/video.mp4"), frames=VIDEO_FRAMES)
    assert frame.shape[1] >= 2 * 480 and not np.any(np.array(frame.shape[:2]) % 2), "even sides, for every player"
    video = base64.b64encode(Path("report/video.mp4").read_bytes()).decode()
    assert f"data:video/mp4;base64,{video}" in Path("report/report.html").read_text()


def test_report_of_a_folder_goes_into_it_and_of_several_into_one_of_its_own(call, run: Path, tmp_path: Path):
    call("enerf", "report", run.parent, "--no-video")
    assert (run.parent / "report.html").is_file()
    call("enerf", "report", run.parent, tmp_path, "--no-video", "--reach", 1, 2.5)
    assert set(json.loads(Path("report/scores.json").read_text())) == {"recording", str(tmp_path)}


def test_demo_on_a_recording_that_is_there_already(call, home: Path):
    shutil.copytree(home / "recording", "demo/recording")
    call("enerf", "demo", "--output-dir", "demo", "--max-num-iterations", 2)
    (scores,) = json.loads(Path("demo/scores.json").read_text()).values()
    simulated = json.loads(Path("demo/recording/simulation.json").read_text())
    assert {"psnr", "ssim", "lpips", "depth_rmse", "train_seconds", "events"} <= set(scores)
    assert scores["train_seconds"] > 0 and scores["events"] == simulated["num_events"]
    assert Image.open("demo/side-by-side.png").size[0] > 1000
    check_video(Path("demo/video.mp4"), frames=VIDEO_FRAMES)


def test_report_of_no_run_is_an_error(call):
    with pytest.raises(SystemExit, match=r"enerf: .*nothing\.yml"):
        call("enerf", "report", "nothing.yml")


def test_resume(call, run: Path, tmp_path: Path):
    """Training goes on from the checkpoint with its parameters, its optimizer and its step."""
    checkpoints = run.parent / "nerfstudio_models"
    recording = yaml.load(run.read_text(), Loader=yaml.Loader).data
    longer = ["--load-dir", checkpoints, "--timestamp", "resumed", "--max-num-iterations", 10]
    call("ns-train", "enerf", "--data", recording, *SMALL, *longer)
    (file,) = tmp_path.glob("outputs/recording/enerf/resumed/nerfstudio_models/*.ckpt")
    before, after = (torch.load(path) for path in (checkpoints / "step-000000004.ckpt", file))
    assert (before["step"], after["step"]) == (4, 9)
    (state,) = {int(state["step"]) for state in after["optimizers"]["fields"]["state"].values()}
    assert state == 10
    bias = "_model.field.geometry.network.layers.1.bias"
    assert abs(after["pipeline"][bias][0] - before["pipeline"][bias][0]) < 0.5, "it starts from the raised density"


def test_the_viewer_answers(run: Path, tmp_path: Path):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [Path(sys.executable).with_name("ns-viewer"), "--load-config", run, "--viewer.websocket-port", str(port)]
    with open(tmp_path / "log", "w") as log:
        viewer = subprocess.Popen(command, cwd=tmp_path, stdout=log, stderr=log)
    try:
        page = ""
        for _ in range(120):
            assert viewer.poll() is None, (tmp_path / "log").read_text()
            try:
                page = urllib.request.urlopen(f"http://127.0.0.1:{port}", timeout=5).read().decode()
                break
            except (urllib.error.URLError, ConnectionError):
                time.sleep(0.5)
        assert "<html" in page.lower()
        time.sleep(1.0)
        assert viewer.poll() is None, (tmp_path / "log").read_text()
    finally:
        viewer.terminate()
        viewer.wait()


def test_eval_without_frames(call, run_without_frames: Path, capsys: pytest.CaptureFixture[str]):
    call("ns-eval", "--load-config", run_without_frames, "--output-path", "scores.json")
    printed = capsys.readouterr().out
    assert "Protocol events: Rendered changes of log brightness are compared" in printed and "\nNo " not in printed
    scores = json.loads(Path("scores.json").read_text())["results"]
    assert "psnr" not in scores, "a picture of events is no frame to compare with"
    assert -1.0 <= scores["event_correlation"] <= 1.0


def test_render_without_frames(call, run_without_frames: Path):
    call("ns-render", "interpolate", "--load-config", run_without_frames, "--output-path", "video.mp4",
         "--interpolation-steps", 3)  # fmt: skip
    check_rendered(Path("video.mp4"), frames=6)
    call("ns-render", "dataset", "--load-config", run_without_frames, "--output-path", "renders",
         "--rendered-output-names", "rgb", "gt-rgb")  # fmt: skip
    pictures = sorted(Path("renders/test/gt-rgb").iterdir())
    assert len(pictures) == 3
    assert np.ptp(np.asarray(Image.open(pictures[-1]))) > 100, "a picture of events"


def test_export_without_frames(call, run_without_frames: Path):
    pytest.importorskip("open3d", reason="open3d lacks system libraries", exc_type=ImportError)
    call("ns-export", "cameras", "--load-config", run_without_frames, "--output-dir", "cameras")
    assert len(json.loads(Path("cameras/transforms_train.json").read_text())) == 45
    call("ns-export", "pointcloud", "--load-config", run_without_frames, "--output-dir", "cloud", "--num-points", 500,
         "--num-rays-per-batch", 512, "--remove-outliers", "False")  # fmt: skip
    assert Path("cloud/point_cloud.ply").stat().st_size > 500


def check_refused(code: int, printed: str) -> str:
    """Not zero, one sentence, no traceback; the sentence."""
    assert code != 0 and "Traceback" not in printed
    (sentence,) = [line for line in printed.splitlines() if line.startswith("enerf: ")]
    return sentence


def test_a_bad_recording_is_refused_before_anything_is_written(home: Path, tmp_path: Path, start):
    bad = tmp_path / "data" / "bad"
    shutil.copytree(home / "recording", bad)
    events = np.load(bad / "events/00000.npy")
    events[0, 0] = WIDTH
    np.save(bad / "events/00000.npy", events)
    before = contents(tmp_path)
    sentence = check_refused(*start("ns-train", "enerf", "--data", "data/bad", *SMALL, cwd=tmp_path))
    assert "bad/events/00000.npy" in sentence and f"x = {WIDTH}" in sentence
    assert contents(tmp_path) == before and [entry.name for entry in tmp_path.iterdir()] == ["data"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "--data is missing"),
        (["--data", "nothing"], "nothing does not exist"),
        (["--data", "."], "no known format"),
    ],
)
def test_data_that_is_no_recording_is_refused(call, tmp_path: Path, arguments: list[str], message: str):
    with pytest.raises(SystemExit) as refused:
        call("ns-train", "enerf", *SMALL, *arguments)
    assert str(refused.value).startswith("enerf: ") and message in str(refused.value)
    assert "\n" not in str(refused.value) and not list(tmp_path.iterdir())

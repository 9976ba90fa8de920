"""Nerfstudio's own methods on our data, from training to pictures, by the commands that a person types."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import torchvision
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanagerConfig
from nerfstudio.utils.eval_utils import eval_setup
from PIL import Image
from test_tools import RECORDINGS, call, check_video, contents  # noqa: F401 - call is a fixture
from warm_commands import WarmCommands

from enerf_ns.dataparsers.event_dataparser import EventDataParserConfig
from enerf_ns.dataparsers.formats.tum_vie import TumVieOptions
from enerf_ns.simulator.engine import simulate
from enerf_ns.simulator.settings import SimulationSettings

pytestmark = pytest.mark.slow

WIDTH, HEIGHT, NUM_FRAMES, NUM_HELD_OUT = 48, 36, 11, 3
STEPS = ["--vis", "tensorboard", "--max-num-iterations", 4, "--machine.device-type", "cpu"]
NERFACTO = [
    *("--pipeline.datamanager.train-num-rays-per-batch", 64, "--pipeline.model.log2-hashmap-size", 12),
    *("--pipeline.model.num-levels", 4, "--pipeline.model.num-proposal-samples-per-ray", 8, 8),
    *("--pipeline.model.num-nerf-samples-per-ray", 8),
]
WITHOUT_FRAMES = {"esim-npz", "esim-bag, esim_bag", "evimo2-events, evimo2_left_camera"}
"""Recordings of events alone, the first with views for evaluation."""
METHODS = {
    "nerfacto": NERFACTO,
    "depth-nerfacto": NERFACTO,
    "vanilla-nerf": [
        *("--pipeline.datamanager.train-num-rays-per-batch", 64, "--pipeline.model.num-coarse-samples", 8),
        *("--pipeline.model.num-importance-samples", 8),
    ],
}


@pytest.fixture(autouse=True, scope="module")
def no_weights_of_lpips(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """There are none, neither in torchvision's folder nor at the address from which it downloads them."""
    folder = tmp_path_factory.mktemp("nothing")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torchvision.models.AlexNet_Weights.DEFAULT.value, "url", (folder / "alexnet.pth").as_uri())
        yield


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With sharp and blurred frames, and depth."""
    folder = tmp_path_factory.mktemp("data") / "recording"
    settings = SimulationSettings(
        "shapes", width=WIDTH, height=HEIGHT, num_frames=NUM_FRAMES, duration=0.1, exposure_ms=5.0
    )
    simulate(settings, folder)
    return folder


@pytest.fixture(scope="module")
def nerfacto(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """config.yml of a run of nerfacto."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("runs"))
        return train("nerfacto", recording, patch)


def train(method: str, data: Path, patch: pytest.MonkeyPatch) -> Path:
    """config.yml of a run of a few steps in the working directory."""
    from nerfstudio.scripts.train import entrypoint

    output = ["--output-dir", Path("outputs").resolve()]
    arguments = ["ns-train", method, "--data", data, *output, *STEPS, *METHODS[method], "event-data"]
    patch.setattr("sys.argv", [*map(str, arguments)])
    entrypoint()
    (config,) = Path("outputs").resolve().glob(f"*/{method}/*/config.yml")
    return config


@pytest.mark.parametrize("method", METHODS)
def test_methods_train_on_sharp_frames_and_are_scored(
    call: Callable[..., None],  # noqa: F811
    recording: Path,
    monkeypatch: pytest.MonkeyPatch,
    method: str,
    capsys: pytest.CaptureFixture[str],
):
    before = contents(recording)
    config = train(method, recording, monkeypatch)
    pipeline: Any = eval_setup(config)[1]
    capsys.readouterr()
    manager = pipeline.datamanager
    shown = manager.train_dataset.get_numpy_image(0)
    np.testing.assert_array_equal(shown, np.asarray(Image.open(recording / "images/00000.png").convert("RGB")))
    assert len(manager.eval_dataset) == NUM_HELD_OUT
    call("ns-eval", "--load-config", config, "--output-path", "scores.json")
    scores = json.loads(Path("scores.json").read_text())["results"]
    assert (
        3 < scores["psnr"] < 60 and np.isnan([score for name, score in scores.items() if name.endswith("lpips")]).all()
    )
    printed = capsys.readouterr().out
    assert printed.count("lpips is left out (nan): its weights cannot be downloaded; get them by enerf") == 1
    assert contents(recording) == before


def test_enerf_and_others_hold_out_the_same_frames(recording: Path, nerfacto: Path):
    from enerf_ns.method.datamanager import EnerfDataManagerConfig

    own = EnerfDataManagerConfig(dataparser=EventDataParserConfig(data=recording)).setup(test_mode="inference")
    other: Any = eval_setup(nerfacto)[1]
    for ours, theirs in (
        (own.train_dataset, other.datamanager.train_dataset),
        (own.eval_dataset, other.datamanager.eval_dataset),
    ):
        assert [file.name for file in ours.image_filenames] == [file.name for file in theirs.image_filenames]
        torch.testing.assert_close(ours.cameras.camera_to_worlds, theirs.cameras.camera_to_worlds)


@pytest.mark.parametrize("factor", [None, 2])
def test_render_dataset(call: Callable[..., None], nerfacto: Path, recording: Path, factor: int | None):  # noqa: F811
    scaled = [] if factor is None else ["--downscale-factor", factor]
    call("ns-render", "dataset", "--load-config", nerfacto, "--output-path", "renders", "--image-format", "png",
         "--rendered-output-names", "rgb", "gt-rgb", *scaled)  # fmt: skip
    size = WIDTH // (factor or 1), HEIGHT // (factor or 1)
    for output in ("rgb", "gt-rgb"):
        files = sorted(Path("renders/test", output).glob("*.png"))
        assert len(files) == NUM_HELD_OUT and all(Image.open(file).size == size for file in files)
    frame = Image.open(recording / "images/00002.png").convert("RGB").resize(size, Image.Resampling.HAMMING)
    np.testing.assert_array_equal(np.asarray(Image.open("renders/test/gt-rgb/00002.png")), np.asarray(frame))


def test_render_videos(call: Callable[..., None], nerfacto: Path):  # noqa: F811
    path = {
        "camera_type": "perspective",
        "render_height": HEIGHT,
        "render_width": WIDTH,
        "seconds": 0.5,
        "camera_path": [{"camera_to_world": np.eye(4).ravel().tolist(), "fov": 60.0, "aspect": WIDTH / HEIGHT}] * 3,
    }
    Path("path.json").write_text(json.dumps(path))
    small = ["--load-config", nerfacto, "--output-path", "video.mp4"]
    for kind, frames in {
        ("interpolate", "--interpolation-steps", 2): 2 * (NUM_HELD_OUT - 1),
        ("spiral", "--seconds", 0.25): 6,
        ("camera-path", "--camera-path-filename", "path.json"): 3,
    }.items():
        call("ns-render", kind[0], *small, *kind[1:])
        frame = check_video(Path("video.mp4"), frames)
        assert abs(frame.shape[0] - HEIGHT) <= 1 and abs(frame.shape[1] - WIDTH) <= 1


@pytest.mark.parametrize("name", sorted(RECORDINGS.keys() - WITHOUT_FRAMES))
def test_every_format_is_loaded_by_the_manager_of_splatfacto(tmp_path: Path, name: str):
    """Which hands whole pictures on; the rasterizer itself needs a GPU."""
    data = RECORDINGS[name](tmp_path / "recording")
    before = contents(data)
    options = {"format": "tum_vie", "options": TumVieOptions("right")} if name.endswith("right") else {}
    config = EventDataParserConfig(data=data, depth_range=(0.3, 4.0), **options)
    manager = FullImageDatamanagerConfig(dataparser=config, cache_images_type="uint8").setup(device="cpu")
    camera, batch = manager.next_train(0)
    assert batch["image"].shape == (camera.height.item(), camera.width.item(), 3)
    assert contents(data) == before


@pytest.mark.parametrize("name", sorted(WITHOUT_FRAMES))
def test_events_and_views_for_evaluation_alone_are_nothing_to_train_on(tmp_path: Path, name: str):
    config = EventDataParserConfig(data=RECORDINGS[name](tmp_path / "recording"), depth_range=(0.3, 4.0))
    with pytest.raises(SystemExit, match="holds no frames to train on"):
        config.setup().get_dataparser_outputs("train")


def test_without_frames_a_sentence_says_what_to_do(recording: Path, tmp_path: Path, warm_commands: WarmCommands):
    shutil.copytree(recording, tmp_path / "events", ignore=shutil.ignore_patterns("images*", "depth"))
    code, printed = warm_commands.run("ns-train", "nerfacto", *STEPS, "event-data", "--data", "events", cwd=tmp_path)
    assert code != 0 and "Traceback" not in printed
    said = " ".join(printed.split())
    assert "events holds no frames to train on" in said and "ns-train enerf --data" in said
    assert not (tmp_path / "outputs").is_dir() or not list((tmp_path / "outputs").rglob("*.ckpt"))

"""What a recording holds beside its events is put into whole simulated recordings with one fault each: the inspection
names the fault, or says that it is unknown, and does not suspect a whole recording."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.formats import event_recording
from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.formats.writer import MOUNTING_KEY
from enerf_ns.dataparsers.inspection.evidence import Evidence
from enerf_ns.dataparsers.inspection.page import Inspection
from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.simulator.engine import simulate
from enerf_ns.simulator.settings import SimulationSettings

Fault = Callable[[Path], object]

SIZES = {"small": (48, 36), "usual": (120, 90)}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Simulated recordings, one of each size, each made when it is first asked for."""
    made: dict[str, Path] = {}

    def write(size: str) -> Path:
        if size not in made:
            width, height = SIZES[size]
            made[size] = tmp_path_factory.mktemp("whole") / size
            scene = {"scene": "shapes", "motion": "shake", "duration": 0.6, "num_frames": 24}
            simulate(SimulationSettings(**scene, width=width, height=height, layout="event_recording"), made[size])
        return made[size]

    return write


def column(name: str, of: Callable[[np.ndarray, dict], np.ndarray]) -> Fault:
    def fault(folder: Path) -> None:
        path, about = folder / f"events/{name}.npy", json.loads((folder / "recording.json").read_text())
        values = np.load(path)
        np.save(path, of(values, about["camera"]).astype(values.dtype))

    return fault


def poses(of: Callable[[np.ndarray, Rotation], tuple[np.ndarray, Rotation]]) -> Fault:
    def fault(folder: Path) -> None:
        times = np.loadtxt(folder / "poses.txt", dtype=np.int64, usecols=0)
        rows = np.loadtxt(folder / "poses.txt")
        places, turns = of(rows[:, 1:4], Rotation.from_quat(rows[:, 4:]))
        event_recording.write_poses(folder / "poses.txt", times, places, turns.as_quat())

    return fault


def depth_maps(of: Callable[[np.ndarray], np.ndarray]) -> Fault:
    def fault(folder: Path) -> None:
        for path in (folder / "depth").glob("*.npy"):
            np.save(path, of(np.load(path)).astype(np.float32))

    return fault


def frames(of: Callable[[np.ndarray], np.ndarray]) -> Fault:
    def fault(folder: Path) -> None:
        for path in [*(folder / "frames").glob("*.png"), *(folder / "blurred_frames").glob("*.png")]:
            Image.fromarray(of(np.asarray(Image.open(path)))).save(path)

    return fault


def in_another_order(folder: Path) -> None:
    files = sorted((folder / "frames").glob("*.png"))
    contents = [file.read_bytes() for file in files]
    for file, content in zip(files, np.random.default_rng(0).permutation(np.array(contents, object)), strict=True):
        file.write_bytes(content)


def all_the_first(folder: Path) -> None:
    first, *others = sorted((folder / "frames").glob("*.png"))
    for file in others:
        shutil.copyfile(first, file)


def stating(change: Callable[[dict], object]) -> Fault:
    def fault(folder: Path) -> None:
        about = json.loads((folder / "recording.json").read_text())
        change(about)
        (folder / "recording.json").write_text(json.dumps(about))

    return fault


def mounted_at(metres: float) -> Fault:
    pose = np.eye(4)
    pose[0, 3] = metres
    return stating(lambda about: about.update(frame_camera=about["camera"] | {MOUNTING_KEY: pose.tolist()}))


def of_16_bits(folder: Path) -> None:
    """Values of 12 bits, of which 65535 is stated to be white."""
    frames(lambda image: image.astype(np.uint16) * 16)(folder)
    stating(lambda about: about.update(white_level=65535))(folder)


def inverse(places: np.ndarray, turns: Rotation) -> tuple[np.ndarray, Rotation]:
    return -turns.inv().apply(places), turns.inv()


FAULTS: dict[str, tuple[Fault, str]] = {
    "polarity": (column("p", lambda p, _: np.where(p > 0, 0, 1)), "On and off events are exchanged"),
    "negatives": (frames(lambda image: 255 - image), "On and off events are exchanged"),
    "mirrored x": (column("x", lambda x, camera: camera["width"] - 1 - x), "frames are mirrored left to right:"),
    "mirrored y": (column("y", lambda y, camera: camera["height"] - 1 - y), "frames are mirrored top to bottom:"),
    "mirrored frames": (frames(lambda image: image[:, ::-1]), "frames are mirrored left to right:"),
    "frames of another order": (in_another_order, "frames do not show what the events show"),
    "black frames": (frames(np.zeros_like), "frames are black"),
    "frames of another unit": (of_16_bits, "frames are black: their brightest pixel has"),
    "white frames": (frames(lambda image: np.full_like(image, 255)), "frames are white"),
    "grey frames": (frames(lambda image: np.full_like(image, 128)), "frames show nothing"),
    "one frame again and again": (all_the_first, "frames are all the same picture"),
    "depth in millimetres": (depth_maps(lambda depth: 1000 * depth), "as if they were in millimetres"),
    "depth in kilometres": (depth_maps(lambda depth: 0.001 * depth), "as if they were in kilometres"),
    "depth below 0": (depth_maps(lambda depth: -depth), "holds a depth of -"),
    "infinite depth": (depth_maps(lambda depth: np.where(depth > 2, np.inf, depth)), "holds a depth of inf"),
    "depth that is not a number": (depth_maps(lambda depth: depth * np.nan), "holds a depth of nan"),
    "no depth": (depth_maps(np.zeros_like), "depth maps are 0 everywhere"),
    "principal point to the left": (stating(lambda about: about["camera"].update(cx=-9.0)), "lies outside of its"),
    "principal point below": (stating(lambda about: about["camera"].update(cy=150.0)), "lies outside of its"),
    "depth range in millimetres": (
        stating(lambda about: about.update(depth_range=[1000 * depth for depth in about["depth_range"]])),
        "states a depth range of",
    ),
    "mount in millimetres": (mounted_at(60.0), "are 60 m apart"),
}
"""Faults that other modules do not name, and what is said of each."""


@pytest.mark.sweep(8)
@pytest.mark.slow
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_named(name: str, size: str, whole, tmp_path: Path):
    fault, said = FAULTS[name]
    folder = tmp_path / "recording"
    shutil.copytree(whole(size), folder)
    fault(folder)
    found = Evidence.of(read_recording(folder)).problems
    assert any(said in problem.what for problem in found), found
    assert all(problem.what.endswith(".") and problem.advice.endswith(".") for problem in found)


def test_depth_maps_without_pictures_are_compared_with_the_events(whole, tmp_path: Path):
    folder = tmp_path / "recording"
    shutil.copytree(whole("small"), folder)
    depth_maps(lambda depth: 1000 * depth)(folder)
    recording = read_recording(folder)
    frames = recording.frames
    assert frames is not None and frames.depth_filenames is not None
    maps = replace(frames, filenames=frames.depth_filenames)
    found = Evidence.of(replace(recording, frames=None, depth_maps=maps)).problems
    assert ["as if they were in millimetres" in problem.what for problem in found] == [True]


@pytest.mark.sweep(2)
@pytest.mark.slow
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("has_frames", [True, False])
def test_inverse_poses_are_named(size: str, has_frames: bool, whole, tmp_path: Path):
    folder = tmp_path / "recording"
    shutil.copytree(whole(size), folder)
    if not has_frames:
        for name in ("frames", "blurred_frames", "depth"):
            shutil.rmtree(folder / name)
    poses(inverse)(folder)
    assert "world to camera, the inverse" in Inspection.of(read_recording(folder)).problems[0].what


EXPOSURES = 0.75 + 0.25 * np.sin(np.arange(100) / 3)


def with_automatic_exposure(folder: Path) -> None:
    for file, gain in zip(sorted((folder / "frames").glob("*.png")), EXPOSURES, strict=False):
        Image.fromarray(np.rint(np.asarray(Image.open(file)) * gain).astype(np.uint8)).save(file)


@pytest.mark.slow
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize(
    "change",
    [
        lambda folder: None,
        with_automatic_exposure,
        frames(lambda image: np.rint(255 * (image / 255) ** (1 / 2.2)).astype(np.uint8)),  # gamma
        frames(lambda image: np.minimum(image.astype(int) * 2, 255).astype(np.uint8)),  # saturated
    ],
    ids=["whole", "automatic exposure", "gamma", "saturated"],
)
def test_a_whole_recording_is_not_suspected(change: Fault, size: str, whole, tmp_path: Path):
    folder = tmp_path / "recording"
    shutil.copytree(whole(size), folder)
    change(folder)
    assert Evidence.of(read_recording(folder)).problems == []


def test_questions_without_an_answer_are_said(whole, tmp_path: Path):
    folder = tmp_path / "recording"
    shutil.copytree(whole("small"), folder)
    for name in ("frames", "blurred_frames", "depth"):
        shutil.rmtree(folder / name)
    t = np.load(folder / "events/t.npy")
    for name in "xytp":
        values = np.load(folder / f"events/{name}.npy")
        np.save(folder / f"events/{name}.npy", values[:: len(t) // 3000])
    found = Inspection.of(read_recording(folder))
    fits, polarity = (one.sentence for one in found.unknown)
    assert fits.startswith("It is unknown whether poses, clocks and calibration fit the events, because ")
    assert polarity.endswith("whether events and frames are mirrored, because there are no frames.")


@pytest.mark.parametrize("ratio", [0.01, 100.0])
def test_a_lens_that_stretches_is_refused(ratio: float, whole, tmp_path: Path):
    folder = tmp_path / "recording"
    shutil.copytree(whole("small"), folder)
    stating(lambda about: about["camera"].update(fx=ratio * about["camera"]["fy"]))(folder)
    with pytest.raises(RecordingError, match="fits no lens"):
        read_recording(folder)

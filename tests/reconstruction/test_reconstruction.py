"""Recordings with reconstructed frames, as `enerf reconstruct` writes them, and training on them."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
import tyro
from recordings import joined, write_davis, write_esim, write_image
from small_runs import check_two_steps, small_config
from test_event_recording import MOUNTING, write_recording

from enerf_ns.dataparsers.formats.conversion import convert_recording
from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.recording.errors import OutputError, UserError
from enerf_ns.dataparsers.recording.files import load_image
from enerf_ns.reconstruction import reconstruction
from enerf_ns.reconstruction.complementary_filter import ComplementaryFilter
from enerf_ns.reconstruction.frames_of_events import reconstruct_frames
from enerf_ns.reconstruction.networks import E2VID
from enerf_ns.reconstruction.reconstruction import reconstruct
from enerf_ns.scripts.reconstruct import Reconstruct


def contents(folder: Path) -> dict[str, bytes]:
    """Files by their paths; without the poses, whose quaternions are normalised whenever they are read."""
    files = [file for file in folder.rglob("*") if file.is_file() and file.name != "poses.txt"]
    return {str(file.relative_to(folder)): file.read_bytes() for file in files}


SECOND_CAMERA = {
    **{"width": 20, "height": 16, "model": "pinhole", "fx": 18.0, "fy": 18.0, "cx": 9.5, "cy": 7.5},
    "event_camera_from_frame_camera": MOUNTING.tolist(),
}


@pytest.fixture(scope="module")
def reconstructed(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The simulated recording with frames of the complementary filter."""
    folder = tmp_path_factory.mktemp("reconstructed") / "new"
    reconstruct(recording, folder)
    return folder


def test_all_else_is_as_it_was(recording: Path, reconstructed: Path):
    before, after = read_recording(recording), read_recording(reconstructed)
    for name in ("camera", "contrast_thresholds", "refractory_period", "response", "bayer_pattern", "depth_range"):
        assert getattr(after, name) == getattr(before, name)
    np.testing.assert_array_equal(after.trajectory.times, before.trajectory.times)
    for name in "xytp":
        found, expected = (getattr(joined(one.stream_events()), name) for one in (after, before))
        np.testing.assert_array_equal(found > 0 if name == "p" else found, expected > 0 if name == "p" else expected)
    assert before.frames is not None and after.frames is not None
    assert before.frames.depth_filenames is not None and after.frames.depth_filenames is not None
    for kind in ("filenames", "depth_filenames"):
        for old, new in zip(getattr(before.frames, kind), getattr(after.frames, kind), strict=True):
            assert old.read_bytes() == new.read_bytes()
    assert sorted(path.name for path in reconstructed.iterdir()) == [
        *("blurred_frames", "depth", "events", "frames", "poses.txt", "recording.json"),
    ]


def test_frames_are_8_bits_of_one_range(recording: Path, reconstructed: Path):
    source, made = read_recording(recording), read_recording(reconstructed)
    assert source.frames is not None and made.blurred_frames is not None and source.contrast_thresholds is not None
    np.testing.assert_array_equal(made.blurred_frames.times, source.frames.times)
    filter = ComplementaryFilter(32, 24, source.contrast_thresholds, 0.5, source.span[0])
    brightness = np.stack(list(reconstruct_frames(source, filter, source.frames.times)))
    black, white = np.percentile(brightness, [1, 99])
    expected = 255 * np.clip((brightness - black) / (white - black), 0, 1)
    found = np.stack([load_image(file) for file in made.blurred_frames.filenames])[..., 0]
    assert found.dtype == np.uint8 and np.abs(found - expected).max() < 0.51


def test_the_method_of_reconstruction_is_stored(reconstructed: Path):
    made = read_recording(reconstructed)
    assert made.reconstructed_by == "a complementary filter (0.5 Hz)"
    assert "The blurred frames are reconstructed from events by a complementary filter (0.5 Hz)." in made.notes


def test_converting_it_changes_nothing(reconstructed: Path, tmp_path: Path):
    convert_recording(reconstructed, tmp_path / "again")
    assert contents(tmp_path / "again") == contents(reconstructed)


def test_learns_from_them_and_is_scored_on_the_sharp_ones(reconstructed: Path, tmp_path: Path):
    trainer = check_two_steps(
        small_config(reconstructed, tmp_path, data__supervision="frames"),
        {"frame_loss", "distortion_loss", "interlevel_loss"},
    )
    manager = trainer.pipeline.datamanager
    learnt, scored = manager.train_dataset.frames, manager.eval_dataset.frames
    assert {file.parent.name for file in learnt.filenames} == {"blurred_frames"}
    assert {file.parent.name for file in scored.filenames} == {"frames"}
    assert not set(learnt.times.tolist()) & set(scored.times.tolist())
    assert len(learnt.times) + len(scored.times) == 11


def test_frames_of_a_second_camera_stay_its_own(tmp_path: Path):
    """The reconstructed ones are seen by the event camera, and from its place."""
    source = write_recording(tmp_path / "two", frame_camera=SECOND_CAMERA)
    (source / "frames").mkdir()
    times = [300_000_000, 600_000_000]
    (source / "frames/stamps_ns.txt").write_text("".join(f"{time}\n" for time in times))
    for i in range(2):
        write_image(source / f"frames/{i}.png", np.full((16, 20, 1), 90 + i, np.uint8))
    reconstruct(source, tmp_path / "new")
    convert_recording(tmp_path / "new", tmp_path / "again")
    before = read_recording(source)
    for folder in ("new", "again"):
        made = read_recording(tmp_path / folder)
        assert made.frames is not None and made.blurred_frames is not None and before.frames is not None
        assert made.frames.camera == before.frames.camera != made.camera
        instants = torch.tensor(times)
        torch.testing.assert_close(
            made.frames.trajectory.poses(instants), before.frames.trajectory.poses(instants), rtol=0, atol=1e-9
        )
        assert made.blurred_frames.camera == made.camera and made.blurred_frames.trajectory is made.trajectory


def test_a_recording_without_frames_gets_some(recording: Path, tmp_path: Path):
    source = tmp_path / "without"
    shutil.copytree(recording, source, ignore=shutil.ignore_patterns("images*", "depth"))
    reconstruct(source, tmp_path / "new", frames_per_second=80.0)
    made = read_recording(tmp_path / "new")
    assert made.frames is None and made.blurred_frames is not None
    start = made.trajectory.start
    np.testing.assert_array_equal(made.blurred_frames.times - start, np.arange(1, 9) * 12_500_000)


def test_a_network(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """E2VID, whose U-Net wants sizes that 16 divides, with any weights, as the command line takes it."""
    torch.manual_seed(0)
    network = E2VID(5, 4, 4, 1, batch_norm=False, transposed=False)
    state = {f"unetrecurrent.{name}": value for name, value in network.state_dict().items()}
    torch.save({"state_dict": state}, tmp_path / "any.pth")
    new = tmp_path / "new"
    tyro.cli(
        Reconstruct, args=[str(recording), "--output-dir", str(new), "--weights", str(tmp_path / "any.pth")]
    ).main()
    made = read_recording(new)
    assert made.reconstructed_by == "E2VID (any.pth)" and made.blurred_frames is not None
    pictures = np.stack([load_image(file) for file in made.blurred_frames.filenames])
    assert pictures.shape == (11, 24, 32, 1) and pictures.std() > 10
    printed = " ".join(capsys.readouterr().out.split())
    assert "11 frames are reconstructed by E2VID (any.pth)." in printed
    assert "The blurred frames of the recording are left out." in printed
    assert f"ns-train enerf --data {new} --pipeline.datamanager.supervision frames" in printed


# -------------------------------------------------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"weights": Path("nowhere.pth")}, "nowhere.pth is missing; a checkpoint of PyTorch was expected there"),
        ({"weights": Path("w.pth"), "cutoff_frequency": 1.0}, "--cutoff-frequency is for the complementary filter"),
        ({"cutoff_frequency": -1.0}, "--cutoff-frequency is -1, but must be from 0 to 1000 (Hz)"),
        ({"cutoff_frequency": float("nan")}, "--cutoff-frequency is nan, but must be"),
        ({"frames_per_second": 10.0}, "--frames-per-second is for recordings without frames, but"),
    ],
)
def test_flags_that_cannot_be_followed(recording: Path, tmp_path: Path, settings: dict, message: str):
    with pytest.raises(UserError) as caught:
        reconstruct(recording, tmp_path / "new", **settings)
    assert message in str(caught.value) and "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("rate", [0.5, 1e9, 0.0, -3.0, float("nan"), float("inf")])
def test_rates_that_make_no_frames_or_too_many(tmp_path: Path, rate: float):
    source = write_davis(tmp_path / "davis", frames=False)
    with pytest.raises(UserError, match=r"--frames-per-second .* but from 1 to 100,000 were expected"):
        reconstruct(source, tmp_path / "new", frames_per_second=rate)
    assert [path.name for path in tmp_path.iterdir()] == ["davis"]


def test_a_colour_filter_is_refused(tmp_path: Path):
    source = write_recording(tmp_path / "bayer", ("frames",), bayer_pattern="RGGB")
    with pytest.raises(UserError, match="with the colour filter RGGB, but frames are reconstructed"):
        reconstruct(source, tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_frames_without_any_event_before_are_refused(tmp_path: Path):
    """A picture of one brightness has no range."""
    source = write_esim(tmp_path / "esim")
    (source / "images/image_stamps_ns.txt").write_text("1000000\n2000000\n3000000\n")
    with pytest.raises(UserError, match="only frames of one uniform brightness"):
        reconstruct(source, tmp_path / "new")
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("error", "expected"), [(KeyboardInterrupt(), KeyboardInterrupt), (OSError(28, "No space left"), OutputError)]
)
@pytest.mark.parametrize("where", ["reconstruct_frames", "write_recording"])
def test_what_stops_it_leaves_nothing(
    recording: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    error: BaseException,
    expected: type[BaseException],
    where: str,
):
    before = getattr(reconstruction, where)

    def stopped(*arguments):
        made = before(*arguments)
        yield next(made)
        raise error

    def stopped_at_once(*_):
        raise error

    monkeypatch.setattr(reconstruction, where, stopped if where == "reconstruct_frames" else stopped_at_once)
    with pytest.raises(expected):
        reconstruct(recording, tmp_path / "new")
    assert not list(tmp_path.iterdir())

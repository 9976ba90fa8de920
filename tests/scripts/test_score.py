"""`enerf score`: renders of any method against held-out frames."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import cv2
import numpy as np
import pytest
import tyro
from recordings import FRAME_TIMES, HEIGHT, WIDTH, image, write_davis, write_esim, write_image
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.recording.errors import FlagError, OutputError, RecordingError
from enerf_ns.report.scoring import Scoring
from enerf_ns.scripts.score import Score

NAMES = [f"{i:05d}" for i in range(len(FRAME_TIMES))]


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """A recording of three frames that are smooth, so that each resembles itself alone."""
    folder = write_esim(tmp_path / "esim")
    for i, name in enumerate(NAMES):
        write_image(folder / "images" / f"{name}.png", smooth(i))
    return folder


def smooth(index: int) -> np.ndarray:
    picture = gaussian_filter(image(index, 3).astype(float), (2, 2, 0))
    return np.rint(255 * (picture - picture.min()) / np.ptp(picture)).astype(np.uint8)


def write_renders(folder: Path, pictures: dict[str, np.ndarray]) -> Path:
    folder.mkdir(parents=True)
    for name, picture in pictures.items():
        if name.endswith(".npy"):
            np.save(folder / name, picture)
        else:
            write_image(folder / name, picture)
    return folder


def frames() -> dict[str, np.ndarray]:
    return {f"{name}.png": smooth(i) for i, name in enumerate(NAMES)}


def scores(recording: Path, renders: Path, protocol: str = "raw", **flags) -> dict:
    output = recording.parent / "scores.json"
    Score(recording, renders, held_out_every=1, output=output, scoring=Scoring(protocol), **flags).main()
    return json.loads(output.read_text())


def test_scores_are_those_of_the_definitions(recording: Path, tmp_path: Path):
    noisy = {
        name: np.clip(picture.astype(int) + np.random.default_rng(1).integers(-20, 21, picture.shape), 0, 255)
        for name, picture in frames().items()
    }
    renders = write_renders(tmp_path / "renders", {name: p.astype(np.uint8) for name, p in noisy.items()})
    found = scores(recording, renders)
    psnr = [-10 * np.log10(np.mean((noisy[name] / 255 - picture / 255) ** 2)) for name, picture in frames().items()]
    assert found["scores"]["psnr"] == pytest.approx(np.mean(psnr), abs=1e-4)
    assert [frame["psnr"] for frame in found["frames"]] == pytest.approx(psnr, abs=1e-4)
    assert [frame["name"] for frame in found["frames"]] == [f"{name}.png" for name in NAMES]


def test_the_protocol_corrects_brightness(recording: Path, tmp_path: Path):
    """Renders of half the brightness are corrected by a factor of 2."""
    darker = {f"{name}.npy": smooth(i).astype(np.float32) / 255 / 2 for i, name in enumerate(NAMES)}
    renders = write_renders(tmp_path / "renders", darker)
    raw, corrected = (scores(recording, renders, protocol)["scores"] for protocol in ("raw", "gamma-affine"))
    assert raw["psnr"] < 15 and corrected["psnr"] > 45
    assert corrected["gamma_factor"] == pytest.approx(2.0, rel=0.02)


def deepened(folder: Path, pictures: dict[str, np.ndarray], white: int) -> Path:
    folder.mkdir(exist_ok=True)
    for name, picture in pictures.items():
        cv2.imwrite(str(folder / name), np.rint(picture[..., ::-1] / 255 * white).astype(np.uint16))
    return folder


@pytest.mark.parametrize("white", [255, 4095, 65535])
@pytest.mark.parametrize("kind", ["16 bits", "floats"])
def test_dark_renders_of_more_than_8_bits_are_dark(recording: Path, tmp_path: Path, white: int, kind: str):
    """Renders of a fifth of the brightness, of frames of 8, 12 and 16 bits: their largest value is no full one."""
    if white > 255:
        deepened(recording / "images", frames(), white)
    darker = {name: 0.2 * picture for name, picture in frames().items()}
    if kind == "16 bits":
        renders = deepened(tmp_path / "renders", darker, white if white > 255 else 65535)
    else:
        renders = tmp_path / "renders"
        renders.mkdir()
        for name, picture in darker.items():
            stored = (picture[..., ::-1] / 255).astype(np.float32)
            cv2.imwrite(str(renders / name.replace(".png", ".tif")), stored, [cv2.IMWRITE_TIFF_COMPRESSION, 1])
    expected = np.mean([-10 * np.log10(np.mean((0.8 * picture / 255) ** 2)) for picture in frames().values()])
    assert scores(recording, renders)["scores"]["psnr"] == pytest.approx(expected, abs=0.05)


def test_renders_without_the_names_of_frames_count_in_the_order_of_their_numbers(recording: Path, tmp_path: Path):
    pictures = {f"view {number}.png": smooth(i) for i, number in enumerate((2, 10, 33))}
    assert scores(recording, write_renders(tmp_path / "renders", pictures))["scores"]["psnr"] > 100


def test_other_files_beside_renders_do_not_matter(recording: Path, tmp_path: Path):
    renders = write_renders(tmp_path / "renders", frames())
    (renders / "video.mp4").touch()
    (renders / "depth").mkdir()
    write_image(renders / "of a training view.png", image(7, 3))
    assert scores(recording, renders)["scores"]["psnr"] > 100


def test_renders_in_another_order_are_noticed(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    swapped = {f"{name}.png": smooth((i + 1) % 3) for i, name in enumerate(NAMES)}
    scores(recording, write_renders(tmp_path / "renders", swapped))
    assert "3 of 3 renders resemble another held-out frame" in capsys.readouterr().out
    scores(recording, write_renders(tmp_path / "right", frames()))
    assert "resemble" not in capsys.readouterr().out


def test_the_views_to_render_are_listed(recording: Path, tmp_path: Path):
    """The camera of the tests slides along x by 1 m/s and turns about y by 0.5 rad/s, from 0 s on."""
    views = tmp_path / "views.json"
    Score(recording, views=views, held_out_every=1).main()
    found = json.loads(views.read_text())
    assert (found["w"], found["h"]) == (WIDTH, HEIGHT)
    assert [frame["file_path"] for frame in found["frames"]] == [f"{name}.png" for name in NAMES]
    for frame, time in zip(found["frames"], 1e-9 * FRAME_TIMES, strict=True):
        turn = Rotation.from_rotvec([0, 0.5 * time, 0]).as_matrix()
        right, up, back, place = np.array(frame["transform_matrix"])[:3].T
        assert frame["time"] == pytest.approx(time)
        np.testing.assert_allclose([right, -up, -back], turn.T, atol=1e-4)
        np.testing.assert_allclose(place, [time, 0, 0], atol=1e-4)


def test_the_held_out_frames_are_those_of_training(recording: Path, tmp_path: Path):
    views = tmp_path / "views.json"
    Score(recording, views=views).main()
    assert [frame["file_path"] for frame in json.loads(views.read_text())["frames"]] == ["00002.png"]
    Score(recording, views=views, held_out_frame_indices=(0, 1)).main()
    assert len(json.loads(views.read_text())["frames"]) == 2
    Score(recording, views=views, train_frame_indices=(2,)).main()
    assert [frame["file_path"] for frame in json.loads(views.read_text())["frames"]] == ["00000.png", "00001.png"]


GREY = image(0)
FAULTS: dict[str, tuple[dict[str, np.ndarray], str]] = {
    "no pictures": ({}, "holds no renders"),
    "one is missing": ({name: GREY for name in ("00000.png", "00002.png")}, "no render of the held-out frame 00001"),
    "another number": ({f"r{i}.png": GREY for i in range(4)}, "holds 4 renders that have the name of no held-out"),
    "another size": ({f"{name}.png": GREY[1:] for name in NAMES}, "has 24 x 17 pixels, but its frame has 24 x 18"),
    "twice": ({**frames(), "00001.npy": GREY / 255.0}, "holds both"),
    "negative": ({f"{name}.npy": GREY / 255.0 - 1.0 for name in NAMES}, "brightness of -"),
    "another shape": ({f"{name}.npy": np.zeros((HEIGHT, WIDTH, 4)) for name in NAMES}, "the shape 18 x 24 x 4"),
    "words": ({f"{name}.npy": np.full((HEIGHT, WIDTH), "a") for name in NAMES}, "holds no array of numbers"),
}


@pytest.mark.parametrize(("pictures", "said"), FAULTS.values(), ids=FAULTS)
def test_renders_that_do_not_fit_are_refused(recording: Path, tmp_path: Path, pictures, said: str):
    renders = write_renders(tmp_path / "renders", pictures)
    output = tmp_path / "scores.json"
    with pytest.raises(RecordingError, match=said):
        Score(recording, renders, held_out_every=1, output=output).main()
    assert not output.exists()


def test_a_render_that_is_not_finite_has_no_score_and_the_others_have(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    pictures = {f"{name}.npy": smooth(i) / 255.0 for i, name in enumerate(NAMES)}
    pictures["00001.npy"][0, 0] = np.nan
    found = scores(recording, write_renders(tmp_path / "renders", pictures))
    assert found["scores"]["psnr"] > 100 and found["scores"]["not_scored"]["psnr"] == {"the render is not finite": [1]}
    assert "the render is not finite (00001.png)" in capsys.readouterr().out


def test_what_cannot_be_scored_is_said(recording: Path, tmp_path: Path):
    with pytest.raises(FlagError, match="nothing to score"):
        Score(recording).main()
    with pytest.raises(RecordingError, match="holds no frames"):
        Score(write_davis(tmp_path / "davis", frames=False), views=tmp_path / "views.json").main()
    with pytest.raises(OutputError, match="never written to"):
        Score(recording, views=recording / "views.json").main()
    with pytest.raises(OutputError, match=r"--views .* could not be written"):
        Score(recording, views=tmp_path).main()


def test_the_printed_command_scores_the_views_that_were_listed(recording: Path, tmp_path: Path, capsys):
    flags = ["--held-out-every", "1", "--time-range", "0.0", "0.1", "--downscale-factor", "2.0"]
    views = tmp_path / "views.json"
    tyro.cli(Score, args=["--recording", str(recording), "--views", str(views), *flags]).main()
    command = capsys.readouterr().out.splitlines()[-1].partition(": ")[2]
    assert command == shlex.join(["enerf", "score", "RENDERS", "--recording", str(recording), *flags])


@pytest.mark.parametrize("flags", [{"time_range": (0, np.inf)}, {"downscale_factor": 0.0}, {"held_out_every": 0}])
def test_numbers_outside_their_range_are_refused(recording: Path, tmp_path: Path, flags: dict):
    (name,) = flags
    with pytest.raises(FlagError, match=f"^--{name.replace('_', '-')} is .*, but must be from"):
        Score(recording, views=tmp_path / "views.json", **flags).main()
    assert not (tmp_path / "views.json").exists()

"""Pictures of more than 8 bits are as bright as what was written, against files that Pillow and OpenCV wrote."""

from __future__ import annotations

import json
import shutil
import struct
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from nerfstudio.data.datasets.base_dataset import InputDataset
from PIL import Image
from recordings import FRAME_TIMES, HEIGHT, POSE_TIMES, WIDTH, poses, write_esim
from small_runs import set_up, small_config

from enerf_ns.dataparsers.event_dataparser import EventDataParserConfig
from enerf_ns.dataparsers.formats.event_recording import read as read_own
from enerf_ns.dataparsers.formats.event_recording import write
from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.inspection.page import Inspection
from enerf_ns.dataparsers.recording.camera import Camera
from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.files import image_size, load_image
from enerf_ns.dataparsers.recording.picture_depth import brightness, find_white_level
from enerf_ns.dataparsers.recording.recording import Frames
from enerf_ns.dataparsers.recording.trajectory import Trajectory


def truth(channels: int = 1, number: int = 0) -> np.ndarray:
    """Brightness in [0, 1], [18, 24, channels], with black and white in each."""
    values = np.random.default_rng(number).random((HEIGHT, WIDTH, channels))
    values[0, 0], values[0, 1] = 0.0, 1.0
    return values


def of_bits(bits: int, channels: int = 1) -> np.ndarray:
    return np.rint(truth(channels) * (2**bits - 1)).astype(np.uint16)


def with_sbit(path: Path, bits: int, pixels: np.ndarray) -> None:
    """A PNG of Pillow whose header states its bits."""
    Image.fromarray(pixels[..., 0]).save(path)
    content, chunk = path.read_bytes(), b"sBIT" + bytes([bits])
    stated = struct.pack(">I", 1) + chunk + struct.pack(">I", zlib.crc32(chunk))
    path.write_bytes(content[:33] + stated + content[33:])  # behind the header


def packed_tiff(path: Path, bits: int, pixels: np.ndarray) -> None:
    """TIFF whose values follow each other without padding, after the specification of TIFF 6.0."""
    rows = ["".join(format(value, f"0{bits}b") for value in row) for row in pixels[..., 0].tolist()]
    data = b"".join(int(row, 2).to_bytes(len(row) // 8, "big") for row in rows)
    height, width = pixels.shape[:2]
    tags = {256: width, 257: height, 258: bits, 259: 1, 262: 1, 273: 8, 277: 1, 278: height, 279: len(data)}
    entries = b"".join(struct.pack(">HHII", tag, 4, 1, value) for tag, value in tags.items())
    path.write_bytes(
        b"MM\0*" + struct.pack(">I", 8 + len(data)) + data + struct.pack(">H", len(tags)) + entries + bytes(4)
    )


def with_cv2(path: Path, bits: int, pixels: np.ndarray) -> None:
    assert cv2.imwrite(str(path), pixels[..., ::-1], (cv2.IMWRITE_TIFF_COMPRESSION, 1))  # else LogLuv, with errors


def ppm(path: Path, bits: int, pixels: np.ndarray) -> None:
    kind = {".pgm": "P5", ".ppm": "P6"}[path.suffix]
    path.write_bytes(f"{kind} {WIDTH} {HEIGHT} {2**bits - 1}\n".encode() + pixels.astype(">u2").tobytes())


WRITERS: dict[str, tuple[str, int, Callable[[Path, int, np.ndarray], object]]] = {
    "Pillow's PNG": (".png", 1, lambda path, _, pixels: Image.fromarray(pixels[..., 0]).save(path)),
    "PNG with sBIT": (".png", 1, with_sbit),
    "Pillow's TIFF": (".tif", 1, lambda path, _, pixels: Image.fromarray(pixels[..., 0]).save(path)),
    "packed TIFF": (".tif", 1, packed_tiff),
    "OpenCV's PNG in colour": (".png", 3, with_cv2),
    "OpenCV's TIFF in colour": (".tiff", 3, with_cv2),
    "PGM": (".pgm", 1, ppm),
    "PPM": (".ppm", 3, ppm),
}


@pytest.mark.parametrize("bits", [10, 12, 14, 16])
@pytest.mark.parametrize("writer", WRITERS)
def test_pictures_are_as_bright_as_what_was_written(tmp_path: Path, writer: str, bits: int):
    suffix, channels, write_file = WRITERS[writer]
    if writer == "packed TIFF" and bits == 16:
        pytest.skip("which is TIFF as Pillow writes it")
    file = tmp_path / f"a{suffix}"
    write_file(file, bits, of_bits(bits, channels))
    assert image_size(file) == (WIDTH, HEIGHT)
    found = frames_of([file]).image(0)
    assert found.dtype == np.float32 and found.shape == (HEIGHT, WIDTH, channels)
    np.testing.assert_allclose(found, truth(channels), rtol=0, atol=0.51 / (2**bits - 1))


def frames_of(files: list[Path]) -> Frames:
    camera = Camera(WIDTH, HEIGHT, 20.0, 20.0, 12.0, 9.0)
    trajectory = Trajectory(POSE_TIMES, poses()[:, :3], poses()[:, 3:])
    return Frames(tuple(files), FRAME_TIMES[: len(files)], camera, trajectory)


@pytest.mark.parametrize("kind", [np.float32, np.float64])
@pytest.mark.parametrize("channels", [1, 3])
def test_floats_are_brightness(tmp_path: Path, channels: int, kind: type):
    with_cv2(tmp_path / "a.tif", 0, truth(channels).astype(kind))
    frames = frames_of([tmp_path / "a.tif"])
    assert frames.white_level == 1.0
    np.testing.assert_allclose(frames.image(0), truth(channels), atol=1e-7)


def test_of_floats_above_1_the_largest_of_the_recording_is_white(tmp_path: Path):
    for number, scale in enumerate((3.0, 37.5)):
        Image.fromarray((scale * truth(1, number)[..., 0]).astype(np.float32)).save(tmp_path / f"{number}.tif")
    frames = frames_of([tmp_path / "0.tif", tmp_path / "1.tif"])
    assert frames.white_in_words == ", white is 37.5"
    np.testing.assert_allclose(frames.image(0), truth() * 3 / 37.5, atol=1e-6)
    np.testing.assert_allclose(frames.image(1), truth(1, 1), atol=1e-6)


@pytest.mark.parametrize("stated", [True, False])
def test_the_brightest_frame_of_a_recording_tells_the_depth_of_all(tmp_path: Path, stated: bool):
    """So that dark frames stay dark; and a header may state more bits than are used."""
    dark, bright = of_bits(12) // 8, of_bits(12) // 8
    if not stated:
        bright[5, 5] = 4095
    Image.fromarray(dark[..., 0]).save(tmp_path / "0.png")
    with_sbit(tmp_path / "1.png", 12 if stated else 10, bright)
    frames = frames_of([tmp_path / "0.png", tmp_path / "1.png"])
    assert frames.white_level == 4095
    np.testing.assert_allclose(frames.image(0), dark / 4095, atol=1e-7)
    np.testing.assert_array_equal(frames.subset(np.array([0])).image(0), frames.image(0))


def test_values_that_fill_16_bits_are_of_16_bits_whatever_sbit_states(tmp_path: Path):
    """As the specification of PNG asks for, which has 12 bits moved to the upper end of 16."""
    with_sbit(tmp_path / "a.png", 12, of_bits(16))
    assert find_white_level((tmp_path / "a.png",)) == 65535


def test_pictures_of_8_bits_alone_have_the_white_level_of_8_bits(tmp_path: Path):
    Image.fromarray(np.zeros((4, 4), np.uint8)).save(tmp_path / "a.png")
    assert find_white_level((tmp_path / "a.png",)) == find_white_level(()) == 255


@pytest.mark.parametrize("value", [-0.5, np.nan, np.inf])
def test_floats_that_are_no_brightness_are_refused(tmp_path: Path, value: float):
    pixels = truth()[..., 0].astype(np.float32)
    pixels[3, 4] = value
    Image.fromarray(pixels).save(tmp_path / "a.tif")
    with pytest.raises(
        RecordingError, match=rf"a\.tif holds a brightness of {value:g}, but numbers from 0 on"
    ) as error:
        load_image(tmp_path / "a.tif")
    assert "\n" not in str(error.value)


def test_32_bits_are_refused(tmp_path: Path):
    Image.fromarray(of_bits(16)[..., 0].astype(np.int32)).save(tmp_path / "a.tif")
    with pytest.raises(RecordingError, match=r"a\.tif holds values of type int32, but pictures of 8 or 16 bits"):
        load_image(tmp_path / "a.tif")


def test_whole_numbers_beside_floats_are_refused(tmp_path: Path):
    Image.fromarray(of_bits(12)[..., 0]).save(tmp_path / "0.tif")
    Image.fromarray(truth()[..., 0].astype(np.float32)).save(tmp_path / "1.tif")
    with pytest.raises(
        RecordingError, match=r"1\.tif holds values of type float32, but pictures before it hold uint16"
    ):
        find_white_level((tmp_path / "0.tif", tmp_path / "1.tif"))


def test_what_is_transparent_is_laid_over_white(tmp_path: Path):
    pixels = np.dstack([of_bits(16, 3), of_bits(16, 1)])
    assert cv2.imwrite(str(tmp_path / "a.png"), pixels[..., [2, 1, 0, 3]])
    opacity = pixels[..., 3:] / 65535
    found = load_image(tmp_path / "a.png")
    np.testing.assert_allclose(found, opacity * pixels[..., :3] + (1 - opacity) * 65535, atol=1)


@pytest.fixture(scope="module")
def deep(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording with sharp and, darker, blurred frames of 12 bits in 16-bit PNG of Pillow."""
    folder = tmp_path_factory.mktemp("deep") / "recording"
    shutil.copytree(recording, folder)
    rng = np.random.default_rng(0)
    for kind, scale in (("images", 16), ("images_corrupted", 3)):
        for file in sorted((folder / kind).glob("*.png")):
            values = np.asarray(Image.open(file).convert("L")).astype(np.uint16) * scale
            values += rng.integers(0, scale, values.shape, dtype=np.uint16)  # what 8 bits cannot hold
            Image.fromarray(values).save(file)
    return folder


def stored(file: Path) -> np.ndarray:
    """Brightness of a file of 12 bits, by OpenCV."""
    values = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
    assert values is not None and values.dtype == np.uint16 and values.max() < 4096
    return values / 4095


def test_a_step_of_training_learns_from_all_12_bits(deep: Path, tmp_path: Path):
    config = small_config(deep, tmp_path, data__supervision="frames", data__train_num_rays_per_batch=300)
    pipeline = set_up(config).pipeline
    manager = pipeline.datamanager
    files = manager.train_dataset.frames.filenames
    assert all(file.parent.name == "images_corrupted" and stored(file).max() < 0.25 for file in files)
    frames = manager.next_batch(pipeline.model.sensor).frames
    truth = np.stack([stored(file) for file in files])[tuple(frames.indices.T.numpy())]
    np.testing.assert_allclose(frames.colours, np.repeat(truth[:, None], 3, axis=1), rtol=0, atol=1e-6)
    assert len(np.unique(np.round(255 * truth, 3))) > len(np.unique(np.round(255 * truth)))  # else 8 bits would pass

    held_out = manager.eval_dataset
    for i, file in enumerate(held_out.frames.filenames):
        np.testing.assert_allclose(held_out[i]["image"][..., 0], stored(file), rtol=0, atol=1e-6)


def test_pictures_of_8_bits_stay_so_in_memory(recording: Path, tmp_path: Path):
    pipeline = set_up(small_config(recording, tmp_path, data__supervision="frames")).pipeline
    assert pipeline.datamanager.frame_colours.dtype == torch.uint8


def test_downscaled_pictures_are_means_of_pixels(deep: Path):
    frames = read_recording(deep).frames
    assert frames is not None
    small = replace(frames, downscale_factor=2.0).picture(0)
    found = cv2.resize(
        stored(frames.filenames[0]).astype(np.float32), None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA
    )
    assert np.abs(small[..., 0] - found).mean() < 0.01 and small.shape == (*found.shape, 1)


def test_other_methods_get_pictures_of_8_bits(deep: Path):
    outputs = EventDataParserConfig(data=deep, format="auto").setup().get_dataparser_outputs("train")
    sources = read_recording(deep).frames
    assert sources is not None
    names = {file.stem: file for file in sources.filenames}
    for i, file in enumerate(outputs.image_filenames):
        found = InputDataset(outputs).get_numpy_image(i)
        assert found.dtype == np.uint8 and found.shape == (24, 32, 3)
        np.testing.assert_allclose(found[..., 0] / 255, stored(names[file.stem]), rtol=0, atol=0.51 / 255)


def test_a_converted_recording_is_as_bright_whatever_it_leaves_out(deep: Path, tmp_path: Path):
    """Its frames alone, the dark ones, would look as if of 10 bits."""
    recording = replace(read_recording(deep), frames=None)
    (tmp_path / "converted").mkdir()
    write(recording, tmp_path / "converted")
    assert json.loads((tmp_path / "converted/recording.json").read_text())["white_level"] == 4095
    found = read_recording(tmp_path / "converted").blurred_frames
    assert found is not None
    for i, file in enumerate(sorted((deep / "images_corrupted").glob("*.png"))):
        np.testing.assert_allclose(found.image(i)[..., 0], stored(file), rtol=0, atol=1e-6)


@pytest.mark.parametrize("white", [0, -1, "4095", True, [4095]])
def test_a_stated_white_level_that_is_none_is_refused(deep: Path, tmp_path: Path, white: object):
    (tmp_path / "own").mkdir()
    write(read_recording(deep), tmp_path / "own")
    about = json.loads((tmp_path / "own/recording.json").read_text()) | {"white_level": white}
    (tmp_path / "own/recording.json").write_text(json.dumps(about))
    with pytest.raises(RecordingError, match=r"recording\.json holds white_level = .*, but a number above 0"):
        read_recording(tmp_path / "own")


@pytest.mark.parametrize("white", [1, 65535])
def test_a_white_level_of_frames_of_8_bits_is_refused(tmp_path: Path, white: float):
    (tmp_path / "own").mkdir()
    write(read_recording(write_esim(tmp_path / "esim")), tmp_path / "own")
    about = json.loads((tmp_path / "own/recording.json").read_text())
    for stated in (255, white):
        (tmp_path / "own/recording.json").write_text(json.dumps(about | {"white_level": stated}))
        if stated == 255:
            read_own(tmp_path / "own")
    with pytest.raises(RecordingError, match=rf"holds white_level = {white}, but .*00000\.png has 8 bits"):
        read_own(tmp_path / "own")


def test_frames_above_the_stated_white_level_are_refused(deep: Path, tmp_path: Path):
    (tmp_path / "own").mkdir()
    write(read_recording(deep), tmp_path / "own")
    about = json.loads((tmp_path / "own/recording.json").read_text()) | {"white_level": 1023}
    (tmp_path / "own/recording.json").write_text(json.dumps(about))
    frames = read_recording(tmp_path / "own").frames
    assert frames is not None
    with pytest.raises(RecordingError, match=r"00000\.png holds \d+, but 1023 is stated to be white"):
        frames.image(0)


def test_inspection_says_what_is_white_and_shows_it(deep: Path):
    inspection = Inspection.of(read_recording(deep))
    assert inspection.found()["frames"].endswith(", white is 4095")


def test_gamma_encoded_frames_are_linear_where_they_are_read(deep: Path, tmp_path: Path):
    """Of 8 bits and of more; the files are copied as they are."""
    for name, source in {"deep": deep, "esim": write_esim(tmp_path / "esim")}.items():
        (tmp_path / f"own-{name}").mkdir()
        write(read_recording(source), tmp_path / f"own-{name}")
        encoded = read_own(tmp_path / f"own-{name}").frames
        about = json.loads((tmp_path / f"own-{name}/recording.json").read_text())
        (tmp_path / f"own-{name}/recording.json").write_text(json.dumps(about | {"frame_gamma": 1.8}))
        linear = read_own(tmp_path / f"own-{name}").frames
        assert encoded is not None and linear is not None and linear.image(1).dtype == np.float32
        np.testing.assert_allclose(linear.image(1), brightness(encoded.image(1)).astype(float) ** 1.8, rtol=1e-5)


@pytest.mark.parametrize("gamma", [0, 0.45, 5, "2.2", True])
def test_a_gamma_that_is_none_is_refused(tmp_path: Path, gamma: object):
    (tmp_path / "own").mkdir()
    write(read_recording(write_esim(tmp_path / "esim")), tmp_path / "own")
    about = json.loads((tmp_path / "own/recording.json").read_text()) | {"frame_gamma": gamma}
    (tmp_path / "own/recording.json").write_text(json.dumps(about))
    with pytest.raises(RecordingError, match=r"recording\.json holds frame_gamma = .*, but a number from 1 to 4"):
        read_own(tmp_path / "own")

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import ExifTags, Image, ImageCms
from recordings import HEIGHT, WIDTH

from enerf_ns.dataparsers.recording.errors import FlagError, RecordingError
from enerf_ns.dataparsers.recording.files import (
    files_in,
    image_size,
    in_colour,
    load_array,
    load_depth,
    load_image,
    of_file,
    partial_of,
    read_json,
    reading,
    write_together,
    write_whole,
)


@pytest.mark.parametrize(
    ("mode", "channels"), [("L", 1), ("RGB", 3), ("RGBA", 3), ("LA", 1), ("P", 3), ("I;16", 1), ("1", 1)]
)
def test_load_image_gives_one_or_three_channels(tmp_path: Path, mode: str, channels: int):
    grey = np.arange(HEIGHT * WIDTH).reshape(HEIGHT, WIDTH) % 256
    if mode == "I;16":
        grey = grey * 257
        image = Image.fromarray(grey.astype(np.uint16))
    elif mode == "1":
        grey = np.where(grey > 127, 255, 0)
        image = Image.fromarray(grey.astype(np.uint8)).convert("1")
    else:
        image = Image.fromarray(grey.astype(np.uint8)).convert("RGB").convert(mode)
    image.save(tmp_path / "image.png")
    loaded = load_image(tmp_path / "image.png")
    assert loaded.dtype == (np.uint16 if mode == "I;16" else np.uint8) and loaded.shape == (HEIGHT, WIDTH, channels)
    tolerance = 51 if mode == "P" else 0  # a palette of 216 colours is coarse
    np.testing.assert_allclose(loaded.astype(int), np.repeat(grey[..., None], channels, 2), atol=tolerance)


PICTURE = Image.fromarray(np.arange(HEIGHT * WIDTH * 3, dtype=np.uint8).reshape(HEIGHT, WIDTH, 3))


def turned_by(orientation: int) -> Image.Exif:
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    return exif


def in_lab(image: Image.Image) -> Image.Image:
    profiles = ImageCms.createProfile("sRGB"), ImageCms.createProfile("LAB")
    found = ImageCms.applyTransform(image, ImageCms.buildTransform(*profiles, "RGB", "LAB"))
    assert found is not None
    return found


def pages(path: Path) -> None:
    PICTURE.save(path, save_all=True, append_images=[PICTURE.rotate(180)])


def deep_pages(path: Path) -> None:
    cv2.imwritemulti(str(path), [np.full((HEIGHT, WIDTH), 1000 * page, np.uint16) for page in (1, 2)])


NOT_PLAIN: dict[str, tuple[str, Callable[[Path], object], str]] = {
    "turned JPEG": ("a.jpg", lambda path: PICTURE.save(path, exif=turned_by(6)), r"by its EXIF \(orientation 6\)"),
    "mirrored PNG": ("a.png", lambda path: PICTURE.save(path, exif=turned_by(2)), r"by its EXIF \(orientation 2\)"),
    "turned WebP": ("a.webp", lambda path: PICTURE.save(path, exif=turned_by(3)), r"by its EXIF \(orientation 3\)"),
    "turned TIFF": ("a.tif", lambda path: PICTURE.save(path, tiffinfo={274: 8}), r"by its EXIF \(orientation 8\)"),
    "CMYK JPEG": ("a.jpg", lambda path: PICTURE.convert("CMYK").save(path), "colours in CMYK, but grey or RGB"),
    "CMYK TIFF": ("a.tif", lambda path: PICTURE.convert("CMYK").save(path), "colours in CMYK, but grey or RGB"),
    "YCbCr TIFF": ("a.tif", lambda path: PICTURE.convert("YCbCr").save(path), "colours in YCbCr, but grey or RGB"),
    "LAB TIFF": ("a.tif", lambda path: in_lab(PICTURE).save(path), "colours in LAB, but grey or RGB"),
    "GIF": ("a.gif", pages, "holds 2 pictures, but one was expected"),
    "APNG": ("a.png", pages, "holds 2 pictures, but one was expected"),
    "WebP": ("a.webp", pages, "holds 2 pictures, but one was expected"),
    "TIFF of pages": ("a.tif", pages, "holds 2 pictures, but one was expected"),
    "deep TIFF of pages": ("a.tif", deep_pages, "holds 2 pictures, but one was expected"),
}
"""Pictures whose stored pixels are not what a viewer shows: the name of the file, how to write it, and what is said."""


@pytest.mark.parametrize("name", NOT_PLAIN)
def test_a_picture_that_is_not_one_array_of_grey_or_rgb_is_refused(name: str, tmp_path: Path):
    file, write, message = NOT_PLAIN[name]
    write(tmp_path / file)
    for read in (load_image, image_size):
        with pytest.raises(RecordingError, match=f"^{re.escape(str(tmp_path / file))} .*{message}"):
            read(tmp_path / file)


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp", ".tif"])
def test_an_upright_picture_is_accepted(suffix: str, tmp_path: Path):
    PICTURE.save(tmp_path / f"a{suffix}", exif=turned_by(1))
    assert load_image(tmp_path / f"a{suffix}").shape == (HEIGHT, WIDTH, 3)
    assert image_size(tmp_path / f"a{suffix}") == (WIDTH, HEIGHT)


@pytest.mark.parametrize("value", [-1.0, np.nan, np.inf])
def test_what_is_no_depth_is_refused(value: float, tmp_path: Path):
    depth = np.ones((HEIGHT, WIDTH), np.float32)
    np.save(tmp_path / "a.npy", depth)
    np.testing.assert_array_equal(load_depth(tmp_path / "a.npy"), depth)
    depth[3, 4] = value
    np.save(tmp_path / "a.npy", depth)
    with pytest.raises(RecordingError, match=rf"a\.npy holds a depth of {value:g} m, but .* write 0 where"):
        load_depth(tmp_path / "a.npy")


def test_what_is_transparent_is_laid_over_white(tmp_path: Path):
    pixels = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 4), dtype=np.uint8)
    Image.fromarray(pixels).save(tmp_path / "image.png")
    colour, alpha = pixels[..., :3].astype(float), pixels[..., 3:] / 255
    found = load_image(tmp_path / "image.png")
    np.testing.assert_allclose(found, alpha * colour + (1 - alpha) * 255, atol=1)
    opaque = pixels[..., 3] == 255
    np.testing.assert_array_equal(found[opaque], pixels[opaque, :3])


def test_grey_pictures_in_colour():
    grey = np.arange(6, dtype=np.uint8).reshape(2, 3)
    assert in_colour(grey).shape == (2, 3, 3) and (in_colour(grey) == grey[..., None]).all()
    coloured = np.arange(18, dtype=np.uint8).reshape(2, 3, 3)
    assert in_colour(coloured) is coloured


def test_values_that_do_not_check_as_sound_are_named_by_their_file():
    with pytest.raises(RecordingError, match=r"^calib\.txt holds no camera\.$"), of_file(Path("calib.txt")):
        raise ValueError("no camera")
    with pytest.raises(RecordingError, match=r"^a\.yaml, cam0, holds no camera\.$"), of_file("a.yaml, cam0,"):
        raise ValueError("no camera.")
    with pytest.raises(FlagError, match="--box"), of_file(Path("calib.txt")):
        raise FlagError("--box")
    with pytest.raises(KeyError), of_file(Path("calib.txt")):
        raise KeyError("a mistake of ours")


def test_what_a_library_raises_becomes_one_sentence(tmp_path: Path):
    def sentence(path: Path, error: Exception) -> str:
        with pytest.raises(RecordingError) as caught, reading(path, "a clay tablet"):
            raise error
        return str(caught.value)

    path = tmp_path / "tablet"
    assert sentence(path, OSError("gone")) == f"{path} is missing; a clay tablet was expected there."
    path.write_bytes(b"")
    assert sentence(path, OSError("short")) == f"{path} is empty; a clay tablet was expected."
    path.write_bytes(b"1")
    found = sentence(path, RuntimeError("It is cracked. Very.\nAnd burnt."))
    assert found == f"{path} cannot be read as a clay tablet (It is cracked, Very); copy it again from its source."
    assert "(KeyError)" in sentence(path, KeyError())
    assert "(column)" in sentence(path, KeyError("column"))
    assert "('utf-8' codec)" in sentence(path, ValueError("'utf-8' codec"))
    with pytest.raises(FlagError), reading(path, "a clay tablet"):
        raise FlagError("--box")


@pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"], ids=["plain", "byte-order mark"])
def test_json_is_read_with_and_without_a_byte_order_mark(tmp_path: Path, mark: bytes):
    (tmp_path / "a.json").write_bytes(mark + json.dumps({"µ": [1]}, ensure_ascii=False).encode())
    assert read_json(tmp_path / "a.json") == {"µ": [1]}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "is missing; JSON was expected there"),
        (b"", "is empty; JSON was expected"),
        (b"{", "cannot be read as JSON"),
        (b"\xff\xfe", "cannot be read as JSON"),
        (b"[" * 100_000, "cannot be read as JSON"),
        (b"[]", "holds a list, but a JSON object was expected"),
    ],
)
def test_what_is_no_json_object_is_an_error_of_one_sentence(tmp_path: Path, content: bytes | None, message: str):
    if content is not None:
        (tmp_path / "a.json").write_bytes(content)
    with pytest.raises(RecordingError, match=message) as error:
        read_json(tmp_path / "a.json")
    assert "a.json" in str(error.value) and "\n" not in str(error.value)


def test_half_of_a_letter_is_named_and_a_whole_one_is_read(tmp_path: Path):
    (tmp_path / "a.json").write_text(r'{"whole": "\ud83d\ude00", "response": "\ud83d"}')
    with pytest.raises(RecordingError, match=r"a\.json holds \\ud83d, which is half of a letter, after .*response"):
        read_json(tmp_path / "a.json")
    (tmp_path / "a.json").write_text(r'{"whole": "\ud83d\ude00", "\\ud83d": 1}')
    assert read_json(tmp_path / "a.json") == {"whole": "\N{GRINNING FACE}", r"\ud83d": 1}


def test_arrays_that_are_none(tmp_path: Path):
    np.savez(tmp_path / "a.npz", x=np.zeros(3))
    with pytest.raises(RecordingError, match="holds no array of numbers"):
        load_array(tmp_path / "a.npz")
    with pytest.raises(RecordingError, match="is missing; a NumPy array"):
        load_array(tmp_path / "b.npy")


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_file_is_written_whole_or_stays_as_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    write_whole(tmp_path / "new/a.txt", "first µ")
    write_whole(tmp_path / "new/a.txt", b"second")
    assert contents(tmp_path) == {"new/a.txt": b"second"}
    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", refuse)
        with pytest.raises(OSError, match="full"):
            write_whole(tmp_path / "new/a.txt", "third")
    assert contents(tmp_path) == {"new/a.txt": b"second"}


def refuse(*_: object) -> None:
    raise OSError("full")


def test_files_and_lines_are_written_together(tmp_path: Path):
    write_together(tmp_path, {"a/1.png": b"1", "b/1.png": b"2"}, {"a/stamps.txt": "1\n"})
    write_together(tmp_path, {"a/2.png": b"3"}, {"a/stamps.txt": "2\n"})
    assert contents(tmp_path) == {"a/1.png": b"1", "b/1.png": b"2", "a/2.png": b"3", "a/stamps.txt": b"1\n2\n"}


@pytest.mark.parametrize("fails_at", [1, 2])
def test_of_files_written_together_none_is_left_where_one_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fails_at: int
):
    write_together(tmp_path, {"a/1.png": b"1"}, {"a/stamps.txt": "1\n"})
    before, replace, calls = contents(tmp_path), Path.replace, []

    def replace_until_it_fails(self: Path, target: Path) -> Path:
        calls.append(target)
        return refuse() if len(calls) == fails_at else replace(self, target)  # type: ignore[return-value]

    monkeypatch.setattr(Path, "replace", replace_until_it_fails)
    with pytest.raises(OSError, match="full"):
        write_together(tmp_path, {"a/2.png": b"2", "b/2.png": b"2"}, {"a/stamps.txt": "2\n", "b/stamps.txt": "2\n"})
    assert contents(tmp_path) == before


def test_what_processes_that_are_gone_have_left_is_removed_by_the_next_that_writes(tmp_path: Path):
    """Of files written together, into whichever folders; what another process is still writing stays."""
    code = (
        "import os, sys; from pathlib import Path; from enerf_ns.dataparsers.recording.files import write_together;"
        "Path.replace = lambda *_: os._exit(9);"
        "write_together(Path(sys.argv[1]), {'a/1.png': b'1', 'b/1.png': b'2', '3.json': b'3'})"
    )
    assert subprocess.run([sys.executable, "-c", code, str(tmp_path)]).returncode == 9
    left = [path.name for path in tmp_path.iterdir() if path.is_file()]
    assert len(left) == 3 and all(name.startswith(".") for name in left)
    assert not [path for path in tmp_path.rglob("*/*")], "all in the folder that the next looks into"
    alive = partial_of(tmp_path / "alive").name.replace(f"-{os.getpid()}", f"-{os.getppid()}")
    (tmp_path / alive).write_text("still being written")
    write_together(tmp_path, {"a/2.png": b"4"})
    assert contents(tmp_path) == {"a/2.png": b"4", alive: b"still being written"}


def test_files_are_in_the_order_in_which_people_count(tmp_path: Path):
    names = ["0.25.png", "0.5.png", "1.png", "a2.png", "a10.png", "a1609459200123456789.png", "b.png"]
    for name in [*names, "c.txt", "._1.png", ".hidden/1.png", "inner/1.png"]:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    assert [file.name for file in files_in(tmp_path, "*.png")] == names
    assert files_in(tmp_path, "*.txt", "*/*.png") == [tmp_path / "c.txt", tmp_path / "inner/1.png"]
    assert files_in(tmp_path / "missing", "*") == []

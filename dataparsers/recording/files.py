"""Reads images, arrays and JSON, and writes files completely or not at all."""

from __future__ import annotations

import json
import os
import platform
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from io import FileIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import psutil
from jaxtyping import Float, Float32, Shaped, UInt8
from PIL import ExifTags, Image, UnidentifiedImageError

from enerf_ns.dataparsers.recording.errors import FlagError, RecordingError, UserError

OTHER_COLOURS = ("CMYK", "YCbCr", "LAB", "HSV")
"""Colour spaces of images that are not those of a camera's pixels."""

UPRIGHT = 1
"""EXIF orientation of an image that is shown as it is stored."""


def expanded(path: Path | str) -> Path:
    """Returns a path that a user gave, with the home folder in place of ~.

    Raises:
        FlagError: The home folder is unknown, or the path is not UTF-8, which some libraries require.
    """
    try:
        expanded = Path(path).expanduser()
    except RuntimeError as error:
        raise FlagError(f"{path} begins with a home folder that is not known; give the path without ~.") from error
    try:
        str(expanded).encode()
    except UnicodeEncodeError as error:
        raise FlagError(f"{expanded} holds bytes that are not UTF-8; rename it.") from error
    return expanded


def absolute(path: Path | str) -> Path:
    """Returns a path that a user gave, perhaps with ~, as an absolute path without links.

    Raises:
        FlagError: The home folder is unknown, the path is not UTF-8, or links lead in a circle.
    """
    try:
        return expanded(expanded(path).resolve())
    except (OSError, RuntimeError) as error:  # which one depends on the version of Python
        raise FlagError(f"{path} cannot be followed (links that lead in a circle); give another path.") from error


@contextmanager
def of_file(path: Path | str) -> Iterator[None]:
    """Turns a ValueError of the block into an error that names the file.

    Args:
        path: The file or folder, or words for a part of it, such as "camchain.yaml, cam0,".

    Raises:
        RecordingError: The words "PATH holds" and the message of the ValueError.
    """
    try:
        yield
    except UserError:
        raise
    except ValueError as error:
        raise RecordingError(f"{path} holds {str(error).rstrip('.')}.") from error


def check_is_file(path: Path, expected: str) -> None:
    """Checks that a path is a regular file or missing. Opening a pipe or a device could wait for ever.

    Args:
        path: The path; links are followed.
        expected: The expected content, such as "an HDF5 file with events".

    Raises:
        RecordingError: A folder, pipe, device or socket.
    """
    if path.exists() and not path.is_file():
        what = "a folder" if path.is_dir() else "no regular file (but a pipe, a device or a socket)"
        raise RecordingError(f"{path} is {what}; {expected} was expected there.")


def check_is_folder(path: Path, expected: str) -> None:
    """Checks that a path is a folder or missing.

    Args:
        path: The path; links are followed.
        expected: The expected content, such as "a folder of frames".

    Raises:
        RecordingError: A file of any kind.
    """
    if path.exists() and not path.is_dir():
        raise RecordingError(f"{path} is no folder, but {expected} was expected there; rename it, or give its content.")


@contextmanager
def reading(path: Path, expected: str) -> Iterator[None]:
    """Turns any error of a library about a damaged file into one sentence.

    Args:
        path: The file.
        expected: The expected content, such as "an HDF5 file with events".

    Raises:
        RecordingError: The block raised an error, or the file is missing.
    """
    try:
        check_is_file(path, expected)
        yield
    except UserError:
        raise
    except Exception as error:  # libraries raise errors of many types at damaged files
        _check_can_be_read(path, expected)
        is_key = isinstance(error, KeyError) and bool(error.args)  # str would quote the key
        text = str(error.args[0] if is_key else error)
        lines = text.strip().splitlines() or [type(error).__name__]
        reason = lines[0].rstrip(".").replace(". ", ", ")
        raise RecordingError(
            f"{path} cannot be read as {expected} ({reason}); copy it again from its source."
        ) from error


def _check_can_be_read(path: Path, expected: str) -> None:
    """Raises RecordingError if the file is missing, empty or not readable."""
    try:
        with open(path, "rb") as file:
            is_empty = not file.read(1)
    except FileNotFoundError as error:
        raise RecordingError(f"{path} is missing; {expected} was expected there.") from error
    except OSError as error:
        raise RecordingError(
            f"{path} cannot be opened ({error.strerror}); {expected} was expected, which you may read."
        ) from error
    if is_empty:
        raise RecordingError(f"{path} is empty; {expected} was expected.")


def read_text(path: Path, expected: str) -> str:
    """Returns the text of a file, UTF-8 with or without a byte-order mark.

    Args:
        path: The file.
        expected: The expected content, such as "JSON".

    Raises:
        RecordingError: The file is missing, cannot be read, or is not text.
    """
    with reading(path, expected):
        return path.read_text(encoding="utf-8-sig")


def load_image(path: Path) -> Shaped[np.ndarray, "height width channels"]:
    """Returns the stored values of an image with one or three channels: uint8, uint16 or float32.

    Transparent pixels are laid over white. For 16 bits and floats, `picture_depth` finds the value of full brightness.

    Raises:
        RecordingError: The file is missing or cannot be decoded, is shown turned or mirrored, is neither grey nor RGB,
            holds several pictures, or holds values of another type, below 0 or not finite.
    """
    with reading(path, "an image"):
        if is_deep(path):
            return _load_deep(path)
        with Image.open(path) as image:
            _check_is_plain(path, image)
            image.verify()  # the checksums of a PNG, which decoding passes over
        with Image.open(path) as image:
            image.load()
            _check_is_plain(path, image)  # once more, since a PNG may have its EXIF behind its pixels
            grey = image.mode in ("1", "L", "LA")
            if image.mode in ("LA", "PA", "RGBA") or "transparency" in image.info:
                colours = image.convert("RGBA")
                image = Image.alpha_composite(Image.new("RGBA", image.size, "white"), colours)
            pixels = np.array(image.convert("L" if grey else "RGB"))
        return pixels[..., None] if grey else pixels


def is_deep(path: Path) -> bool:
    """Returns whether an image has more than 8 bits in each channel, from the header only.

    Raises:
        RecordingError: The file is missing.
    """
    with reading(path, "an image"):
        try:
            with Image.open(path) as image:
                decoder = image.tile[0][3] if image.tile else ""
                mode, *rest = decoder if isinstance(decoder, tuple) else (decoder,)
                is_deep_ppm = image.format == "PPM" and bool(rest) and rest[0] > 255
                return image.mode.startswith(("I", "F")) or ";16" in str(mode) or is_deep_ppm
        except UnidentifiedImageError:  # such as TIFF with floats of three channels, which OpenCV reads
            return True


def _load_deep(path: Path) -> Shaped[np.ndarray, "height width channels"]:
    """Returns the values of an image with more than 8 bits in each channel, uint16 or float32, as `load_image` does."""
    with suppress(UnidentifiedImageError), Image.open(path) as image:
        _check_is_plain(path, image)
        image.verify()
    stored = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_UNCHANGED)
    if stored is None:
        raise ValueError("its pixels cannot be decoded")
    if stored.dtype not in (np.uint16, np.float32, np.float64):
        raise RecordingError(
            f"{path} holds values of type {stored.dtype}, but pictures of 8 or 16 bits, or of floats, were expected."
        )
    pixels = np.atleast_3d(stored)
    if pixels.dtype.kind == "f":
        pixels = pixels.astype(np.float32)
        wrong = ~((pixels >= 0) & (pixels < np.inf))
        if wrong.any():
            raise RecordingError(
                f"{path} holds a brightness of {pixels[wrong][0]:g}, but numbers from 0 on were expected; write 0 "
                "where it is not known."
            )
    if pixels.shape[2] == 4:
        white = 65535 if pixels.dtype == np.uint16 else 1.0
        opacity = pixels[..., 3:] / np.float32(white)
        laid = pixels[..., :3] * opacity + white * (1 - opacity)
        pixels = (np.rint(laid) if pixels.dtype == np.uint16 else laid).astype(pixels.dtype)
    return np.ascontiguousarray(pixels[..., ::-1])


def _check_is_plain(path: Path, image: Image.Image) -> None:
    """Checks that an opened image is one picture, grey or RGB, with its pixels in the order of the sensor.

    Raises:
        RecordingError: It is animated, has several pages, is CMYK or LAB, or its EXIF states another orientation.
    """
    if (number := getattr(image, "n_frames", 1)) > 1:
        raise RecordingError(f"{path} holds {number} pictures, but one was expected; write each into its own file.")
    if image.mode in OTHER_COLOURS:
        raise RecordingError(f"{path} holds colours in {image.mode}, but grey or RGB was expected; convert it to RGB.")
    turn = Image.Image.getexif(image).get(ExifTags.Base.Orientation, UPRIGHT)  # of a PNG, without decoding it
    if turn not in (0, UPRIGHT):
        raise RecordingError(
            f"{path} is to be shown turned or mirrored by its EXIF (orientation {turn}), but pixels in the order of "
            "the sensor were expected; store them in this order, without this tag."
        )


def in_colour(image: UInt8[np.ndarray, "height width *channels"]) -> UInt8[np.ndarray, "height width 3"]:
    """Returns an image with three channels; a grey image, [height, width] or with one channel, is repeated."""
    image = image if image.ndim == 3 else image[..., None]
    return np.repeat(image, 3, axis=2) if image.shape[2] == 1 else image


def check_image_sizes(paths: Sequence[Path], width: int, height: int) -> None:
    """Checks that images have this size in pixels, from their headers only.

    Raises:
        RecordingError: A file is missing, is not an image, or has another size; or `image_size` refuses it.
    """
    for path in paths:
        if (found := image_size(path)) != (width, height):
            raise RecordingError(
                f"{path} has {found[0]} x {found[1]} pixels, but {width} x {height} of its camera were expected; give "
                "images and calibration of one resolution."
            )


def image_size(path: Path) -> tuple[int, int]:
    """Returns width and height in pixels, from the header only.

    Raises:
        RecordingError: The file is missing or is not an image, is shown turned or mirrored, is neither grey nor RGB, or
            holds several pictures.
    """
    with reading(path, "an image"):
        try:
            with Image.open(path) as image:
                _check_is_plain(path, image)
                return image.size
        except UnidentifiedImageError:
            height, width, _ = _load_deep(path).shape
            return width, height


def load_array(path: Path, mmap_mode: str | None = None) -> Float[np.ndarray, "..."]:
    """Returns an array of real numbers from a .npy file.

    Args:
        path: The file.
        mmap_mode: The argument of `numpy.load`; "r" reads only the header.

    Raises:
        RecordingError: The file is missing, or holds no such array.
    """
    with reading(path, "a NumPy array (.npy)"):
        array = np.load(path, mmap_mode=mmap_mode)  # type: ignore[arg-type]
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "biuf":
        raise RecordingError(f"{path} holds no array of numbers, but a .npy file of numbers was expected.")
    return array


def load_depth(path: Path) -> Float32[np.ndarray, "height width"]:
    """Returns a depth map from a .npy file: depth along the optical axis in metres, 0 where it is unknown.

    Raises:
        RecordingError: The file is missing, or holds no such array.
    """
    depth = load_array(path).astype(np.float32)
    wrong = ~((depth >= 0) & (depth < np.inf))
    if wrong.any():
        raise RecordingError(
            f"{path} holds a depth of {depth[wrong][0]:g} m, but finite numbers from 0 on were expected; write 0 where "
            "the depth is not known."
        )
    return depth


def read_json(path: Path) -> dict[str, Any]:
    """Returns the JSON object of a file, with or without a byte-order mark.

    Raises:
        RecordingError: The file is missing or holds no JSON object.
    """
    with reading(path, "JSON"):
        value = json.loads(read_text(path, "JSON"))
    if not isinstance(value, dict):
        raise RecordingError(f"{path} holds a {type(value).__name__}, but a JSON object was expected.")
    return value


def fill_page(template: Path, **values: Any) -> str:
    """Returns a page of HTML from a Jinja template. Values are escaped, and a missing value is an error."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    templates = Environment(
        loader=FileSystemLoader(template.parent),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return templates.get_template(template.name).render(**values)


def partial_of(path: Path) -> Path:
    """Returns the path of a temporary file or folder, which replaces `path` once it is complete.

    The function also removes temporary files that ended processes of this machine left in the same folder.

    Args:
        path: The final path; the temporary name has the same suffix.
    """
    remove_leftovers(path.parent)
    return path.with_name(f".{path.stem}{_mark()}{os.getpid()}{path.suffix}")


def remove_leftovers(folder: Path) -> None:
    """Removes the temporary files (`partial_of`) that ended processes of this machine left in a folder."""
    mark = _mark()
    with suppress(OSError):  # the folder is missing or may not be read
        for entry in os.scandir(folder):
            number = entry.name.rpartition(mark)[2].partition(".")[0] if entry.name.startswith(".") else ""
            if mark in entry.name and number.isdecimal() and not psutil.pid_exists(int(number)):
                if entry.is_dir(follow_symlinks=False):
                    shutil.rmtree(entry.path, ignore_errors=True)
                else:
                    os.unlink(entry.path)


def _mark() -> str:
    """Returns the part of a temporary name before the number of its process."""
    return f".partial-{platform.node()}-"


def write_whole(path: Path, content: str | bytes) -> None:
    """Writes a file completely, or leaves everything as it was.

    Args:
        path: The file; its folder is created if it is missing.
        content: Bytes, or text that is encoded as UTF-8.

    Raises:
        OSError: The disk is full, or the folder cannot be written to.
    """
    write_together(path.parent, {path.name: content.encode() if isinstance(content, str) else content})


def write_together(folder: Path, files: dict[str, bytes], lines: dict[str, str] | None = None) -> None:
    """Writes files and appends lines to tables: all of them, or none after an error.

    Args:
        folder: The start of all paths, and the place of temporary files.
        files: Content of each file by path; existing files are replaced.
        lines: Text that is appended to each table, by path.

    Raises:
        OSError: The disk is full, or a folder cannot be written to. Everything is then as before, except that some of
            several replaced files may be new.
    """
    lines = lines or {}
    partials = {path: partial_of(folder / path.replace("/", "-")) for path in files}
    replaced = [path for path in files if (folder / path).exists()]
    lengths = {path: (folder / path).stat().st_size for path in lines if (folder / path).exists()}
    try:
        for path, content in files.items():
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            partials[path].write_bytes(content)
        for path, line in lines.items():
            with open(folder / path, "ab", buffering=0) as table:
                write_all(table, line.encode())
        for path, partial in partials.items():
            partial.replace(folder / path)
    except BaseException:
        for path in {*files, *lines}.difference(replaced, lengths):
            (folder / path).unlink(missing_ok=True)
        for partial in partials.values():
            partial.unlink(missing_ok=True)
        for path, length in lengths.items():
            os.truncate(folder / path, length)
        raise


def write_all(file: FileIO, content: bytes) -> None:
    """Writes all bytes to an unbuffered file, whose `write` may accept only a part when the disk is nearly full.

    Raises:
        OSError: The disk is full. A part may be written.
    """
    left = memoryview(content)
    while left:
        left = left[file.write(left) :]

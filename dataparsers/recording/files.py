"""Reads images, arrays and JSON, and writes files completely or not at all."""

from __future__ import annotations

import json
import os
import platform
import re
import shutil
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from decimal import Decimal
from functools import cache
from io import FileIO
from pathlib import Path
from typing import IO, Any

import cv2
import numpy as np
import psutil
from jaxtyping import Float, Float32, Shaped, UInt8
from PIL import ExifTags, Image, UnidentifiedImageError

from enerf_ns.dataparsers.recording.errors import FlagError, RecordingError, UserError, printable

LARGEST_TEXT = 2**24
"""Most bytes of a file of settings or calibrations: JSON, YAML or flags."""

LARGEST_TABLE = 2**28
"""Most bytes of a table of poses or stamps."""

LARGEST_ARRAY = 2**27
"""Most bytes of an array that is read as a whole."""

LARGEST_PICTURE = 2**29
"""Most bytes of a file of a picture."""

LONGEST_LINE = 4096
"""Most letters of a line of a table, or of a value in YAML."""

LONGEST_NPY_HEADER = 2**16
"""Most bytes of the header of an array."""

MOST_PLACES = 8
"""Most folders that links lead to and that are named."""

KERNEL_FOLDERS = (Path("/proc"), Path("/sys"))
"""Folders of files whose content the kernel makes. They are regular by their mode, and some never end."""

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


def check_is_file(path: Path, expected: str, largest: int | None = None) -> None:
    """Checks that a path is a regular file or missing. Reading anything else could wait for ever or never end.

    Args:
        path: The path; links are followed.
        expected: The expected content, such as "an HDF5 file with events".
        largest: Most bytes of a file whose whole content is read. None for files that are read in pieces.

    Raises:
        RecordingError: A folder, pipe, device, socket, file of the kernel, or larger file.
    """
    if not path.exists():
        return
    if path.is_dir():
        raise RecordingError(f"{path} is a folder; {expected} was expected there.")
    place = path.resolve()
    if not path.is_file() or any(place.is_relative_to(folder) for folder in KERNEL_FOLDERS):
        raise RecordingError(
            f"{path} is no regular file (but a pipe, a device, a socket or a file of the kernel); {expected} was "
            "expected there."
        )
    if largest is not None and (size := path.stat().st_size) > largest:
        raise RecordingError(
            f"{path} has {size:,} bytes, but {expected} of at most {largest:,} bytes was expected; give that file."
        )


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


def files_in(folder: Path, *patterns: str) -> list[Path]:
    """Returns the files and folders of some patterns in a folder, without hidden ones, in the order of their names.

    Hidden are names that begin with a dot, such as the companions ._NAME that macOS writes to disks of other systems.
    """
    found = {path for pattern in patterns for path in folder.glob(pattern)}
    shown = (path for path in found if not any(part.startswith(".") for part in path.relative_to(folder).parts))
    return sorted(shown, key=by_numbers)


def by_numbers(path: Path) -> list[tuple[Decimal, str]]:
    """Returns the parts of a name to sort by, so that 2.png comes before 10.png, and 0.25.png before 0.5.png."""
    parts = re.split(r"(\d+(?:\.\d+)?)", str(path))
    return [(Decimal(part), part) if number % 2 else (Decimal(-1), part) for number, part in enumerate(parts)]


def name_links_out(folder: Path) -> None:
    """Prints one line that names the links of a folder that lead out of it, and what they lead to.

    Links are followed when a recording is read, since large files are often linked. Whoever gets a recording from
    somebody else sees so which other files of the disk it reads, before anything is copied.

    Args:
        folder: The folder of a recording, without links in its path.
    """
    leading: dict[Path, list[str]] = defaultdict(list)
    for place, folders, files in os.walk(folder):
        for link in (Path(place, name) for name in (*folders, *files)):
            with suppress(OSError, RuntimeError):  # a link that leads nowhere or in a circle, as its reader will say
                if link.is_symlink() and not (target := link.resolve(strict=True)).is_relative_to(folder):
                    leading[target.parent].append(f"{link.relative_to(folder)} to {target}")
    if not leading:
        return
    rarest = sorted(leading.items(), key=lambda item: len(item[1]))
    shown = [
        f"{links[0]}" + (f" and {len(links) - 1:,} more to {place}" if len(links) > 1 else "")
        for place, links in rarest[:MOST_PLACES]
    ]
    left = f", and to {len(rarest) - MOST_PLACES:,} more folders" if len(rarest) > MOST_PLACES else ""
    print(printable(f"Links of {folder} lead out of it: {', '.join(shown)}{left}. They are read as parts of it."))


@contextmanager
def reading(path: Path, expected: str, largest: int | None = None) -> Iterator[None]:
    """Turns any error of a library about a damaged file into one sentence.

    Args:
        path: The file.
        expected: The expected content, such as "an HDF5 file with events".
        largest: Argument of `check_is_file`.

    Raises:
        RecordingError: The block raised an error, or the file is missing, is no regular file or is too large.
    """
    try:
        check_is_file(path, expected, largest)
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


def read_text(path: Path, expected: str, largest: int = LARGEST_TEXT) -> str:
    """Returns the text of a file, UTF-8 with or without a byte-order mark.

    Args:
        path: The file.
        expected: The expected content, such as "JSON".
        largest: Most bytes of the file.

    Raises:
        RecordingError: The file is missing, cannot be read, is too large, or is not text.
    """
    with reading(path, expected, largest):
        return path.read_text(encoding="utf-8-sig")


def load_image(path: Path) -> Shaped[np.ndarray, "height width channels"]:
    """Returns the stored values of an image with one or three channels: uint8, uint16 or float32.

    Transparent pixels are laid over white. For 16 bits and floats, `picture_depth` finds the value of full brightness.

    Raises:
        RecordingError: The file is missing or cannot be decoded, is shown turned or mirrored, is neither grey nor RGB,
            holds several pictures, or holds values of another type, below 0 or not finite.
    """
    with reading(path, "an image", LARGEST_PICTURE):
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
    with reading(path, "an image", LARGEST_PICTURE):
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
    with reading(path, "an image", LARGEST_PICTURE):
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
    with reading(path, "a NumPy array (.npy)", LARGEST_ARRAY if mmap_mode is None else None):
        with open(path, "rb") as file:
            check_npy_header(file)
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


def check_npy_header(file: IO[bytes]) -> None:
    """Checks the length of the header with which a .npy file begins. NumPy reads it as a whole before it checks it.

    Raises:
        ValueError: The header is longer than `LONGEST_NPY_HEADER`.
    """
    start = file.read(12)
    file.seek(0)
    length = int.from_bytes(start[8:12], "little")
    if start[:6] == np.lib.format.MAGIC_PREFIX and start[6:7] != b"\1" and length > LONGEST_NPY_HEADER:
        raise ValueError(f"its header states a length of {length:,} bytes")


def read_json(path: Path) -> dict[str, Any]:
    """Returns the JSON object of a file, with or without a byte-order mark.

    Raises:
        RecordingError: The file is missing or holds no JSON object.
    """
    with reading(path, "JSON"):
        value = parse_json(path, read_text(path, "JSON"))
    if not isinstance(value, dict):
        raise RecordingError(f"{path} holds a {type(value).__name__}, but a JSON object was expected.")
    return value


def parse_json(path: Path, text: str) -> Any:
    """Returns the value of JSON.

    Args:
        path: The file that the text is of.
        text: JSON.

    Raises:
        ValueError: The text is no JSON. It is a RecordingError if a value holds half of a letter of UTF-16, such as
            "\\ud83d", since no file can hold it.
    """
    value = json.loads(text)
    if "\\ud" in text.lower():
        try:
            json.dumps(value, ensure_ascii=False).encode()
        except UnicodeEncodeError as error:
            found = printable(error.object[error.start : error.start + 1])
            near = printable(error.object[max(0, error.start - 20) : error.start])
            raise RecordingError(
                f"{path} holds {found}, which is half of a letter, after {near!r}; write the letter itself, in UTF-8."
            ) from error
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


@cache
def _mark() -> str:
    """Returns the part of a temporary name before the number of its process: the machine and, on Linux, the namespace
    of its processes, since two containers on one machine do not see each other's."""
    with suppress(OSError):
        return f".partial-{platform.node()}-{os.stat('/proc/self/ns/pid').st_ino}-"
    return f".partial-{platform.node()}-"


def encode_png(pixels: Shaped[np.ndarray, "height width *channels"]) -> bytes:
    """Returns a PNG file of pixels in grey or RGB, uint8 or uint16, packed quickly rather than small."""
    in_order = pixels[..., ::-1] if pixels.ndim == 3 else pixels  # OpenCV takes BGR
    return cv2.imencode(".png", in_order, (cv2.IMWRITE_PNG_COMPRESSION, 1))[1].tobytes()


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

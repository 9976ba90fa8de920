"""Files that recordings are made of: images, arrays, JSON; and files that are written whole or not at all."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from enerf_ns.dataparsers.errors import RecordingError, UserError


@contextmanager
def of_file(path: Path) -> Iterator[None]:
    """Says of a value that does not check itself as sound which file it came from.

    Args:
        path: The file, or the folder.

    Raises:
        RecordingError: `path holds`, and what the ValueError of the block says.
    """
    try:
        yield
    except UserError:
        raise
    except ValueError as error:
        raise RecordingError(f"{path} holds {error}") from error


def load_image(path: Path) -> UInt8[np.ndarray, "height width channels"]:
    """An image file as uint8 with one or three channels; what is transparent is laid over white, 16 bits become 8.

    Raises:
        RecordingError: The file is missing or cannot be decoded.
    """
    try:
        with Image.open(path) as image:
            image.verify()  # the checksums of a PNG, which decoding passes over
        with Image.open(path) as image:
            if image.mode.startswith("I"):
                return (np.asarray(image).clip(0, 65535) // 256).astype(np.uint8)[..., None]
            grey = image.mode in ("1", "L", "LA")
            if image.mode in ("LA", "PA", "RGBA") or "transparency" in image.info:
                colors = image.convert("RGBA")
                image = Image.alpha_composite(Image.new("RGBA", image.size, "white"), colors)
            pixels = np.array(image.convert("L" if grey else "RGB"))
    except Exception as error:  # of any kind, since Pillow has some of its own for what is damaged
        raise unreadable(path, "an image", error) from error
    return pixels[..., None] if grey else pixels


def check_image_size(path: Path, width: int, height: int) -> None:
    """Reads an image's header only.

    Raises:
        RecordingError: The file is missing, no image, or not of the size in pixels.
    """
    if (found := image_size(path)) != (width, height):
        raise RecordingError(
            f"{path} has {found[0]} x {found[1]} pixels, but {width} x {height} as of the sensor were expected."
        )


def image_size(path: Path) -> tuple[int, int]:
    """Width and height in pixels, from the header only.

    Raises:
        RecordingError: The file is missing or no image.
    """
    try:
        with Image.open(path) as image:
            return image.size
    except Exception as error:  # of any kind, since Pillow has some of its own for what is damaged
        raise unreadable(path, "an image", error) from error


def load_array(path: Path, mmap_mode: str | None = None) -> Float[np.ndarray, "..."]:
    """An array of real numbers from a .npy file.

    Args:
        path: The file.
        mmap_mode: As of `numpy.load`; "r" to read the header only.

    Raises:
        RecordingError: The file is missing, or holds no such array.
    """
    try:
        array = np.load(path, mmap_mode=mmap_mode)  # type: ignore[arg-type]
    except Exception as error:  # of any kind, since NumPy parses the header as Python
        raise unreadable(path, "a NumPy array (.npy)", error) from error
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "biuf":
        raise RecordingError(f"{path} holds no array of numbers, but a .npy file of numbers was expected.")
    return array


def unreadable(path: Path, expected: str, error: Exception) -> RecordingError:
    if not path.exists():
        return RecordingError(f"{path} is missing; {expected} was expected there.")
    if path.is_file() and path.stat().st_size == 0:
        return RecordingError(f"{path} is empty; {expected} was expected.")
    reason = str(error).splitlines()[0].rstrip(".") if str(error) else type(error).__name__
    return RecordingError(f"{path} cannot be read as {expected} ({reason}); copy it again from its source.")


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object from a file, with or without a byte-order mark.

    Raises:
        RecordingError: The file is missing or holds no JSON object.
    """
    try:
        value = json.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError, RecursionError) as error:
        raise unreadable(path, "JSON", error) from error
    if not isinstance(value, dict):
        raise RecordingError(f"{path} holds a {type(value).__name__}, but a JSON object was expected.")
    return value


def write_whole(path: Path, content: str | bytes) -> None:
    """Writes a file beside its place and then renames it, so that it is whole or not there, or as it was before.

    Args:
        path: In a folder that exists.
        content: Text is encoded as UTF-8.

    Raises:
        OSError: The disk is full, or the folder cannot be written to; nothing is left then.
    """
    partial = path.with_name(f".{path.name}.partial-{os.getpid()}")
    try:
        partial.write_bytes(content.encode() if isinstance(content, str) else content)
        partial.replace(path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise

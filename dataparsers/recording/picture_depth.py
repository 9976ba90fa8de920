"""Finds the value of full brightness in images of more than 8 bits, and converts images to brightness.

An image is uint8, with 255 as full brightness, or float32 in [0, 1]. Images of 8 bits stay uint8, which needs a quarter
of the memory. Cameras of 10, 12 or 14 bits write files of 16 bits. The largest value over the whole recording shows the
number of bits. A value for each image would make the brightness jump from image to image.
"""

from __future__ import annotations

from functools import lru_cache
from io import BytesIO
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Shaped, UInt8
from PIL import Image
from PIL.TiffImagePlugin import BITSPERSAMPLE, ImageFileDirectory_v2
from rich.progress import track

from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.hdf5_files import is_deep_picture, load_picture

DEPTHS = (8, 10, 12, 14, 16)
"""Numbers of bits that a camera may have."""

LUMA = (0.299, 0.587, 0.114)
"""Weights of red, green and blue in the brightness that a grey sensor sees (ITU-R BT.601)."""


@lru_cache(maxsize=16)
def find_white_level(files: tuple[Path, ...]) -> float:
    """Returns the value of full brightness in the images of one recording with more than 8 bits.

    For integers, it is the largest number of the fewest bits of `DEPTHS` that hold all values, or the number that the
    header of a file states. For floats, it is 1, or the largest value if that is above 1. Without such images it is
    255.

    Args:
        files: All images of the recording; images of 8 bits are ignored.

    Raises:
        RecordingError: A file is missing or cannot be decoded, or some files hold integers and others floats.
    """
    largest, stated, kind = 0.0, 0.0, None
    deep = [file for file in files if is_deep_picture(file)]
    for file in track(deep, "Looking for the depth of pictures", transient=True, disable=len(deep) < 2):
        image = load_picture(file)
        if kind not in (None, image.dtype):
            raise RecordingError(
                f"{file} holds values of type {image.dtype}, but pictures before it hold {kind}; give pictures of one "
                "kind."
            )
        kind, largest = image.dtype, max(largest, float(image.max()))
        if kind == np.uint16:
            stated = max(stated, _stated_white(file))
            if max(largest, stated) >= 2 ** DEPTHS[-2]:
                break
    if kind is None:
        return 255.0
    if kind == np.float32:
        return max(largest, 1.0)
    least = max(largest, stated)
    return stated if stated == least else min(2.0**bits - 1 for bits in DEPTHS if 2**bits > least)


def brightness(picture: Shaped[np.ndarray, "height width channels"]) -> Float32[np.ndarray, "height width channels"]:
    """Returns an image in [0, 1]."""
    return picture / np.float32(255) if picture.dtype == np.uint8 else picture


def in_8_bits(picture: Shaped[np.ndarray, "height width channels"]) -> UInt8[np.ndarray, "height width channels"]:
    """Returns an image with 8 bits in each channel."""
    return picture if picture.dtype == np.uint8 else np.rint(255 * picture).astype(np.uint8)


def _stated_white(file: Path) -> int:
    """Returns the largest value that the header of a file with 16 bits states, or 0.

    PGM and PPM state it, TIFF with 10, 12 or 14 bits (which OpenCV shifts to the upper bits), and PNG with sBIT.
    """
    content = file.read_bytes()
    if content[:2] in (b"P5", b"P6"):
        with Image.open(file) as image:
            return image.tile[0][3][1] if isinstance(image.tile[0][3], tuple) else 65535
    if content[:4] in (b"II*\0", b"MM\0*"):
        directory = ImageFileDirectory_v2(content[:8])
        tags = BytesIO(content)
        tags.seek(directory.next)
        directory.load(tags)
        bits = max(directory.get(BITSPERSAMPLE, (16,)))
        return 2**16 - 2 ** (16 - bits) if bits < 16 else 0
    place = content[: content.find(b"IDAT")].find(b"sBIT")
    return 2 ** content[place + 4] - 1 if place > 0 else 0

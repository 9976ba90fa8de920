"""Reads HDF5 files that may come from anybody, and pictures and depth maps within them.

A path beyond the file names a picture: data.hdf5/davis/left/image_raw/17 is the picture number 17, from 0, of the
dataset davis/left/image_raw [pictures, height, width] in data.hdf5.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float32, Shaped

from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.files import LARGEST_ARRAY, is_deep, load_depth, load_image, reading

if TYPE_CHECKING:
    import h5py

BLOSC_FILTERS, BLOSC_PARAMETERS = (32001, 32026), 4
"""HDF5 numbers of Blosc and Blosc2, and their least number of parameters. These filters end the process if a damaged
file states fewer."""

LARGEST_CHUNK = 2**27
"""Most bytes of a chunk, which HDF5 decompresses as a whole."""

SUFFIXES = (".hdf5", ".h5")


def file_of(path: Path) -> Path:
    """Returns the file that holds a picture: the path itself, or the HDF5 file that it leads into."""
    return next((above for above in path.parents if above.suffix in SUFFIXES and above.is_file()), path)


def load_picture(path: Path) -> Shaped[np.ndarray, "height width channels"]:
    """Returns what `load_image` returns, also of a picture in an HDF5 file, which is grey with 8 bits.

    Raises:
        RecordingError: The file is missing or cannot be read.
    """
    return load_image(path) if file_of(path) == path else _load(path, "u", 1)[..., None]


def is_deep_picture(path: Path) -> bool:
    """Returns whether a picture has more than 8 bits; those in HDF5 files have 8."""
    return file_of(path) == path and is_deep(path)


def load_depth_map(path: Path) -> Float32[np.ndarray, "height width"]:
    """Returns what `load_depth` returns, also of a depth map in an HDF5 file, where NaN is unknown.

    Raises:
        RecordingError: The file is missing or cannot be read, or a depth is negative.
    """
    if file_of(path) == path:
        return load_depth(path)
    depth = _load(path, "f", 8).astype(np.float32)
    depth[~np.isfinite(depth)] = 0
    if (depth < 0).any():
        raise RecordingError(
            f"{path} holds a depth of {depth.min():g} m, but numbers from 0 on, or NaN, were expected."
        )
    return depth


def _load(path: Path, kind: str, largest_number: int) -> np.ndarray:
    """Returns a picture whose numbers are of a kind and have at most so many bytes."""
    import h5py
    import hdf5plugin  # noqa: F401  makes the filters known

    source = file_of(path)
    *names, number = path.relative_to(source).parts
    with reading(source, "an HDF5 file with pictures"), h5py.File(source, "r", locking=False) as file:
        dataset = dataset_in(source, file, "/".join(names))
        if dataset.dtype.kind != kind or dataset.dtype.itemsize > largest_number:
            raise RecordingError(f"{source} holds other values in {dataset.name} than before; read it again.")
        return dataset[int(number)]


def dataset_in(path: Path, file: h5py.File, name: str) -> h5py.Dataset:
    """Returns a dataset of a file.

    Args:
        path: The file.
        file: The open file.
        name: Names of groups and dataset, separated by slashes.

    Raises:
        RecordingError: There is none, it refers to another place, or it cannot be read without harm.
    """
    import h5py

    found = file
    for part in name.split("/"):
        found = member(path, found, part) if isinstance(found, h5py.Group) else None
    if not isinstance(found, h5py.Dataset):
        raise RecordingError(f"{path} lacks the dataset {name}, which was expected; give a file that holds it.")
    check_filters(path, found)
    if len(found.shape) > 2 and (size := math.prod(found.shape[1:]) * found.dtype.itemsize) > LARGEST_ARRAY:
        raise RecordingError(
            f"{path} holds pictures of {size:,} bytes in {name}, but at most {LARGEST_ARRAY:,} were expected."
        )
    return found


def member(path: Path, group: h5py.Group, name: str) -> h5py.Group | h5py.Dataset | h5py.Datatype | None:
    """Returns the member of a group with this name, or None.

    Raises:
        RecordingError: The member is a link, external storage or a virtual dataset. A hostile file could name another
            file of the user's disk in this way.
    """
    import h5py

    link = group.get(name, getlink=True)
    if link is None:
        return None
    member = group[name] if isinstance(link, h5py.HardLink) else None
    if member is None or (isinstance(member, h5py.Dataset) and (member.external or member.is_virtual)):
        raise RecordingError(
            f"{path} refers for {name} to another place, such as another file, and that is not followed; repack the "
            "file with the data in it."
        )
    return member


def check_filters(path: Path, dataset: h5py.Dataset) -> None:
    """Checks that a dataset can be read without harm.

    Raises:
        RecordingError: Its chunks are larger than `LARGEST_CHUNK`, or a filter is not available or lacks parameters.
    """
    import h5py

    properties = dataset.id.get_create_plist()
    if dataset.chunks and (size := math.prod(dataset.chunks) * dataset.dtype.itemsize) > LARGEST_CHUNK:
        raise RecordingError(
            f"{path} holds {dataset.name} in chunks of {size:,} bytes, each of which is read as a whole, but at most "
            f"{LARGEST_CHUNK:,} were expected; repack the file with smaller chunks."
        )
    for i in range(properties.get_nfilters()):
        number, _, parameters, name = properties.get_filter(i)
        if not h5py.h5z.filter_avail(number):
            called = f" ({name.decode(errors='replace')!r})" if name else ""
            raise RecordingError(
                f"{path} is compressed by the HDF5 filter {number}{called}, which is neither in h5py nor in "
                "hdf5plugin; install its plugin and set HDF5_PLUGIN_PATH, or repack the file without it."
            )
        if number in BLOSC_FILTERS and len(parameters) < BLOSC_PARAMETERS:
            raise RecordingError(
                f"{path} is compressed by the HDF5 filter {number} (Blosc) and lacks its parameters; copy it again "
                "from its source."
            )

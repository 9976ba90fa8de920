"""Reads HDF5 files that may come from anybody, and pictures and depth maps within them and within .npz files.

A path beyond the file names a picture: data.hdf5/davis/left/image_raw/17 is the picture number 17, from 0, of the
dataset davis/left/image_raw [pictures, height, width], perhaps with one channel, in data.hdf5; depth.npz/depth_17 is
the array depth_17 [height, width] in depth.npz.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any
from zipfile import ZipFile

import numpy as np
from jaxtyping import Float32, Shaped

from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.files import (
    LARGEST_ARRAY,
    check_npy_header,
    is_deep,
    load_depth,
    load_image,
    reading,
)

if TYPE_CHECKING:
    import h5py

BLOSC_FILTERS, BLOSC_PARAMETERS = (32001, 32026), 4
"""HDF5 numbers of Blosc and Blosc2, and their least number of parameters. These filters end the process if a damaged
file states fewer."""

LARGEST_CHUNK = 2**27
"""Most bytes of a chunk, which HDF5 decompresses as a whole."""

SUFFIXES = (".hdf5", ".h5", ".npz")


def file_of(path: Path) -> Path:
    """Returns the file that holds a picture: the path itself, or the HDF5 or .npz file that it leads into."""
    return next((above for above in path.parents if above.suffix in SUFFIXES and above.is_file()), path)


def load_picture(path: Path) -> Shaped[np.ndarray, "height width channels"]:
    """Returns what `load_image` returns, also of a picture in an HDF5 file, which is grey with 8 bits.

    Raises:
        RecordingError: The file is missing or cannot be read.
    """
    if file_of(path) == path:
        return load_image(path)
    picture = _load(path)
    if picture.dtype != np.uint8:
        raise RecordingError(f"{path} holds a picture of {picture.dtype}, but 8 bits were expected; read it again.")
    return picture[..., None]


def is_deep_picture(path: Path) -> bool:
    """Returns whether a picture has more than 8 bits; those in HDF5 files have 8."""
    return file_of(path) == path and is_deep(path)


def load_depth_map(path: Path) -> Float32[np.ndarray, "height width"]:
    """Returns what `load_depth` returns, also of a depth map in an HDF5 or .npz file.

    There, whole numbers are millimetres, and 0 is unknown; floats are metres, and NaN is unknown, too.

    Raises:
        RecordingError: The file is missing or cannot be read, or a depth is negative.
    """
    if file_of(path) == path:
        return load_depth(path)
    stored = _load(path)
    depth = stored.astype(np.float32) * np.float32(1e-3 if stored.dtype.kind == "u" else 1)
    depth[~np.isfinite(depth)] = 0
    if (depth < 0).any():
        raise RecordingError(
            f"{path} holds a depth of {depth.min():g} m, but numbers from 0 on, or NaN, were expected."
        )
    return depth


def _load(path: Path) -> np.ndarray:
    source = file_of(path)
    *names, last = path.relative_to(source).parts
    with reading(source, "a file with pictures"):
        if source.suffix == ".npz":
            return _load_from_npz(source, last)
        with open_hdf5(source) as file:
            dataset = dataset_in(source, file, "/".join(names), "pictures")
            shape = dataset.shape[1:3] + dataset.shape[3:] * (dataset.shape[3:] != (1,))
            _checked(source, dataset.dtype, shape)
            return dataset[int(last)].reshape(shape)


def _load_from_npz(source: Path, name: str) -> np.ndarray:
    with ZipFile(source) as archive, archive.open(f"{name}.npy") as member:
        check_npy_header(member)
        major, _ = np.lib.format.read_magic(member)
        header = np.lib.format.read_array_header_1_0 if major == 1 else np.lib.format.read_array_header_2_0
        shape, by_column, kind = header(member)
        _checked(source, kind, shape)
        content = member.read(math.prod(shape) * kind.itemsize)
        return np.frombuffer(content, kind).reshape(shape, order="F" if by_column else "C")


def _checked(source: Path, kind: np.dtype, shape: tuple[int, ...]) -> None:
    """Checks that an array is a picture before it is read."""
    size = math.prod(shape) * kind.itemsize
    if kind.kind not in "uf" or len(shape) != 2 or size > LARGEST_ARRAY:
        raise RecordingError(
            f"{source} holds a picture as {kind} of shape {shape}, but numbers [height, width] of at most "
            f"{LARGEST_ARRAY:,} bytes were expected; read it again."
        )


def open_hdf5(path: Path, **options: Any) -> h5py.File:
    """Returns an HDF5 file that is open for reading, with the filters of hdf5plugin; options are those of h5py."""
    import h5py
    import hdf5plugin  # noqa: F401  makes the filters known

    return h5py.File(path, "r", locking=False, **options)


def member_at(path: Path, group: h5py.Group, name: str) -> h5py.Group | h5py.Dataset | h5py.Datatype | None:
    """Returns the member with this name, which has / between its parts, or None. It raises what `member` raises."""
    import h5py

    *above, last = name.split("/")
    for part in above:
        inner = member(path, group, part)
        if not isinstance(inner, h5py.Group):
            return None
        group = inner
    return member(path, group, last)


def read_dataset(path: Path, file: h5py.File, name: str, expected: str, shape: tuple[int | None, ...]) -> np.ndarray:
    """Returns a dataset of real numbers that is read as a whole.

    Args:
        path: The file, for error messages.
        file: The same, opened.
        name: Name of the dataset, with / between its parts.
        expected: The expected content, such as "poses, 4 x 4 numbers each".
        shape: Its shape, with None for a length that is free.

    Raises:
        RecordingError: It is missing, has another shape or type, is larger than `LARGEST_ARRAY`, or cannot be read.
    """
    dataset = dataset_at(path, file, name, expected, shape)
    if dataset.size * dataset.dtype.itemsize > LARGEST_ARRAY:
        raise RecordingError(
            f"{path} holds {name} of {dataset.size:,} numbers, but {expected} of at most {LARGEST_ARRAY:,} bytes was "
            "expected; give a part of it."
        )
    return np.asarray(dataset[...])


def dataset_at(
    path: Path, file: h5py.File, name: str, expected: str, shape: tuple[int | None, ...], kinds: str = "iuf"
) -> h5py.Dataset:
    """Returns a dataset of numbers, of which only the header is read.

    Args:
        path, file, name, expected, shape: The arguments of `read_dataset`.
        kinds: Kinds of numbers that it may hold, as NumPy's `dtype.kind`.

    Raises:
        RecordingError: It is missing, has another shape or kind, or cannot be read without harm.
    """
    dataset = dataset_in(path, file, name, expected)
    fits = len(dataset.shape) == len(shape) and all(
        want in (None, length) for want, length in zip(shape, dataset.shape, strict=True)
    )
    if not fits or dataset.dtype.kind not in kinds:
        wanted = " x ".join("n" if length is None else str(length) for length in shape) or "one number"
        raise RecordingError(
            f"{path} holds {name} as {dataset.dtype} of shape {dataset.shape}, but numbers of shape {wanted} were "
            f"expected: {expected}."
        )
    return dataset


def dataset_in(path: Path, file: h5py.File, name: str, expected: str) -> h5py.Dataset:
    """Returns a dataset of a file, of any shape and kind; the arguments are those of `read_dataset`.

    Raises:
        RecordingError: There is none, it refers to another place, or it cannot be read without harm.
    """
    import h5py

    found = member_at(path, file, name)
    if not isinstance(found, h5py.Dataset):
        raise RecordingError(f"{path} lacks the dataset {name}, {expected}; get the file as it is published.")
    check_filters(path, found)
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

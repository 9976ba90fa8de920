"""Reads calibrations in YAML, as Kalibr and ROS write them, of limited size."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

from enerf_ns.dataparsers.formats.json_values import Value
from enerf_ns.dataparsers.recording.camera import Camera, CameraModel
from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.files import LONGEST_LINE, files_in, read_text

if TYPE_CHECKING:
    import yaml

LARGEST_YAML, MOST_VALUES = 2**18, 10_000
"""Most bytes and most values of a file. Kalibr writes a few thousand bytes and a hundred values."""

KALIBR_MODELS: dict[str, CameraModel] = {"radtan": "radtan", "equidistant": "fisheye", "none": "pinhole"}
"""Camera models of this package by Kalibr's name of the distortion model."""


def find_calibration(folder: Path, pattern: str) -> Path | None:
    """Returns the first file of a pattern in a folder or, without one, in the calibration folders beside it."""
    places = [folder, *files_in(folder.parent, "*[cC]alib*/"), *files_in(folder.parent, "*[cC]alib*/*/")]
    return next((path for place in places for path in files_in(place, pattern)), None)


def read_yaml(path: Path, expected: str) -> tuple[str, Value]:
    """Returns the text of a YAML file and its value.

    Args:
        path: The file.
        expected: The expected content, such as "a Kalibr camchain".

    Raises:
        RecordingError: The file is missing, is larger than `LARGEST_YAML`, is no YAML, or holds more than
            `MOST_VALUES`, counting those that aliases repeat.
    """
    import yaml

    class Loader(yaml.SafeLoader):
        """Reads 1e-05 as a number. YAML 1.1 takes it for text."""

    Loader.add_implicit_resolver("tag:yaml.org,2002:float", re.compile(r"[-+]?\d+[eE][-+]?\d+$"), [*"-+0123456789"])
    text = read_text(path, expected, LARGEST_YAML)
    try:
        loader = Loader(text)
        node = loader.get_single_node()
        if node is not None:
            _num_values(node, {})
        return text, Value(path, None if node is None else loader.construct_document(node))
    except Exception as error:  # PyYAML raises other ones for wrong values of each type
        mark = getattr(error, "problem_mark", None)
        line = f", line {mark.line + 1}," if mark else ""
        found = f" ({error})" if type(error) is ValueError else ""
        raise RecordingError(f"{path}{line} cannot be read as YAML{found}, but {expected} was expected.") from error


def kalibr_camera(entry: Value) -> Camera:
    """Returns the camera of an entry of a Kalibr camchain, such as cam0."""
    entry["camera_model"].choice(("pinhole",))
    model = KALIBR_MODELS[entry["distortion_model"].choice(KALIBR_MODELS)]
    intrinsics, size = entry["intrinsics"].numbers((4,)).tolist(), entry["resolution"].numbers((2,)).tolist()
    distortion = () if model == "pinhole" else entry["distortion_coeffs"].numbers((4,)).tolist()
    return entry.camera(size, intrinsics, distortion, model)


def _num_values(node: yaml.Node, known: dict[int, int]) -> int:
    """Returns the number of values below a node of YAML, with those that aliases repeat.

    Args:
        node: The node.
        known: The numbers of nodes that were counted before, by their id.

    Raises:
        ValueError: There are more than `MOST_VALUES`, a value holds itself, or a value is too long.
    """
    if len(node.value) > (LONGEST_LINE if isinstance(node.value, str) else MOST_VALUES):
        raise ValueError(f"a value of {len(node.value):,} letters or parts")
    if isinstance(node.value, str):
        return 1
    if id(node) not in known:
        known[id(node)] = MOST_VALUES + 1  # while its own values are counted, among which it must not be
        items = [item if isinstance(item, tuple) else (item,) for item in node.value]  # those of a mapping are pairs
        known[id(node)] = 1 + sum(_num_values(part, known) for item in items for part in item)
    if known[id(node)] > MOST_VALUES:
        raise ValueError(f"aliases that repeat values more than {MOST_VALUES:,} times")
    return known[id(node)]

"""Reads YAML of calibrations with limits of size, since aliases in a small file can take all memory."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

from enerf_ns.dataparsers.formats.json_values import Value
from enerf_ns.dataparsers.recording.errors import RecordingError
from enerf_ns.dataparsers.recording.files import LONGEST_LINE, read_text

if TYPE_CHECKING:
    import yaml

LARGEST_YAML, MOST_VALUES = 2**18, 10_000
"""Most bytes and most values of a calibration. Kalibr writes a few thousand bytes and a hundred values."""


def open_yaml(path: Path, expected: str) -> Value:
    """Returns the content of a YAML file.

    Args:
        path: The file.
        expected: The expected content, such as "a Kalibr camchain".

    Raises:
        RecordingError: The file is missing, too large or not YAML.
    """
    return parse_yaml(path, read_text(path, expected, LARGEST_YAML), expected)


def parse_yaml(path: Path, text: str, expected: str) -> Value:
    """Returns the content of YAML.

    Args:
        path: The file that the text is of.
        text: YAML.
        expected: The expected content, such as "a Kalibr camchain".

    Raises:
        RecordingError: The text is no YAML, or holds more than `MOST_VALUES`.
    """
    import yaml

    class Loader(yaml.SafeLoader):
        """Reads 1e-05 as a number. YAML 1.1 takes it for text."""

    Loader.add_implicit_resolver("tag:yaml.org,2002:float", re.compile(r"[-+]?\d+[eE][-+]?\d+$"), [*"-+0123456789"])
    try:
        loader = Loader(text)
        node = loader.get_single_node()
        if node is not None:
            _num_values(node, {})
        return Value(path, None if node is None else loader.construct_document(node))
    except Exception as error:  # PyYAML raises other ones for wrong values of each type
        mark = getattr(error, "problem_mark", None)
        line = f", line {mark.line + 1}," if mark else ""
        found = f" ({error})" if type(error) is ValueError else ""
        raise RecordingError(f"{path}{line} cannot be read as YAML{found}, but {expected} was expected.") from error


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

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from enerf_ns.dataparsers.formats.json_values import parse_array, parse_numbers, shown
from enerf_ns.dataparsers.recording.errors import RecordingError

FILE = Path("about.json")


def test_nested_lists_become_arrays():
    found = parse_array([[1, 2.5], [3, 4]], (2, 2))
    assert found.dtype == np.float64 and found.tolist() == [[1, 2.5], [3, 4]]
    assert parse_numbers(FILE, "size", [3, 4], (2,), "two numbers").tolist() == [3, 4]


@pytest.mark.parametrize(
    "value", [None, "12", [1], [1, 2, 3], [1, True], [1, "2"], [1, None], [1, float("nan")], [1, 10**400], [[1], [2]]]
)
def test_what_is_something_else_is_refused_and_shown(value: Any):
    with pytest.raises(ValueError, match=r"expected|too large"):
        parse_array(value, (2,))
    with pytest.raises(RecordingError, match=r"^about\.json holds size = .*, but two numbers were expected\.$"):
        parse_numbers(FILE, "size", value, (2,), "two numbers")


def test_what_is_long_is_shown_in_part():
    assert shown([1, 2]) == "[1, 2]"
    assert len(shown(list(range(1000)))) <= 60 and shown(list(range(1000))).endswith("...")

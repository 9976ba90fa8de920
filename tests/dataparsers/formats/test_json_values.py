from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from enerf_ns.dataparsers.formats.json_values import Value, shown
from enerf_ns.dataparsers.recording.errors import RecordingError

FILE = Path("about.json")


def value(found: Any, name: str = "size") -> Value:
    return Value(FILE, found, name)


def test_nested_lists_become_arrays():
    found = value([[1, 2.5], [3, 4]]).numbers((2, 2))
    assert found.dtype == np.float64 and found.tolist() == [[1, 2.5], [3, 4]]
    assert Value(FILE, {"size": [3, 4]}).pair("size") == (3, 4)


@pytest.mark.parametrize(
    "found", [None, "12", [1], [1, 2, 3], [1, True], [1, "2"], [1, None], [1, float("nan")], [1, 10**400], [[1], [2]]]
)
def test_what_is_something_else_is_refused_and_shown(found: Any):
    with pytest.raises(RecordingError, match=r"^about\.json holds size = .*, but two numbers were expected\.$"):
        value(found).numbers((2,), "two numbers were")
    with pytest.raises(RecordingError, match=r"^about\.json holds size = .*, but 2 numbers were expected\.$"):
        value(found).numbers((2,))


def test_errors_name_the_place_in_the_file():
    whole = Value(FILE, {"cameras": [{"fx": "wide"}], "none": None})
    with pytest.raises(RecordingError, match=r'^about\.json holds cameras\[0\]\.fx = "wide", but a number was'):
        whole["cameras"][0].each("fx")
    for place in (lambda: whole["cameras"][1], lambda: whole["cameras"][0]["fy"], lambda: whole["none"]["fx"]):
        with pytest.raises(RecordingError, match=r"^about\.json lacks (cameras\[1\]|cameras\[0\]\.fy|none), which was"):
            place()
    assert whole.get("none") is None and whole.get("other") is None and whole.nanoseconds("other") is None


@pytest.mark.parametrize(
    ("matrix", "words"),
    [
        (np.eye(3).tolist(), "but a matrix of 4 x 4 numbers was expected"),
        ((2 * np.eye(4)).tolist(), "whose upper left 3 x 3 part is no rotation"),
        ((np.eye(4) + np.diag([0.1], -3)).tolist(), r"whose last row is \[0.1, 0.0, 0.0, 1.0\]"),
    ],
)
def test_a_pose_is_a_rotation_and_a_position(matrix: list, words: str):
    with pytest.raises(RecordingError, match=words):
        value(matrix).pose()
    assert (value(np.eye(4).tolist()).pose() == np.eye(4)).all()


def test_what_is_long_is_shown_in_part():
    assert shown([1, 2]) == "[1, 2]"
    assert len(shown(list(range(1000)))) <= 60 and shown(list(range(1000))).endswith("...")


def test_what_json_cannot_hold_is_shown_too():
    circle: list = []
    circle.append(circle)
    assert shown(circle) == "list" and shown({(1, 2): 3}) == "dict"

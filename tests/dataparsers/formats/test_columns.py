from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from enerf_ns.dataparsers.formats.columns import LATEST, check_columns, check_times, unit_quaternions
from enerf_ns.dataparsers.recording.errors import RecordingError

FILE = Path("events.h5")


def columns(**changed: np.ndarray) -> dict[str, np.ndarray]:
    return {name: np.zeros(3, np.uint16) for name in "xytp"} | changed


def test_columns_of_one_length_and_of_whole_numbers_are_right():
    check_columns(FILE, columns(p=np.zeros(3, bool)), "ns")


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        (
            {"t": np.zeros(3)},
            r"holds t as float64 of shape \(3,\), but .* \(t in microseconds\) was expected; save it with .*int64",
        ),
        (
            {name: np.linspace(0, 0.5, 10**5) if name == "t" else np.zeros(10**5, int) for name in "xytp"},
            r"holds t as float64, up to 0\.5, which look like seconds, but whole microseconds were expected; save "
            r"np\.rint\(t \* 1e\+06\)\.astype\(np\.int64\)\.",
        ),
        ({"x": np.zeros(3, bool)}, "holds x as bool"),
        ({"y": np.zeros((3, 1), int)}, r"holds y as int64 of shape \(3, 1\)"),
        ({"y": np.zeros(2, int)}, "holds 3 x, 2 y, 3 t, 3 p, but as many of each"),
        ({name: np.zeros(0, int) for name in "xytp"}, "holds no events"),
    ],
)
def test_other_columns_are_refused(changed: dict[str, np.ndarray], words: str):
    with pytest.raises(RecordingError, match=rf"^events\.h5 {words}"):
        check_columns(FILE, columns(**changed), "us")


@pytest.mark.parametrize(("unit", "limit", "named"), [("ns", LATEST, "nano"), ("us", LATEST // 1000, "micro")])
def test_times_lie_within_146_years(unit: str, limit: int, named: str):
    check_times(FILE, np.array([1 - limit, limit - 1]), unit)
    check_times(FILE, np.array([limit], np.uint64), unit, offset=-1)
    for times, offset in (([limit], 0), ([-limit], 0), ([limit - 1], 1)):
        with pytest.raises(RecordingError, match=f"{unit}, which is beyond 146 years; {named}seconds were expected"):
            check_times(FILE, np.array(times), unit, offset)


def test_a_date_in_another_unit_is_named():
    with pytest.raises(RecordingError, match=r"these look like nanoseconds, so divide them by 1,000\."):
        check_times(FILE, np.array([1_700_000_000 * 10**9]), "us")


def test_poses_beyond_all_measure_are_refused_by_their_place():
    good, notes = np.array([[0.0, 0, 0, 1]]), []
    assert (unit_quaternions(FILE, np.ones((1, 3)), 1.0001 * good, notes, str) == good).all() and len(notes) == 1
    for position, quaternion, words in (
        ([np.nan, 0, 0], good, "row 0, holds the position"),
        ([2e9, 0, 0], good, "row 0, holds the position"),
        ([0, 0, 0], good * np.nan, "row 0, holds a quaternion of norm nan"),
        ([0, 0, 0], good * 1.01, "row 0, holds a quaternion of norm 1.01"),
    ):
        with pytest.raises(RecordingError, match=words):
            unit_quaternions(FILE, np.array([position]), quaternion, [], lambda row: f"row {row}")

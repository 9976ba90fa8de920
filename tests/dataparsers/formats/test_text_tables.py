from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from enerf_ns.dataparsers.formats.text_tables import parse_times, read_poses, read_rows, read_times
from enerf_ns.dataparsers.recording.errors import RecordingError


def table(folder: Path, text: str) -> Path:
    (folder / "table.txt").write_text(text, encoding="utf-8")
    return folder / "table.txt"


def test_comments_headers_and_empty_lines_are_passed_over(tmp_path: Path):
    rows, numbers = read_rows(table(tmp_path, "time value\n# made by hand\n\n1 2\n\n3\t4\n"), "t_s value")
    assert rows == [["1", "2"], ["3", "4"]] and numbers == [4, 6]


def test_a_byte_order_mark_is_no_part_of_the_first_number(tmp_path: Path):
    assert read_rows(table(tmp_path, "\ufeff1 2\n"), "t_s value")[0] == [["1", "2"]]


@pytest.mark.parametrize(("unit", "factor"), [("s", 10**9), ("us", 1000), ("ns", 1)])
def test_times_are_exact_however_many_digits_they_have(tmp_path: Path, unit: str, factor: int):
    cells = ["1468939802.123456789", "1468939802.123456790", "1.4689398021234567915e9", "1500000000"]
    expected = [round(Fraction(cell) * factor) for cell in cells]
    if len(set(expected)) == len(expected):
        np.testing.assert_array_equal(parse_times(tmp_path, cells, [1, 2, 3, 4], unit), expected)
    else:
        with pytest.raises(RecordingError, match="which is not after that of the row before"):
            parse_times(tmp_path, cells, [1, 2, 3, 4], unit)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1\n2 3\n", r"table\.txt, line 2 has 2 columns, but 1 were expected: t_s"),
        ("1\nx\n", r"table\.txt, line 2 holds 'x' where a finite number was expected"),
        ("1\ninf\n", r"table\.txt, line 2 holds 'inf' where a finite number was expected"),
        ("1\n1_0\n", r"table\.txt, line 2 holds '1_0' where a finite number was expected"),
        ("2\n1\n", r"table\.txt, line 2 has the time 1 s, which is not after that of the row before"),
        ("1e30\n", r"table\.txt, line 1 holds the time 1e30 s, which is beyond 146 years"),
        ("# nothing\n", r"table\.txt is empty"),
    ],
)
def test_what_is_no_table_of_times_is_refused_with_its_line(tmp_path: Path, text: str, message: str):
    with pytest.raises(RecordingError, match=message):
        read_times(table(tmp_path, text), "s")


def test_poses_are_normalised_with_a_note_and_refused_far_off(tmp_path: Path):
    notes: list[str] = []
    times, positions, quaternions = read_poses(
        table(tmp_path, "0 1 2 3 0 0 0 1.0005\n1 1 2 4 0.6 0 0 0.8\n"), "s", notes
    )
    np.testing.assert_array_equal(times, [0, 10**9])
    np.testing.assert_array_equal(positions, [[1, 2, 3], [1, 2, 4]])
    np.testing.assert_allclose(quaternions, [[0, 0, 0, 1], [0.6, 0, 0, 0.8]], atol=1e-15)
    assert len(notes) == 1 and notes[0].startswith("1 of 2 quaternions in table.txt were off norm 1 by up to 0.0005")
    with pytest.raises(RecordingError, match=r"line 2, holds a quaternion of norm 1\.1"):
        read_poses(table(tmp_path, "0 1 2 3 0 0 0 1\n1 1 2 3 0 0 0 1.1\n"), "s", [])

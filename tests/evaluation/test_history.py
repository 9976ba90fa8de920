"""Histories on the disk, whole and damaged."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from enerf_ns.evaluation.history import HISTORY_FILE, HistoryRow, append_row, cut_history, read_history

ROWS = [HistoryRow(step, 0.5 * step, {"event_loss": 1.0 / step}, {"psnr": 20.0}, 2) for step in (1, 2, 4)]
ROWS.append(
    HistoryRow(
        5, 2.5, parts={"draw": 0.1}, final=True, not_scored={"psnr": {"no brightness fits": [0, 2]}}, protocol="raw"
    )
)


def written(folder: Path) -> Path:
    for row in ROWS:
        append_row(folder, row)
    return folder / HISTORY_FILE


def test_rows_are_stored_as_they_are_and_cut_behind_a_step(tmp_path: Path):
    assert read_history(tmp_path) == cut_history(tmp_path, 3) == []
    written(tmp_path)
    assert read_history(tmp_path) == ROWS
    assert cut_history(tmp_path, 5) == ROWS[:3] == read_history(tmp_path)
    assert cut_history(tmp_path, 3) == ROWS[:2] == read_history(tmp_path)


@pytest.mark.parametrize(
    "damage",
    [
        b"\xff\xfe\x00", b"\x00" * 64, b'{"step": "\xff', b"\xef\xbb\xbf", b'{"step": 5, "sec', b"[1, 2.0]", b"{}",
        b"5", b"null", b"", b'{"step": 5, "seconds": 1, "of another version": 0}', b'{"step": "one", "seconds": 1}',
        b'{"step": 5, "seconds": null}', b'{"step": 5, "seconds": NaN}', b'{"step": 5, "seconds": 1, "losses": [1]}',
        b'{"step": 5, "seconds": 1, "scores": null}',
    ],
)  # fmt: skip
def test_a_history_ends_before_the_first_line_that_is_no_row(tmp_path: Path, damage: bytes):
    """At whatever line: those after it are not to be trusted; and cut, it is whole again."""
    lines = written(tmp_path).read_bytes().splitlines()
    for number in range(len(lines) + 1):
        content = b"\n".join([*lines[:number], damage, *lines[number:]]) + b"\n"
        (tmp_path / HISTORY_FILE).write_bytes(content)
        assert read_history(tmp_path) == ROWS[:number]
    assert cut_history(tmp_path, 9) == ROWS[:3]
    append_row(tmp_path, ROWS[3])
    assert read_history(tmp_path) == ROWS


def test_a_file_cut_anywhere_has_the_rows_before(tmp_path: Path):
    file = written(tmp_path)
    content = file.read_bytes()
    for length in range(len(content)):
        file.write_bytes(content[:length])
        assert read_history(tmp_path) == ROWS[: len([1 for row in content[: length + 1].split(b"}\n")]) - 1]


@pytest.mark.parametrize("nothing", [math.nan, math.inf, -math.inf, None])
def test_numbers_that_are_not_finite_are_neither_written_nor_read(tmp_path: Path, nothing: float):
    row = HistoryRow(1, 2.0, {"event_loss": nothing, "sum": 1.0}, {"psnr": nothing, "ssim": 1.0}, 3, {"draw": nothing})
    expected = HistoryRow(1, 2.0, {"sum": 1.0}, {"ssim": 1.0}, 3)
    append_row(tmp_path, row)
    text = (tmp_path / HISTORY_FILE).read_text()
    json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))
    assert read_history(tmp_path) == [expected] and "null" not in text
    (tmp_path / HISTORY_FILE).write_text(json.dumps(vars(row)) + "\n")
    assert read_history(tmp_path) == [expected]

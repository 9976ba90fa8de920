"""Every case of `enerf check-numerics` passes, and one that does not hold does not."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from enerf_ns.bench.numerics.all_cases import CASES
from enerf_ns.bench.numerics.case import Case, as_json, as_table, run
from enerf_ns.scripts.check_numerics import CheckNumerics


@pytest.mark.sweep(16)
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_numbers_hold(case: Case):
    result = run(case)
    assert result.passed, result


def test_every_case_has_a_name_of_its_own_and_is_listed_on_their_page():
    names = [case.name for case in CASES]
    assert len(set(names)) == len(names)
    page = (Path(__file__).parents[1] / "docs" / "numerics.md").read_text()
    assert [name for name in names if f"| {name} |" not in page] == []


def raises() -> float:
    raise ZeroDivisionError("by | zero")


@pytest.mark.parametrize(
    ("measure", "passed"),
    [(lambda: 0.5, True), (lambda: 0.6, False), (lambda: math.nan, False), (lambda: math.inf, False), (raises, False)],
)
def test_a_case_passes_up_to_its_bound_alone(measure, passed: bool):
    result = run(Case("name", "expected", 0.5, "m", measure))
    assert result.passed == passed and (result.error is None) == (measure is raises)
    (row,) = as_table([result]).rows
    assert row[:2] == ["name", "expected"] and row[-1] == ("pass" if passed else "FAIL")
    assert json.loads(as_json([result]))[0]["passed"] == passed


def test_the_command_writes_both_tables_and_says_what_fails(tmp_path: Path, monkeypatch, capsys):
    cases = [Case("sound", "nothing", 0.0, "", lambda: 0.0), Case("ill", "nothing", 0.0, "", lambda: 1.0)]
    monkeypatch.setattr("enerf_ns.bench.numerics.all_cases.CASES", cases)
    with pytest.raises(SystemExit, match=r"enerf: 1 of 2 cases fail: ill\."):
        CheckNumerics(tmp_path / "numerics").main()
    stored = json.loads((tmp_path / "numerics/numerics.json").read_text())
    assert [result["passed"] for result in stored] == [True, False]
    assert (tmp_path / "numerics/numerics.md").read_text().count("\n") == 4
    assert "2 cases" in capsys.readouterr().out
    monkeypatch.setattr("enerf_ns.bench.numerics.all_cases.CASES", cases[:1])
    CheckNumerics().main()

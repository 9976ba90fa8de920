"""Extreme cases with their expected results and bounds of their errors."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass

from enerf_ns.report.tables import Table

Measure = Callable[[], float]
"""Computes the error of a case: a distance from a closed form or float64, or the number of faults."""


@dataclass(frozen=True)
class Case:
    """One extreme case."""

    name: str
    expected: str
    """Expected result, in words."""
    bound: float
    """Largest error that passes."""
    unit: str
    """Unit of the error and its bound."""
    measure: Measure


@dataclass(frozen=True)
class Result:
    """The outcome of one case."""

    case: Case
    error: float | None
    """None: the case raised an error."""
    failure: str
    """The error that the case raised."""
    seconds: float

    @property
    def passed(self) -> bool:
        """Whether the error is a number within the bound."""
        return self.error is not None and self.error <= self.case.bound


CASES: list[Case] = []
"""Cases of all imported modules. `enerf_ns.bench.numerics.all_cases` imports all modules."""


def case(name: str, expected: str, bound: float = 0.0, unit: str = "") -> Callable[[Measure], Measure]:
    """Returns a decorator that registers a function as the measure of a case.

    Args:
        name: Name of the case.
        expected: Expected result, in words.
        bound: Largest error that passes.
        unit: Unit of the error.
    """

    def register(measure: Measure) -> Measure:
        CASES.append(Case(name, expected, bound, unit, measure))
        return measure

    return register


def run(case: Case) -> Result:
    """Computes a case. A case that raises an error, or whose error is NaN, does not pass."""
    start = time.perf_counter()
    error, failure = None, ""
    try:
        error = float(case.measure())
    except Exception as raised:  # any error is a result
        failure = f"{type(raised).__name__}: {raised}"
    return Result(case, error, failure, time.perf_counter() - start)


def as_table(results: list[Result]) -> Table:
    """A table with a row for each case."""
    rows = []
    for result in results:
        case = result.case
        error = result.failure if result.error is None else shown(result.error, case.unit)
        verdict = "pass" if result.passed else "FAIL"
        rows.append([case.name, case.expected, error, shown(case.bound, case.unit), verdict])
    note = f"{len(results)} cases, {sum(result.seconds for result in results):.0f} s"
    return Table("Numbers at the extremes", ["case", "expected", "error", "at most", "result"], rows, note, 5)


def as_json(results: list[Result]) -> str:
    """The results as a list of objects."""
    objects = [
        {"name": result.case.name, "expected": result.case.expected, "error": result.error, "bound": result.case.bound,
         "unit": result.case.unit, "passed": result.passed, "seconds": result.seconds, "failure": result.failure}
        for result in results
    ]  # fmt: skip
    return json.dumps(objects, indent=2) + "\n"


def shown(value: float, unit: str) -> str:
    """An error with its unit, as tables show it."""
    return f"{value:.2g} {unit}".rstrip()

"""Extreme cases, each with what is expected, and how far from it the package may be."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass

Measure = Callable[[], float]
"""Computes the error of a case: its distance from a closed form or float64, or how many things went wrong."""


@dataclass(frozen=True)
class Case:
    """One extreme case."""

    name: str
    expected: str
    """What is expected, in words."""
    bound: float
    """Largest error that passes."""
    unit: str
    """Of the error and its bound."""
    measure: Measure


@dataclass(frozen=True)
class Result:
    """What was measured of a case."""

    name: str
    expected: str
    error: float | None
    """Error; None where the case could not be computed."""
    bound: float
    unit: str
    passed: bool
    seconds: float
    failure: str = ""
    """Why the case could not be computed."""


CASES: list[Case] = []
"""All cases of the modules that are imported; `enerf_ns.bench.numerics.all_cases` imports all."""


def case(name: str, expected: str, bound: float = 0.0, unit: str = "") -> Callable[[Measure], Measure]:
    """Makes a case of the function that computes its error.

    Args:
        name: What is extreme.
        expected: What is expected, in words.
        bound: Largest error that passes.
        unit: Of the error.
    """

    def register(measure: Measure) -> Measure:
        CASES.append(Case(name, expected, bound, unit, measure))
        return measure

    return register


def run(case: Case) -> Result:
    """Computes a case. One that raises, or whose error is not a number, has not passed."""
    start = time.perf_counter()
    error, failure = None, ""
    try:
        error = float(case.measure())
    except Exception as raised:  # whatever it is, it is the result
        failure = f"{type(raised).__name__}: {raised}"
    passed = error is not None and error <= case.bound
    seconds = time.perf_counter() - start
    return Result(case.name, case.expected, error, case.bound, case.unit, passed, seconds, failure)


def as_markdown(results: list[Result]) -> str:
    """A table with a line for each case."""
    return "\n".join(["| case | expected | error | at most | |", "|---|---|---|---|---|", *_lines(results)]) + "\n"


def as_json(results: list[Result]) -> str:
    """The results as a list of objects."""
    return json.dumps([asdict(result) for result in results], indent=2) + "\n"


def _lines(results: list[Result]) -> Iterator[str]:
    for result in results:
        error = shown(result.error, result.unit) if result.error is not None else result.failure
        bound, verdict = shown(result.bound, result.unit), "pass" if result.passed else "**fail**"
        yield f"| {result.name} | {result.expected} | {error} | {bound} | {verdict} |"


def shown(value: float, unit: str) -> str:
    """An error with its unit, as tables show it."""
    return f"{value:.2g} {unit}".rstrip()

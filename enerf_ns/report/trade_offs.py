"""Quality of runs against their time: the Pareto front, and the time to reach a score."""

from __future__ import annotations

from collections.abc import Sequence
from math import floor

from enerf_ns.evaluation.history import HistoryRow

NUM_TARGETS, TARGET_STEP = 4, 2
"""Number of default targets, and their distance in dB."""


def pareto_front(costs: Sequence[tuple[float, float]]) -> list[bool]:
    """Whether each pair of costs, such as time and error, is on the Pareto front.

    A pair is on the front if no other pair is as low in both costs and lower in one.
    """
    front, best = [False] * len(costs), float("inf")
    order = sorted(range(len(costs)), key=lambda number: costs[number])
    for place, number in enumerate(order):
        before = order[place - 1]
        is_same = place > 0 and costs[number] == costs[before]
        front[number] = front[before] if is_same else costs[number][1] < best
        best = min(best, costs[number][1])
    return front


def seconds_to_reach(history: Sequence[HistoryRow], score: str, target: float) -> tuple[float, bool] | None:
    """Training time after which a run first reaches a score.

    Args:
        history: Rows, oldest first.
        score: Name of a score that is better the higher it is.
        target: Value to reach.

    Returns:
        Seconds, interpolated linearly between the first row that reaches the target and the row before it; and whether
        the first row of all reaches it, so that the seconds are an upper bound. None: no row reaches the target.
    """
    before: tuple[float, float] | None = None
    for row in history:
        value = row.scores.get(score)
        if value is None:
            continue
        if value >= target:
            if before is None:
                return row.seconds, True
            seconds, lower = before
            return seconds + (row.seconds - seconds) * (target - lower) / (value - lower), False
        before = row.seconds, value
    return None


def default_targets(histories: Sequence[Sequence[HistoryRow]], score: str) -> list[float]:
    """Up to `NUM_TARGETS` values that some run reaches and that lie above the lowest value of all runs."""
    values = [row.scores[score] for history in histories for row in history if score in row.scores]
    if not values:
        return []
    highest = floor(max(values) / TARGET_STEP) * TARGET_STEP
    targets = [float(highest - TARGET_STEP * number) for number in reversed(range(NUM_TARGETS))]
    return [target for target in targets if target > min(values)]

"""How good a run is for the time it took: the Pareto front of several, and the time to reach a score."""

from __future__ import annotations

from collections.abc import Sequence
from math import floor

from enerf_ns.evaluation.history import HistoryRow

NUM_TARGETS, TARGET_STEP = 4, 2
"""Number of scores to reach that are chosen from the data, and how many dB they lie apart."""


def pareto_front(costs: Sequence[tuple[float, float]]) -> list[bool]:
    """Of each pair of costs, such as time and error, whether no other is as low in both and lower in one."""
    front, best = [False] * len(costs), float("inf")
    order = sorted(range(len(costs)), key=lambda number: costs[number])
    for place, number in enumerate(order):
        before = order[place - 1]
        is_same = place > 0 and costs[number] == costs[before]
        front[number] = front[before] if is_same else costs[number][1] < best
        best = min(best, costs[number][1])
    return front


def seconds_to_reach(history: Sequence[HistoryRow], score: str, target: float) -> tuple[float, bool] | None:
    """Training time after which a score, of which more is better, is reached for the first time.

    Args:
        history: Oldest row first.
        score: Its name among the scores of a row.
        target: What it is to reach.

    Returns:
        Seconds, by linear interpolation between the first row that reaches it and the one before; and whether that
        one is the first of all, so that it was reached at some time before. None: never.
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
    """A few scores that some run reaches and that lie above what every run begins with."""
    values = [row.scores[score] for history in histories for row in history if score in row.scores]
    if not values:
        return []
    highest = floor(max(values) / TARGET_STEP) * TARGET_STEP
    targets = [float(highest - TARGET_STEP * number) for number in reversed(range(NUM_TARGETS))]
    return [target for target in targets if target > min(values)]

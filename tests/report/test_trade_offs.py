from __future__ import annotations

import itertools
import random

import pytest

from enerf_ns.evaluation.history import HistoryRow
from enerf_ns.report.trade_offs import default_targets, pareto_front, seconds_to_reach


@pytest.mark.parametrize("seed", range(20))
def test_the_pareto_front_is_what_no_other_dominates(seed: int):
    """Of few values, so that many are equal in one cost or in both."""
    draw = random.Random(seed)
    costs = [(float(draw.randrange(6)), float(draw.randrange(6))) for _ in range(draw.randrange(1, 25))]

    def dominated(cost: tuple[float, float]) -> bool:
        return any(other[0] <= cost[0] and other[1] <= cost[1] and other != cost for other in costs)

    assert pareto_front(costs) == [not dominated(cost) for cost in costs]


def test_the_order_of_the_runs_changes_no_front():
    costs = [(1.0, 3.0), (2.0, 2.0), (2.0, 2.0), (3.0, 2.0), (2.0, 5.0)]
    for order in itertools.permutations(range(5)):
        front = pareto_front([costs[number] for number in order])
        assert {number for number, best in zip(order, front, strict=True) if best} == {0, 1, 2}
    assert pareto_front([]) == []


HISTORY = [
    HistoryRow(10, 1.0, scores={"psnr": 10.0}),
    HistoryRow(15, 2.0, scores={"ssim": 0.5}),  # of which PSNR is not known
    HistoryRow(20, 3.0, scores={"psnr": 18.0}),
    HistoryRow(30, 7.0, scores={"psnr": 16.0}),
    HistoryRow(40, 9.0, scores={"psnr": 24.0}, final=True),
]


@pytest.mark.parametrize(
    ("target", "expected"),
    [
        (9.0, (1.0, True)),
        (10.0, (1.0, True)),
        (14.0, (2.0, False)),  # half of the way from 10 dB after 1 s to 18 dB after 3 s
        (18.0, (3.0, False)),
        (20.0, (8.0, False)),  # after it had become worse: from 16 dB after 7 s to 24 dB after 9 s
        (24.0, (9.0, False)),
        (24.1, None),
    ],
)
def test_time_to_reach(target: float, expected: tuple[float, bool] | None):
    assert seconds_to_reach(HISTORY, "psnr", target) == expected


def test_nothing_is_reached_without_a_score():
    assert seconds_to_reach([], "psnr", 10.0) is None
    assert seconds_to_reach(HISTORY, "lpips", 0.1) is None


def test_targets_are_reached_by_some_run_and_not_at_once_by_all():
    assert default_targets([HISTORY], "psnr") == [18.0, 20.0, 22.0, 24.0]
    assert default_targets([HISTORY[:3], HISTORY[:1]], "psnr") == [12.0, 14.0, 16.0, 18.0]
    assert default_targets([HISTORY[:1]], "psnr") == default_targets([[], []], "psnr") == []

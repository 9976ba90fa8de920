"""Error against time of a result file: where its rows lie, and which are on the front."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from matplotlib.figure import Figure
from test_bench_tables import results, run

from enerf_ns.bench.diagram import _plot, diagram, way_to_train
from enerf_ns.bench.tables import lines

SPEED = (1.0, 0.5)
"""Of the machine of each seed."""


def runs_of(row: str, work: float, scores: tuple[float, float]) -> list[dict[str, Any]]:
    return [run(row, psnr, seed=seed, seconds=work / SPEED[seed]) for seed, psnr in enumerate(scores)]


FAST, SLOW, BEHIND = (
    runs_of("fast", 2.0, (20.0, 22.0)),
    runs_of("slow", 6.0, (25.0, 29.0)),
    runs_of("behind", 7.0, (24.0, 26.0)),
)


def test_rows_lie_at_their_means_and_what_is_slower_and_worse_is_behind_the_front():
    axis: Any = Figure().subplots()
    _plot(axis, lines(results(*FAST, *SLOW, *BEHIND, published={})))
    places = [container.lines[0].get_xydata()[0].tolist() for container in axis.containers]
    assert places == [[1.0, 21.0], [3.0, 27.0], [3.5, 25.0]]
    (front,) = [line for line in axis.lines if line.get_label() == "Pareto front"]
    assert front.get_xydata().tolist() == [[1.0, 21.0], [3.0, 27.0]]
    upper = axis.containers[1].lines[1][-1].get_ydata()
    assert float(np.max(upper)) == pytest.approx(27.0 + np.std([25.0, 29.0], ddof=1))


def test_rows_that_differ_in_their_budget_alone_are_one_curve_whose_band_is_the_spread_of_the_seeds():
    axis: Any = Figure().subplots()
    longer = runs_of("fast-2.5x", 5.0, (25.0, 29.0))
    _plot(axis, lines(results(*FAST, *longer, *BEHIND, published={})))
    curve, point = axis.containers
    assert (curve.get_label(), point.get_label()) == ("fast", "behind")
    assert curve.lines[0].get_xydata().tolist() == [[1.0, 21.0], [2.5, 27.0]]
    (band,) = axis.collections[:1]
    low, high = np.std([20.0, 22.0], ddof=1), np.std([25.0, 29.0], ddof=1)
    for expected in ((1.0, 21.0 - low), (1.0, 21.0 + low), (2.5, 27.0 - high), (2.5, 27.0 + high)):
        assert np.abs(band.get_paths()[0].vertices - expected).max(axis=1).min() < 1e-9


@pytest.mark.parametrize(("row", "name"), [("events-0.5x", "events"), ("resolution-x12", "resolution-x12")])
def test_a_way_to_train_is_a_row_without_its_budget(row: str, name: str):
    assert way_to_train(row) == name


def test_a_plot_for_each_sequence_that_has_two_rows():
    one = diagram(results(*FAST, *SLOW, published={}))
    two = diagram(results(*FAST, *SLOW, *(each | {"sequence": "other"} for each in FAST + SLOW), published={}))
    assert one is not None and two is not None
    heights = [cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR).shape[0] for png in (one, two)]
    assert heights[1] == 2 * heights[0]


@pytest.mark.parametrize("runs", [FAST, [*FAST, run("unscored", None)], []])
def test_one_row_is_no_diagram(runs: list):
    assert diagram(results(*runs, published={})) is None

"""Error against time of a result file: where its rows lie, and which are on the front."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from matplotlib.figure import Figure
from test_bench_tables import results, run

from enerf_ns.bench.diagram import _plot, diagram
from enerf_ns.bench.tables import lines

FAST = [run("fast", psnr, seed=seed, seconds=1.0 + seed) for seed, psnr in enumerate((20.0, 22.0))]
SLOW = [run("slow", psnr, seed=seed, seconds=6.0) for seed, psnr in enumerate((25.0, 29.0))]
BEHIND = [run("behind", psnr, seed=seed, seconds=7.0) for seed, psnr in enumerate((24.0, 26.0))]


def test_rows_lie_at_their_means_and_what_is_slower_and_worse_is_behind_the_front():
    axis: Any = Figure().subplots()
    _plot(axis, lines(results(*FAST, *SLOW, *BEHIND, published={})))
    places = [container.lines[0].get_xydata()[0].tolist() for container in axis.containers]
    assert places == [[1.5, 21.0], [6.0, 27.0], [7.0, 25.0]]
    (front,) = [line for line in axis.lines if line.get_label() == "Pareto front"]
    assert front.get_xydata().tolist() == [[1.5, 21.0], [6.0, 27.0]]
    upper = axis.containers[1].lines[1][-1].get_ydata()
    assert float(np.max(upper)) == pytest.approx(27.0 + np.std([25.0, 29.0], ddof=1))


def test_a_plot_for_each_sequence_that_has_two_rows():
    one = diagram(results(*FAST, *SLOW, published={}))
    two = diagram(results(*FAST, *SLOW, *(each | {"sequence": "other"} for each in FAST + SLOW), published={}))
    assert one is not None and two is not None
    heights = [cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR).shape[0] for png in (one, two)]
    assert heights[1] == 2 * heights[0]


@pytest.mark.parametrize("runs", [FAST, [*FAST, run("unscored", None)], []])
def test_one_row_is_no_diagram(runs: list):
    assert diagram(results(*runs, published={})) is None

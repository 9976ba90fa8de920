"""Plot of the PSNR of the rows of an experiment against their training time, with the Pareto front.

Rows that differ in their budget alone are one curve. Its band is the standard deviation of the seeds.
"""

from __future__ import annotations

import io
import re
from statistics import mean, stdev
from typing import TYPE_CHECKING

from enerf_ns.bench.tables import Line, Results, lines, reference_row
from enerf_ns.report.figures import GREY, WIDTH, logarithmic, plain, style
from enerf_ns.report.trade_offs import pareto_front

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def diagram(results: Results) -> bytes | None:
    """A PNG with a plot for each sequence: PSNR against training time, a ratio to that of `reference_row`, as means and
    standard deviations over seeds. None if no sequence has two rows with scores."""
    from matplotlib.figure import Figure

    by_sequence: dict[str, list[Line]] = {}
    for line in lines(results):
        if line.protocol == results["protocols"][0] and line.scores.get("psnr") and line.times:
            by_sequence.setdefault(line.sequence, []).append(line)
    compared = {name: found for name, found in by_sequence.items() if len(found) > 1}
    if not compared:
        return None
    most = max(map(len, compared.values()))
    figure = Figure(figsize=(1.5 * WIDTH, (1.0 + max(3.2, 0.2 * most)) * len(compared)), layout="constrained", dpi=150)
    for axis, (name, found) in zip(
        figure.subplots(len(compared), 1, squeeze=False)[:, 0], compared.items(), strict=True
    ):
        _plot(axis, found)
        axis.set(xlabel=f"training time, {reference_row(results)} = 1", ylabel="PSNR, dB")
        axis.set_title(name, loc="left", fontsize=10)
    target = io.BytesIO()
    figure.savefig(target, format="png")
    return target.getvalue()


def _plot(axis: Axes, found: list[Line]) -> None:
    """Draws each row as a point, and joins the rows of one way to train by a line with a band."""
    points = [(mean(line.times), mean(line.scores["psnr"])) for line in found]
    curves: dict[str, list[int]] = {}
    for number, line in enumerate(found):
        curves.setdefault(way_to_train(line.row), []).append(number)
    for place, (name, numbers) in enumerate(curves.items()):
        ordered = sorted(numbers, key=lambda number: points[number])
        times, psnr = ([points[number][axis_of] for number in ordered] for axis_of in (0, 1))
        off = [stdev(scores) if len(scores := found[number].scores["psnr"]) > 1 else 0.0 for number in ordered]
        wide = [stdev(found[number].times) if len(found[number].times) > 1 else 0.0 for number in ordered]
        look = style(place) | {"markersize": 8, "markeredgecolor": "black"}
        if len(numbers) > 1:
            low, high = ([value + sign * each for value, each in zip(psnr, off, strict=True)] for sign in (-1, 1))
            axis.fill_between(times, low, high, color=look["color"], alpha=0.2, linewidth=0)
        else:
            look["linestyle"] = "none"
        axis.errorbar(times, psnr, xerr=wide, yerr=off, **look, elinewidth=0.8, capsize=2, label=name)
    if len(curves) < len(found):
        logarithmic(axis, "x", [time for time, _ in points])
    best = pareto_front([(time, -psnr) for time, psnr in points])
    front = sorted(point for point, is_best in zip(points, best, strict=True) if is_best)
    axis.step(*zip(*front, strict=True), where="post", color=GREY, linewidth=1.2, zorder=1, label="Pareto front")
    plain(axis)
    axis.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False, fontsize=8)


def way_to_train(row: str) -> str:
    """The name of a row without the factor of its budget, such as events for events-2x."""
    return re.sub(r"-\d+(\.\d+)?x$", "", row)

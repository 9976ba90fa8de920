"""Plot of the PSNR of the rows of an experiment against their training time, with the Pareto front."""

from __future__ import annotations

import io
from statistics import mean, stdev
from typing import TYPE_CHECKING

from enerf_ns.bench.tables import Line, Results, lines
from enerf_ns.report.figures import GREY, WIDTH, plain, style
from enerf_ns.report.trade_offs import pareto_front

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def diagram(results: Results) -> bytes | None:
    """A PNG with a plot for each sequence: PSNR against training time in seconds, as means and standard deviations
    over seeds. None if no sequence has two rows with scores."""
    from matplotlib.figure import Figure

    by_sequence: dict[str, list[Line]] = {}
    for line in lines(results):
        if line.protocol == results["protocols"][0] and line.scores.get("psnr") and line.seconds:
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
        axis.set_title(name, loc="left", fontsize=10)
    target = io.BytesIO()
    figure.savefig(target, format="png")
    return target.getvalue()


def _plot(axis: Axes, found: list[Line]) -> None:
    means = [(mean(line.seconds), mean(line.scores["psnr"])) for line in found]
    for number, (line, (seconds, psnr)) in enumerate(zip(found, means, strict=True)):
        spread = {
            "xerr": stdev(line.seconds) if len(line.seconds) > 1 else None,
            "yerr": stdev(line.scores["psnr"]) if len(line.scores["psnr"]) > 1 else None,
        }
        look = style(number) | {"linestyle": "none", "markersize": 8, "markeredgecolor": "black"}
        axis.errorbar(seconds, psnr, **spread, **look, elinewidth=0.8, capsize=2, label=line.row)
    best = pareto_front([(seconds, -psnr) for seconds, psnr in means])
    front = sorted(point for point, is_best in zip(means, best, strict=True) if is_best)
    axis.step(*zip(*front, strict=True), where="post", color=GREY, linewidth=1.2, zorder=1, label="Pareto front")
    axis.set(xlabel="training, s", ylabel="PSNR, dB")
    plain(axis)
    axis.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False, fontsize=8)

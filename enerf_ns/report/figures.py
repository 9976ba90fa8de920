"""Plots of runs: error against time, final error against time, and the time of a step by part."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from enerf_ns.evaluation.history import HistoryRow
from enerf_ns.report.trade_offs import pareto_front

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SCORES = {
    "psnr": "PSNR, dB",
    "ssim": "SSIM",
    "lpips": "LPIPS",
    "lpips_vgg": "LPIPS (VGG)",
    "correlation": "correlation",
    "depth_rmse": "depth RMSE, m",
    "depth_rmse_known": "depth RMSE where known, m",
    "depth_known": "known depth, share",
    "depth_rmse_spread": "depth RMSE, spread, m",
    "event_correlation": "event correlation",
    "event_rmse": "event RMSE, thresholds",
    "event_sign": "event sign, share",
}
"""Label of each score with its unit."""

AT_END = ("depth_rmse_known", "depth_known", "depth_rmse_spread")
"""Scores that exist only at the end of a run."""

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Colours of Okabe and Ito, which colour-blind readers can distinguish."""
GREY = "#5a6272"
MARKERS = "osD^vPX<>"
LINES = ("-", "--", "-.", ":")
FINAL = {"linestyle": "none", "markersize": 11, "markeredgecolor": "black"}
"""Style of the score over all held-out frames."""
HATCHES = ("", "///", "...", "\\\\\\", "xxx", "+++", "ooo")

WIDTH = 5.6
"""Width of a plot in inches, at which text of 9 points is readable on a phone."""


@dataclass(frozen=True)
class Curve:
    """The data of a run that the plots show."""

    name: str
    history: list[HistoryRow]
    seconds: float | None
    """Training time up to the scored step, s; None if unknown."""
    scores: dict[str, float]
    """Scores of the run, as in the table."""
    over_all_frames: bool
    """Whether the scores are over all held-out frames."""


def style(number: int) -> dict[str, Any]:
    """Colour, marker and line of the run with this number. Each alone distinguishes the first seven runs or more."""
    return {
        "color": COLOURS[number % len(COLOURS)],
        "marker": MARKERS[number % len(MARKERS)],
        "linestyle": LINES[number // len(COLOURS) % len(LINES)],
    }


def plain(axis: Axes) -> None:
    """Gives a plot a light grid, and no frame above and on the right."""
    axis.grid(alpha=0.3)
    axis.spines[["top", "right"]].set_visible(False)


def error_against(axis_of: Literal["seconds", "step"], runs: Sequence[Curve]) -> Figure | None:
    """Plots of each score against training time or steps, on a logarithmic axis; None if no run has scores.

    If any run has frames, event_correlation alone represents the scores of events. A line joins the scores over a few
    frames during training. Larger, separate marks show the scores over all frames at the end of a run.
    """
    from matplotlib.figure import Figure

    drawn = [row for run in runs for row in run.history if getattr(row, axis_of) > 0]
    left_out = (*AT_END, *(("event_rmse", "event_sign") if any(row.num_frames for row in drawn) else ()))
    names = [name for name in SCORES if name not in left_out and any(name in row.scores for row in drawn)]
    if not names:
        return None
    figure = Figure(figsize=(WIDTH, 0.7 + 1.7 * len(names) + 0.2 * len(runs)), layout="constrained", dpi=150)
    axes = figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
    for axis, name in zip(axes, names, strict=True):
        for number, run in enumerate(runs):
            rows = [row for row in run.history if name in row.scores and getattr(row, axis_of) > 0]
            for final in (False, True):
                chosen = [row for row in rows if row.final == final]
                look = style(number) | (FINAL if final else {"markersize": 4})
                axis.plot([getattr(row, axis_of) for row in chosen], [row.scores[name] for row in chosen], **look)
        axis.set_ylabel(SCORES[name])
        axis.margins(y=0.15)
        plain(axis)
    logarithmic(axes[-1], "x", [getattr(row, axis_of) for row in drawn])
    axes[-1].set_xlabel("training time, s (log)" if axis_of == "seconds" else "training steps (log)")
    few = {row.num_frames for row in drawn if not row.final and row.num_frames}
    over = f"{min(few)} held-out frames, " if len(few) == 1 else "a few held-out frames, " if few else ""
    every = "all held-out frames, " if any(row.num_frames for row in drawn) else ""
    marks = [("o", GREY, 4, "full", f"small, joined: {over}during training")]
    marks += [("o", GREY, 9, "full", f"large: {every}at the end")]
    _legend(axes[0], runs, marks if any(row.final for row in drawn) else marks[:1])
    return figure


def work_precision(runs: Sequence[Curve]) -> Figure | None:
    """Plots of the final error against training time with the Pareto front; None if fewer than two runs have both.

    The errors are the RMS error of brightness, 10^(-PSNR / 20), the RMSE of depth in metres, and 1 - event_correlation.
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator, NullLocator, ScalarFormatter

    panels = [
        panel
        for panel in (
            ("psnr", "RMS error of brightness", rms_error),
            ("depth_rmse", "depth RMSE, m", float),
            ("event_correlation", "1 - event correlation", lambda correlation: 1.0 - correlation),
        )
        if sum(panel[0] in run.scores and bool(run.seconds) for run in runs) > 1
    ]
    if not panels:
        return None
    figure = Figure(figsize=(WIDTH, 0.7 + 3.3 * len(panels) + 0.2 * len(runs)), layout="constrained", dpi=150)
    axes = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    for axis, (name, label, error) in zip(axes, panels, strict=True):
        chosen = [number for number, run in enumerate(runs) if name in run.scores and run.seconds]
        costs = [(float(runs[number].seconds or 0), error(runs[number].scores[name])) for number in chosen]
        for number, cost in zip(chosen, costs, strict=True):
            hollow = {} if runs[number].over_all_frames else {"markerfacecolor": "white"}
            axis.plot(*cost, **style(number) | {"linestyle": "none", "markersize": 9, **hollow}, zorder=3)
        front = sorted(cost for cost, best in zip(costs, pareto_front(costs), strict=True) if best)
        axis.step(*zip(*front, strict=True), where="post", color=GREY, linewidth=1.2, zorder=1)
        axis.plot(*zip(*front, strict=True), "o", markersize=17, fillstyle="none", color=GREY, zorder=2)
        axis.set_ylabel(f"{label} (log)")
        axis.margins(0.12)
        plain(axis)
        logarithmic(axis, "y", [cost[1] for cost in costs])
        if name == "psnr":
            decibels = axis.secondary_yaxis("right", functions=(psnr_of, rms_error))
            decibels.set_ylabel("PSNR, dB")
            decibels.yaxis.set_major_locator(MaxNLocator(6))
            decibels.yaxis.set_major_formatter(ScalarFormatter())
            decibels.yaxis.set_minor_locator(NullLocator())
    logarithmic(axes[-1], "x", [run.seconds for run in runs if run.seconds])
    axes[-1].set_xlabel("training time, s (log)")
    marks = [("o", GREY, 12, "none", "on the Pareto front: no other run is both faster and better")]
    if not all(run.over_all_frames for run in runs):
        marks.append(("o", GREY, 6, "none", "hollow: during training"))
    _legend(axes[0], runs, marks)
    return figure


def rms_error(psnr: float) -> float:
    """RMS error of brightness in [0, 1] for a PSNR in dB, or for an array of them."""
    return 10.0 ** (-psnr / 20.0)


def psnr_of(error: Any) -> Any:
    """PSNR in dB for an RMS error of brightness in [0, 1], or for an array of them."""
    return -20.0 * np.log10(np.maximum(error, 1e-12))


def step_breakdown(runs: Sequence[tuple[str, dict[str, float]]]) -> Figure:
    """Bar chart of the time of a training step by part, with one bar for each run.

    Args:
        runs: Name, and seconds of a step by part; at least one.
    """
    from matplotlib.figure import Figure

    parts = list(dict.fromkeys(part for _, seconds in runs for part in seconds))
    figure = Figure(figsize=(WIDTH, 1.1 + 0.42 * len(runs) + 0.17 * len(parts)), layout="constrained", dpi=150)
    axis = figure.subplots()
    for number, part in enumerate(parts):
        widths = [1e3 * seconds.get(part, 0.0) for _, seconds in runs]
        starts = [1e3 * sum(seconds.get(before, 0.0) for before in parts[:number]) for _, seconds in runs]
        axis.barh(
            range(len(runs)), widths, left=starts, height=0.62, label=part, edgecolor="white", linewidth=0.6,
            color=COLOURS[number % len(COLOURS)], hatch=HATCHES[number // len(COLOURS) % len(HATCHES)],
        )  # fmt: skip
    axis.set_yticks(range(len(runs)), [shortened(name, 24) for name, _ in runs])
    axis.invert_yaxis()
    axis.set_xlabel("time of one training step, ms")
    axis.spines[["top", "right", "left"]].set_visible(False)
    axis.tick_params(axis="y", length=0)
    axis.legend(loc="lower left", bbox_to_anchor=(0, 1.0), ncols=2, frameon=False, fontsize=8)
    return figure


def shortened(name: str, length: int) -> str:
    """A name of at most `length` characters: both ends of a longer name, with … between them."""
    return name if len(name) <= length else f"{name[: length // 2]}…{name[1 - length + length // 2 :]}"


def _legend(axis: Axes, runs: Sequence[Curve], marks: Sequence[tuple[str, str, int, Any, str]]) -> None:
    """Adds a legend of runs and of marks (marker, colour, size, fill style, label) above a plot."""
    from matplotlib.lines import Line2D

    handles = [
        Line2D([], [], **style(number), markersize=5, label=shortened(run.name, 60)) for number, run in enumerate(runs)
    ]
    handles += [
        Line2D([], [], linestyle="none", marker=marker, color=colour, markersize=size, fillstyle=fill, label=words)
        for marker, colour, size, fill, words in marks
    ]
    axis.legend(handles=handles, loc="lower left", bbox_to_anchor=(0, 1.0), frameon=False, fontsize=8)


def logarithmic(axes: Axes, which: Literal["x", "y"], values: Sequence[float]) -> None:
    """Makes an axis logarithmic with plain numbers, even if the values span less than a factor of 4."""
    from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

    axes.set(**{f"{which}scale": "log"})
    axis = axes.xaxis if which == "x" else axes.yaxis
    ratio = max(values) / min(values)
    close = LogLocator(subs=(1.0, 2.0, 5.0)) if ratio < 1e3 else LogLocator()
    axis.set_major_locator(MaxNLocator(5) if 1.0 < ratio < 4.0 else close)
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.4g}"))
    axis.set_minor_locator(NullLocator())

"""Draws the figures of the page “How it works” with the code of the package: `python docs/figures.py [FOLDER]`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("svg")
import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch
from nerfstudio.cameras.rays import RayBundle

from enerf_ns.rendering.ray_samplers import PairedPDFSampler, PairedUniformSampler
from enerf_ns.sensor.response import response_named
from enerf_ns.simulator.event_sensor import EventSensor, SensorSettings

ON, OFF, LINE, PALE = "#c1352b", "#2b5fc1", "#333333", "#9a9a9a"
STYLE: dict[Any, Any] = {"font.size": 10, "axes.spines.top": False, "axes.spines.right": False, "svg.fonttype": "path"}


def event_pair() -> Figure:
    """Log brightness of one pixel, the events that the simulated sensor makes of it, and a pair of them."""
    threshold, response = 0.25, "logarithm:0.001"
    times = np.linspace(0, 40e6, 801).astype(np.int64)
    phase = times / 40e6
    brightness = np.exp(-1.1 + 0.75 * np.sin(2 * np.pi * (1.15 * phase - 0.2)) + 0.25 * np.sin(2 * np.pi * 3 * phase))
    settings = SensorSettings(contrast_thresholds=(threshold, threshold), response=response)
    sensor = EventSensor(settings, np.full((1, 1), brightness[0]), 0)
    fired = [sensor.advance(np.full((1, 1), b), int(t)) for t, b in zip(times[1:], brightness[1:], strict=True)]
    when = np.concatenate([events.t for events in fired]) * 1e-6
    signs = np.where(np.concatenate([events.p for events in fired]) > 0, 1, -1)
    level = response_named(response)(brightness)
    at = np.interp(when, times * 1e-6, level)

    figure, axes = plt.subplots(figsize=(8, 3.6), layout="constrained")
    axes.plot(times * 1e-6, level, color=LINE)
    for sign, colour, name in ((1, ON, "on event"), (-1, OFF, "off event")):
        chosen = signs == sign
        axes.vlines(when[chosen], level.min() - 0.55, level.min() - 0.3, color=colour, linewidth=2)
        axes.scatter(when[chosen], at[chosen], color=colour, s=22, zorder=3, label=name)
    for step in level[0] + threshold * np.arange(-20, 20):
        if level.min() - 0.1 < step < level.max() + 0.1:
            axes.axhline(step, color=PALE, linewidth=0.5, linestyle=":", zorder=0)
    first, second = 3, 9
    on, off = ((signs[first + 1 : second + 1] == sign).sum() for sign in (1, -1))
    for index in (first, second):
        axes.scatter(when[index], at[index], s=130, facecolors="none", edgecolors=LINE, linewidths=1.5, zorder=4)
    arrow = {"arrowstyle": "<->", "color": LINE, "linewidth": 1.5}
    axes.vlines(when[second], *sorted((at[first], at[second])), color=PALE, linewidth=0.8, linestyle="--")
    axes.annotate(
        "", (when[second], at[second]), (when[first], at[first]), arrowprops={**arrow, "shrinkA": 7, "shrinkB": 7}
    )
    label = f"a pair: {on} on, {off} off\nmeasured change = {on} C_on - {off} C_off = {threshold * (on - off):+.2f}"
    middle = 0.5 * (when[first] + when[second])
    axes.annotate(label, (middle, level.min() - 0.1), ha="center", va="bottom")
    axes.set(xlabel="time, ms", ylabel="log brightness of one pixel", xlim=(0, 40))
    axes.legend(loc="upper right", frameon=False)
    return figure


def sensor_model() -> Figure:
    """The steps from brightness to events, and the parameter of each."""
    steps = [
        ("brightness", "of the rays of\nthe pixel", ""),
        ("response", "logarithm or\nlinlog", "response"),
        ("low pass", "lag of the\nphotoreceptor", "cutoff-frequency"),
        ("threshold", "one event per\nC_on or C_off", "contrast-thresholds\nleak-rate"),
        ("refractory", "blind after\neach event", "refractory-period-ns"),
        ("events", "x, y, t, p", ""),
    ]
    figure, axes = plt.subplots(figsize=(9, 1.9), layout="constrained")
    for number, (name, what, flag) in enumerate(steps):
        x = 1.6 * number
        ends = number in (0, len(steps) - 1)
        box = FancyBboxPatch(
            (x, 0), 1.2, 0.8, boxstyle="round,pad=0.04", facecolor="white" if ends else "#eef2fa", edgecolor=LINE
        )
        axes.add_patch(box)
        axes.text(x + 0.6, 0.6, name, ha="center", va="center", weight="bold")
        axes.text(x + 0.6, 0.24, what, ha="center", va="center", fontsize=9)
        axes.text(x + 0.6, -0.14, flag, ha="center", va="top", fontsize=8, family="monospace", color=OFF)
        if number:
            axes.add_patch(
                FancyArrowPatch((x - 0.34, 0.4), (x - 0.05, 0.4), arrowstyle="-|>", mutation_scale=12, color=LINE)
            )
    axes.set(xlim=(-0.1, 1.6 * len(steps) - 0.3), ylim=(-0.6, 0.95))
    axes.axis("off")
    return figure


def sampling() -> Figure:
    """Two surfaces along a ray: samples of the proposal network, samples of the field, and the weights of both."""

    def density(distance: np.ndarray) -> np.ndarray:
        return 9.0 * np.exp(-(((distance - 1.6) / 0.08) ** 2)) + 40.0 * np.exp(-(((distance - 2.9) / 0.1) ** 2))

    def weights(edges: np.ndarray) -> np.ndarray:
        thickness = density(0.5 * (edges[1:] + edges[:-1])) * np.diff(edges)
        before = np.concatenate([[0.0], np.cumsum(thickness)[:-1]])
        return np.exp(-before) * (1.0 - np.exp(-thickness))

    torch.manual_seed(0)
    forward = torch.tensor([[0.0, 0.0, 1.0]])
    near, far = torch.tensor([[0.5]]), torch.tensor([[4.0]])
    rays = RayBundle(torch.zeros(1, 3), forward, torch.ones(1, 1), nears=near, fars=far)
    coarse = PairedUniformSampler().eval()(rays, num_samples=48)
    coarse_edges = torch.cat([coarse.frustums.starts[0, :, 0], coarse.frustums.ends[0, -1:, 0]]).numpy()
    expected = torch.from_numpy(weights(coarse_edges)).float()[None, :, None]
    fine = PairedPDFSampler().eval()(rays, coarse, expected, num_samples=24)
    fine_edges = torch.cat([fine.frustums.starts[0, :, 0], fine.frustums.ends[0, -1:, 0]]).numpy()

    figure, (upper, lower) = plt.subplots(
        2, 1, figsize=(8, 3.8), sharex=True, layout="constrained", height_ratios=(3, 2)
    )
    distance = np.linspace(0.5, 4.0, 1400)
    depth = np.concatenate([[0.0], np.cumsum(density(distance)[:-1] * np.diff(distance))])
    upper.fill_between(distance, density(distance) / 40.0, color="#d8dce6", label="density (of its maximum)")
    upper.plot(distance, np.exp(-depth), color=LINE, label="transmittance")
    upper.legend(frameon=False, loc="upper right")
    upper.set(ylim=(0, 1.1))
    for edges, height, colour, name in (
        (coarse_edges, 1.0, PALE, "48 of the proposal network"),
        (fine_edges, 0.0, ON, "24 of the field"),
    ):
        middles = 0.5 * (edges[1:] + edges[:-1])
        lower.vlines(middles, height, height + 0.25, color=colour, linewidth=1.2)
        lower.bar(
            edges[:-1],
            0.5 * weights(edges) / weights(edges).max(),
            np.diff(edges),
            height + 0.3,
            align="edge",
            color=colour,
            alpha=0.45,
        )
        lower.text(4.03, height + 0.12, name, va="center", color=LINE, fontsize=9)
    lower.set(xlabel="distance from the camera, m", xlim=(0.5, 4.0), yticks=[])
    lower.spines["left"].set_visible(False)
    lower.text(4.03, 0.55, "bars: weights", va="center", color=LINE, fontsize=9)
    return figure


FIGURES = {"event-pair": event_pair, "sensor-model": sensor_model, "sampling": sampling}


def main(folder: Path) -> None:
    """Writes all figures into a folder as PNG."""
    folder.mkdir(parents=True, exist_ok=True)
    with plt.rc_context(STYLE):
        for name, draw in FIGURES.items():
            figure = draw()
            figure.savefig(folder / f"{name}.png", dpi=130, metadata={"Software": None})
            plt.close(figure)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).with_name("figures"))

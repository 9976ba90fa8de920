"""Agreement of events with the true brightness of known scenes, at events and at any instant.

Simulates recordings of an ideal sensor, draws pairs of instants as training does, renders the true scene at both, over
the area of each pixel and through its centre alone, and compares the changes with what the events say. Prints for each
the correlation, and the error in contrast thresholds (root mean square), of all pairs, and how far brightness has gone
on since the last event (`enerf_ns.events.samplers.AHEAD`). A second table has the mean change that events tell between
any two instants, by the true change over the area.

    python benchmarks/instants.py
    python benchmarks/instants.py floor clutter statue
"""

from __future__ import annotations

import sys
import tempfile
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch

from enerf_ns.bench.validation import CHOSEN_ON, ONLY_SCORED
from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.events.batch import EventBatch
from enerf_ns.events.samplers import EventPairSampler, InstantPairSampler
from enerf_ns.sensor.response import response_named
from enerf_ns.simulator.engine import simulate
from enerf_ns.simulator.scene.render import SAMPLES, Renderer
from enerf_ns.simulator.settings import SimulationSettings
from enerf_ns.simulator.sources import RenderedScene
from enerf_ns.simulator.view import view_of

PAIRS, DISTANCE, APART_NS = 8000, 10, 100_000_000
THRESHOLD = 0.2
SIZES = (0.1, 0.25, 0.5, 0.75, 1.0, 1.5, 2.5, 4.0)
"""Limits of the true changes of the second table, in thresholds."""
CENTRE = np.tile([[0.0, 0.0]], (4, 1)) + 1e-6 * np.arange(4)[:, None]
"""Four places that are one, since the renderer takes its samples by fours."""


def main() -> None:
    names = sys.argv[1:] or ["shapes", "floor", "clutter"]
    print("| scene | instants | ray | correlation | error, thresholds | gone on since the last event, thresholds |")
    print("| --- | --- | --- | --- | --- | --- |")
    of_sizes = []
    for name in names:
        with tempfile.TemporaryDirectory() as folder:
            settings = settings_of(name, Path(folder))
            simulate(settings, Path(folder) / "recording")
            index = index_events(read_recording(Path(folder) / "recording"))
            scene = view_of(settings, []).events
        assert isinstance(scene, RenderedScene)
        generator = torch.Generator().manual_seed(0)
        batches = {
            "events": EventPairSampler(index, "partner", DISTANCE).sample(PAIRS, generator),
            "any": InstantPairSampler(index, *index.span, APART_NS).sample(PAIRS, generator),
        }
        for instants, batch in batches.items():
            for ray, places in (("area", SAMPLES), ("centre", CENTRE)):
                scene.renderer = Renderer(scene.renderer.scene, scene.camera, places)
                change = changes(scene, settings, batch) / THRESHOLD
                counted = (batch.on - batch.off).numpy().astype(float)
                told = counted if batch.ahead is None else counted + batch.ahead.numpy()
                going = 0.0 if batch.ahead is None else ahead(change - counted, batch.ahead.numpy())
                print(
                    f"| {name} | {instants} | {ray} | {np.corrcoef(change, told)[0, 1]:.3f} | "
                    f"{np.sqrt(np.mean((change - told) ** 2)):.2f} | {going:.2f} |".replace("| 0.00 |", "| - |"),
                    flush=True,
                )
                if instants == "any" and ray == "area":
                    of_sizes.append(f"| {name} | {' | '.join(told_of_sizes(change, told))} |")
    print("\n| scene | " + " | ".join(f"{low:g} to {high:g}" for low, high in pairwise(SIZES)) + " |")
    print("| --- " * (len(SIZES)) + "|", *of_sizes, sep="\n")


def settings_of(name: str, folder: Path) -> SimulationSettings:
    """What `enerf bench validation` simulates of this name, or the scene of `enerf simulate`, with an ideal sensor."""
    sequence = {**CHOSEN_ON, **ONLY_SCORED}.get(name)
    thresholds = (THRESHOLD, THRESHOLD)
    if sequence is None:
        return SimulationSettings(name, layout="esim", contrast_thresholds=thresholds)
    ideal = SimulationSettings(layout="esim", contrast_thresholds=thresholds)
    changed = ("layout", "contrast_thresholds", "sensor", "colour", "bayer_pattern")
    return sequence.simulation_settings(folder, **{name: getattr(ideal, name) for name in changed})


def changes(scene: RenderedScene, settings: SimulationSettings, batch: EventBatch) -> np.ndarray:
    """True changes of log brightness between the instants of pairs."""
    response = response_named(settings.sensor.response)
    seen = [
        np.array([
            np.ravel(scene.brightness(time, np.array([pixel])))[0]
            for time, pixel in zip(times.tolist(), batch.pixels.tolist(), strict=True)
        ])
        for times in (batch.start, batch.end)
    ]  # fmt: skip
    before, after = (response(brightness.astype(np.float64)) for brightness in seen)
    return after - before


def told_of_sizes(change: np.ndarray, told: np.ndarray) -> list[str]:
    """For true changes between each two of `SIZES`: their mean size, and the mean of what events tell in their
    direction."""
    found = []
    for low, high in pairwise(SIZES):
        chosen = (np.abs(change) >= low) & (np.abs(change) < high)
        sizes, direction = np.abs(change[chosen]), np.sign(change[chosen])
        found.append(f"{sizes.mean():.2f}, {(direction * told[chosen]).mean():.2f}" if chosen.any() else "-")
    return found


def ahead(left: np.ndarray, told: np.ndarray) -> float:
    """Thresholds by which brightness has gone on in the direction of the last event, by least squares."""
    direction = np.sign(told) * np.round(np.abs(told) / np.abs(told[told != 0]).min())
    return float((direction * left).sum() / (direction * direction).sum())


if __name__ == "__main__":
    main()

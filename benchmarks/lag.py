"""Estimate of the lag of slow pixels from event rates, compared with the true lag of a known scene.

Simulates the scene `shapes` with pixels of a finite bandwidth, draws pairs of events, renders what the pixels saw at
both instants, and compares the true lag, which is the change of brightness minus that of the events, with the lag that
the sensor model estimates from event rates. Prints the standard deviations of the true lag and of the error, in
contrast thresholds, and the factor by which the estimate is too small.

    python benchmarks/lag.py
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import torch

from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.events.samplers import EventPairSampler
from enerf_ns.sensor.part import GREY
from enerf_ns.sensor.sensor_model import SensorModelConfig
from enerf_ns.simulator.engine import simulate
from enerf_ns.simulator.event_sensor import SensorSettings
from enerf_ns.simulator.settings import SimulationSettings
from enerf_ns.simulator.view import view_of

THRESHOLD, RESPONSE, PAIRS = 0.25, "logarithm:0.001", 3000


def main() -> None:
    print("| cut-off, Hz | lag, thresholds | error of the estimate | factor |\n| --- | --- | --- | --- |")
    for cutoff in (50.0, 100.0, 200.0, 400.0):
        settings = SimulationSettings("shapes", layout="esim", sensor=SensorSettings(cutoff_frequency=cutoff))
        with tempfile.TemporaryDirectory() as folder:
            simulate(settings, Path(folder) / "recording")
            index = index_events(read_recording(Path(folder) / "recording"))
        scene = view_of(settings, []).events
        batch = EventPairSampler(index, "partner", max_distance=10).sample(PAIRS, torch.Generator().manual_seed(0), 0)
        start, end = (
            torch.tensor(
                [
                    scene.brightness(time, np.array([pixel]))
                    for time, pixel in zip(times.tolist(), batch.pixels.tolist(), strict=True)
                ]
            ).reshape(-1, 1)
            for times in (batch.start, batch.end)
        )
        sensor = SensorModelConfig(
            contrast_thresholds=(THRESHOLD, THRESHOLD),
            response=RESPONSE,
            refractory_period_ns=0,
            bayer_pattern=GREY,
            cutoff_frequency=cutoff,
        ).setup()
        changes = [sensor.log_brightness(rgb, batch.pixels) for rgb in (start, end)]
        lag = (changes[1] - changes[0] - sensor.measured_change(batch)).double() / THRESHOLD
        told = sensor.lag(start, end, batch).double() / THRESHOLD
        factor = float((told * lag).sum() / told.square().sum())
        print(f"| {cutoff:g} | {lag.std():.2f} | {(lag - told).std():.2f} | {factor:.2f} |", flush=True)


if __name__ == "__main__":
    main()

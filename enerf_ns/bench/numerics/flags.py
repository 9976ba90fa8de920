"""Cases of flags: values that are NaN or out of range are refused before training starts."""

from __future__ import annotations

import math
from typing import Any

from enerf_ns.bench.numerics.case import case
from enerf_ns.bench.numerics.small_run import small_config
from enerf_ns.choices.ranges import check_ranges
from enerf_ns.dataparsers.recording.errors import FlagError

SENSOR, MODEL, DATA = "pipeline.model.sensor.", "pipeline.model.", "pipeline.datamanager."


def _accepted(*settings: tuple[str, Any]) -> float:
    """Number of invalid settings that are accepted."""
    accepted = 0
    for name, value in settings:
        try:
            check_ranges(small_config({name: value}))
            accepted += 1
        except FlagError:
            pass
    return accepted


@case("thresholds of nan, inf, 1e-45 and 1e6", "refused", 0, "accepted")
def thresholds() -> float:
    return _accepted(*((f"{SENSOR}contrast_thresholds", (value, value)) for value in (math.nan, math.inf, 1e-45, 1e6)))


@case("loss weights of nan, inf and -1", "refused", 0, "accepted")
def weights() -> float:
    names = [f"{MODEL}{kind}_loss_weight" for kind in ("event", "no_event", "frame", "opacity", "distortion")]
    return _accepted(*((name, value) for name in names for value in (math.nan, math.inf, -1.0)))


@case("no event pairs, no steps, no samples", "refused", 0, "accepted")
def nothing() -> float:
    return _accepted((f"{DATA}event_pairs", 0), ("max_num_iterations", 0), (f"{MODEL}num_samples", 0))


@case("depth ranges of nan, of nothing, and backwards", "refused", 0, "accepted")
def depths() -> float:
    name = f"{DATA}dataparser.depth_range"
    return _accepted((name, (math.nan, 1.0)), (name, (1.0, 1.0)), (name, (0.0, 1.0)), (name, (2.0, 1.0)))

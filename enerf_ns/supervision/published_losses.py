"""Losses of other methods on the field of enerf: how pairs are drawn, what pixels compare, and what an error costs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class PublishedLosses:
    """What a publication has a field learn from events, as settings of the method enerf."""

    source: str
    """Name of the method, authors, venue and year."""
    settings: dict[str, Any]
    """Values by the names of ns-train's flags."""


PAIRS = 1365
"""Pairs of instants that enerf draws at each step, of events and silent pixels; each of these draws as many in all."""

PUBLISHED_LOSSES: dict[str, PublishedLosses] = {
    "enerf-paper-loss": PublishedLosses(
        "E-NeRF (Klenk, Koestler, Scaramuzza, Cremers, RA-L 2023)",
        {
            "pipeline.datamanager.pair_mode": "successor",
            "pipeline.datamanager.uniform_over": "pixels",
            "pipeline.datamanager.event_pairs": PAIRS,
            "pipeline.datamanager.silent_pairs": 0,
            "pipeline.model.sensor.response": "linlog",
            "pipeline.model.sensor.refractory_period_ns": 0,
            "pipeline.model.event_loss": "squared",
            "pipeline.model.no_event_loss_weight": 5.0,  # as enerf-paper has it, for runs with silent pairs
            "pipeline.model.no_event_margin": 1.0,
        },
    ),
    "enerf-eventnerf": PublishedLosses(
        "EventNeRF (Rudnev, Elgharib, Theobalt, Golyanik, CVPR 2023)",
        {
            "pipeline.datamanager.pair_mode": "accumulated",
            "pipeline.datamanager.event_pairs": PAIRS,
            "pipeline.datamanager.silent_pairs": 0,
            "pipeline.model.sensor.response": "gamma:2.2:1e-05",
            "pipeline.model.sensor.refractory_period_ns": 0,
            "pipeline.model.event_loss": "squared",
        },
    ),
    "enerf-robust": PublishedLosses(
        "Robust e-NeRF (Low, Lee, ICCV 2023)",
        {
            "pipeline.datamanager.pair_mode": "successor",
            "pipeline.datamanager.event_pairs": PAIRS,
            "pipeline.datamanager.silent_pairs": 0,
            "pipeline.model.sensor.response": "logarithm:0.001",
            "pipeline.model.event_loss": "squared",
        },
    ),
    "enerf-deblur": PublishedLosses(
        "Deblur e-NeRF (Low, Lee, ECCV 2024)",
        {
            "pipeline.datamanager.pair_mode": "successor",
            "pipeline.datamanager.event_pairs": PAIRS - PAIRS // 2,
            "pipeline.datamanager.silent_pairs": PAIRS // 2,
            "pipeline.datamanager.silent_mode": "intervals",
            "pipeline.model.sensor.response": "logarithm:0.001",
            "pipeline.model.event_loss": "huber",
            "pipeline.model.no_event_loss_weight": 0.2,  # its 0.1 for real recordings: `huber_event_loss` is twice its
            "pipeline.model.no_event_margin": 0.0,
        },
    ),
}
"""Losses by the names of the methods that have them, as their authors have them for real recordings.

What is no loss of events stays that of enerf: field, brightness activation, regularisers, and thresholds, which the
authors of the last two learn. Missing are Robust e-NeRF's loss on derivatives in time, of weight 0.001, for which the
hash grid would have to be differentiated twice, and the bandwidth of the pixels of Deblur e-NeRF.
"""

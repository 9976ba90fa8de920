"""Losses of publications on the field of enerf, as settings: pairs, brightness response, and loss functions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class PublishedLosses:
    """The event losses of a publication, as settings of the method enerf."""

    source: str
    """Name of the method, authors, venue and year."""
    settings: dict[str, Any]
    """Values by the names of the flags of `ns-train`."""


PAIRS = 1365
"""Pairs of instants per step, events and silent pixels together: as many as enerf draws."""

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
            "pipeline.model.no_event_loss_weight": 5.0,  # the weight in enerf-paper, for runs with silent pairs
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
            "pipeline.model.no_event_loss_weight": 0.2,  # their 0.1, doubled as in `huber_event_loss`
            "pipeline.model.no_event_margin": 0.0,
        },
    ),
}
"""Losses by method name, with the values that their authors use for real recordings.

Everything else is that of enerf: field, brightness activation, regularisers, and thresholds, which the authors of the
last two methods learn. Poses are taken as stated, as by the authors. Two parts are missing: the loss of Robust e-NeRF
on derivatives in time (weight 0.001), which needs second derivatives of the hash grid, and the bandwidth of the pixels
in Deblur e-NeRF.
"""

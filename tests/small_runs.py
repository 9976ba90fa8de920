"""Runs of the method `enerf` that take a few seconds."""

from __future__ import annotations

from typing import Any

SMALL: dict[str, Any] = {
    "max_num_iterations": 2,
    "timestamp": "run",
    "machine.device_type": "cpu",
    "pipeline.datamanager.event_pairs": 64,
    "pipeline.datamanager.silent_pairs": 0,
    "pipeline.model.log2_table_size": 12,
    "pipeline.model.num_levels": 4,
    "pipeline.model.num_samples": 16,
    "pipeline.model.num_proposal_samples": 16,
}
"""What they change of it, by the names of ns-train's flags."""

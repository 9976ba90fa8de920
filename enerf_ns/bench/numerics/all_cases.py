"""All extreme cases, in the order of the table."""

from enerf_ns.bench.numerics import (  # isort: skip - in the order of the table
    poses, scene, drawing, brightness, rendering, training, scores, flags,
)  # fmt: skip
from enerf_ns.bench.numerics.case import CASES

__all__ = ["CASES", "brightness", "drawing", "flags", "poses", "rendering", "scene", "scores", "training"]

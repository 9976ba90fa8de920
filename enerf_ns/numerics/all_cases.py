"""All extreme cases, in the order in which they are shown."""

from enerf_ns.numerics import brightness, drawing, flags, poses, rendering, scores, training
from enerf_ns.numerics.case import CASES

__all__ = ["CASES", "brightness", "drawing", "flags", "poses", "rendering", "scores", "training"]

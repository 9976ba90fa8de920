"""Presets for the five simulated sequences of the E-NeRF paper (Klenk et al., RA-L 2023), as `enerf simulate spiral1`.

Scene, motion, strength of blur, size and number of frames follow the paper. The paper does not state speed, exposure
and field of view; they are chosen here so that the presets of `ns-train` with the same names suit the simulated
sequences. `USUAL` has the values for all other scenes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from enerf_ns.dataparsers.recording.trajectory import Trajectory
from enerf_ns.simulator.trajectories import MOTIONS


@dataclass(frozen=True)
class SimulationPreset:
    """Values of settings that are left out."""

    scene: Literal["roads", "moon"] | None
    """Name of the scene in `scenes.SCENES`; None for any other scene."""
    motion: Literal["shake", "spiral"]
    """Motion of the camera: forward-facing with abrupt turns, or an inward spiral."""
    turns_per_second: float | None
    """Reversals per second of a shaking camera, or rounds per second of a spiral; None for the motion's default."""
    num_frames: int
    """Number of frames, as in the configs of the paper."""
    duration: float
    """Duration of the recording, seconds."""
    exposure_ms: float
    """Exposure of the blurred frames, milliseconds."""
    blur: float
    """Motion of the picture during an exposure, pixels: mean over pixels, frames and many seeds; nan if unknown."""
    width: int = 640
    """Width of events and frames, pixels."""
    height: int = 480
    """Height of events and frames, pixels."""
    field_of_view: float = 60.0
    """Horizontal field of view, degrees."""
    contrast_thresholds: tuple[float, float] = (0.2, 0.2)
    """Contrast thresholds of on and off events that the paper trains with."""

    def trajectory(self, camera: np.ndarray, target: np.ndarray, rng: np.random.Generator) -> Trajectory:
        """The trajectory of this preset; for the arguments see `trajectories.shake`."""
        turns = () if self.turns_per_second is None else (self.turns_per_second,)
        return MOTIONS[self.motion](round(self.duration * 1e9), camera, target, rng, *turns)


PRESETS = {
    "spiral1": SimulationPreset("roads", "spiral", 1.2, num_frames=66, duration=1.65, exposure_ms=10.0, blur=4.5),
    "spiral2": SimulationPreset("roads", "spiral", 1.2, num_frames=48, duration=1.2, exposure_ms=10.0, blur=4.5),
    "shake-moon1": SimulationPreset("moon", "shake", 3.0, num_frames=65, duration=1.625, exposure_ms=10.0, blur=4.3),
    "shake-moon2": SimulationPreset("moon", "shake", 4.0, num_frames=77, duration=1.925, exposure_ms=16.0, blur=9.2),
    "shake-carpet1": SimulationPreset(
        "roads", "shake", 6.0, num_frames=41, duration=1.025, exposure_ms=22.0, blur=20.0
    ),
}
"""Presets by name. Blur is mild (spiral1, spiral2, shake-moon1), medium (shake-moon2) or strong (shake-carpet1)."""

USUAL = SimulationPreset(
    None, "shake", None, num_frames=41, duration=1.0, exposure_ms=20.0, blur=float("nan"), width=160, height=120
)
"""Values for all other scenes."""

"""How a report scores held-out frames; apart from the report, so that its flags are told without loading Nerfstudio."""

from __future__ import annotations

from dataclasses import dataclass

from enerf_ns.dataparsers.recording.errors import FlagError
from enerf_ns.evaluation.lpips import Net
from enerf_ns.evaluation.protocols import DEFAULT_PROTOCOL, PROTOCOLS


@dataclass(frozen=True)
class Scoring:
    """How held-out frames are scored; by default as every run is at its end."""

    protocol: str = DEFAULT_PROTOCOL
    """What is done to the brightness of renders before they are compared: log-affine-set, log-affine-image, log-offset,
    eventnerf, gamma-affine or raw."""
    lpips: tuple[Net, ...] = ("alex",)
    """Networks of LPIPS."""
    crop: tuple[int, int] | None = None
    """Height and width of the middle of each frame that alone is scored, pixels; None: all."""

    def __post_init__(self) -> None:
        if self.protocol not in PROTOCOLS:
            raise FlagError(f"There is no --protocol {self.protocol}; choose one of {', '.join(PROTOCOLS)}.")


DEFAULT_SCORING = Scoring()

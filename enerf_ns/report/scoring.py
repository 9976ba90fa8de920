"""Scoring of held-out frames in a report, in a module of its own so that --help need not load Nerfstudio."""

from __future__ import annotations

from dataclasses import dataclass

from enerf_ns.dataparsers.recording.errors import FlagError
from enerf_ns.evaluation.lpips import Net
from enerf_ns.evaluation.protocols import DEFAULT_PROTOCOL, PROTOCOLS


@dataclass(frozen=True)
class Scoring:
    """Scoring of held-out frames. The defaults are those of the scores at the end of every run."""

    protocol: str = DEFAULT_PROTOCOL
    """Correction of the brightness of renders before they are compared with frames: log-affine-set, log-affine-image,
    log-offset, eventnerf, gamma-affine or raw."""
    lpips: tuple[Net, ...] = ("alex",)
    """Networks of LPIPS: alex (AlexNet), vgg (VGG-16)."""
    crop: tuple[int, int] | None = None
    """Height and width in pixels of the central part of each frame that is scored. Default: the whole frame."""

    def __post_init__(self) -> None:
        if self.protocol not in PROTOCOLS:
            raise FlagError(f"There is no --protocol {self.protocol}; choose one of {', '.join(PROTOCOLS)}.")


DEFAULT_SCORING = Scoring()

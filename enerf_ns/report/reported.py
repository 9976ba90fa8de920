"""A run with the contents of its report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from enerf_ns.evaluation.protocols import DEFAULT_PROTOCOL
from enerf_ns.report.pictures import Column
from enerf_ns.report.run_files import RunFiles

SENSOR_PARTS = ("threshold per polarity", "threshold map", "refractory period", "response", "leak", "bandwidth")
"""Choices that describe the sensor."""
ALWAYS_STATED = ("threshold per polarity", "response")
"""Choices whose value describes the sensor even where nothing of it is learned."""


@dataclass
class Reported:
    """A run with the contents of its report."""

    files: RunFiles
    name: str = ""
    prefix: str = ""
    """Beginning of the names of the run's own files: empty, or a folder."""
    scores: dict[str, Any] = field(default_factory=dict)
    protocol: str = DEFAULT_PROTOCOL
    """Name of the protocol of the scores."""
    step: int = 0
    """Training step of the field that is scored."""
    num_frames: int = 0
    """Number of held-out frames that are scored."""
    over_all_frames: bool = False
    seconds: float | None = None
    """Training time up to the scored step, s."""
    events: int | None = None
    verdict: str = ""
    """Sentence on whether the events are explained; empty if the run did not learn from events."""
    sensor: str = ""
    """Size and lens of the sensor; empty if the recording is gone."""
    columns: list[Column] = field(default_factory=list)
    """Pictures of held-out views."""
    caption: str = ""
    """Sentences about the pictures, or about the picture that stands for them."""
    picture: tuple[str, bytes] | None = None
    """Name and content of the file with all pictures."""
    moving: bytes | None = None
    """Animated WebP of the recorded path."""
    video: bytes | None = None
    poster: bytes | None = None
    """WebP of a picture of the video."""
    video_note: str = ""
    """Caption of the video."""
    mesh: bytes | None = None
    """Animated WebP of the mesh."""
    poses: list[dict[str, Any]] = field(default_factory=list)
    """Errors that were found in clock, poses and lens, as `Finding.as_dict` gives them."""
    corrections: bytes | None = None
    """PNG of the corrections of the poses."""
    at_stated_poses: dict[str, float] = field(default_factory=dict)
    """Scores at the poses of the recording, if the run refined them."""
    notes: list[str] = field(default_factory=list)
    """Sentences about missing parts of the report, with advice."""

    @property
    def summary(self) -> str:
        """The verdict on the events, and how well renders match held-out frames; empty without scores."""
        psnr = self.scores.get("psnr")
        frames = "" if psnr is None else f"Renders match held-out frames with a PSNR of {psnr:.1f} dB."
        return " ".join(filter(None, [self.verdict, frames]))

    @property
    def has_frames(self) -> bool:
        """Whether held-out frames exist, as far as the files of the run show it."""
        return bool(self.num_frames) or any(row.num_frames for row in self.files.history)

    def entry(self) -> dict[str, Any]:
        """The entry of the run in scores.json."""
        entry: dict[str, Any] = {"state": self.files.state, "step": self.step, "train_seconds": self.seconds}
        entry |= {"events": self.events} if self.events is not None else {}
        entry |= {"verdict": self.verdict} if self.verdict else {}
        over = {"protocol": self.protocol, "num_frames": self.num_frames} if self.scores else {}
        return entry | over | {"over_all_frames": self.over_all_frames} | self.scores

    def not_scored(self) -> list[str]:
        """A sentence for each score that some frames lack, with the reason. Without frames, none misses them."""
        reasons: dict[str, dict[str, list[int]]] = self.scores.get("not_scored", {})
        return [
            f"No {name}{self._of_frames(numbers)}: {reason}."
            for name, by_reason in reasons.items()
            for reason, numbers in by_reason.items()
            if self.has_frames or not numbers
        ]

    def _of_frames(self, numbers: Sequence[int]) -> str:
        """Words on some held-out frames; empty for all of them."""
        is_part = 0 < len(numbers) < self.num_frames
        return f" for frames {', '.join(map(str, numbers))}" if is_part else ""

    def making(self) -> list[tuple[str, str]]:
        """Command, machine, data and assumptions of the run, by name, as far as its files state them."""
        config, choices, origin = self.files.config, self.files.choices, self.files.origin
        steps = f"{self.step:,} steps" + ("" if self.seconds is None else f", {self.seconds:,.4g} s")
        recording = "" if config.data is None else config.data.name
        recording += "" if self.events is None else f", {self.events:,} events"
        known = [
            f"{choice['part']}: {choice['value'] or 'left out'}"
            for choice in choices
            if choice["part"] in SENSOR_PARTS and (choice["kept"] or choice["part"] in ALWAYS_STATED)
        ]
        rows = {
            "command": origin.get("command", ""),
            "version": origin.get("version", ""),
            "date": origin.get("date", str(config.timestamp)),
            "machine": origin.get("machine", ""),
            "training": f"{config.method_name} from {self.files.learns_from}, {steps} on {config.machine.device_type}, "
            f"seed {config.machine.seed}",
            "recording": recording,
            "sensor": "; ".join(filter(None, [self.sensor, *known])),
            "assumptions": " ".join(_assumptions(choices)),
            "folder": str(self.files.folder),
        }
        return [(name, value) for name, value in rows.items() if value]


def _assumptions(choices: Sequence[dict[str, Any]]) -> list[str]:
    """Sentences about what training assumed."""
    sentences = ["The scene does not move, and its light does not change."]
    for choice in choices:
        if choice["part"] == "threshold per polarity" and "assumed" in choice["why"]:
            sentences.append(
                f"Mean threshold assumed: brightness is known up to scale. Thresholds are {choice['value']}, since "
                f"{choice['why']}. If the true mean differs by a factor, so does log brightness."
            )
        elif choice["part"] == "level of brightness" and choice["kept"]:
            sentences.append(f"Level of brightness: {choice['value']}, since {choice['why']}.")
        elif choice["part"] == "view direction" and not choice["kept"]:
            sentences.append(f"A surface looks the same from all directions, since {choice['why']}.")
    return sentences

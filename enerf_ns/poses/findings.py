"""Errors that a training found in clock, poses and lens of a recording, in words and with standard errors."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float64

from enerf_ns.dataparsers.recording.recording import EventRecording
from enerf_ns.dataparsers.recording.trajectory import evenly_spaced
from enerf_ns.poses.corrections import Corrections, Drift
from enerf_ns.poses.refiner import IDENTIFIABLE, Part, PoseRefiner

INSTANTS, PLACES = 64, 5
"""Number of instants, and of columns and rows of pixels, at which `picture_shift` compares two cameras."""

FLAGS: dict[Part, str] = {
    "clock": "--pipeline.refine-clock",
    "rate": "--pipeline.refine-clock",
    "rotation": "--pipeline.refine-mount",
    "translation": "--pipeline.refine-mount",
    "lens": "--pipeline.refine-lens",
    "drift": "--pipeline.refine-drift",
    "noise": "--pipeline.refine-drift",
}
"""Flag of `ns-train` that forces or forbids the correction of each part."""


@dataclass(frozen=True)
class Finding:
    """The error of one part of clock, poses or lens."""

    what: str
    """Name of the part."""
    value: str
    """Value with its unit and its standard error."""
    is_corrected: bool
    """Whether training corrected it."""
    is_identifiable: bool
    """Whether the recording determines the value. If not, the part stays as it was stated."""
    pixels: float
    """Pixels by which the correction moves the picture, root mean square over pixels and time."""
    flag: str
    """Flag of `ns-train` that forces or forbids the correction."""

    def as_dict(self) -> dict[str, Any]:
        """The fields by name, for JSON."""
        return asdict(self)


def findings(refiner: PoseRefiner, distance: float) -> list[Finding]:
    """The errors that a training found, one for each part.

    Args:
        refiner: At the end of the training, or while it goes on.
        distance: Usual depth of the scene, metres.
    """
    now, recording = refiner.corrections, refiner.recording
    errors = {part: refiner.errors_of(part) for part in refiner.parts if part != "noise"}
    turn, turn_error = (np.degrees(np.linalg.norm(both)) for both in (now.rotation, errors["rotation"]))
    shift, shift_error = (1e3 * np.linalg.norm(both) for both in (now.translation, errors["translation"]))
    focal_error, *distortion_error = errors["lens"]
    lens = f"focal length {now.focal_scale:.4f} ± {focal_error:.4f} of the stated one"
    if distortion_error:
        lens += f", first coefficient of distortion {now.distortion:+.4f} ± {distortion_error[0]:.4f}"
    one_by_one = {
        "clock": (
            "clock of the poses",
            f"{now.delay:+.2f} ± {errors['clock'][0]:.2f} ms late",
            replace(now, delay=0.0),
        ),
        "rate": (
            "clock rate of the poses",
            f"{now.delay_rate:+.3f} ± {errors['rate'][0]:.3f} ms per second",
            replace(now, delay_rate=0.0),
        ),
        "rotation": (
            "mount, rotation",
            f"{turn:.2f} ± {turn_error:.2f} degrees",
            replace(now, rotation=(0.0, 0.0, 0.0)),
        ),
        "translation": (
            "mount, shift",
            f"{shift:.1f} ± {shift_error:.1f} mm",
            replace(now, translation=(0.0, 0.0, 0.0)),
        ),
        "lens": ("lens", lens, replace(now, focal_scale=1.0, distortion=0.0)),
        "drift": ("drift", _size(now.drift), replace(now, drift=None)),
    }
    if "noise" in refiner.parts:
        one_by_one["noise"] = ("noise after smoothing", _size(now.noise), replace(now, noise=None))
    found = []
    for part, (what, value, without) in one_by_one.items():
        known = part in ("drift", "noise") or bool((errors[part] < IDENTIFIABLE * refiner.units[part]).all())
        moved = picture_shift(recording, without, now, distance)
        found.append(Finding(what, value, part in refiner.corrected, known, moved, FLAGS[part]))
    return found


def _size(drift: Drift | None) -> str:
    """Root mean square of shift and turn, in words."""
    if drift is None:
        return "none"
    values = drift.at(evenly_spaced(drift.basis.start, drift.basis.end, 256))
    far, wide = (np.sqrt((values[:, some] ** 2).sum(axis=1).mean()) for some in (slice(3), slice(3, 6)))
    return f"{1e3 * far:.2g} mm and {np.degrees(wide):.2g} degrees, root mean square"


def picture_shift(recording: EventRecording, first: Corrections, second: Corrections, distance: float) -> float:
    """Pixels by which points move in the picture between two corrections, root mean square.

    Args:
        recording: As it was read.
        first, second: The two corrections.
        distance: Depth of the points, metres.
    """
    times = recording.instants(INSTANTS)
    before, after = (corrections.poses(recording.trajectory, times) for corrections in (first, second))
    camera, other = (corrections.camera(recording.camera) for corrections in (first, second))
    rows, columns = (np.linspace(0, side - 1, PLACES).round().astype(int) for side in (camera.height, camera.width))
    places = np.ix_(rows, columns)
    seen, now = (lens.pixel_directions()[places].reshape(-1, 3) for lens in (camera, other))
    world = before[:, None, :, 3] + distance * seen @ before[:, :, :3].transpose(0, 2, 1)
    there = (world - after[:, None, :, 3]) @ after[:, :, :3]
    apart: Float64[np.ndarray, "times places 2"] = there[..., :2] / there[..., 2:].clip(min=1e-9) - now[:, :2]
    return float(np.sqrt(((np.array([camera.fx, camera.fy]) * apart) ** 2).sum(axis=-1).mean()))

"""The validation set: different recordings on which changes of defaults are chosen and checked.

A default that is good for one scene may be bad for others. So a default is changed only if no recording of `CHOSEN_ON`
and `ONLY_SCORED` loses more than `tables.LARGEST_LOSS` (`enerf bench validation --against FILE`). Defaults are
chosen on the recordings of `CHOSEN_ON` alone.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

from enerf_ns.bench.experiment import Sequence as Recording

KEYS_PER_SECOND = 40
"""Key frames per second of the paths."""

Vector = tuple[float, float, float]


def _part(shape: str, size: Any, position: Sequence[float], texture: str, brightness: Sequence[float], **more: Any):
    return {
        "shape": shape,
        "size": size,
        "position": list(position),
        "texture": texture,
        "brightness": list(brightness),
        **more,
    }


UPRIGHT, TURNED = {"rotation": [90, 0, 0]}, {"rotation": [0, 0, 25]}


def _swing(seconds: float, camera: Vector, target: Vector, reach: Vector, gaze: Vector, hertz: Vector) -> str:
    """Key frames of a camera whose position and target oscillate, with a frequency for each axis."""
    rows = []
    for step in range(round(seconds * KEYS_PER_SECOND) + 1):
        time = step / KEYS_PER_SECOND
        swings = [math.sin(2.0 * math.pi * rate * time + axis) for axis, rate in enumerate(hertz)]
        looks = [math.sin(2.0 * math.pi * 0.7 * rate * time + 2.0 + axis) for axis, rate in enumerate(hertz)]
        place = [c + r * s for c, r, s in zip(camera, reach, swings, strict=True)]
        look = [t + g * s for t, g, s in zip(target, gaze, looks, strict=True)]
        rows.append((time, *place, *look))
    return _lines(rows)


def _straight(seconds: float, begin: Vector, end: Vector, target: Vector, target_end: Vector) -> str:
    """Key frames of a camera whose position and target move along straight lines."""
    return _lines([(0.0, *begin, *target), (seconds, *end, *target_end)])


def _around(seconds: float, radius: float, height: float, bob: float) -> str:
    """Key frames of a camera that circles the origin once while it moves up and down."""
    rows = []
    for step in range(round(seconds * KEYS_PER_SECOND) + 1):
        turn = 2.0 * math.pi * step / (seconds * KEYS_PER_SECOND)
        rows.append(
            (
                step / KEYS_PER_SECOND,
                radius * math.cos(turn),
                radius * math.sin(turn),
                height + bob * math.sin(5.0 * turn),
                0.0,
                0.0,
                0.0,
            )
        )
    return _lines(rows)


def _lines(rows: Sequence[Sequence[float]]) -> str:
    return "".join(" ".join(f"{value:.6g}" for value in row) + "\n" for row in rows)


def _recording(
    name: str,
    parts: Sequence[Mapping[str, Any]],
    path: str,
    size: tuple[int, int],
    thresholds: float | None = 0.2,
    sensor: Mapping[str, Any] | None = None,
    light: bool = True,
    changes: Mapping[str, Any] | None = None,
    **simulation: Any,
) -> Recording:
    """A sequence of a scene along a path. Its sensor is ideal and stated, unless a sensor is given."""
    scene = {"parts": list(parts), "camera": [0, 0, 0], "target": [0, 1, 0]}
    if not light:
        scene["light"] = None
    stated = {} if thresholds is None else {"contrast_thresholds": (thresholds, thresholds)}
    return Recording(
        f"{name}.json",
        changes=changes or {},
        simulation={"key_frames": f"{name}.txt", "width": size[0], "height": size[1], **stated, **simulation},
        sensor=sensor,
        files={f"{name}.json": json.dumps(scene), f"{name}.txt": path},
    )


FLOOR = (
    _part("plane", [12, 12], (0, 1, 0), "clouds", (0.38, 0.52)),
    _part("plane", [12, 5], (0, 2.1, 1), "clouds", (0.3, 0.4), **UPRIGHT),
    _part("box", [0.25, 0.25, 0.3], (-0.45, 0.15, 0.15), "plain", (0, 0.9), **TURNED),
    _part("box", [0.2, 0.3, 0.4], (0.45, 0.25, 0.2), "mosaic", (0.1, 0.9), rotation=[0, 0, -20]),
    _part("box", [0.3, 0.2, 0.5], (0.1, 0.9, 0.25), "plain", (0, 0.12), rotation=[0, 0, 10]),
    _part("box", [0.2, 0.2, 0.2], (-0.65, 0.95, 0.1), "text", (0.1, 0.85), rotation=[0, 0, 40]),
    _part("box", [0.3, 0.3, 0.3], (0.95, 1.1, 0.15), "plain", (0, 0.75), rotation=[0, 0, 15]),
    _part("ball", 0.3, (0.05, 0.1, 0.15), "plain", (0, 0.2)),
    _part("ball", 0.2, (-0.1, 0.5, 0.1), "lines", (0.2, 0.95)),
)
CLUTTER = (
    _part("plane", [7, 6], (0, 1.2, -0.45), "clouds", (0.4, 0.5)),
    _part("plane", [7, 4], (0, 2.6, 0.5), "clouds", (0.3, 0.45), **UPRIGHT),
    _part("box", [0.22, 0.2, 0.55], (-0.3, 0.6, -0.17), "mosaic", (0.1, 0.9), **TURNED),
    _part("box", [0.2, 0.2, 0.35], (0.32, 0.62, -0.27), "text", (0.15, 0.9), rotation=[0, 0, -20]),
    _part("box", [0.3, 0.3, 0.8], (0.7, 1.5, -0.05), "plain", (0, 0.85), rotation=[0, 0, 10]),
    _part("box", [0.3, 0.4, 0.6], (-0.8, 1.7, -0.15), "plain", (0, 0.12), rotation=[0, 0, 40]),
    _part("ball", 0.34, (0, 1.15, -0.28), "lines", (0.2, 0.95)),
    _part("ball", 0.2, (0.02, 0.62, -0.32), "plain", (0, 0.8)),
)
STATUE = (
    _part("box", [0.5, 0.4, 0.3], (0, 0, -0.3), "mosaic", (0.2, 0.85), **TURNED),
    _part("box", [0.24, 0.24, 0.4], (-0.02, 0.03, 0.05), "text", (0.2, 0.9), rotation=[0, 0, -15]),
    _part("ball", 0.26, (0, 0, 0.36), "roads", (0, 1)),
    _part("ball", 0.16, (0.24, -0.1, -0.08), "lines", (0.3, 0.9)),
)
RELIEF = (
    _part("plane", [8, 6], (0, 2.1, 0), "text", (0.25, 0.8), **UPRIGHT),
    _part("box", [0.5, 0.12, 0.4], (-0.4, 2.05, 0.2), "mosaic", (0.2, 0.8)),
    _part("box", [0.4, 0.16, 0.5], (0.5, 2.03, -0.15), "clouds", (0.2, 0.8)),
    _part("ball", 0.2, (0.05, 2.05, -0.3), "lines", (0.2, 0.9)),
)
FAR = (
    _part("plane", [16, 20], (-4, 8, 0), "mosaic", (0.2, 0.8), **UPRIGHT),
    _part("plane", [200, 200], (0, 50, 0), "moon", (0, 1), **UPRIGHT),
    _part("box", [0.5, 0.4, 0.6], (-0.5, 1.6, -0.2), "text", (0.15, 0.85), **TURNED),
    _part("ball", 0.45, (0.4, 1.3, 0.15), "clouds", (0.2, 0.9)),
    _part("box", [0.3, 0.3, 0.9], (0.2, 2.0, -0.1), "mosaic", (0.15, 0.9)),
)
ROOM = (
    _part("box", [4, 4, 2.4], (0, 1.2, 0.2), "bricks", (0.3, 0.6), inward=True),
    _part("box", [0.8, 0.5, 0.7], (-0.5, 2.1, -0.65), "wood", (0.1, 0.75), **TURNED),
    _part("box", [0.5, 0.4, 0.5], (0.6, 1.9, -0.75), "plain", (0, 0.85), rotation=[0, 0, -20]),
    _part("ball", 0.4, (0.1, 1.5, -0.2), "mosaic", (0.15, 0.9)),
    _part("ball", 0.36, (-0.7, 1.5, 0.35), "plain", (0, 0.15)),
)
PLAIN = (
    _part("plane", [9, 6], (0, 2.6, 0), "plain", (0, 0.45), **UPRIGHT),
    _part("plane", [9, 6], (0, 1.2, -0.6), "plain", (0, 0.6)),
    _part("box", [0.4, 0.4, 0.5], (-0.5, 1.5, -0.35), "plain", (0, 0.85), **TURNED),
    _part("box", [0.35, 0.35, 0.8], (0.55, 1.9, -0.2), "plain", (0, 0.2), rotation=[0, 0, -20]),
    _part("ball", 0.4, (0.05, 1.2, -0.3), "plain", (0, 0.75)),
    _part("box", [0.5, 0.1, 0.35], (-0.25, 2.45, 0.45), "lines", (0.2, 0.9)),
)
CORRIDOR = (
    _part("box", [2.0, 14, 1.8], (0, 6, 0), "bricks", (0.25, 0.75), inward=True),
    _part("box", [0.4, 0.4, 0.7], (-0.7, 2.6, -0.55), "mosaic", (0.1, 0.9), **TURNED),
    _part("box", [0.3, 0.3, 1.2], (0.8, 3.6, -0.3), "plain", (0, 0.85)),
    _part("ball", 0.4, (0.45, 2.2, -0.65), "lines", (0.2, 0.9)),
)
NEAR_OBJECT = (
    _part("plane", [5, 4], (0, 1.5, 0), "mosaic", (0.3, 0.6), **UPRIGHT),
    _part("box", [0.12, 0.1, 0.14], (-0.02, 0.38, -0.03), "text", (0.15, 0.9), **TURNED),
    _part("ball", 0.09, (0.1, 0.36, 0.03), "lines", (0.2, 0.9)),
    _part("box", [0.5, 0.3, 0.1], (0, 0.5, -0.16), "wood", (0.1, 0.7)),
)

CHOSEN_ON: dict[str, Recording] = {
    "floor": _recording(
        "floor",
        FLOOR,
        _swing(1.0, (0, -0.62, 0.6), (0, 0.4, 0.05), (0.42, 0.18, 0.2), (0.22, 0.1, 0.08), (3.7, 3.1, 4.3)),
        (160, 120),
    ),
    "relief": _recording(
        "relief",
        RELIEF,
        _straight(1.5, (-0.15, 0, 0), (0.15, 0, 0.05), (-0.35, 2, 0), (0.35, 2, 0)),
        (160, 120),
        num_frames=41,
    ),
    "statue": _recording(
        "statue",
        STATUE,
        _around(2.0, 1.9, 0.5, 0.25),
        (346, 260),
        bayer_pattern="RGGB",
        colour=True,
        field_of_view=45.0,
        num_frames=61,
    ),
    "room-hard": _recording(
        "room",
        ROOM,
        _swing(3.0, (0, 0, 0.1), (0, 1.9, -0.2), (0.25, 0.15, 0.2), (0.2, 0.1, 0.15), (0.9, 0.7, 1.1)),
        (160, 120),
        thresholds=None,
        sensor={"threshold_spread": 0.06, "refractory_period": 8_000_000, "contrast_thresholds": (0.28, 0.2)},
    ),
    "far": _recording(
        "far",
        FAR,
        _swing(1.0, (0, 0, 0), (0, 2, 0), (0.25, 0.1, 0.15), (0.1, 0, 0.1), (2.3, 1.9, 2.9)),
        (160, 120),
        light=False,
    ),
}
"""Recordings on which defaults may be chosen."""

ONLY_SCORED: dict[str, Recording] = {
    "clutter": _recording(
        "clutter",
        CLUTTER,
        _swing(1.0, (0, -0.05, 0.2), (0, 1.3, -0.15), (0.3, 0.14, 0.28), (0.25, 0.1, 0.2), (4.1, 2.9, 3.5)),
        (160, 120),
    ),
    "plain": _recording(
        "plain",
        PLAIN,
        _swing(1.5, (0, 0, 0), (0, 1.6, -0.2), (0.2, 0.1, 0.12), (0.25, 0, 0.15), (1.5, 1.1, 1.9)),
        (160, 120),
    ),
    "corridor": _recording(
        "corridor",
        CORRIDOR,
        _straight(1.5, (-0.1, 0, 0), (0.15, 1.3, 0.1), (0, 4, -0.2), (0.1, 5, -0.2)),
        (346, 260),
        num_frames=41,
    ),
    "near": _recording(
        "near",
        NEAR_OBJECT,
        _swing(1.0, (0, 0, 0.02), (0, 0.5, 0), (0.08, 0.03, 0.06), (0.03, 0, 0.03), (2.3, 1.7, 3.1)),
        (160, 120),
    ),
    "relief-large": _recording(
        "relief-large",
        RELIEF,
        _straight(0.6, (-0.14, 0.1, 0.05), (0.16, 0, -0.05), (-0.05, 2, 0), (0.05, 2, 0)),
        (640, 480),
        num_frames=21,
    ),
    "dense": _recording(
        "dense",
        ROOM,
        _swing(1.0, (0, 0, 0.1), (0, 1.9, -0.2), (0.25, 0.15, 0.2), (0.25, 0.1, 0.2), (2.7, 2.1, 3.3)),
        (160, 120),
        thresholds=0.08,
    ),
    "clutter-faults": _recording(
        "clutter-faults",
        CLUTTER,
        _swing(2.0, (0, -0.05, 0.2), (0, 1.3, -0.15), (0.25, 0.14, 0.22), (0.2, 0.1, 0.15), (1.7, 1.3, 2.1)),
        (160, 120),
        thresholds=None,
        sensor={
            "contrast_thresholds": (0.28, 0.2),
            "threshold_spread": 0.06,
            "leak_rate": 0.5,
            "shot_noise_rate": 2.0,
            "cutoff_frequency": 200.0,
            "timestamp_jitter": 200_000.0,
        },
    ),
}
"""Recordings that are only scored. No default is chosen on them."""

REAL = "slider_depth"
"""Name of a real recording on which defaults may be chosen. It needs --data."""

"""Depth range that events determine, for cameras that only rotate, bounded scenes, and scenes beyond the box.

    python benchmarks/parallax.py [RECORDING ...]

Events of points in closed form, and any recordings. Prints a Markdown table: the range of depth, or that the camera
only turns; the tiles whose votes pile up clearly at a depth, behind the camera (as many depths are chance) and at
infinity; and the share of the events from beyond the range.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from enerf_ns.bench.numerics.points import CAMERA, TURNING, noisy, points_between, recording_of_points, shaking
from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.recording.trajectory import Trajectory
from enerf_ns.dataparsers.scene.depth_range import (
    Parallax,
    measure_parallax,
    measure_share_beyond,
    recording_parallax,
    share_beyond,
)


def row(name: str, parallax: Parallax, share: float | None) -> None:
    """Prints a line of the table."""
    found = "only turns" if parallax.is_ruled_out else "unknown"
    if parallax.is_shown:
        near, far = parallax.depth_range
        found = f"{near:.3g} to {far:.3g} m"
    tiles = f"{len(parallax.depths)} / {parallax.num_by_chance} / {parallax.at_infinity[0]}"
    print(f"| {name} | {found} | {tiles} | {'-' if share is None else f'{share:.3f}'} |", flush=True)


def of_points(name: str, points: np.ndarray, positions: np.ndarray, noise: float = 0.0, kind: str = "white") -> None:
    """Prints the line of points whose camera shakes, with noise (metres) in its poses."""
    events, path, seen = recording_of_points(points, positions, TURNING)
    path = Trajectory(path.times, noisy(path.positions, noise, kind, seed=0), path.quaternions)
    parallax = measure_parallax(events, CAMERA, path)
    share = measure_share_beyond(events, CAMERA, path, parallax.depth_range) if parallax.is_shown else None
    far = float(np.mean(seen > 100))
    row(f"{name}{f'; {far:.2f} of the events from 300 m' if far else ''}", parallax, share)


if __name__ == "__main__":
    print("| events | found | tiles at a depth / behind / at infinity | share beyond |\n|---|---|---|---|")
    still = np.zeros((2000, 3))
    for kind in ("white", "drift"):
        for noise in (1e-6, 1e-4, 1e-3, 1e-2):
            of_points(
                f"points at 1 to 3 m, turning, poses off by {noise:g} m ({kind})",
                points_between(1, 3),
                still,
                noise,
                kind,
            )
    of_points("points at 1 to 3 m, shaking by 0.1 m", points_between(1, 3), shaking(0.1))
    for far_points in (40, 100, 200, 240, 340):
        generator = np.random.default_rng(4)
        depths = np.exp(generator.uniform(0.0, np.log(2.0), (400, 1)))
        depths[:far_points] = 300.0
        points = depths * np.append(generator.uniform(-0.6, 0.6, (400, 2)), np.ones((400, 1)), axis=1)
        of_points(f"{far_points} of 400 points at 300 m, the others at 1 to 2 m", points, shaking(0.1))
    for folder in map(Path, sys.argv[1:]):
        recording = read_recording(folder)
        parallax = recording_parallax(recording)
        row(folder.name, parallax, share_beyond(recording, parallax.depth_range) if parallax.is_shown else None)

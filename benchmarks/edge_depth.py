"""Error, coverage and time of the depth of edges (`enerf_ns.dataparsers.scene.edge_depth`) on simulated recordings.

    python benchmarks/edge_depth.py

It prints for each scene the median of |depth / true depth - 1|, the share of depths wrong by more than 5 %, the
share of pixels that have a depth, the share of the edges of brightness in the frame nearest in time (by Canny) that
have a depth within two pixels, and the processor time of all views. The true depth is that of this frame; of 3 x 3
pixels, the nearest depth counts, since an edge lies between two surfaces.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import cv2
import numpy as np
import torch

from enerf_ns.dataparsers.formats.registry import read_recording
from enerf_ns.dataparsers.index.indexing import index_events
from enerf_ns.dataparsers.recording.recording import Frames
from enerf_ns.dataparsers.scene.depth_range import scene_depth_range
from enerf_ns.dataparsers.scene.edge_depth import EdgeView, edge_depth
from enerf_ns.simulator.engine import simulate
from enerf_ns.simulator.settings import SimulationSettings

DURATIONS = {"shapes": 1.0, "carpet": 0.6, "roads": 0.6, "moon": 0.6}
"""Duration (s) of the recording of each scene."""


CANNY = 50, 150
"""Thresholds of Canny for the edges of a frame of 8 bits."""


def in_frame(view: EdgeView, frames: Frames) -> tuple[int, np.ndarray, np.ndarray, np.ndarray]:
    """The frame nearest in time, and column, row and depth there of the points of a view that it sees."""
    nearest = int(np.abs(frames.times - view.time).argmin())
    camera, pose = frames.camera, frames.trajectory.poses(torch.from_numpy(frames.times[[nearest]]))[0].numpy()
    seen = (view.points - pose[:, 3]) @ pose[:, :3]
    x, y = np.rint(seen[:, :2] / seen[:, 2:] * camera.fx + [camera.cx, camera.cy]).astype(int).T
    inside = (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)
    return nearest, x[inside], y[inside], seen[inside, 2]


def errors(view: EdgeView, frames: Frames) -> np.ndarray:
    """|depth / true depth - 1| of the points of a view that the frame nearest in time sees."""
    nearest, x, y, found = in_frame(view, frames)
    depth = frames.depth(nearest)
    assert depth is not None
    around = np.pad(depth, 1, mode="edge")
    true = np.stack([around[y + down, x + right] for down in range(3) for right in range(3)])
    return np.abs(found / true - 1).min(0)


def coverage(view: EdgeView, frames: Frames) -> float:
    """Share of the edges of the frame nearest in time that have a point of a view within two pixels."""
    nearest, x, y, _ = in_frame(view, frames)
    edges = cv2.Canny(np.ascontiguousarray(frames.image(nearest)[..., 0]), *CANNY) > 0
    points = np.zeros(edges.shape, np.uint8)
    points[y, x] = 1
    return float((cv2.dilate(points, np.ones((5, 5), np.uint8)) > 0)[edges].mean())


def main() -> None:
    titles = (
        "median error",
        "wrong by more than 5 %",
        "pixels with a depth",
        "edges with a depth",
        "processor time, s",
    )
    print("| scene | events |", " | ".join(titles), "|")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for scene, duration in DURATIONS.items():
        with tempfile.TemporaryDirectory() as folder:
            settings = SimulationSettings(scene, width=240, height=180, duration=duration)
            simulate(settings, Path(folder) / scene)
            recording = read_recording(Path(folder) / scene)
            depth_range, number = scene_depth_range(recording), len(index_events(recording))
            edge_depth(recording, depth_range, 1)  # compiles
            start = time.process_time()
            views = edge_depth(recording, depth_range)
            seconds = time.process_time() - start
            assert recording.frames is not None
            found = np.concatenate([errors(view, recording.frames) for view in views])
            covered = np.mean([coverage(view, recording.frames) for view in views])
            share = np.mean([np.mean(view.depth > 0) for view in views])
            print(
                f"| {scene} | {number:,} | {100 * np.median(found):.2f} % | {100 * np.mean(found > 0.05):.1f} % | "
                f"{100 * share:.1f} % | {100 * covered:.0f} % | {seconds:.1f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()

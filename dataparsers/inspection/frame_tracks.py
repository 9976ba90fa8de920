"""Corners that are followed from frame to frame: whether they go where poses and calibration let them."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float32, Float64, UInt8

from enerf_ns.dataparsers.recording.picture_depth import brightness, in_8_bits
from enerf_ns.dataparsers.recording.recording import EventRecording, Frames

NUM_PAIRS = 24
"""Most pairs of frames between which corners are followed."""

FRAMES_APART = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32)
"""How many frames a pair may be apart; the first is taken over which corners move by `SHORTEST_WAY` and are found."""

SHORTEST_WAY = 0.04
"""By how much corners must move (median), as a share of the width."""

MOST_CORNERS, FEWEST_CORNERS = 300, 20

CORNER_QUALITY = 0.01
"""Strength of a corner, as a share of the strongest one's."""

CORNER_DISTANCE = 1 / 60
"""How far corners are apart, as a share of the width."""

SEARCHED = {"winSize": (15, 15), "maxLevel": 4}
"""Around each corner, on how many pyramid levels (Lucas and Kanade; OpenCV)."""

FARTHEST_RETURN = 0.5
"""Pixels by which a corner may be missed when it is followed back."""

LARGEST_MISS = 5.0
"""Pixels above which all misses count alike."""

NEAREST_DEPTH = 0.05
"""Depth (relative to the nearest thing) at which what is behind the camera is put."""


@dataclass(frozen=True, eq=False)
class Pair:
    """Corners that were found in two frames."""

    first: int
    second: int
    """Numbers among the frames."""
    directions: Float64[np.ndarray, "2 corners 2"]
    """x / z and y / z of where each is seen in the first and in the second frame, by the calibration as stated."""


@dataclass(frozen=True, eq=False)
class FrameTracks:
    """Corners followed from frame to frame by optical flow, there and back."""

    frames: Frames
    pairs: list[Pair]

    @classmethod
    def of(cls, recording: EventRecording) -> FrameTracks | None:
        """Corners of the sharp frames, else of the blurred ones; None where there are no two that share some."""
        frames = recording.frames or recording.blurred_frames
        if frames is None or (recording.reconstructed_by is not None and recording.frames is None):
            return None
        known = np.flatnonzero(recording.knows_poses(frames))
        starts = np.unique(np.linspace(0, len(known) - 2, NUM_PAIRS).round().astype(int)) if len(known) > 1 else []
        found = (_follow(frames, known[start:]) for start in starts)
        pairs = [pair for pair in found if pair is not None]
        return cls(frames, pairs) if pairs else None

    def misses(self, nearest: float, focal_scale: float = 1.0, delay: int = 0) -> list[Float64[np.ndarray, " corners"]]:
        """How far the corners of each pair are found from where they can be, pixels of a frame without distortion.

        Where the corner of the first frame can be in the second one is a line: a part of its epipolar line, from the
        nearest depth to infinity; a point where the camera only turned.

        Args:
            nearest: Least depth of the scene, metres.
            focal_scale: The focal length as a multiple of the stated one.
            delay: How much later the poses are stamped than frames of the same instant, ns.
        """
        trajectory = self.frames.trajectory
        focal = np.array([self.frames.camera.fx, self.frames.camera.fy])
        found = []
        for pair in self.pairs:
            times = self.frames.times[[pair.first, pair.second]] + delay
            first, second = trajectory.poses(torch.from_numpy(times.clip(trajectory.start, trajectory.end))).numpy()
            x, y = pair.directions[0].T / focal_scale
            far = np.stack([x, y, np.ones_like(x)], axis=1) @ first[:, :3].T @ second[:, :3]
            near = far + (first[:, 3] - second[:, 3]) @ second[:, :3] / nearest
            begin, end = (
                focal_scale * focal * point[:, :2] / np.maximum(point[:, 2:], NEAREST_DEPTH) for point in (far, near)
            )
            way, miss = end - begin, focal * pair.directions[1] - begin
            share = (miss * way).sum(1) / np.maximum((way**2).sum(1), 1e-12)
            found.append(np.linalg.norm(miss - share.clip(0, 1)[:, None] * way, axis=1))
        return found

    def fit(self, nearest: float, focal_scale: float, delay: int) -> Float64[np.ndarray, " pairs"]:
        """How much less than `LARGEST_MISS` corners are missed by on average, as a share of it; 1 at best."""
        misses = self.misses(nearest, focal_scale, delay)
        return np.array([1 - np.minimum(miss, LARGEST_MISS).mean() / LARGEST_MISS for miss in misses])


def _follow(frames: Frames, numbers: np.ndarray) -> Pair | None:
    """Corners of the first of some frames, in the next one in which they are elsewhere; None if they are not found."""
    width, first = frames.camera.width, _grey(frames, numbers[0])
    corners = cv2.goodFeaturesToTrack(first, MOST_CORNERS, CORNER_QUALITY, max(CORNER_DISTANCE * width, 3.0))
    for apart in FRAMES_APART:
        if corners is None or apart >= len(numbers):
            return None
        second = _grey(frames, numbers[apart])
        moved, is_found, _ = cv2.calcOpticalFlowPyrLK(first, second, corners, corners.copy(), **SEARCHED)
        back, is_back, _ = cv2.calcOpticalFlowPyrLK(second, first, moved, moved.copy(), **SEARCHED)
        returned = np.linalg.norm(back - corners, axis=2) < FARTHEST_RETURN
        kept = ((is_found > 0) & (is_back > 0) & returned)[:, 0]
        if kept.sum() < FEWEST_CORNERS:
            return None
        if np.median(np.linalg.norm(moved - corners, axis=2)[kept]) >= SHORTEST_WAY * width:
            looks = frames.camera.pixel_directions()[..., :2].astype(np.float32)
            empty, border = np.zeros((0, 0), np.float32), cv2.BORDER_REPLICATE
            seen = [
                cv2.remap(looks, at[kept], empty, cv2.INTER_LINEAR, borderMode=border)[:, 0] for at in (corners, moved)
            ]
            return Pair(int(numbers[0]), int(numbers[apart]), np.stack(seen).astype(np.float64))
    return None


def _grey(frames: Frames, number: int) -> UInt8[np.ndarray, "height width"]:
    picture: Float32[np.ndarray, "height width"] = brightness(frames.image(int(number))).mean(2, keepdims=True)
    return in_8_bits(picture)[..., 0]

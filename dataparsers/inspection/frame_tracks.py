"""Corners that are tracked from frame to frame, and their reprojection errors."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float32, Float64, UInt8

from enerf_ns.dataparsers.recording.picture_depth import brightness, in_8_bits
from enerf_ns.dataparsers.recording.recording import EventRecording, Frames

NUM_PAIRS = 24
"""Most pairs of frames between which corners are tracked."""

FRAMES_APART = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32)
"""Distances in the sequence at which a pair of frames is tried. The first one is used at which corners have moved by
`SHORTEST_WAY`."""

SHORTEST_WAY = 0.04
"""Smallest median motion of the corners of a pair, as a share of the width."""

MOST_CORNERS, FEWEST_CORNERS = 300, 20
"""Most corners of a frame, and fewest of a pair."""

CORNER_QUALITY = 0.01
"""Smallest strength of a corner, as a share of the strongest one's."""

CORNER_DISTANCE = 1 / 60
"""Smallest distance between corners, as a share of the width."""

OPTICAL_FLOW = {"winSize": (15, 15), "maxLevel": 4}
"""Window (pixels) and pyramid levels of OpenCV's optical flow (Lucas and Kanade)."""

FARTHEST_RETURN = 0.5
"""Pixels by which a corner that is tracked there and back may end beside its start."""

LARGEST_ERROR = 5.0
"""Reprojection error (pixels) above which all count alike."""

NEAREST_DEPTH = 0.05
"""Smallest depth of a reprojected point, relative to the depth of the line's near or far end. Points behind the camera
are put there."""


@dataclass(frozen=True, eq=False)
class Pair:
    """Corners that were found in two frames."""

    first: int
    """Number of the first frame."""
    second: int
    """Number of the second frame."""
    directions: Float64[np.ndarray, "2 corners 2"]
    """Directions (x / z, y / z) in which the first and the second frame see each corner, by the stated calibration."""


@dataclass(frozen=True, eq=False)
class FrameTracks:
    """Corners that optical flow tracks from one frame to another and back."""

    frames: Frames
    pairs: list[Pair]

    @classmethod
    def of(cls, recording: EventRecording) -> FrameTracks | None:
        """Tracks corners of the sharp frames, else of the blurred ones. None if no two frames share corners."""
        frames = recording.camera_frames
        if frames is None:
            return None
        known = np.flatnonzero(recording.knows_poses(frames))
        starts = np.unique(np.linspace(0, len(known) - 2, NUM_PAIRS).round().astype(int)) if len(known) > 1 else []
        found = (_follow(frames, known[start:]) for start in starts)
        pairs = [pair for pair in found if pair is not None]
        return cls(frames, pairs) if pairs else None

    def reprojection_errors(
        self, nearest: float, focal_scale: float = 1.0, delay: int = 0
    ) -> list[Float64[np.ndarray, " corners"]]:
        """Distances of the corners of each pair from their epipolar lines, pixels of a frame without distortion.

        The depth of a corner of the first frame is unknown, so that it may lie anywhere on a part of its epipolar line
        in the second frame: from the point of the nearest depth to the point of infinity. If the camera only turns, the
        line is a point.

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
            line, away = end - begin, focal * pair.directions[1] - begin
            share = (away * line).sum(1) / np.maximum((line**2).sum(1), 1e-12)
            found.append(np.linalg.norm(away - share.clip(0, 1)[:, None] * line, axis=1))
        return found

    def fit(self, nearest: float, focal_scale: float, delay: int) -> Float64[np.ndarray, " pairs"]:
        """1 less the mean reprojection error of each pair in units of `LARGEST_ERROR`: 1 at best, 0 at worst.

        The arguments are those of `reprojection_errors`.
        """
        errors = self.reprojection_errors(nearest, focal_scale, delay)
        return np.array([1 - np.minimum(error, LARGEST_ERROR).mean() / LARGEST_ERROR for error in errors])


def _follow(frames: Frames, numbers: np.ndarray) -> Pair | None:
    """Tracks corners from the first of some frames to the next one in which they have moved. None if they are lost."""
    width, first = frames.camera.width, _grey(frames, numbers[0])
    corners = cv2.goodFeaturesToTrack(first, MOST_CORNERS, CORNER_QUALITY, max(CORNER_DISTANCE * width, 3.0))
    for apart in FRAMES_APART:
        if corners is None or apart >= len(numbers):
            return None
        second = _grey(frames, numbers[apart])
        moved, is_found, _ = cv2.calcOpticalFlowPyrLK(first, second, corners, corners.copy(), **OPTICAL_FLOW)
        back, is_back, _ = cv2.calcOpticalFlowPyrLK(second, first, moved, moved.copy(), **OPTICAL_FLOW)
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

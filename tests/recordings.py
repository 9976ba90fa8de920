"""Writes tiny recordings in each format, for tests."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from enerf_ns.dataparsers.formats import event_recording
from enerf_ns.dataparsers.recording.recording import EventRecording, Events, Frames
from enerf_ns.dataparsers.recording.trajectory import Trajectory

WIDTH, HEIGHT = 24, 18

EVENTS = np.array(
    [
        # x, y, t (ns), p
        [3, 4, 110_000_000, 1],
        [23, 17, 200_000_000, -1],
        [0, 0, 250_000_001, 1],
        [3, 4, 250_000_001, -1],
        [3, 4, 400_000_000, 1],
        [0, 0, 900_000_000, 1],
    ]
)
"""Six events on a sensor of 24 x 18 pixels, all within the poses."""

POSE_TIMES = np.arange(11) * 100_000_000
FRAME_TIMES = np.array([150_000_000, 450_000_000, 750_000_000])


TRUE_EVENTS = np.column_stack(
    [
        np.random.default_rng(3).integers(0, WIDTH, 2000),
        np.random.default_rng(4).integers(0, HEIGHT, 2000),
        np.sort(np.random.default_rng(5).integers(1000, 999_000, 2000)) * 1000,
        np.random.default_rng(6).integers(0, 2, 2000),
    ]
)
"""Many events x y t (ns, whole microseconds) p (0 or 1), over the poses."""


def joined(pieces: Iterable[Events]) -> Events:
    """The events of a stream as one array a column."""
    held = list(pieces)
    return Events(*(np.concatenate([getattr(piece, name) for piece in held]) for name in "xytp"))


def poses() -> np.ndarray:
    """Positions and quaternions xyzw, float64 [11, 7]: a slide along x while turning about y."""
    angles = np.linspace(0.0, 0.5, len(POSE_TIMES)) / 2
    zero = np.zeros_like(angles)
    return np.column_stack([np.linspace(0, 1, len(angles)), zero, zero, zero, np.sin(angles), zero, np.cos(angles)])


def check_poses(trajectory: Trajectory, expected: np.ndarray) -> None:
    """Compares poses at `POSE_TIMES` with matrices, float64 [11, 4, 4]."""
    np.testing.assert_array_equal(trajectory.times, POSE_TIMES)
    np.testing.assert_allclose(trajectory.positions, expected[:, :3, 3], atol=1e-12)
    found = Rotation.from_quat(trajectory.quaternions).as_matrix()
    np.testing.assert_allclose(found, expected[:, :3, :3], atol=1e-12)


def image(index: int, channels: int = 1) -> np.ndarray:
    """A picture that differs from frame to frame, uint8 [18, 24, channels]."""
    return np.random.default_rng(index).integers(0, 256, (HEIGHT, WIDTH, channels), dtype=np.uint8)


def write_image(path: Path, pixels: np.ndarray) -> None:
    Image.fromarray(pixels[..., 0] if pixels.shape[2] == 1 else pixels).save(path)


def seconds(nanoseconds: int) -> str:
    """As the UZH data set writes times."""
    return f"{nanoseconds // 10**9}.{nanoseconds % 10**9:09d}"


def write_davis(folder: Path, frames: bool = True, zero: int = 0) -> Path:
    """A recording in the text format of the UZH event-camera dataset whose clock shows `zero` (ns) at the start."""
    folder.mkdir()
    (folder / "events.txt").write_text(
        "".join(f"{seconds(zero + t)} {x} {y} {(p + 1) // 2}\n" for x, y, t, p in EVENTS.tolist())
    )
    rows = zip(POSE_TIMES.tolist(), poses().tolist(), strict=True)
    (folder / "groundtruth.txt").write_text(
        "".join(f"{seconds(zero + t)} {' '.join(map(repr, pose))}\n" for t, pose in rows)
    )
    (folder / "calib.txt").write_text("330.0 340.0 11.5 8.5 -0.14 0.09 -0.0003 0.0002 0.0\n")
    if frames:
        (folder / "images").mkdir()
        lines = []
        for i, time in enumerate(FRAME_TIMES.tolist()):
            write_image(folder / f"images/frame_{i:08d}.png", image(i))
            lines.append(f"{seconds(zero + time)} images/frame_{i:08d}.png\n")
        (folder / "images.txt").write_text("".join(lines))
    return folder


def write_esim(
    folder: Path,
    frames: tuple[str, ...] = ("images",),
    channels: int = 3,
    depth: bool = False,
    dtype: type = np.float64,
) -> Path:
    """A recording in E-NeRF's ESIM layout: events in two files, frames in the folders named."""
    (folder / "events").mkdir(parents=True)
    np.save(folder / "events/00000.npy", EVENTS[:4].astype(dtype))
    np.save(folder / "events/00001.npy", EVENTS[4:].astype(dtype))
    rows = zip(POSE_TIMES.tolist(), poses().tolist(), strict=True)
    (folder / "0_poses_all.txt").write_text(
        "# timestamp_ns px py pz qx qy qz qw\n" + "".join(f"{t} {' '.join(map(repr, pose))}\n" for t, pose in rows)
    )
    llff = np.tile(np.column_stack([np.eye(3, 4), [HEIGHT, WIDTH, 20.0]]).ravel(), (11, 1))
    np.save(folder / "poses_bounds.npy", np.column_stack([llff, np.linspace(0.5, 0.6, 11), np.linspace(3, 4, 11)]))
    for name in frames:
        (folder / name).mkdir()
        (folder / name / "image_stamps_ns.txt").write_text("".join(f"{t}\n" for t in FRAME_TIMES))
        for i in range(len(FRAME_TIMES)):
            write_image(folder / name / f"{i:05d}.png", image(i + 10 * (name != "images"), channels))
    if depth:
        (folder / "depth").mkdir()
        for i in range(len(FRAME_TIMES)):
            np.save(folder / f"depth/{i:05d}.npy", np.full((HEIGHT, WIDTH), 1.0 + i, np.float32))
    return folder


def changed(
    recording: EventRecording, zero: int = 0, origin: float = 0.0, slower: int = 1, faster: int = 1
) -> EventRecording:
    """The recording on a clock that shows `zero` (ns) at its begin, in a world that begins elsewhere, and slower."""

    def moved(times: np.ndarray) -> np.ndarray:
        return (times - recording.trajectory.start) * slower // faster + zero

    old = recording.trajectory
    positions = old.positions + origin * np.array([0.6, -0.8, 0.1])
    trajectory = Trajectory(moved(old.times), positions, old.quaternions)

    def frames(old: Frames | None) -> Frames | None:
        exposures = None if old is None or old.exposures is None else old.exposures * slower // faster
        return old and replace(old, times=moved(old.times), trajectory=trajectory, exposures=exposures)

    return replace(
        recording,
        trajectory=trajectory,
        stream_events=lambda: (Events(e.x, e.y, moved(e.t), e.p) for e in recording.stream_events()),
        frames=frames(recording.frames),
        blurred_frames=frames(recording.blurred_frames),
    )


def write_event_recording(recording: EventRecording, folder: Path) -> Path:
    folder.mkdir()
    event_recording.write(recording, folder)
    return folder
